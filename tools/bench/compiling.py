"""Where generated C pays: what the compiler takes for a run's libraries, and what a run takes with them and without.

Each scenario runs in CasADi's virtual machine and as C with an empty cache, CPU times. For each library: the operations of its
functions (the point up to which ``compile = "auto"`` waits is counted in these) and the compiler's time. For the plant alone: how
many steps it takes until the compiler's time is saved.

Run: python tools/bench/compiling.py [SCENARIO ...]
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
import resource
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core import mapped, prediction, step
from pgexcite.core.config import load
from pgexcite.core.initialise import initialise
from pgexcite.core.simulate import Simulation
from pgexcite.core.step import Kernel

CONFIGS = Path(__file__).parents[2] / "configs"
SCENARIOS = (
    "smib/fault_constant.toml",
    "smib/fault_st1a.toml",
    "smib/fault_nmpc.toml",
    "smib/fault_linear.toml",
    "two_area/thyristor_pss.toml",
    "two_area/step_nmpc.toml",
    "two_area/step_equivalent.toml",
    "two_area/step_linear.toml",
    "regional/link_loss.toml",
    "regional/link_loss_nmpc_secondary.toml",
)


def spent(who: int) -> float:
    """CPU time of this process, or of those it has waited for, s."""
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


class Libraries:
    """Watches what is generated and compiled."""

    def __init__(self) -> None:
        self.operations: dict[str, int] = {}
        self.built: list[dict[str, float]] = []
        self._generate, self._build = step.generate, step.build
        for module in (step, prediction):
            module.generate = self.generate  # type: ignore[attr-defined]
        for module in (step, prediction, mapped):
            module.build = self.build  # type: ignore[attr-defined]

    def generate(self, functions: Any, *others: Any) -> str:
        source = self._generate(functions, *others)
        self.operations[source] = sum(function.n_instructions() for function in functions)
        return source

    def build(self, source: str, **options: Any) -> Path | None:
        began = spent(resource.RUSAGE_CHILDREN)
        library = self._build(source, **options)
        took = spent(resource.RUSAGE_CHILDREN) - began
        if took > 0.01:  # else it was there already
            found = {"operations": self.operations[source]} if source in self.operations else {}
            self.built.append({**found, "lines": source.count("\n"), "compiler_s": round(took, 2)})
        return library


def whole_run(scenario: Any, libraries: Libraries) -> dict[str, Any]:
    """CPU time of a run and of the compiler, s, with an empty cache."""
    found: dict[str, Any] = {}
    for name, how in (("virtual machine", "never"), ("C", "always")):
        libraries.built.clear()
        with tempfile.TemporaryDirectory() as folder:
            os.environ["PGEXCITE_CACHE"] = folder
            settings = replace(scenario.settings, compile=how)
            simulation = Simulation(scenario.system, settings, scenario.changes, scenario.controllers)
            began = spent(resource.RUSAGE_SELF)
            simulation.run()
            found[f"run in {name} [s]"] = round(spent(resource.RUSAGE_SELF) - began, 2)
    return {"steps": simulation.state.k, **found, "libraries": list(libraries.built)}


def plant(scenario: Any, repeats: int = 7, n: int = 200) -> dict[str, float]:
    """Thread CPU time per step next to rest, medians of turns, us, and the steps after which the compiler's time is saved."""
    initial = initialise(scenario.system)
    state = initial.state.with_(x=initial.state.x * (1 + 1e-3 * np.sin(np.arange(initial.state.x.size))))
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PGEXCITE_CACHE"] = folder
        began = spent(resource.RUSAGE_CHILDREN)
        kernels = [Kernel(initial.model, initial.state, initial.p, how) for how in ("never", "always")]
        compiler = spent(resource.RUSAGE_CHILDREN) - began
        times: list[list[float]] = [[], []]
        for _ in range(repeats):
            for kernel, found in zip(kernels, times, strict=True):
                began = time.thread_time()
                kernel.advance(state, initial.p, scenario.settings.rule, scenario.settings.h, n)
                found.append(1e6 * (time.thread_time() - began) / n)
    slow, fast = map(statistics.median, times)
    saved = round(1e6 * compiler / (slow - fast))
    return {"virtual machine [us]": round(slow, 1), "C [us]": round(fast, 1), "steps until it has paid": saved}


def main() -> None:
    """Measure and print the figures as JSON, a scenario a line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenarios", nargs="*", default=SCENARIOS)
    names = parser.parse_args().scenarios
    libraries = Libraries()
    for name in names:
        scenario = load(CONFIGS / name, [])
        print(json.dumps({"scenario": name, "plant": plant(scenario), **whole_run(scenario, libraries)}), flush=True)


if __name__ == "__main__":
    main()
