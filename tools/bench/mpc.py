"""One predictive control problem, several solvers, one run: real-time iterations (Python and exported C), do-mpc, SLSQP.

The plant is the paper's, 0.1 s of arc fault inside; sample 50 ms, five steps of 10 ms to a sample, N moves for N samples. All
solvers get the same sequence of states, that of a closed loop under converged plans, and keep their own warm start; the exported C
replays the loop that it closes itself. Predictions are made in the plant's own steps and, where a row says so, in two steps of
25 ms to a sample. do-mpc transcribes the same equations by its own collocation. SLSQP is single shooting on the compiled prediction
with finite differences. How far a command is off is told against plans that have converged on steps of 2 ms.

Run: python tools/bench/mpc.py [--horizons 5 10 20] [--passes 30] [--compiled]      (do-mpc is left out where it is not installed)
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import contextlib
import ctypes
import gc
import importlib.util
import json
import platform
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from pgexcite.core import compiling
from pgexcite.core.config import load
from pgexcite.core.controller import Sample
from pgexcite.core.export import export_c
from pgexcite.core.prediction import Predictor
from pgexcite.core.simulate import Simulation

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "configs" / "smib" / "fault_nmpc.toml"
COMMAND = "unit.G2.exciter.e_fd_ref"
FAULT = "bus.HV.fault_status"
FINE, COARSE = 0.002, 0.025
CONVERGED = 'mode="converged", max_iterations=100, tolerance=1e-8'


@dataclass
class Times:
    """Times of one solver, s, and its first commands."""

    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    commands: list[float] = field(default_factory=list)

    def measure(self, call: Callable[[], Any]) -> Any:
        """Call, and note what it took."""
        cpu, wall = time.thread_time(), time.perf_counter()
        found = call()
        self.wall.append(time.perf_counter() - wall)
        self.cpu.append(time.thread_time() - cpu)
        return found

    def together(self, before: Times, call: Callable[[], Any]) -> None:
        """Call, and note what it took together with the last of ``before``."""
        own = Times()
        own.measure(call)
        self.cpu.append(before.cpu[-1] + own.cpu[0])
        self.wall.append(before.wall[-1] + own.wall[0])

    def row(self, reference: np.ndarray) -> dict[str, Any]:
        """Medians and tails, us, and how far the commands are from the converged ones, pu.

        The worst sample is the one whose median over the passes is largest: a tail without the noise of the machine. The first
        sample of a pass starts from nothing; a controller makes it before it is in charge. It is left out.
        """
        warm = np.arange(len(self.cpu)) % reference.size > 0
        off = np.abs(np.resize(reference, len(self.commands)) - self.commands)
        row: dict[str, Any] = {"samples": int(warm.sum())}
        by_sample = np.median(np.array(self.cpu).reshape(-1, reference.size), axis=0)
        row["cpu of the worst sample"] = round(1e6 * float(by_sample[1:].max()), 1)
        for name, found in (("cpu", self.cpu), ("wall", self.wall)):
            times = np.array(found)[warm]
            for label, q in (("median", 50), ("p99", 99), ("p99.9", 99.9)):
                row[f"{name} {label}"] = round(1e6 * float(np.percentile(times, q)), 1)
        if self.commands:
            row |= {"off median": float(f"{np.median(off):.1e}"), "off max": float(f"{off.max():.1e}")}
        return row


@dataclass(frozen=True)
class Contestant:
    """A solver, or a few measures of one, and how to take it through the sequence once."""

    times: dict[str, Times]
    once: Callable[[], None]
    passes: int


def scenario(N: int, t_end: float, **changes: Any) -> Any:
    """The paper's plant and fault with this horizon."""
    values = {"N_p": N, "N_c": N} | changes
    overrides = [f"controller.mpc.{key}={value}" for key, value in values.items()]
    return load(CONFIG, ["simulation.h=0.01", f"simulation.t_end={t_end}", "event.0.t=0.3", *overrides])


def prepared(N: int, t_end: float, **changes: Any) -> tuple[Simulation, Any]:
    """A simulation at its start, and its controller's solver."""
    chosen = scenario(N, t_end, **changes)
    simulation = chosen.simulation()
    return simulation, simulation.sessions["mpc"]


