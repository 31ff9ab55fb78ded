"""Small dense quadratic programs by ProxQP, with its iteration caps set so that it cannot stall a control loop.

ProxQP's default limits let a contradictory problem of ten variables run for half a minute. Inputs are therefore checked first and
the caps are the deadline.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import proxsuite
from numpy.typing import NDArray

Array = NDArray[np.float64]

_EPS = 1e-10
_GAP = 1e-8
_EPS_INFEASIBLE = 1e-12
WIDE = 1e20
_MAX_ITERATIONS = 60
_MAX_INNER_ITERATIONS = 60


@dataclass(frozen=True)
class QPSolution:
    """Minimiser of ``x'Hx/2 + g'x`` subject to ``lower <= x <= upper`` and ``rows_lower <= rows x <= rows_upper``.

    Attributes:
        x: shape ``(n,)``.
        multipliers: of the rows, then of the box, positive at an upper bound, shape ``(m + n,)``.
        solved: whether the optimality conditions hold to the solver's tolerance.
        iterations: inner iterations of the solver.
    """

    x: Array
    multipliers: Array
    solved: bool
    iterations: int


class QuadraticProgram:
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
        # of infeasibility to its own tolerance of 1e-4. What has no solution ends at the caps.
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

    def solve(
        self,
        H: Array,
        g: Array,
        lower: Array,
        upper: Array,
        rows: Array | None = None,
        rows_lower: Array | None = None,
        rows_upper: Array | None = None,
    ) -> QPSolution:
        """Solve; never raises on bad numbers: an unusable input or an uncapped iteration gives ``solved = False``."""
        n, m = self._n, self._m
        if not usable(H, g, lower, upper, rows, rows_lower, rows_upper):
            return QPSolution(np.zeros(n), np.zeros(m + n), False, 0)
        if m:
            self._rows[:m], self._low[:m], self._high[:m] = rows, rows_lower, rows_upper
        self._low[m:], self._high[m:] = lower, upper
        # Bounds that do not exist are large numbers to ProxQP, not infinities.
        low, high = np.maximum(self._low, -WIDE), np.minimum(self._high, WIDE)
        self._qp.init(H, g, None, None, self._rows, low, high)
        self._qp.solve(np.zeros(n), self._no_equality, self._multipliers)
        results = self._qp.results
        x, z = np.array(results.x), np.array(results.z)
        solved = results.info.status == proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED and bool(np.isfinite(x).all())
        self._multipliers = z if solved else np.zeros(m + n)
        # The tolerance leaves a bound crossed by up to eps; what reaches a plant must not be.
        return QPSolution(np.clip(x, lower, upper), z, solved, int(results.info.iter))


def usable(
    H: Array,
    g: Array,
    lower: Array,
    upper: Array,
    rows: Array | None,
    rows_lower: Array | None,
    rows_upper: Array | None,
) -> bool:
    """Whether a solver may be handed this: finite, and no bound above its opposite (a NaN compares false)."""
    # A sum is finite only if every term is: cheaper than a look at each.
    if not np.isfinite(H.sum() + g.sum()) or not (lower <= upper).all():
        return False
    if rows is None or rows_lower is None or rows_upper is None:
        return True
    return bool(np.isfinite(rows.sum()) and (rows_lower <= rows_upper).all())
