"""Plans by shooting as C, and the controller that plans from the plant's own state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.codegen import loop
from pgexcite.core.controller import Sample
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.export import shared
from pgexcite.core.export.horizon import horizon
from pgexcite.core.export.parts import Input, Numbers, Parts, Predictions
from pgexcite.core.sensitivity import write_sensitivities
from pgexcite.core.shooting import DECREASE, SHORTEST, Shooting
from pgexcite.core.step import RULES

Array = NDArray[np.float64]

TOLERANCE = 1e-9
"""Measured 6e-13 pu; 2e-11 on an estimate."""
TOLERANCE_CONVERGED = 1e-5
"""With soft bounds, where rounding of the cost ends an iteration one program sooner or later: measured 1.5e-6 pu."""

LOOPS = ("step.c", "advance.c", "rollout.c", "chain.c")
"""What ``shooting.c`` goes below."""

_ABOUT = """One predictive controller for one plant: plans on the plant's own step, from the plant's own state, as
   pgexcite.core.shooting makes them, and the checks of pgexcite.core.ladder."""
DELAYED = """

   A plan takes a sample to compute: the command answered is for the next sample, and what is to be sent now was answered in
   the last."""
"""Of a problem with computing delay."""


def nmpc_parts(shooting: Shooting, where: str) -> Parts:
    """Parts of plans from a state that is told.

    Raises:
        ConfigError: something in the configuration cannot be exported.
    """
    refuse(where, shooting)
    model, predictions = shooting.kernel.model, planning(shooting)
    names = {"x": model.x_names, "z": model.z_names, "d": model.d_names, "u": model.u_names, "p": model.p_names}
    about = {
        "x": "the plant's differential states",
        "z": "its algebraic unknowns",
        "d": "its discrete states",
        "u": "its set-points in force",
        "p": "its parameters",
    }
    return Parts(
        about=_ABOUT + DELAYED * shooting.problem.delayed,
        inputs=(
            Input("t", "s, on the clock of the references"),
            Input("active", "whether the controller is in charge", kind="int"),
            Input("startup", "backward-Euler steps left after a discontinuity (trapezoidal rule); else 0", kind="int"),
            *(Input.of(key, about[key], names[key]) for key in names),
            Input("u_last", "commands in force until the plan begins", len(shooting.problem.commands)),
        ),
        record=_record,
        condensed=shooting.condensed,
        functions=predictions.functions,
        along=predictions.along,
        loops=LOOPS,
        constants=predictions.constants,
        arrays=predictions.arrays,
        templates=tuple(loop(file) for file in ("horizon.c", "shooting.c", "nmpc.c")),
        tolerance=tolerance(shooting),
    )


def tolerance(shooting: Shooting) -> float:
    """Difference of a command, pu, up to which the replay agrees with Python."""
    return TOLERANCE_CONVERGED if shooting.problem.soft and shooting.options.mode == "converged" else TOLERANCE


def _record(sample: Sample, u_last: Array) -> list[Array | float]:
    state, p = sample.state, sample.p
    assert state is not None
    assert p is not None
    return [sample.t, int(sample.active), state.startup, state.x, state.z, state.d, state.u, p, u_last]


def refuse(where: str, shooting: Shooting) -> None:
    """Refuse what the exported controller does not do.

    Raises:
        ConfigError: something in the configuration cannot be exported.
    """
    unsupported = {
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


def planning(shooting: Shooting) -> Predictions:
    """What ``horizon.c`` and ``shooting.c`` are to know: functions of the model, constants and arrays."""
    kernel, problem, options = shooting.kernel, shooting.problem, shooting.options
    model = kernel.model
    commands = np.array([model.position("u", path) for path in problem.commands], dtype=np.int32)
    outputs = np.array([model.position("y", path) for path in shooting.condensed.outputs()], dtype=np.int32)
    converge = options.mode == "converged"
    # What was prepared is corrected for the state.
    transitions = shooting.predictor.transitions or not converge
    columns = len(model.x_names) + commands.size if transitions else problem.N_c * commands.size
    owned = {*problem.commands, *problem.fixed}
    others = [k for k, path in enumerate(model.u_names) if path not in owned]
    horizon_constants, horizon_arrays = horizon(shooting.horizons)
    constants: dict[str, object] = {
        "n_commands": commands.size,
        "n_columns": columns,
        "n_selected": outputs.size,
        "transition": int(transitions),
        "rule": RULES.index(shooting.rule),
        "n_others": len(others),
        "converge": int(converge),
        "jump": options.jump,
        "jump_tolerance": max(options.jump_tolerance, options.tolerance),
        "plan_tolerance": options.tolerance,
        "max_plan_iterations": options.max_iterations,
        "jump_iterations": options.jump_iterations,
        "shortest": SHORTEST,
        "decrease": DECREASE,
    }
    arrays: dict[str, Numbers] = {
        "COMMANDS": commands,
        "OTHERS": np.array(others, dtype=np.int32),
    }
    sensitivities = write_sensitivities(kernel, commands, outputs)
    return Predictions(
        functions=[*kernel.stepping(), kernel.functions.land, *sensitivities.functions()],
        along=sensitivities.along(),
        constants=kernel.constants() | sensitivities.constants() | constants | horizon_constants,
        arrays=arrays | horizon_arrays,
    )