class Recorder:
    """Notes what a solver is asked and what it answers."""

    def __init__(self, solver: Any) -> None:
        self.solver, self.asked, self.answers = solver, [], []

    def solve(self, sample: Sample, u_last: np.ndarray) -> Any:
        solution = self.solver.solve(sample, u_last)
        self.asked.append((sample, u_last.copy()))
        self.answers.append(float(solution.u[0, 0]))
        return solution

    def __getattr__(self, name: str) -> Any:
        return getattr(self.solver, name)


def sequence(N: int, t_end: float) -> tuple[list[tuple[Sample, np.ndarray]], np.ndarray]:
    """Samples of the closed loop under converged plans, and what plans on fine steps command there."""
    simulation, session = prepared(N, t_end, options=f"{{{CONVERGED}}}")
    session.solver = recorder = Recorder(session.solver)
    simulation.run()
    fine = prepared(N, t_end, options=f"{{{CONVERGED}, step={FINE}}}")[1].solver
    return recorder.asked, np.array([float(fine.solve(*asked).u[0, 0]) for asked in recorder.asked])


def named(name: str, step: float) -> str:
    """A solver's name, with its steps where they are not the plant's."""
    return f"{name}, steps of {1e3 * step:g} ms" if step else name


def real_time_iteration(N: int, t_end: float, asked: Sequence[Any], passes: int, step: float = 0.0) -> Contestant:
    """Feedback alone, and feedback with preparation."""
    _, session = prepared(N, t_end, options=f"{{step={step}}}")
    solver = session.solver
    feedback, whole = Times(), Times()

    def once() -> None:
        solver.recall({})
        for k, (sample, u_last) in enumerate(asked):
            solution = feedback.measure(lambda s=sample, u=u_last: solver.solve(s, u))
            # What was sent is what the loop that made the sequence sent.
            sent = asked[k + 1][1] if k + 1 < len(asked) else solution.u[0]
            whole.together(feedback, lambda u=sent: solver.prepare(u))
            feedback.commands.append(float(solution.u[0, 0]))

    name = named("pgexcite", step)
    return Contestant({f"{name}, feedback": feedback, f"{name}, with preparation": whole}, once, passes)


def exported(N: int, t_end: float, folder: Path, passes: int, step: float = 0.0, programs: int = 2) -> Contestant:
    """The exported C on its own replay, compiled for this processor; so many programs after a jump."""
    options = f"{{step={step}, jump_iterations={programs}}}"
    directory = export_c(scenario(N, t_end, options=options), folder / f"c{N}-{step}-{programs}").directory
    cc, (native, _) = compiling.compiler(), compiling.processor()
    assert cc is not None
    command = [cc, "-std=c99", "-O2", *native, "-ffp-contract=off", "-fPIC", "-shared", "mpc.c", "-o", "mpc.so", "-lm"]
    subprocess.run(command, cwd=directory, check=True)
    library = ctypes.CDLL(str(directory / "mpc.so"))
    sizes = [int(n) for n in re.findall(r"MPC_N_[XZDUP] = (\d+)", (directory / "mpc.h").read_text())]
    fields = [("t", ctypes.c_double), ("active", ctypes.c_int), ("startup", ctypes.c_int)]
    fields += [(key, ctypes.c_double * max(1, n)) for key, n in zip("xzdup", sizes, strict=True)]

    class Input(ctypes.Structure):
        _fields_ = (*fields, ("u_last", ctypes.c_double * 1))

    output = (ctypes.c_double * 8)()
    inputs = []
    for line in (directory / "replay.txt").read_text().splitlines():
        numbers = [float(word) for word in line.split()]
        item, at = Input(), 3
        item.t, item.active, item.startup = numbers[0], int(numbers[1]), int(numbers[2])
        for key, n in zip("xzdup", sizes, strict=True):
            getattr(item, key)[:n] = numbers[at : at + n]
            at += n
        item.u_last[0] = numbers[at]
        inputs.append(item)
    feedback, whole = Times(), Times()

    def once() -> None:
        library.mpc_reset()
        for item in inputs:
            feedback.measure(lambda i=item: library.mpc_step(ctypes.byref(i), output))
            whole.together(feedback, lambda: library.mpc_prepare(output))

    name = named("exported C" if programs > 1 else "exported C, one program after a jump", step)
    return Contestant({f"{name}, feedback": feedback, f"{name}, with preparation": whole}, once, passes)


