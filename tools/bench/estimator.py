"""The estimator of the equivalent and the NMPC on it: what a sample of a closed loop costs, and what filterpy alone would.

The loop is configs/smib/fault_equivalent.toml (50 ms, N_p = 5, N_c = 1, 1 % of noise, a fault of 0.1 s); times are thread CPU.
An estimator's sample is one prediction, one update and what it tells of itself; where the network has changed it tries up to
three updates, and those samples are counted apart. filterpy's own filter gets the same functions, a Python call for each sigma
point. The exported C replays the same loop.

Run: python tools/bench/estimator.py [--passes 30]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import ctypes
import gc
import json
import platform
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from filterpy.kalman import UnscentedKalmanFilter

from pgexcite.core import compiling
from pgexcite.core.config import Scenario, load
from pgexcite.core.export import export_c
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.estimators.mapped_filter import SigmaPoints

CONFIG = Path(__file__).parents[2] / "configs" / "smib" / "fault_equivalent.toml"
DT = 0.05


class Timed:
    """A function that keeps the thread CPU time of its calls, us."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self.times: list[float] = []
        self.results: list[Any] = []

    def __call__(self, *args: Any) -> Any:
        began = time.thread_time_ns()
        result = self._function(*args)
        self.times.append((time.thread_time_ns() - began) / 1e3)
        self.results.append(result)
        return result


def loop(simulation: Simulation) -> dict[str, list[float]]:
    """Times of one pass: estimator (plain samples, changes of the network), NMPC, both together."""
    simulation.restart()
    solver = simulation._running["mpc"].session.solver
    observe, solve = Timed(solver._observer.observe), Timed(solver.solve)
    solver._observer.observe, solver.solve = observe, solve
    simulation.run()
    changed = [estimate.diagnostics["network_change"] != 0 for estimate in observe.results]
    return {
        "estimator": [t for t, c in zip(observe.times, changed, strict=True) if not c],
        "estimator, network changed": [t for t, c in zip(observe.times, changed, strict=True) if c],
        "NMPC": [both - own for both, own in zip(solve.times, observe.times, strict=True)],
        "estimator + NMPC": solve.times,
    }


class Controller:
    """The exported controller as a library, and what it was told in the closed loop."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        export_c(scenario, folder)
        compiler = compiling.compiler()
        assert compiler is not None
        command = [compiler, "-std=c99", "-O1", "-ffp-contract=off", "-fPIC", "-shared", "mpc.c", "-o", "mpc.so", "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        self._library = ctypes.CDLL(str(folder / "mpc.so"))
        lines = (folder / "replay.txt").read_text().splitlines()
        self._inputs = [_input([float(word) for word in line.split()]) for line in lines]

    def loop(self) -> dict[str, list[float]]:
        """Times of one pass."""
        output = (ctypes.c_double * 32)()
        step = Timed(self._library.mpc_step)
        self._library.mpc_reset()
        for item in self._inputs:
            step(ctypes.byref(item), output)
            self._library.mpc_prepare(output)
        return {"estimator + NMPC (exported C)": step.times}


class _Input(ctypes.Structure):
    _fields_ = (
        ("t", ctypes.c_double),
        ("active", ctypes.c_int),
        ("measured", ctypes.c_double * 5),
        ("u_last", ctypes.c_double),
    )


def _input(numbers: list[float]) -> _Input:
    return _Input(numbers[0], int(numbers[1]), (ctypes.c_double * 5)(*numbers[2:7]), numbers[7])


def stock(simulation: Simulation, samples: int) -> dict[str, list[float]]:
    """Predict and update of filterpy's own filter on the same functions, us."""
    simulation.restart()
    equivalent = simulation._running["mpc"].session.solver._equivalent
    propagate, sense = equivalent.functions(DT, 2)
    n = equivalent.layout.size
    kalman = UnscentedKalmanFilter(
        n,
        4,
        DT,
        hx=lambda x: np.array(sense(x, 1.92)).ravel(),
        fx=lambda x, _dt: np.array(propagate(x, 1.92)).ravel(),
        points=SigmaPoints(n),
    )
    kalman.x, kalman.P, kalman.Q = equivalent.start.copy(), 1e-6 * np.eye(n), 1e-8 * np.eye(n)
    kalman.R = np.diag([1e-4, 1e-4, 1e-4, 1e-8])
    z = np.array(sense(equivalent.start, 1.92)).ravel()
    predict, update = Timed(kalman.predict), Timed(kalman.update)
    for _ in range(samples):
        predict()
        update(z)
    return {"filterpy alone": [a + b for a, b in zip(predict.times, update.times, strict=True)]}


def main() -> None:
    """Measure and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--passes", type=int, default=30)
    passes = parser.parse_args().passes
    scenario = load(CONFIG, ["simulation.t_end=3"])
    simulations = {
        name: Simulation(
            scenario.system, replace(scenario.settings, compile=how), scenario.changes, scenario.controllers
        )
        for name, how in (("C", "always"), ("virtual machine", "never"))
    }
    times: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        controller = Controller(scenario, Path(folder))
    gc.freeze()
    for _ in range(passes):
        for name, simulation in simulations.items():
            for what, found in loop(simulation).items():
                times.setdefault(f"{what} ({name})", []).extend(found)
        for what, found in controller.loop().items():
            times.setdefault(what, []).extend(found)
    times |= stock(simulations["virtual machine"], 60)
    rows = {
        name: {
            "samples": len(found),
            "median_us": round(float(np.median(found)), 1),
            "p99_us": round(float(np.percentile(found, 99)), 1),
            "max_us": round(max(found), 1),
        }
        for name, found in times.items()
    }
    about = {"machine": f"{platform.machine()}, {os.cpu_count()} processors", "load": os.getloadavg(), "rows": rows}
    print(json.dumps(about, indent=1))
    print("| thread CPU, us | samples | median | p99 | max |\n|---|---|---|---|---|")
    for name, row in rows.items():
        print(f"| {name} | " + " | ".join(str(value) for value in row.values()) + " |")


if __name__ == "__main__":
    main()
