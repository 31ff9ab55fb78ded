"""The two-area system with a fault of 0.1 s: time per step in CasADi's virtual machine and as C, side by side with ANDES.

ANDES (GPL-3.0) is wanted for this comparison only and never imported here: it runs in an interpreter of its own, its kundur_full
case with the same fault, step, trapezoidal rule and tolerance. The runs take turns, so that all see the same machine. What is timed
is the integration alone, recording included: loading, power flow and compilation are left out on all sides.

Run: python tools/bench/two_area.py [--andes /path/to/python/with/andes] [--runs 5] [--t-end 10]
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
from pathlib import Path

from pgexcite.core.config import load
from pgexcite.core.simulate import Simulation

CASE = Path(__file__).parents[2] / "tests" / "validation" / "two_area" / "andes_fault7.toml"
H = 1 / 120
TOLERANCE = 1e-8

ANDES = f"""
import json, sys, time
import andes
andes.config_logger(50)
t_end = float(sys.argv[1])
# Whatever a first run prepares is left out: the second is timed.
for _ in range(2):
    system = andes.load(andes.get_case("kundur/kundur_full.xlsx"), setup=False, no_output=True, default_config=True)
    system.Toggle.u.v[:] = [0.0] * len(system.Toggle.u.v)
    if system.Fault.n:
        system.Fault.u.v[:] = [0.0] * len(system.Fault.u.v)
    system.add("Fault", dict(bus=7, tf=1.0, tc=1.1, xf=1e-4, rf=0.0, u=1))
    system.setup()
    system.PFlow.run()
    config = system.TDS.config
    config.tf, config.tstep, config.fixt, config.shrinkt, config.tol, config.no_tqdm = t_end, {H!r}, 1, 1, {TOLERANCE!r}, 1
    system.TDS.init()
    began = time.perf_counter()
    done = system.TDS.run()
    spent = time.perf_counter() - began
steps = len(system.dae.ts.t)
print(json.dumps(dict(version=andes.__version__, converged=bool(done), steps=steps, microseconds=1e6 * spent / steps)))
"""


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--andes", help="interpreter that has ANDES; without it only our own times are taken")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--t-end", type=float, default=10.0)
    return parser.parse_args()


def ours(simulation: Simulation) -> float:
    """Microseconds a step of one run from the start."""
    simulation.restart()
    outcome = simulation.run()
    if outcome.ending.value != "completed":
        raise SystemExit(f"the run ended as {outcome}")
    return 1e6 * simulation.wall_time / simulation.state.k


def andes(interpreter: str, t_end: float) -> dict[str, float]:
    """One run of ANDES in its own interpreter."""
    done = subprocess.run([interpreter, "-c", ANDES, str(t_end)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{interpreter} could not run ANDES:\n{done.stderr.strip()}")
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Take turns and print the figures as JSON."""
    told = arguments()
    found: dict[str, list[float]] = {}
    settings = [f"simulation.h={H!r}", 'simulation.rule="trapezoidal"', f"simulation.t_end={told.t_end!r}"]
    plants = {}
    for name, compiled in (("vm", "never"), ("c", "always")):
        scenario = load(CASE, [*settings, f'simulation.compile="{compiled}"'])
        plants[name] = Simulation(scenario.system, scenario.settings, scenario.changes)
    facts: dict[str, object] = {
        "machine": platform.processor() or platform.machine(),
        "python": platform.python_version(),
    }
    model = plants["vm"].model
    facts |= {"states": len(model.x_names), "algebraic": len(model.z_names), "h": H, "steps": round(told.t_end / H)}
    for _ in range(told.runs):
        for name, simulation in plants.items():
            found.setdefault(name, []).append(ours(simulation))
        if told.andes:
            run = andes(told.andes, told.t_end)
            found.setdefault("andes", []).append(run["microseconds"])
            facts["andes"] = {key: run[key] for key in ("version", "converged", "steps")}
    medians = {name: statistics.median(times) for name, times in found.items()}
    facts["microseconds_per_step"] = {
        name: {"median": round(medians[name], 2), "min": round(min(times), 2), "max": round(max(times), 2)}
        for name, times in found.items()
    }
    if "andes" in medians:
        facts["times_faster_than_andes"] = {name: round(medians["andes"] / medians[name], 1) for name in plants}
    print(json.dumps(facts, indent=2))


if __name__ == "__main__":
    main()
