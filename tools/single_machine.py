"""The single machine: pictures like figures 5, 8 and 9 of the paper, and their tables, for docs/mpc.md.

Run: python tools/single_machine.py [OUT]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core.config import load
from pgexcite.core.trace import Trace
from pgexcite.studies.figures import draw_runs
from pgexcite.studies.measures import swing_figures

CONFIGS = Path(__file__).parents[1] / "configs" / "smib"
UNIT = "G2"
FIGURES = {
    "figure_5": (
        "Open-circuit voltage steps of +-5 %",
        {name: f"open_circuit_{name}" for name in ("st1a", "nmpc", "linear", "equivalent")},
        (0.5, 9.0),
    ),
    "figure_8_9": (
        "Three-phase arc fault of 0.1 s, published weights",
        {
            "constant field": "fault_constant",
            "ST1A + PSS": "fault_st1a",
            "nmpc": "fault_nmpc",
            "linear": "fault_linear",
            "equivalent": "fault_equivalent",
        },
        (0.8, 4.5),
    ),
    "figure_8_9_known": (
        "The same fault, known in advance",
        {
            "nmpc, not known": "fault_nmpc",
            "nmpc, known": "fault_nmpc_known",
            "linear, not known": "fault_linear",
            "linear, known": "fault_linear_known",
        },
        (0.6, 4.5),
    ),
    "damped": (
        "The same fault, weights that damp the swing",
        {
            "ST1A + PSS": "fault_st1a",
            "nmpc, published": "fault_nmpc",
            "nmpc": "fault_nmpc_damped",
            "linear": "fault_linear_damped",
            "equivalent": "fault_equivalent_damped",
        },
        (0.8, 6.0),
    ),
}
EXACT = ("controller.mpc.measurement.noise=0.0", "controller.mpc.measurement.noise_omega=0.0")
COLUMNS = {
    "first_swing_deg": "{:.2f}", "recovery_5": "{:.2f}", "recovery_1": "{:.2f}", "iae": "{:.3f}", "damping": "{:.3f}",
    "control_energy": "{:.2f}", "overshoot_percent": "{:.1f}", "settled": "{:.3f}",
}  # fmt: skip


def run(name: str) -> Trace:
    """One run, with instruments that do not err."""
    scenario = load(CONFIGS / f"{name}.toml", EXACT if name.startswith("fault_equivalent") else ())
    simulation = scenario.simulation()
    simulation.run()
    return simulation.trace()


def figures(trace: Trace, step: bool) -> dict[str, Any]:
    """Figures of a swing, or of the first of two voltage steps (at 1 s from 0.95 to 1 pu, the second at 6 s)."""
    v = trace[f"unit.{UNIT}.v_t"]
    if not step:
        return {**swing_figures(trace, UNIT), "iae": float(np.trapezoid(np.abs(v - v[0]), trace.t))}
    first = (trace.t >= 1.0) & (trace.t < 6.0 - 1e-9)
    outside = trace.t[first & (np.abs(v - 1.0) > 0.05 * 0.05)]
    return {"overshoot_percent": 100 * (v[first].max() - 1.0) / 0.05, "settled": outside[-1] - 1.0}


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Rows as Markdown, without columns that nobody has."""
    columns = [key for key in COLUMNS if any(row.get(key) is not None for row in rows.values())]
    lines = ["| run | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, row in rows.items():
        cells = ["-" if row.get(key) is None else COLUMNS[key].format(row[key]) for key in columns]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(out: Path) -> None:
    """All pictures into a directory, their tables on standard output."""
    for name, (title, runs, window) in FIGURES.items():
        traces = {label: run(config) for label, config in runs.items()}
        signals = ("e_fd", "v_t") if name == "figure_5" else ("e_fd", "v_t", "delta", "omega")
        draw_runs(traces, [UNIT], out / f"{name}.png", title, window, signals)
        rows = {label: figures(trace, name == "figure_5") for label, trace in traces.items()}
        print(f"\n{name}\n\n{table(rows)}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/single_machine"))
    main(parser.parse_args().out)
