"""Small dense quadratic programs: by pivoting where there is only a box, by ProxQP else, capped so that no control loop stalls.

ProxQP's default limits let a contradictory problem of ten variables run for half a minute. Inputs are therefore checked first and
the caps are the deadline.

A program with nothing but a box is first tried with the bounds that were active last. Where that set, or one a few exchanges away,
satisfies the optimality conditions, the program is solved, exactly and in a tenth of the time; else ProxQP solves it. What ProxQP
finds is made exact by ``pgexcite.core.polish``.
"""

from __future__ import annotations

import numpy as np
import proxsuite
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from pgexcite.core.polish import polished
from pgexcite.core.program import Program, QPSolution

Array = NDArray[np.float64]

_EPS = 1e-10
_GAP = 1e-8
_EPS_INFEASIBLE = 1e-30
WIDE = 1e20
_MAX_ITERATIONS = 60
_MAX_INNER_ITERATIONS = 60

_MAX_EXCHANGES = 20
"""How often ``exchange`` changes the active set before it gives up."""
_PATIENCE = 3
"""How many times in a row the variables on a wrong side may get no fewer before they change it one at a time."""
_CROSSED = 1e-12
"""What a variable may be beyond its bound, by rounding."""
_STATIONARY = 1e-9
"""Largest slope, against the largest one of the program, that is left where a variable is free of its bounds."""


class WarmSolver:
    """Solves programs of one size, each warm-started from the last solution.

    The warm start is a value (``memory``), not a state of the solver: a run resumed from a snapshot gives the same bits.

    Args:
        n: number of variables.
        m: number of general rows.
    """

    def __init__(self, n: int, m: int) -> None:
        self._n, self._m = n, m
        # The box goes in as rows: ProxQP's own box takes no warm start, and was twice as slow.
        self._qp = qp = proxsuite.proxqp.dense.QP(n, 0, m + n)
        self._rows = np.vstack((np.zeros((m, n)), np.eye(n)))
        self._low, self._high = np.zeros(m + n), np.zeros(m + n)
        settings = qp.settings
        settings.eps_abs, settings.eps_rel = _EPS, 0.0
        # Without the gap a point 4e-7 off an active bound counts as solved.
        settings.check_duality_gap, settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = True, _GAP, 0.0
        # A move bound and a box on the same command are parallel rows, and opposite multipliers of theirs look like a certificate
        # of infeasibility, to its own tolerance of 1e-4 and now and then to 1e-12. What has no solution ends at the caps.
        settings.eps_primal_inf = settings.eps_dual_inf = _EPS_INFEASIBLE
        settings.max_iter, settings.max_iter_in = _MAX_ITERATIONS, _MAX_INNER_ITERATIONS
        settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START
        self._no_equality = np.zeros(0)
        self._multipliers = np.zeros(m + n)

    def memory(self) -> Array:
        """Multipliers of the last solution, where the next solve starts, shape ``(m + n,)``."""
        return self._multipliers.copy()

    def recall(self, multipliers: Array) -> None:
        """Start the next solve from these multipliers."""
        self._multipliers = multipliers.copy()

    def solve(self, program: Program) -> QPSolution:
        """Solve; never raises on bad numbers: an unusable input or an uncapped iteration gives ``solved = False``."""
        n, m = self._n, self._m
        if not program.usable():
            return QPSolution(np.zeros(n), np.zeros(m + n), False, 0)
        if program.rows is None:
            found = exchange(program, self._multipliers)
            if found is not None:
                self._multipliers = found.multipliers
                return found
        else:
            self._rows[:m], self._low[:m], self._high[:m] = program.rows
        self._low[m:], self._high[m:] = program.lower, program.upper
        # Bounds that do not exist are large numbers to ProxQP, not infinities.
        low, high = np.maximum(self._low, -WIDE), np.minimum(self._high, WIDE)
        solved, x, z, iterations = self._run(program, low, high, self._multipliers)
        if not solved and self._multipliers.any():
            # Multipliers of a program that was too different lead it astray now and then.
            solved, x, z, more = self._run(program, low, high, np.zeros(m + n))
            iterations += more
        if solved:
            x, z = polished(program, x, z)
        self._multipliers = z if solved else np.zeros(m + n)
        # The tolerance leaves a bound crossed by up to eps; what reaches a plant must not be.
        return QPSolution(np.clip(x, program.lower, program.upper), z, solved, iterations)

    def _run(self, program: Program, low: Array, high: Array, start: Array) -> tuple[bool, Array, Array, int]:
        """ProxQP from these multipliers: whether it has solved it, minimiser, multipliers, iterations."""
        self._qp.init(program.H, program.g, None, None, self._rows, low, high)
        self._qp.solve(np.zeros(self._n), self._no_equality, start)
        results = self._qp.results
        x, z = np.array(results.x), np.array(results.z)
        solved = results.info.status == proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED and bool(np.isfinite(x).all())
        return solved, x, z, int(results.info.iter)


