"""Plans by shooting as C: real-time iterations from the plant's own state."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.codegen import loop
from pgexcite.core.controller import Sample
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.export import shared
from pgexcite.core.export.parts import Input, Parts
from pgexcite.core.prediction import write_sensitivities
from pgexcite.core.shooting import DECREASE, SHORTEST, Shooting
from pgexcite.core.step import RULES

Array = NDArray[np.float64]
Numbers = NDArray[np.float64] | NDArray[np.int32]

TOLERANCE = 1e-6
"""Measured 3e-9 .. 3e-7 pu, where ProxQP's tolerance puts it."""

_ABOUT = """One predictive controller for one plant: real-time iterations on the plant's own step, from the plant's own state, as
   pgexcite.core.shooting makes them, and the checks of pgexcite.core.ladder."""


def nmpc_parts(shooting: Shooting, where: str) -> Parts:
    """Parts of real-time iterations from a state that is told.

    Raises:
        ConfigError: something in the configuration cannot be exported.
    """
    _refuse(where, shooting)
    model, options = shooting.kernel.model, shooting.options
    functions, pieces = _functions_and_pieces(shooting)
    names = {"x": model.x_names, "z": model.z_names, "d": model.d_names, "u": model.u_names, "p": model.p_names}
    about = {
        "x": "the plant's differential states",
        "z": "its algebraic unknowns",
        "d": "its discrete states",
        "u": "its set-points in force",
        "p": "its parameters",
    }
    constants = {
        "jump": repr(options.jump),
        "plan_tolerance": repr(options.tolerance),
        "max_plan_iterations": options.max_iterations,
        "jump_iterations": options.jump_iterations,
        "shortest": repr(SHORTEST),
        "decrease": repr(DECREASE),
    }
    return Parts(
        about=_ABOUT,
        inputs=(
            Input("t", "s, on the clock of the references"),
            Input("active", "whether the controller is in charge", kind="int"),
            Input("startup", "backward-Euler steps left after a discontinuity (trapezoidal rule); else 0", kind="int"),
            *(Input.of(key, about[key], names[key]) for key in names),
            Input("u_last", "commands in force until now", len(shooting.problem.commands)),
        ),
        record=_record,
        condensed=shooting.condensed,
        functions=functions,
        constants=shooting.kernel.constants() | pieces[0] | constants,
        arrays=pieces[1],
        templates=(loop("shooting.c"), loop("nmpc.c")),
        tolerance=TOLERANCE,
    )


def _record(sample: Sample, u_last: Array) -> list[Array | float]:
    state, p = sample.state, sample.p
    assert state is not None
    assert p is not None
    return [sample.t, int(sample.active), state.startup, state.x, state.z, state.d, state.u, p, u_last]


def _refuse(where: str, shooting: Shooting) -> None:
    """Refuse what the exported controller does not do."""
    problem = shooting.problem
    unsupported = {
        "disturbance_known": (bool(problem.known), "known disturbances are not exported"),
        "delayed": (problem.delayed, "compensation of computing delay is not exported"),
        "options.mode": (
            shooting.options.mode != "rti",
            'only mode = "rti" is exported: its iterations have a fixed cap',
        ),
        "options.candidates": (shooting.options.candidates > 0, "candidate plans are not exported"),
        "rule": (
            shooting.rule == "trapezoidal",
            "must be another: the trapezoidal one starts anew where a command changes, however little, and its predictions jump",
        ),
        "backend": (shooting.kernel.functions.newton is None, "the model is too large to be written out as C"),
    }
    problems = [Problem(f"{where}.{key}", text) for key, (present, text) in unsupported.items() if present]
    problems += shared.objections(where, shooting.condensed)
    if problems:
        raise ConfigError(problems)


def _functions_and_pieces(shooting: Shooting) -> tuple[list[ca.Function], tuple[dict[str, object], dict[str, Numbers]]]:
    """The functions of the model, and the constants and arrays of a rollout over the horizon."""
    kernel, problem = shooting.kernel, shooting.problem
    model, functions = kernel.model, kernel.functions
    commands = np.array([model.position("u", path) for path in problem.commands], dtype=np.int32)
    outputs = np.array([model.position("y", path) for path in shooting.condensed.outputs()], dtype=np.int32)
    columns = len(model.x_names) + commands.size
    sensitivities = write_sensitivities(kernel, commands, outputs, columns)
    horizon = shooting.horizons.at(0.0, np.zeros(len(model.u_names)), np.zeros(len(model.p_names)))
    fixed = {model.position("u", path): value for path, value in problem.fixed.items()}
    constants: dict[str, object] = {
        "n_commands": commands.size,
        "n_columns": columns,
        "n_selected": outputs.size,
        "transition": 1,
        "n_pieces": horizon.counts.size,
        "first_count": int(horizon.counts[0]),
        "rule": RULES.index(shooting.rule),
        "n_fixed": len(fixed),
    }
    arrays: dict[str, Numbers] = {
        "COMMANDS": commands,
        "PIECE_COUNT": horizon.counts,
        "PIECE_LENGTH": horizon.lengths,
        "PIECE_MOVE": horizon.moves,
        "PIECE_ROW": horizon.rows,
        "PIECE_END": horizon.ends,
        "SAMPLE_MOVE": horizon.sample_moves,
        "FIXED_AT": np.array(list(fixed), dtype=np.int32),
        "FIXED_TO": np.array(list(fixed.values()), dtype=float),
    }
    assert functions.newton is not None
    loops = [functions.newton, functions.history, functions.update, functions.outputs, *sensitivities]
    return loops, (constants, arrays)
