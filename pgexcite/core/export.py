"""A controller as self-contained C: the same generated functions and the same loops that run here, with a QP solver of its own.

What is written: ``NAME.c`` and ``NAME.h``, the controller; ``NAME_replay.c`` and ``replay.txt``, a closed loop recorded here and a
program that replays it and compares; ``CMakeLists.txt``. The C is C99, needs the mathematical library only and allocates nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.codegen import array, generate, loop
from pgexcite.core.config import Scenario
from pgexcite.core.controller import Sample
from pgexcite.core.errors import ConfigError, PgexciteError, Problem
from pgexcite.core.ladder import Ladder
from pgexcite.core.model import State
from pgexcite.core.mpc import Solution, Solver
from pgexcite.core.prediction import write_sensitivities
from pgexcite.core.shooting import DECREASE, SHORTEST, Shooting
from pgexcite.core.simulate import Simulation
from pgexcite.core.step import RULES

Array = NDArray[np.float64]

TOLERANCE = 1e-6
"""Difference of a command, in its unit, up to which the replay agrees with Python."""


class ExportError(PgexciteError):
    """A controller cannot be written as C."""


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes:
        directory: where.
        name: prefix of files, functions and types.
        samples: length of the recorded closed loop.
    """

    directory: Path
    name: str
    samples: int


def export_c(scenario: Scenario, directory: Path, controller: str = "") -> Exported:
    """Write a scenario's controller as C, with the scenario's own run as its test.

    Args:
        scenario: with the controller in it.
        directory: new, empty, or of an earlier export.
        controller: its name; may be left out where there is one.

    Raises:
        ConfigError: no such controller, or something in its configuration cannot be exported.
        ExportError: something else stands in the directory.
    """
    name = _chosen(scenario, controller)
    simulation = Simulation(scenario.system, scenario.settings, scenario.changes, scenario.controllers)
    session = simulation.sessions[name]
    if not isinstance(session, Ladder) or not isinstance(session.solver, Shooting) or not session.options.perfect:
        text = "cannot be exported: only the backend nmpc can"
        raise ConfigError([Problem(f"controller.{name}", text)])
    shooting = session.solver
    _refuse(f"controller.{name}", shooting)
    prefix = re.sub(r"\W", "_", name)
    files = _files(prefix, scenario, session, shooting)
    _ensure_ours(directory, [*files, "replay.txt"])
    recorder = _Recorder(shooting)
    session.solver = recorder
    simulation.run()
    files["replay.txt"] = "".join(f"{line}\n" for line in recorder.lines)
    directory.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        (directory / file).write_text(text, encoding="utf-8")
    return Exported(directory, prefix, len(recorder.lines))


def _chosen(scenario: Scenario, controller: str) -> str:
    names = list(scenario.controllers)
    if controller in names:
        return controller
    if not controller and len(names) == 1:
        return names[0]
    text = f"there is no controller {controller!r}" if controller else "which of the controllers is to be exported?"
    raise ConfigError([Problem("controller", text, hint=f"there are: {', '.join(names) or 'none'}")])


def _refuse(where: str, shooting: Shooting) -> None:
    """Refuse what the exported controller does not do."""
    problem = shooting.problem
    unsupported = {
        "soft": (bool(problem.soft), "soft bounds are not exported"),
        "disturbance_known": (bool(problem.known), "known disturbances are not exported"),
        "delayed": (problem.delayed, "compensation of computing delay is not exported"),
        "R": (not (problem.R > 0).all(), "must be positive: the exported QP solver takes strictly convex programs"),
        "options.mode": (
            shooting.options.mode != "rti",
            'only mode = "rti" is exported: its iterations have a fixed cap',
        ),
        "rule": (
            shooting.rule == "trapezoidal",
            "must be another: the trapezoidal one starts anew where a command changes, however little, and its predictions jump",
        ),
        "backend": (shooting.kernel.functions.newton is None, "the model is too large to be written out as C"),
    }
    problems = [Problem(f"{where}.{key}", text) for key, (present, text) in unsupported.items() if present]
    if problems:
        raise ConfigError(problems)


def _ensure_ours(directory: Path, files: Sequence[str]) -> None:
    if directory.exists():
        foreign = sorted({path.name for path in directory.iterdir()} - set(files) - {"build"})
        if foreign:
            raise ExportError(
                f"{directory}: holds {', '.join(foreign[:3])}, which no export wrote; name another directory"
            )


@dataclass
class _Recorder:
    """A solver that writes down what it was asked and what it answered, up to the first plan that may not be used."""

    solver: Solver
    lines: list[str] = field(default_factory=list)
    whole: bool = True

    def solve(self, sample: Sample, u_last: Array) -> Solution:
        solution = self.solver.solve(sample, u_last)
        self.whole = self.whole and solution.status.usable
        if self.whole and sample.state is not None and sample.p is not None:
            self.lines.append(_line(sample.t, sample.state, sample.p, u_last, solution))
        return solution

    def prepare(self, u: Array) -> None:
        self.solver.prepare(u)

    def memory(self) -> Mapping[str, Array]:
        return self.solver.memory()

    def recall(self, memory: Mapping[str, Array]) -> None:
        self.solver.recall(memory)


