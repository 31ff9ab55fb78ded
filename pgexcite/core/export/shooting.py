"""Plans by shooting as C, and the controller that plans from the plant's own state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.codegen import loop
from pgexcite.core.controller import Sample
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.export import shared
from pgexcite.core.export.parts import Input, Parts
from pgexcite.core.plans_in_c import LOOPS
from pgexcite.core.shooting import Shooting
from pgexcite.core.written import Predictions, planning

Array = NDArray[np.float64]

TOLERANCE = 1e-9
"""Measured 6e-13 pu; 2e-11 on an estimate."""
TOLERANCE_CONVERGED = 1e-5
"""With soft bounds, where rounding of the cost ends an iteration one program sooner or later: measured 1.5e-6 pu."""

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
    model, predictions = shooting.kernel.model, exported_planning(shooting)
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
        templates=tuple(loop(file) for file in ("horizon.c", "shooting.c", "prepare.c", "nmpc.c")),
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


def exported_planning(shooting: Shooting) -> Predictions:
    """What its ``horizon.c`` and ``shooting.c`` are to know."""
    return planning(shooting.predictor, shooting.condensed, shooting.horizons, shooting.options, exported=True)
