"""What ``condensed.c`` and ``ladder.c`` are to know: the numbers of the problem and of the ladder."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.condensed import Condensed
from pgexcite.core.errors import Problem
from pgexcite.core.ladder import MOVED, PLAUSIBLE, Ladder
from pgexcite.core.qp import limits

Array = NDArray[np.float64]
Numbers = NDArray[np.float64] | NDArray[np.int32]


def objections(where: str, condensed: Condensed) -> list[Problem]:
    """What of a problem the quadratic program in C does not do."""
    if (condensed.problem.R > 0).all():
        return []
    text = "must be positive: the exported QP solver takes strictly convex programs"
    return [Problem(f"{where}.R", text, float(condensed.problem.R.min()))]


def program(condensed: Condensed) -> tuple[dict[str, object], dict[str, Numbers]]:
    """Constants and arrays of the quadratic program and its cost."""
    problem = condensed.problem
    weights = np.tile(np.concatenate((problem.Q, problem.P)), (problem.N_p, 1))
    weights[-1] *= problem.terminal
    rate = bool(np.isfinite(problem.du_max).any())
    constants: dict[str, object] = {
        "n_v": condensed.n,
        "n_rows": rate * condensed.n + len(problem.soft) * problem.N_p,
        "n_outputs": len(condensed.outputs()),
        "n_soft": len(problem.soft),
        "rate": int(rate),
        "horizon": problem.N_p,
        "n_moves": problem.N_c,
        "n_voltages": len(problem.voltages),
        "n_previews": len(problem.previews),
        "n_steps": len(problem.steps),
        **limits(),
    }
    starts = np.arange(problem.N_c, dtype=float)[:, None]
    arrays: dict[str, Numbers] = {
        "SHIFTED": problem.shifted(starts).astype(np.int32),
        "ENDS": np.cumsum(problem.intervals()),
        "WEIGHTS": weights,
        "R": np.tile(problem.R, problem.N_c),
        "LOWER": np.tile(problem.u_min, problem.N_c),
        "UPPER": np.tile(problem.u_max, problem.N_c),
        "DU_MAX": np.tile(problem.du_max, problem.N_c),
        "SOFT_LOWER": np.array([bound.lower for bound in problem.soft]),
        "SOFT_UPPER": np.array([bound.upper for bound in problem.soft]),
        "SOFT_WEIGHT": np.array([bound.weight for bound in problem.soft]),
        "V_REF": problem.V_ref,
    }
    for name, changes in (("PREVIEW", problem.previews), ("STEP", problem.steps)):
        arrays[f"{name}_T"] = np.array([t for t, _ in changes], dtype=float)
        arrays[f"{name}_V"] = np.array([value for _, value in changes], dtype=float)
    return constants, arrays


def ladder(session: Ladder, measured: int) -> tuple[dict[str, object], dict[str, Numbers]]:
    """Constants and arrays of the ladder; ``measured`` is the number of signals looked at for their age."""
    constants: dict[str, object] = {
        "n_measured": 0 if session.options.perfect else measured,
        "max_reuse": session.options.max_reuse,
        "max_age": session.options.max_age,
        "has_classical": int(session.actuator.has_classical),
        "delayed": int(session.problem.delayed),
        "late": session.problem.late,
        "plausible": PLAUSIBLE,
        "moved_command": MOVED,
    }
    return constants, {"U_0": session.u_0}
