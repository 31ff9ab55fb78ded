"""The solution of a quadratic program made exact: once its active constraints are known, it is that of linear equations.

A solver that stops where the optimality conditions hold to 1e-10 leaves a minimiser that is off by this over the smallest
curvature: some 1e-8 pu of a command. The equations of the constraints that it found active have no such tolerance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from pgexcite.core.program import Program

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_EXCHANGES = 5
"""How often constraints that are on the wrong side are exchanged before the solver's own solution is kept."""
_CROSSED = 1e-12


def polished(program: Program, x: Array, multipliers: Array) -> tuple[Array, Array]:
    """Minimiser and multipliers from those a solver has found, as in ``pgexcite.core.program.QPSolution``.

    Returns:
        The exact ones, where they satisfy the optimality conditions no worse; else those of the solver.
    """
    H, g, low, high, rows = program
    stacked = np.eye(g.size)
    if rows is not None:
        stacked = np.concatenate((rows.matrix, stacked))
        low, high = np.concatenate((rows.lower, low)), np.concatenate((rows.upper, high))
    values = stacked @ x
    # Of an active constraint the multiplier is what is large, of another one the distance.
    at_low, at_high = values - low < -multipliers, high - values < multipliers
    for _ in range(_EXCHANGES):
        found = _on(H, g, stacked, at_low, at_high, low, high)
        if found is None:
            break
        exact, forces = found
        ahead = stacked @ exact
        above, below = ahead > high + _CROSSED, ahead < low - _CROSSED
        released = ((at_high & (forces < 0)) | (at_low & (forces > 0))) & (low < high)
        if not (above | below | released).any():
            crossed = np.maximum(low - values, values - high).max()
            left = np.abs(H @ x + g + multipliers @ stacked).max()
            better = np.abs(H @ exact + g + forces @ stacked).max() <= max(left, crossed)
            return (exact, forces) if better else (x, multipliers)
        at_high, at_low = (at_high & ~released) | above, (at_low & ~released) | below
    return x, multipliers


def _on(
    H: Array, g: Array, stacked: Array, at_low: Flags, at_high: Flags, low: Array, high: Array
) -> tuple[Array, Array] | None:
    """Minimiser and multipliers with these constraints as equations; ``None`` where they are dependent."""
    n, active = g.size, np.flatnonzero(at_low | at_high)
    k, forces = active.size, np.zeros(low.size)
    system, right = np.zeros((n + k, n + k)), np.empty(n + k)
    system[:n, :n] = H
    right[:n] = -g
    if k:
        A = stacked[active]
        system[n:, :n], system[:n, n:] = A, A.T
        right[n:] = np.where(at_high, high, low)[active]
    *_, found, failed = dgesv(system, right)
    if failed or not np.isfinite(found.sum()):
        return None
    forces[active] = found[n:]
    return found[:n], forces
