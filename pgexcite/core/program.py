"""What a quadratic program is, what solves it, and what comes out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Rows(NamedTuple):
    """General rows of a program: ``lower <= matrix x <= upper``.

    Attributes:
        matrix: shape ``(m, n)``.
        lower: shape ``(m,)``; ``-inf`` where there is no such bound.
        upper: shape ``(m,)``; ``inf`` where there is no such bound.
    """

    matrix: Array
    lower: Array
    upper: Array


class Program(NamedTuple):
    """Minimise ``x'Hx/2 + g'x`` subject to ``lower <= x <= upper`` and to rows.

    A tuple, for one is made in every iteration of a control loop.

    Attributes:
        H: symmetric, shape ``(n, n)``.
        g: shape ``(n,)``.
        lower: shape ``(n,)``; ``-inf`` where there is no such bound.
        upper: shape ``(n,)``; ``inf`` where there is no such bound.
        rows: ``None`` where there is nothing but the box.
    """

    H: Array
    g: Array
    lower: Array
    upper: Array
    rows: Rows | None = None

    def usable(self) -> bool:
        """Whether a solver may be handed this: finite, and no bound above its opposite (a NaN compares false)."""
        # A sum is finite only if every term is: cheaper than a look at each.
        if not math.isfinite(self.H.sum() + self.g.sum()) or not (self.lower <= self.upper).all():
            return False
        if self.rows is None:
            return True
        return bool(math.isfinite(self.rows.matrix.sum()) and (self.rows.lower <= self.rows.upper).all())


@dataclass(frozen=True)
class QPSolution:
    """Minimiser of a program with ``n`` variables and ``m`` rows.

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


class QPSolver(Protocol):
    """What solves programs."""

    def solve(self, program: Program) -> QPSolution:
        """Solve; never raises on bad numbers: ``solved`` says whether it did."""
        ...
