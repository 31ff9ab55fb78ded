"""Sparse LU written out symbolically in a fixed order, so that one Newton iteration is one straight-line function.

Equations are first paired with unknowns by a maximum-product matching (without it a lossless network has zero pivots on its
diagonal), then the pairs are eliminated in Markowitz order (minimum fill). The same factors serve any number of right-hand sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from pgexcite.core.errors import AssemblyError

Array = NDArray[np.float64]

_NEVER = 1e-30
"""Magnitude given to an entry that is zero in some of the samples: chosen as a pivot only where there is no other way."""


def pair_equations(samples: Sequence[Array], pattern: NDArray[np.bool_]) -> NDArray[np.intp]:
    """For each unknown the equation it is eliminated with, maximising the product of the pivots' magnitudes.

    Args:
        samples: Jacobians of shape ``(n, n)`` at several points (limits on and off, a fault on and off). An entry counts with its
            smallest magnitude, so that a pairing good at all of them is found.
        pattern: structural nonzeros, shape ``(n, n)``.

    Returns:
        ``(n,)``: row paired with each column.

    Raises:
        AssemblyError: the equations are structurally singular.
    """
    scaled = [_row_scaled(np.abs(sample)) for sample in samples]
    smallest, largest = np.min(scaled, axis=0), np.max(scaled, axis=0)
    # Among entries that vanish at some point, one that is there at others comes before one that never is (an R or X of zero).
    weight = np.where(pattern, -np.log(np.maximum(smallest, _NEVER * np.maximum(largest, _NEVER))) + 1.0, 0.0)
    weight[pattern] -= weight[pattern].min(initial=0.0) - 1.0
    try:
        rows, cols = min_weight_full_bipartite_matching(sp.csr_matrix(weight))
    except ValueError as cause:
        raise AssemblyError(f"the equations are structurally singular: {cause}") from cause
    order = np.empty(pattern.shape[0], dtype=np.intp)
    order[cols] = rows
    return order


def _row_scaled(sample: Array) -> Array:
    largest = sample.max(axis=1, keepdims=True)
    return sample / np.where(largest > 0, largest, 1.0)


class SymbolicLU:
    """Factors of a sparse SX matrix, written out.

    Attributes:
        pivots: the pivots as expressions, in order of elimination.
        entries: number of nonzeros of the factors.
    """

    def __init__(self, matrix: ca.SX, pairing: NDArray[np.intp]) -> None:
        n = matrix.shape[0]
        row_of = {int(row): col for col, row in enumerate(pairing)}
        rows: list[dict[int, Any]] = [{} for _ in range(n)]
        entry_rows, entry_cols = matrix.sparsity().get_triplet()
        for value, i, j in zip(matrix.nonzeros(), entry_rows, entry_cols, strict=True):
            rows[row_of[i]][j] = value
        self._pairing = pairing
        self._steps: list[tuple[int, list[tuple[int, Any]], dict[int, Any]]] = []
        self._eliminate(rows)
        self.pivots = [upper[k] for k, _, upper in self._steps]
        self.entries = sum(len(lower) + len(upper) for _, lower, upper in self._steps)

    def _eliminate(self, rows: list[dict[int, Any]]) -> None:
        n = len(rows)
        users: list[set[int]] = [set() for _ in range(n)]
        for i, row in enumerate(rows):
            for j in row:
                users[j].add(i)
        left = set(range(n))
        while left:
            k = min(left, key=lambda c: ((len(rows[c]) - 1) * (len(users[c]) - 1), c))
            left.remove(k)
            pivot_row = rows[k]
            inverse = 1 / pivot_row[k]
            lower = []
            for i in sorted(users[k] - {k}):
                factor = rows[i].pop(k) * inverse
                lower.append((i, factor))
                for j, value in pivot_row.items():
                    if j == k:
                        continue
                    rows[i][j] = rows[i][j] - factor * value if j in rows[i] else -factor * value
                    users[j].add(i)
            for j in pivot_row:
                users[j].discard(k)
            users[k] = set()
            self._steps.append((k, lower, dict(pivot_row)))

    def solve(self, rhs: ca.SX) -> ca.SX:
        """Solve for one or more right-hand sides, shape ``(n, m)``; structural zeros of ``rhs`` cost nothing."""
        n, m = rhs.shape
        columns = []
        for column in range(m):
            b: list[Any] = [0] * n
            for k in range(n):
                row = int(self._pairing[k])
                b[k] = rhs[row, column] if rhs.sparsity().has_nz(row, column) else 0
            for k, lower, _ in self._steps:
                if not _is_zero(b[k]):
                    for i, factor in lower:
                        b[i] = b[i] - factor * b[k]
            x: list[Any] = [0] * n
            for k, _, upper in reversed(self._steps):
                total = b[k]
                for j, value in upper.items():
                    if j != k and not _is_zero(x[j]):
                        total = total - value * x[j]
                x[k] = 0 if _is_zero(total) else total / upper[k]
            columns.append(ca.vertcat(*x))
        return ca.horzcat(*columns) if columns else ca.SX(n, 0)


def _is_zero(value: Any) -> bool:
    return isinstance(value, int) or bool(value.is_zero())
