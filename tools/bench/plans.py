"""Plans for the regional system's five machines, over 10 s and over 100 s, in C and in CasADi's virtual machine.

The link has tripped two seconds ago; the model is the plant itself, with its tap changers, recovering load and limiters. Intervals
grow geometrically, and the prediction's steps with them. Three things are timed, each from the same state:

- prediction: the rollout with its exact sensitivities;
- iteration: that, the condensed program and its solution, which is what a real-time iteration takes;
- plan: from holding the commands until the plan has converged to 1e-4 pu of a set-point.

How much the steps cost is told by the same plan on steps of 20 ms, the simulation's own.

Run: python tools/bench/plans.py [--passes 30]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq

from pgexcite.core.condensed import Linearised
from pgexcite.core.config import load
from pgexcite.core.controller import Sample
from pgexcite.core.simulate import Simulation

CONFIGS = Path(__file__).parents[2] / "configs" / "regional"
UNTIL = 12.0
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Case:
    """One controller and one horizon.

    Attributes:
        config: scenario with the controller.
        seconds: length of the horizon, s.
        dt: first interval, s.
        N_p: number of intervals.
        N_c: number of moves.
        step: first prediction step, s.
        R: weight on the move: such that no bound is met, or a command would hide what the steps cost.
    """

    config: str
    seconds: float
    dt: float
    N_p: int
    N_c: int
    R: float
    step: float = 0.2

    @property
    def growth(self) -> float:
        """Ratio of consecutive intervals that makes them add up to the horizon."""
        return float(brentq(lambda g: self.dt * sum(g**k for k in range(self.N_p)) - self.seconds, 1.0, 3.0))

    @property
    def name(self) -> str:
        """What it is called in the table."""
        return f"{self.config.rpartition('_')[2]}, {self.seconds:g} s, {self.N_c} move{'s' * (self.N_c > 1)}"


SECONDARY, PRIMARY = "link_loss_nmpc_secondary", "link_loss_nmpc_primary"
CASES = [
    Case(config, *horizon, N_c, R)
    for horizon in ((10.0, 1.0, 8), (100.0, 1.0, 24))
    for config, N_c, R in ((SECONDARY, 1, 1000.0), (SECONDARY, 5, 1000.0), (PRIMARY, 5, 0.1))
]


class Planner:
    """A case's solver two seconds after the link has tripped."""

    def __init__(self, case: Case, compiled: str, step: float) -> None:
        changes = {"dt": case.dt, "N_p": case.N_p, "N_c": case.N_c, "R": case.R, "growth": case.growth}
        options = f'{{mode="converged", step={step}, max_iterations=30, tolerance={TOLERANCE}}}'
        overrides = [f"controller.mpc.{key}={value}" for key, value in (changes | {"options": options}).items()]
        scenario = load(CONFIGS / f"{case.config}.toml", [f"simulation.t_end={UNTIL}", *overrides])
        settings = replace(scenario.settings, compile=compiled)
        simulation = Simulation(scenario.system, settings, scenario.changes, scenario.controllers)
        self.solver: Any = simulation.sessions["mpc"].solver
        # Its plans are made in C as a whole; here the prediction is measured by itself as well.
        self.solver.predictor.make_ready()
        # The run without the controller: its commands are where they were.
        free = Simulation(scenario.system, settings, scenario.changes, {})
        free.run()
        self.sample = Sample(UNTIL, {}, True, free.state, free.p)
        self.u_last = free.state.u[self.solver.predictor.commands]
        self.hold = np.tile(self.u_last, (case.N_c, 1))
        self.states, self.unknowns = len(free.model.x_names), len(free.model.z_names)

    @property
    def steps(self) -> int:
        """Steps of a prediction."""
        return int(self.horizon().counts.sum())

    def horizon(self) -> Any:
        """The horizon from the sample on."""
        return self.solver.horizons.at(UNTIL, self.sample.state.u, self.sample.p)

    def prediction(self) -> Any:
        """The rollout with its sensitivities."""
        return self.solver.predictor.roll(self.sample.state, self.hold, self.horizon(), derivatives=True)

    def iteration(self) -> Any:
        """A prediction, the program around it and its solution."""
        rollout = self.prediction()
        at = Linearised(rollout.y, rollout.dy, self.solver.problem.references(UNTIL))
        return self.solver.condensed.direction(at, self.hold, self.u_last)

    def plan(self) -> Any:
        """A plan that has converged, from holding the commands."""
        self.solver.recall({})
        return self.solver.solve(self.sample, self.u_last)


def measured(call: Callable[[], Any], times: list[float]) -> None:
    """Call, and note what it took of the thread's time, ms."""
    began = time.thread_time()
    call()
    times.append(1e3 * (time.thread_time() - began))


def row(case: Case, how: str, planner: Planner, reference: Planner, times: dict[str, list[float]]) -> dict[str, Any]:
    """A row of the table."""
    found, best = planner.plan(), reference.plan()
    assert found.status.usable
    assert best.status.usable
    ours, exact = planner.prediction(), reference.prediction()
    figures: dict[str, Any] = {"case": case.name, "runs as": how, "steps": planner.steps}
    for name, values in times.items():
        figures |= {
            f"{name}, ms": round(float(np.median(values)), 2),
            f"{name} p99": round(np.percentile(values, 99), 2),
        }
    return figures | {
        "programs": found.iterations,
        "error of outputs": float(f"{np.abs(ours.y - exact.y).max():.1e}"),
        "of sensitivities": float(f"{np.abs(ours.dy - exact.dy).max() / np.abs(exact.dy).max():.1e}"),
        "of the first command": float(f"{np.abs(found.u[0] - best.u[0]).max():.1e}"),
    }


def main() -> None:
    """Measure and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--passes", type=int, default=30)
    passes, rows = parser.parse_args().passes, []
    for case in CASES:
        reference = Planner(case, "wait", 0.02)
        planners = {"C": Planner(case, "wait", case.step), "virtual machine": Planner(case, "never", case.step)}
        times: dict[str, dict[str, list[float]]] = {how: {} for how in planners}
        for k in range(passes):
            for how, planner in planners.items():
                if how != "C" and k % 6:
                    continue
                for name in ("prediction", "iteration", "plan"):
                    measured(getattr(planner, name), times[how].setdefault(name, []))
        rows += [row(case, how, planner, reference, times[how]) for how, planner in planners.items()]
    size = f"{reference.states} states, {reference.unknowns} algebraic unknowns"
    about = {"machine": f"{platform.machine()}, {os.cpu_count()} processors", "load": os.getloadavg(), "model": size}
    print(json.dumps(about | {"rows": rows}, indent=1))
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for line in rows:
        print("| " + " | ".join(str(value) for value in line.values()) + " |")


if __name__ == "__main__":
    main()
