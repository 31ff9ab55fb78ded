"""What ``horizon.c`` is to know: intervals, steps, and the known changes to come."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.horizons import Horizons

Numbers = NDArray[np.float64] | NDArray[np.int32]


def horizon(horizons: Horizons) -> tuple[dict[str, object], dict[str, Numbers]]:
    """Constants and arrays of the horizon of each sample."""
    problem, model = horizons.problem, horizons.model
    fixed = {model.position("u", path): value for path, value in problem.fixed.items()}
    constants: dict[str, object] = {
        "first_count": max(1, round(problem.dt / horizons.h)),
        "sample_steps": max(1, round(problem.dt / horizons.grid)),
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
