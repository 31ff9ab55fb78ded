"""Speed of the kernel: 20 s of the SMIB with ST1A and stabiliser at h = 5 ms, with trace, a fault and its clearing.

In CasADi's virtual machine and as C, alternating in one process; then what a person waits for: import, --help, a run and its
record.

Run: python tools/bench/kernel.py [--repeats 30]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from pgexcite.core.config import load
from pgexcite.core.simulate import Simulation

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs" / "smib"
T_END = 20.0


def measure(simulations: dict[str, Simulation], repeats: int) -> dict[str, dict[str, float]]:
    """Thread CPU and wall time per step, medians over runs that alternate, us; the trace's assembly counts."""
    cpu: dict[str, list[float]] = {name: [] for name in simulations}
    wall: dict[str, list[float]] = {name: [] for name in simulations}
    for _ in range(repeats):
        for name, simulation in simulations.items():
            simulation.restart()
            began_cpu, began = time.thread_time(), time.perf_counter()
            simulation.run()
            simulation.trace()
            cpu[name].append(time.thread_time() - began_cpu)
            wall[name].append(time.perf_counter() - began)
    found = {}
    for name, simulation in simulations.items():
        steps = simulation.state.k
        found[name] = {
            "steps": steps,
            "cpu_us_per_step": 1e6 * statistics.median(cpu[name]) / steps,
            "cpu_us_per_step_p99": 1e6 * float(np.percentile(cpu[name], 99)) / steps,
            "wall_us_per_step": 1e6 * statistics.median(wall[name]) / steps,
            "times_real_time": T_END / statistics.median(wall[name]),
        }
    return found


def wait(*command: str, repeats: int = 5) -> float:
    """Median wall time of a process, s."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        subprocess.run([sys.executable, *command], check=True, capture_output=True)
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def main() -> None:
    """Measure and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=30)
    repeats = parser.parse_args().repeats
    scenario = load(CONFIGS / "fault_st1a.toml", [f"simulation.t_end={T_END}"])
    simulations = {
        name: Simulation(scenario.system, replace(scenario.settings, compile=how), scenario.changes)
        for name, how in (("virtual machine", "never"), ("C", "always"))
    }
    with tempfile.TemporaryDirectory() as folder:
        figures = {
            "machine": f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}",
            "load": os.getloadavg(),
            "stepping": measure(simulations, repeats),
            "import pgexcite [s]": wait("-c", "import pgexcite"),
            "pgexcite --help [s]": wait("-m", "pgexcite", "--help"),
            **{
                f"pgexcite run {name} [s]": wait(
                    "-m", "pgexcite", "run", str(CONFIGS / name), "--out", f"{folder}/{name}", repeats=3
                )
                for name in ("fault_constant.toml", "fault_st1a.toml", "fault_nmpc.toml")
            },
        }
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
