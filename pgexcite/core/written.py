"""What the C of plans is to know: ``condensed.c``, ``horizon.c``, ``shooting.c`` and those above them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.condensed import Condensed
from pgexcite.core.horizons import Horizons
from pgexcite.core.iteration import DECREASE, SAME_STATE, SHORTEST, ShootingOptions
from pgexcite.core.prediction import Predictor
from pgexcite.core.qp import limits
from pgexcite.core.step import RULES

Numbers = NDArray[np.float64] | NDArray[np.int32]


@dataclass(frozen=True)
class Predictions:
    """What the C of predictions is to know; see ``pgexcite.core.codegen.generate``."""

    functions: Sequence[ca.Function]
    along: Sequence[ca.Function]
    constants: Mapping[str, object]
    arrays: Mapping[str, Numbers]


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


def horizon(horizons: Horizons) -> tuple[dict[str, object], dict[str, Numbers]]:
    """Constants and arrays of the horizon of each sample."""
    problem, model = horizons.problem, horizons.model
    fixed = {model.position("u", path): value for path, value in problem.fixed.items()}
    constants: dict[str, object] = {
        "first_count": max(1, round(problem.dt / horizons.h)),
        "sample_steps": max(1, round(problem.dt / horizons.grid)),
        "grid": horizons.grid,
        "n_fixed": len(fixed),
        "n_known": len(problem.known),
    }
    arrays: dict[str, Numbers] = {
        "INTERVALS": problem.intervals(),
        "SAMPLE_MOVE": problem.moves_per_sample(),
        "FIXED_AT": np.array(list(fixed), dtype=np.int32),
        "FIXED_TO": np.array(list(fixed.values()), dtype=float),
    }
    return constants, arrays | _known(horizons)


def _known(horizons: Horizons) -> dict[str, Numbers]:
    """Known changes to come as assignments to elements of ``u`` and ``p``; what the model does not have is left out."""
    index, known = horizons.model.index, horizons.problem.known
    begins, assignments = [0], []
    for change in known:
        assignments += [
            (float(group == "p"), float(index[group][path]), float(added), value)
            for path, value, added in change.assignments()
            for group in ("u", "p")
            if path in index[group]
        ]
        begins.append(len(assignments))
    table = np.array(assignments, dtype=float).reshape(-1, 4)
    return {
        "KNOWN_T": np.array([horizons.instant(change) for change in known], dtype=float),
        "KNOWN_FROM": np.array(begins, dtype=np.int32),
        "SET_P": table[:, 0].astype(np.int32),
        "SET_AT": table[:, 1].astype(np.int32),
        "SET_ADD": table[:, 2],
        "SET_VALUE": table[:, 3],
    }


def planning(
    predictor: Predictor, condensed: Condensed, horizons: Horizons, options: ShootingOptions, *, exported: bool
) -> Predictions:
    """Functions of the model, constants and arrays of ``horizon.c`` and ``shooting.c``.

    Args:
        predictor, condensed, horizons, options: of the plans.
        exported: whether the state is somebody else's, who need not know it to the last bit: what was prepared is then always
            corrected for it.
    """
    kernel, problem = predictor.kernel, condensed.problem
    model, converge = kernel.model, options.mode == "converged"
    transitions = predictor.transitions or (exported and not converge)
    owned = {*problem.commands, *problem.fixed}
    others = [k for k, path in enumerate(model.u_names) if path not in owned]
    horizon_constants, horizon_arrays = horizon(horizons)
    constants: dict[str, object] = {
        "n_others": len(others),
        "converge": int(converge),
        "jump": options.jump if transitions else SAME_STATE,
        "jump_tolerance": max(options.jump_tolerance, options.tolerance),
        "plan_tolerance": options.tolerance,
        "max_plan_iterations": options.max_iterations,
        "jump_iterations": options.jump_iterations,
        "shortest": SHORTEST,
        "decrease": DECREASE,
        "rule": RULES.index(predictor.rule),
    }
    arrays: dict[str, Numbers] = {
        "COMMANDS": predictor.commands,
        "OTHERS": np.array(others, dtype=np.int32),
    }
    return Predictions(
        functions=[*kernel.stepping(), kernel.functions.land, *predictor.sensitivities.functions()],
        along=predictor.sensitivities.along(),
        constants=predictor.constants(transitions=transitions) | constants | horizon_constants,
        arrays=arrays | horizon_arrays,
    )
