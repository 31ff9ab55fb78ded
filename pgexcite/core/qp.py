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
    """Solves programs of one size.

    Every solve starts cold: the answer depends on nothing but its inputs, so that a run resumed from a snapshot gives the same
    bits.

    Args:
        n: number of variables.
        m: number of general rows.
    """

    def __init__(self, n: int, m: int) -> None:
        self._n, self._m = n, m
        self._no_rows = np.zeros((m, n))
        self._free = np.zeros(m)

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
        C = self._no_rows if rows is None else rows
        low = self._free if rows_lower is None else rows_lower
        high = self._free if rows_upper is None else rows_upper
        finite = all(np.isfinite(a).all() for a in (H, g, C)) and not any(
            np.isnan(a).any() for a in (lower, upper, low, high)
        )
        if not finite or (lower > upper).any() or (low > high).any():
            return QPSolution(np.zeros(n), np.zeros(m + n), False, 0)
        qp = proxsuite.proxqp.dense.QP(n, 0, m, True)
        settings = qp.settings
        settings.eps_abs, settings.eps_rel = _EPS, 0.0
        # Without the gap a point 4e-7 off an active bound counts as solved.
        settings.check_duality_gap, settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = True, _GAP, 0.0
        settings.max_iter, settings.max_iter_in = _MAX_ITERATIONS, _MAX_INNER_ITERATIONS
        settings.initial_guess = proxsuite.proxqp.InitialGuess.NO_INITIAL_GUESS
        # Bounds that do not exist are large numbers to ProxQP, not infinities.
        wide = 1e20
        qp.init(
            H,
            g,
            None,
            None,
            C if m else None,
            np.maximum(low, -wide) if m else None,
            np.minimum(high, wide) if m else None,
            np.maximum(lower, -wide),
            np.minimum(upper, wide),
        )
        qp.solve()
        results = qp.results
        x = np.array(results.x)
        solved = results.info.status == proxsuite.proxqp.QPSolverOutput.PROXQP_SOLVED and bool(np.isfinite(x).all())
        # The tolerance leaves a bound crossed by up to eps; what reaches a plant must not be.
        return QPSolution(np.clip(x, lower, upper), np.array(results.z), solved, int(results.info.iter))