def _line(t: float, state: State, p: Array, u_last: Array, solution: Solution) -> str:
    numbers = np.concatenate((state.x, state.z, state.d, state.u, p, u_last, solution.u[0], [solution.cost]))
    return " ".join([repr(t), str(state.startup), *(repr(float(v)) for v in numbers), str(solution.iterations)])


def _files(name: str, scenario: Scenario, session: Ladder, shooting: Shooting) -> dict[str, str]:
    model, problem = shooting.kernel.model, shooting.problem
    groups = {"x": model.x_names, "z": model.z_names, "d": model.d_names, "u": model.u_names, "p": model.p_names}
    words: dict[str, object] = {
        "name": name,
        "NAME": name.upper(),
        "title": _comment(scenario.title or name),
        "config": _comment(scenario.path.name),
        "version": version("pgexcite"),
        "tolerance": TOLERANCE,
        "n_commands": len(problem.commands),
        "commands": _listed(problem.commands),
    }
    for group, names in groups.items():
        words |= {f"n_{group}": len(names), f"size_{group}": max(1, len(names)), f"{group}_names": _listed(names)}

    def filled(template: str) -> str:
        return Template(loop(template)).substitute(words)

    source = [
        f'#include "{name}.h"\n',
        _generated(shooting, session),
        loop("dense.c"),
        loop("qp.c"),
        filled("controller.c"),
    ]
    return {
        f"{name}.h": filled("controller.h"),
        f"{name}.c": "\n".join(source),
        f"{name}_replay.c": filled("replay.c"),
        "CMakeLists.txt": filled("CMakeLists.txt"),
    }


def _generated(shooting: Shooting, session: Ladder) -> str:
    """The functions of the model, the loops around them, and the problem's numbers."""
    kernel, problem, options = shooting.kernel, shooting.problem, shooting.options
    model, functions, condensed = kernel.model, kernel.functions, shooting.condensed
    assert functions.newton is not None
    commands = np.array([model.position("u", path) for path in problem.commands], dtype=np.int32)
    outputs = np.array([model.position("y", path) for path in condensed.outputs()], dtype=np.int32)
    columns = len(model.x_names) + commands.size
    sensitivities = write_sensitivities(kernel, commands, outputs, columns)
    horizon = shooting.horizons.at(0.0, np.zeros(len(model.u_names)), np.zeros(len(model.p_names)))
    fixed = {model.position("u", path): value for path, value in problem.fixed.items()}
    constants: dict[str, object] = {
        "pgexcite_public": "static",
        "n_commands": commands.size,
        "n_columns": columns,
        "n_selected": outputs.size,
        "transition": 1,
        "n_v": condensed.n,
        "rate": int(np.isfinite(problem.du_max).any()),
        "horizon": problem.N_p,
        "n_moves": problem.N_c,
        "n_pieces": horizon.counts.size,
        "first_count": int(horizon.counts[0]),
        "rule": RULES.index(shooting.rule),
        "n_voltages": len(problem.voltages),
        "n_previews": len(problem.previews),
        "n_fixed": len(fixed),
        "jump": repr(options.jump),
        "plan_tolerance": repr(options.tolerance),
        "max_plan_iterations": options.max_iterations,
        "jump_iterations": options.jump_iterations,
        "max_reuse": session.options.max_reuse,
        "shortest": repr(SHORTEST),
        "decrease": repr(DECREASE),
    }
    weights = np.tile(np.concatenate((problem.Q, problem.P)), (problem.N_p, 1))
    weights[-1] *= problem.terminal
    starts = np.arange(problem.N_c)[:, None]
    arrays: dict[str, Array | NDArray[np.int32]] = {
        "COMMANDS": commands,
        "PIECE_COUNT": horizon.counts,
        "PIECE_LENGTH": horizon.lengths,
        "PIECE_MOVE": horizon.moves,
        "PIECE_ROW": horizon.rows,
        "PIECE_END": horizon.ends,
        "SAMPLE_MOVE": horizon.sample_moves,
        "SHIFTED": problem.shifted(starts.astype(float)).ravel().astype(np.int32),
        "ENDS": np.cumsum(problem.intervals()),
        "WEIGHTS": weights.ravel(),
        "R": np.tile(problem.R, problem.N_c),
        "LOWER": np.tile(problem.u_min, problem.N_c),
        "UPPER": np.tile(problem.u_max, problem.N_c),
        "DU_MAX": np.tile(problem.du_max, problem.N_c),
        "V_REF": problem.V_ref,
        "PREVIEW_T": np.array([t for t, _ in problem.previews]),
        "PREVIEW_V": np.array([value for _, value in problem.previews], dtype=float).ravel(),
        "FIXED_AT": np.array(list(fixed), dtype=np.int32),
        "FIXED_TO": np.array(list(fixed.values()), dtype=float),
        "U_0": session.u_0,
    }
    loops = [functions.newton, functions.history, functions.update, functions.outputs, *sensitivities]
    text = generate(loops, kernel.constants() | constants, rollout=True)
    return "\n".join([text, *(array(name, values) for name, values in arrays.items())]) + "\n"


def _listed(names: Sequence[str]) -> str:
    return "\n".join(f"     {k:3d}  {_comment(name)}" for k, name in enumerate(names)) or "     none"


def _comment(text: str) -> str:
    return text.replace("*/", "* /").replace("/*", "/ *")