def slsqp(N: int, t_end: float, asked: Sequence[Any], passes: int, step: float = 0.0) -> Contestant:
    """Single shooting with finite differences on the compiled prediction."""
    _, session = prepared(N, t_end, options=f"{{step={step}}}")
    shooting = session.solver
    model, problem, condensed = shooting.kernel.model, shooting.problem, shooting.condensed
    outputs = [model.position("y", path) for path in condensed.outputs()]
    predictor = Predictor(shooting.kernel, [model.position("u", COMMAND)], outputs, N, shooting.rule)
    times = Times()
    low, high = problem.u_min[0], problem.u_max[0]

    def once() -> None:
        plan = None
        for sample, u_last in asked:
            horizon = shooting.horizons.at(sample.t, sample.state.u, sample.p)
            references = problem.references(sample.t)

            def cost(
                u: np.ndarray, s: Any = sample.state, ho: Any = horizon, r: Any = references, ul: Any = u_last
            ) -> float:
                rollout = predictor.roll(s, u[:, None], ho, derivatives=False)
                return 1e6 if rollout is None else condensed.cost(rollout.y, r, u[:, None], ul)

            start = np.tile(u_last, N) if plan is None else np.append(plan[1:], plan[-1])
            found = times.measure(lambda c=cost, x=start: minimize(c, x, method="SLSQP", bounds=[(low, high)] * N))
            plan = np.clip(found.x, low, high)
            times.commands.append(float(plan[0]))

    return Contestant({named("scipy SLSQP", step): times}, once, passes)


def ordinary(simulation: Simulation) -> tuple[ca.SX, ca.SX, ca.SX, list[ca.SX]]:
    """The plant as ordinary differential equations: moving states, command, fault status, and (x', v_t, omega).

    The algebraic equations are linear in their unknowns here, so they are solved symbolically; that is checked.
    """
    model, state, p_0 = simulation.model, simulation.initial.state, simulation.initial.p
    moving = [k for k in range(len(model.x_names)) if not model.inert[k]]
    x, u, fault = ca.SX.sym("x", len(moving)), ca.SX.sym("u"), ca.SX.sym("fault")
    X, U, P = ca.SX(state.x), ca.SX(state.u), ca.SX(p_0)
    for row, k in enumerate(moving):
        X[k] = x[row]
    U[model.position("u", COMMAND)] = u
    P[model.position("p", FAULT)] = fault
    Z, d = ca.SX.sym("z", len(model.z_names)), ca.SX(state.d)
    f, mass, _, _, g, y = model.dae(X, Z, d, U, P)
    slope = ca.simplify(ca.jacobian(g, Z))
    assert not ca.depends_on(slope, Z), "the algebraic equations are not linear"
    solved = -ca.solve(slope, ca.substitute(g, Z, 0))
    f, y = (ca.substitute(e, Z, solved) for e in (f / mass, y))
    return x, u, fault, [f[moving], y[model.position("y", "unit.G2.v_t")], y[model.position("y", "unit.G2.omega")]]