def exchange(program: Program, multipliers: Array) -> QPSolution | None:
    """Block principal pivoting for a program with bounds only, started from the bounds these multipliers are of.

    J. J. Judice, F. M. Pires, "A block principal pivoting algorithm for large-scale strictly monotone linear complementarity
    problems", Computers and Operations Research 21 (1994) 587-596: all variables on a wrong side change it at once, while that
    makes them fewer; else the last of them alone, by which no set can come back.

    Returns:
        The minimiser; ``None`` where ``H`` is not positive definite, or the active set is not found in ``_MAX_EXCHANGES``.
    """
    H, g, lower, upper, _ = program
    stationary = _STATIONARY * max(1.0, float(np.abs(g).max()))
    if not multipliers.any():
        _, x, failed = dposv(H, -g)
        if not failed and (x <= upper).all() and (x >= lower).all() and np.abs(H @ x + g).max() <= stationary:
            return QPSolution(x, np.zeros_like(x), True, 1)
    at_upper, at_lower = multipliers > 0, multipliers < 0
    fewest, patience = g.size + 1, _PATIENCE
    for iteration in range(1, _MAX_EXCHANGES + 1):
        active = at_upper | at_lower
        free = ~active
        if active.any():
            bound = np.where(at_upper, upper, np.where(at_lower, lower, 0.0))
            # The rows and columns of what is at a bound become those of the unit matrix.
            reduced, right = H * free * free[:, None], bound - free * (g + H @ bound)
            reduced.flat[:: g.size + 1] += active
        else:
            reduced, right = H, -g
        _, x, failed = dposv(reduced, right)
        if failed:
            return None
        slope = -(H @ x + g)
        if not np.abs(slope * free).max() <= stationary:
            return None
        slope *= active
        over, under = x > upper + _CROSSED, x < lower - _CROSSED
        wrong = over | under | (at_upper & (slope < 0)) | (at_lower & (slope > 0))
        count = int(np.count_nonzero(wrong))
        if count == 0:
            return QPSolution(np.minimum(np.maximum(x, lower), upper), slope, True, iteration)
        if count < fewest:
            fewest, patience = count, _PATIENCE
        elif patience:
            patience -= 1
        else:
            wrong[: np.flatnonzero(wrong)[-1]] = False
        # What is at a bound is freed; what is free goes to the bound it has crossed.
        at_upper, at_lower = (at_upper & ~wrong) | (over & wrong), (at_lower & ~wrong) | (under & wrong)
    return None


def limits() -> dict[str, object]:
    """What ``qp.c`` is to know in order to exchange as ``exchange`` does."""
    found = {"max_exchanges": _MAX_EXCHANGES, "patience": _PATIENCE, "crossed": _CROSSED, "stationary": _STATIONARY}
    return {f"qp_{name}": value for name, value in found.items()}
