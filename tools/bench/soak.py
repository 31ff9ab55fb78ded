"""A long paced run: how often a controller misses its period, how late at worst, and whether memory stays flat.

Every 10 s of simulated time a fault of 0.1 s strikes, so that the solver's expensive samples are in the tail; old samples are
dropped.

Run: python tools/bench/soak.py [--config configs/smib/fault_nmpc.toml] [--steps 100000] [--period 0.005] [--budget SECONDS]
     [--priority 50] [--lock-memory] [--core 1] [--gc off]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
from pathlib import Path

from pgexcite.core.config import load
from pgexcite.core.events import Change, Fault
from pgexcite.core.realtime import RealtimeOptions, run_paced
from pgexcite.core.simulate import Simulation

ROOT = Path(__file__).parents[2]
KEEP = 20.0
BETWEEN_FAULTS = 10.0


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=ROOT / "configs" / "smib" / "fault_nmpc.toml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="PATH=VALUE")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--period", type=float, default=0.005, help="s")
    parser.add_argument(
        "--budget", type=float, default=0.0, help="wall time, s; fewer steps are taken where it is short"
    )
    parser.add_argument("--priority", type=int, default=0)
    parser.add_argument("--lock-memory", action="store_true")
    parser.add_argument("--core", type=int)
    parser.add_argument("--gc", dest="garbage", choices=["on", "frozen", "off"], default="on")
    return parser.parse_args()


def faults(bus: str, until: float) -> list[Change]:
    """A fault of 0.1 s every ten seconds."""
    changes: list[Change] = []
    for k in range(int(until / BETWEEN_FAULTS)):
        changes += Fault(type="fault", t=1.0 + k * BETWEEN_FAULTS, bus=bus, R=0.02, duration=0.1).changes()
    return changes


def main() -> None:
    """Run and print the figures as JSON."""
    told = arguments()
    scenario = load(told.config, told.overrides)
    steps = min(told.steps, int(told.budget / told.period)) if told.budget else told.steps
    dt = min(controller.dt for controller in scenario.controllers.values())
    changes = faults("HV", steps * dt)
    simulation = Simulation(scenario.system, scenario.settings, changes, scenario.controllers)
    options = RealtimeOptions(
        period=told.period,
        steps=steps,
        priority=told.priority,
        lock_memory=told.lock_memory,
        core=told.core,
        garbage=told.garbage,
        keep=KEEP,
    )
    before = resource.getrusage(resource.RUSAGE_SELF)
    timing = run_paced(simulation, options)
    after = resource.getrusage(resource.RUSAGE_SELF)
    figures = timing.summary()
    for phase in ("wake_up_ms", "solve_ms", "response_ms", "work_ms"):
        figures[phase].pop("histogram")
    assert simulation.outcome is not None
    print(
        json.dumps(
            {
                "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors",
                "load": os.getloadavg(),
                "outcome": simulation.outcome.ending.value,
                "simulated": simulation.state.t,
                "fallbacks": {name: item.fallbacks for name, item in simulation.result().controllers.items()},
                "preempted": after.ru_nivcsw - before.ru_nivcsw,
                "major_faults": after.ru_majflt - before.ru_majflt,
                "memory": [[j, round(mib, 2)] for j, mib in timing.memory[:: max(1, len(timing.memory) // 10)]],
                **figures,
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
