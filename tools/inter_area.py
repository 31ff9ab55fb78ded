"""The two areas under predictive control and under stabilisers: the picture of docs/inter_area.md.

Run: python tools/inter_area.py [OUT]
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite import load
from pgexcite.core.trace import Trace
from pgexcite.studies.figures import COLOURS, figure, save

CONFIGS = Path(__file__).parents[1] / "configs" / "two_area"
ONE_MOVE = ("controller.mpc.N_c=1",)
PAPERS = tuple(f"controller.G{k}.P=5.0" for k in (1, 2, 3, 4))

STEPS: Mapping[str, tuple[str, Sequence[str]]] = {
    "stabilisers": ("thyristor_pss", ()),
    "nmpc, one move": ("step_nmpc", ONE_MOVE),
    "nmpc": ("step_nmpc", ()),
    "linear": ("step_linear", ()),
    "equivalent": ("step_equivalent", ()),
}
FAULT: Mapping[str, tuple[str, Sequence[str]]] = {
    "stabilisers": ("fault_thyristor_pss", ()),
    "nmpc, one move": ("fault_nmpc", ONE_MOVE),
    "nmpc": ("fault_nmpc", ()),
    "linear": ("fault_linear", ()),
    "equivalent": ("fault_equivalent", ()),
    "equivalent, P = 5": ("fault_equivalent", PAPERS),
}


def run(name: str, overrides: Sequence[str]) -> Trace:
    """The trace of a scenario."""
    scenario = load(CONFIGS / f"{name}.toml", overrides)
    simulation = scenario.simulation()
    simulation.run()
    return simulation.trace()


def draw(ax: Any, runs: Mapping[str, tuple[str, Sequence[str]]], limits: tuple[float, float], title: str) -> None:
    """The angle between the areas in each run; one that lost synchronism leaves the picture."""
    for (label, (name, overrides)), colour in zip(runs.items(), COLOURS, strict=False):
        trace = run(name, overrides)
        ax.plot(trace.t, np.degrees(trace["unit.G1.delta"] - trace["unit.G3.delta"]), color=colour, lw=1.3, label=label)
    ax.set_ylim(*limits)
    ax.set_ylabel(r"$\delta_1 - \delta_3$ [deg]")
    ax.set_title(title, fontsize=10, loc="left")
    ax.legend(fontsize=8, frameon=False, ncols=3)


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", nargs="?", type=Path, default=Path("out"))
    out = parser.parse_args().out
    drawn, axes = figure(8.0, 7.0, 2)
    draw(axes[0], STEPS, (5.0, 35.0), "Steps of the voltage references, +3, -1, -3, +1 %")
    draw(axes[1], FAULT, (-60.0, 190.0), "Bolted fault at bus 7 for 0.1 s, cleared by opening a circuit 7-8")
    axes[1].set_xlabel("t [s]")
    save(drawn, out / "inter_area.png")


if __name__ == "__main__":
    main()
