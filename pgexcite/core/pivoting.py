"""Damped Newton with a pivoting sparse LU: slow and sure, for where a fixed order of elimination fails or does not exist."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]

_SHORTEST = 1e-3
"""Share of an update below which it is shortened no further."""


@np.errstate(over="ignore", invalid="ignore")
def solved(
    residual: Callable[[Array], tuple[Array, sp.csc_matrix]],
    start: Array,
    *,
    tolerance: float,
    update_weight: float,
    iterations: int,
) -> Array | None:
    """Where the residual vanishes, or ``None`` where that was not found.

    Args:
        residual: residual, shape ``(n,)``, and Jacobian, at a point of shape ``(n,)``.
        start: where the search starts.
        tolerance: of the residual before and after the last update, 2-norm, and of that update times ``update_weight**0.5``.
        update_weight: see there.
        iterations: of them, at most.
    """
    w = start
    r, jacobian = residual(w)
    error = float(np.linalg.norm(r))
    for _ in range(iterations):
        if not np.isfinite(error):
            return None
        try:
            step = splu(jacobian).solve(r)
        except RuntimeError:
            return None
        scale = 1.0
        while True:
            trial = w - scale * step
            r_trial, jacobian_trial = residual(trial)
            error_trial = float(np.linalg.norm(r_trial))
            if error_trial < (1 - 0.1 * scale) * error or error_trial < tolerance or scale < _SHORTEST:
                break
            scale /= 2
        update = scale * float(np.linalg.norm(step)) * update_weight**0.5
        converged = error < tolerance and error_trial < tolerance and update < tolerance
        if not error_trial < error and not converged:
            return None
        w, r, jacobian, error = trial, r_trial, jacobian_trial, error_trial
        if converged:
            return w
    return None