def do_mpc(N: int, t_end: float, asked: Sequence[Any], passes: int, folders: Sequence[Path | None]) -> list[Contestant]:
    """do-mpc as its documentation sets it up, and with its program compiled where there is a folder for that."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(sys.stderr):
        warnings.simplefilter("ignore")
        import do_mpc as library

        return [_do_mpc(library, N, t_end, asked, passes, folder) for folder in folders]


def _do_mpc(
    library: Any, N: int, t_end: float, asked: Sequence[Any], passes: int, compile_in: Path | None
) -> Contestant:
    simulation, session = prepared(N, t_end)
    problem = session.solver.problem
    sx, su, sfault, expressions = ordinary(simulation)
    model = library.model.Model("continuous", "SX")
    x = model.set_variable("_x", "x", shape=(sx.numel(), 1))
    u = model.set_variable("_u", "u")
    fault = model.set_variable("_tvp", "fault")
    slope, v_t, omega = ca.substitute(expressions, [sx, su, sfault], [x, u, fault])
    model.set_rhs("x", slope)
    cost = float(problem.Q[0]) * (float(problem.V_ref[0]) - v_t) ** 2 + float(problem.P[0]) * (1 - omega) ** 2
    model.set_expression("cost", cost)
    model.setup()
    mpc = library.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = N, problem.dt
    mpc.settings.supress_ipopt_output()
    mpc.set_objective(lterm=model.aux["cost"], mterm=model.aux["cost"])
    mpc.set_rterm(u=float(problem.R[0]))
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = float(problem.u_min[0]), float(problem.u_max[0])
    template, now = mpc.get_tvp_template(), [0.0]

    def known(_: float) -> Any:
        template["_tvp", :, "fault"] = now[0]
        return template

    mpc.set_tvp_fun(known)
    mpc.setup()
    if compile_in is not None:
        where = compile_in / f"nlp{N}"
        # Its optimizer module uses a name it does not import (5.1.2): nothing else is changed.
        library.optimizer.nlpsol = ca.nlpsol
        with contextlib.chdir(compile_in):
            mpc.compile_nlp(
                overwrite=True, cname=f"nlp{N}.c", libname=f"{where}.so", compiler_command=_compile(N, where)
            )
    moving = ~simulation.model.inert
    position = simulation.model.position("p", FAULT)
    times = Times()

    def once() -> None:
        for k, (sample, u_last) in enumerate(asked):
            x_0 = sample.state.x[moving][:, None]
            now[0] = float(sample.p[position])
            mpc.u0 = u_last[:, None]
            if k == 0:
                mpc.x0 = x_0
                mpc.set_initial_guess()
            found = times.measure(lambda v=x_0: mpc.make_step(v))
            times.commands.append(float(found[0, 0]))

    name = "do-mpc as shipped" if compile_in is None else "do-mpc, program compiled"
    return Contestant({name: times}, once, passes)


def _compile(N: int, where: Path) -> str:
    return f"gcc -fPIC -shared -O1 nlp{N}.c -o {where}.so"


def main() -> None:
    """Measure and print a table and JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--horizons", type=int, nargs="+", default=[5, 10, 20])
    parser.add_argument("--passes", type=int, default=30, help="of the fast solvers through the sequence")
    parser.add_argument("--slow-passes", type=int, default=3, help="of the others")
    parser.add_argument("--t-end", type=float, default=3.0)
    parser.add_argument("--compiled", action="store_true", help="do-mpc's program compiled too, which takes minutes")
    told = parser.parse_args()
    there = importlib.util.find_spec("do_mpc") is not None
    rows = []
    gc.freeze()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for N in told.horizons:
            asked, reference = sequence(N, told.t_end)
            all_of_them = []
            for step in (0.0, COARSE):
                all_of_them += [
                    real_time_iteration(N, told.t_end, asked, told.passes, step),
                    exported(N, told.t_end, folder, told.passes, step),
                    exported(N, told.t_end, folder, told.passes, step, programs=1),
                    slsqp(N, told.t_end, asked, told.slow_passes, step),
                ]
            if there:
                folders = [None, folder] if told.compiled else [None]
                all_of_them += do_mpc(N, told.t_end, asked, told.slow_passes, folders)
            # By turns, so that whatever else the machine does hits them all.
            for k in range(told.passes):
                for one in all_of_them:
                    if k * one.passes // told.passes < (k + 1) * one.passes // told.passes:
                        with contextlib.redirect_stdout(sys.stderr):
                            one.once()
            found = {name: times for one in all_of_them for name, times in one.times.items()}
            rows += [{"N": N, "solver": solver, **times.row(reference)} for solver, times in found.items()]
    about = {"machine": f"{platform.machine()}, {os.cpu_count()} processors", "load": os.getloadavg(), "rows": rows}
    print(json.dumps(about, indent=1))
    keys = list(dict.fromkeys(key for row in rows for key in row))
    print("| " + " | ".join(keys) + " |\n|" + "---|" * len(keys))
    for row in rows:
        print("| " + " | ".join(str(row.get(key, "")) for key in keys) + " |")


if __name__ == "__main__":
    main()
