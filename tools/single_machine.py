"""The single machine: pictures like figures 5, 8 and 9 of the paper, and their tables, for docs/mpc.md.

Runs of a fault end 7 s after it. Run: python tools/single_machine.py [OUT]
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.config import load
from pgexcite.core.trace import Trace
from pgexcite.studies.figures import draw_runs
from pgexcite.studies.measures import swing_figures
from pgexcite.studies.sweep import NOMINAL, cases

CONFIGS = Path(__file__).parents[1] / "configs"
UNIT = "G2"


@dataclass(frozen=True)
class Run:
    """A scenario, and what is overridden in it."""

    path: Path
    overrides: tuple[str, ...] = ()


def published(name: str) -> Run:
    """A scenario as it stands; a fault for 8 s, with instruments that do not err."""
    exact = ("controller.mpc.measurement.noise=0.0", "controller.mpc.measurement.noise_omega=0.0")
    length = ("simulation.t_end=8",) if name.startswith("fault") else ()
    return Run(CONFIGS / "smib" / f"{name}.toml", length + (exact if name.startswith("fault_equivalent") else ()))


def of_study(name: str) -> dict[str, Run]:
    """The nominal runs of a study, by variant."""
    _, found = cases(CONFIGS / "studies" / f"{name}.toml")
    return {case.variant: Run(case.path, case.overrides) for case in found if case.factor == NOMINAL}


def figures() -> dict[str, tuple[str, Mapping[str, Run], tuple[float, float]]]:
    """Name of a picture -> title, its runs by label, and the time it shows, s."""
    fed, own = of_study("mismatch"), of_study("mismatch_own_supply")
    names = ("nmpc", "linear", "equivalent")
    return {
        "figure_5": (
            "Open-circuit voltage steps of +-5 %",
            {name: published(f"open_circuit_{name}") for name in ("st1a", *names)},
            (0.5, 9.0),
        ),
        "figure_8_9": (
            "Three-phase arc fault of 0.1 s, published weights, every field fed from the terminals",
            {
                "constant field": published("fault_constant"),
                "ST1A + PSS": fed["st1a_pss"],
                **{name: fed[name] for name in names},
            },
            (0.8, 4.5),
        ),
        "figure_8_9_published": (
            "The same fault, published bounds of +-3.2: all but the ST1A on a supply of their own",
            {
                "constant field": published("fault_constant"),
                "ST1A + PSS": published("fault_st1a"),
                "SEXS + PSS": own["sexs_pss"],
                **{name: published(f"fault_{name}") for name in names},
            },
            (0.8, 4.5),
        ),
        "figure_8_9_known": (
            "The same fault, known in advance, published bounds on a supply of its own",
            {
                f"{name}, {said}": published(f"fault_{name}{more}")
                for name in ("nmpc", "linear")
                for said, more in (("not known", ""), ("known", "_known"))
            },
            (0.6, 4.5),
        ),
        "damped": (
            "The same fault, weights that damp the swing, every field fed from the terminals",
            {
                "ST1A + PSS": fed["st1a_pss"],
                "ST1A + PSS, tuned": fed["st1a_tuned"],
                **{name: fed[f"{name}_damped"] for name in names},
            },
            (0.8, 6.0),
        ),
    }


COLUMNS = {
    "first_swing_deg": "{:.2f}", "recovery_5": "{:.2f}", "recovery_1": "{:.2f}", "iae": "{:.3f}", "damping": "{:.3f}",
    "control_energy": "{:.2f}", "overshoot_percent": "{:.1f}", "back_percent": "{:.1f}", "settled": "{:.3f}",
}  # fmt: skip


def trace_of(run: Run) -> Trace:
    """One run."""
    simulation = load(run.path, run.overrides).simulation()
    simulation.run()
    return simulation.trace()


def swing(trace: Trace) -> dict[str, Any]:
    """Figures of the swing after a fault."""
    v = trace[f"unit.{UNIT}.v_t"]
    return {**swing_figures(trace, UNIT), "iae": float(np.trapezoid(np.abs(v - v[0]), trace.t))}


def steps(trace: Trace) -> dict[str, Any]:
    """The worse figures of the two voltage steps (at 1 s from 0.95 to 1 pu, at 6 s back), each against the value it ends at."""
    v, found = trace[f"unit.{UNIT}.v_t"], []
    for begins, ends in ((1.0, 6.0), (6.0, trace.t[-1])):
        during = (trace.t > begins + 1e-9) & (trace.t < ends - 1e-9)
        before = float(v[trace.t < begins - 1e-9][-1])
        found.append(step(trace.t[during] - begins, v[during] - before))
    return {key: max(one[key] for one in found) for key in found[0]}


def step(t: NDArray[np.float64], v: NDArray[np.float64]) -> dict[str, float]:
    """Overshoot and swing back, per cent of a step of ``v`` from 0, and when it stays within 5 % of where it ends, s."""
    moved = v / v[-1]
    peak = int(moved.argmax())
    outside = t[np.abs(moved - 1) > 0.05]
    return {
        "overshoot_percent": 100 * float(moved[peak] - 1),
        "back_percent": 100 * float(1 - moved[peak:].min()),
        "settled": float(outside[-1]),
    }


def table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Rows as Markdown, without columns that nobody has."""
    columns = [key for key in COLUMNS if any(row.get(key) is not None for row in rows.values())]
    lines = ["| run | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, row in rows.items():
        cells = ["-" if row.get(key) is None else COLUMNS[key].format(row[key]) for key in columns]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(out: Path) -> None:
    """All pictures into a directory, their tables on standard output."""
    for name, (title, runs, window) in figures().items():
        traces = {label: trace_of(run) for label, run in runs.items()}
        stepped = name == "figure_5"
        signals = ("e_fd", "v_t") if stepped else ("e_fd", "v_t", "delta", "omega")
        draw_runs(traces, [UNIT], out / f"{name}.png", title, window, signals)
        rows = {label: (steps if stepped else swing)(trace) for label, trace in traces.items()}
        print(f"\n{name}\n\n{table(rows)}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/single_machine"))
    main(parser.parse_args().out)
