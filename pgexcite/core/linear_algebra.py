"""Sparse LU written out symbolically in a fixed order, so that one Newton iteration is one straight-line function.

Equations are first paired with unknowns by a maximum-product matching (without it a lossless network has zero pivots on its
diagonal), then the pairs are eliminated in order of least fill. The same factors serve any number of right-hand sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heapify, heappop, heappush
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from pgexcite.core.errors import AssemblyError

Array = NDArray[np.float64]

_WEAKEST = 1e-2
"""Pivot that is eliminated without waiting, relative to its row or its column."""
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


class Entry(NamedTuple):
    """A coefficient of a system.

    Attributes:
        value: expression.
        online: whether it has to be computed anew in every iteration.
        samples: its value at several points.
    """

    value: Any
    online: bool
    samples: Array


Rows = dict[int, dict[int, Entry]]
"""A sparse system: for each unknown the row it is eliminated with, as coefficients by unknown."""


def _product(a: Entry, b: Entry) -> Entry:
    return Entry(a.value * b.value, a.online or b.online, a.samples * b.samples)


def _difference(a: Entry | None, b: Entry) -> Entry:
    if a is None:
        return Entry(-b.value, b.online, -b.samples)
    return Entry(a.value - b.value, a.online or b.online, a.samples - b.samples)


class SymbolicLU:
    """Factors of a sparse system of expressions, written out.

    Unknowns are eliminated in order of least fill, and among these where least is to be computed in every iteration. One whose
    pivot changes its sign between the sample points, or is small beside both its row and its column at any of them, waits for
    others to be eliminated: somewhere between two rotor angles its pivot is zero.

    Args:
        rows: the system; used up.

    Attributes:
        pivots: the pivots as expressions, in order of elimination.
        entries: number of nonzeros of the factors.
    """

    def __init__(self, rows: Rows) -> None:
        self._rows = rows
        self._steps: list[tuple[int, list[tuple[int, Any]], list[tuple[int, Any]], Any]] = []
        self.pivots: list[Any] = []
        self._users: dict[int, set[int]] = {k: set() for k in rows}
        for i, row in rows.items():
            for j in row:
                self._users[j].add(i)
        with np.errstate(all="ignore"):
            self._eliminate()
        self.entries = sum(1 + len(lower) + len(upper) for _, lower, upper, _ in self._steps)

    def _cost(self, k: int) -> tuple[int, int, int] | None:
        """Order in which an unknown comes up; ``None`` while its row does not contain it."""
        row, users, rows = self._rows[k], self._users[k], self._rows
        if k not in row:
            return None
        keys, fill = row.keys(), 0
        for i in users:
            fill += len(keys - rows[i].keys())
        online = row[k].online
        idle_rows = 0 if online else sum(not rows[i][k].online for i in users) - 1
        idle_columns = sum(not entry.online for entry in row.values()) - (not online)
        work = (len(users) - 1) * (len(row) - 1) - idle_rows * idle_columns
        return (fill, work, k)

    def _eliminate(self) -> None:
        costs = {k: self._cost(k) for k in self._rows}
        queue = [cost for cost in costs.values() if cost is not None]
        heapify(queue)
        waiting: list[tuple[float, int]] = []
        while queue or waiting:
            if queue:
                k = queue[0][-1]
                if costs.get(k) != heappop(queue):
                    continue
                strength = self._strength(k)
                if not strength > _WEAKEST:
                    heappush(waiting, (-strength, k))
                    costs[k] = None
                    continue
            else:
                k = heappop(waiting)[1]
                if costs.get(k, k) is not None:
                    continue
            del costs[k]
            for j in self._eliminate_one(k):
                cost = self._cost(j)
                if cost != costs[j]:
                    costs[j] = cost
                    if cost is not None:
                        heappush(queue, cost)
        if costs:
            raise AssemblyError("the equations are structurally singular: an unknown is in no equation that is left")

    def _strength(self, k: int) -> float:
        """Least magnitude of a pivot beside its row or column, whichever is smaller; zero where its sign changes."""
        row, pivot = self._rows[k], self._rows[k][k].samples
        if not pivot.size:
            return 1.0
        if (pivot > 0).any() and (pivot < 0).any():
            return 0.0
        largest = [
            np.abs(entries).max(axis=0)
            for entries in (
                [entry.samples for entry in row.values()],
                [self._rows[i][k].samples for i in self._users[k]],
            )
        ]
        return float(np.nanmin(np.abs(pivot) / np.minimum(*largest), initial=1.0))

    def _eliminate_one(self, k: int) -> set[int]:
        """Eliminate an unknown; which ones this changes the cost of."""
        row, users = self._rows.pop(k), self._users.pop(k) - {k}
        pivot = row.pop(k)
        inverse = Entry(1 / pivot.value, pivot.online, 1 / pivot.samples)
        lower, touched = [], set(users)
        for i in sorted(users):
            target = self._rows[i]
            entry = target.pop(k)
            factor = _product(entry, inverse)
            lower.append((i, factor.value))
            for j, value in row.items():
                product = _product(factor, value)
                target[j] = _difference(target.get(j), product)
                self._users[j].add(i)
            touched.update(target)
        for j in row:
            self._users[j].discard(k)
            touched.update(self._users[j])
        self.pivots.append(pivot.value)
        self._steps.append((k, lower, [(j, entry.value) for j, entry in row.items()], inverse.value))
        return touched | row.keys()

    def solve(self, rhs: ca.SX, pairing: NDArray[np.intp]) -> ca.SX:
        """Solve for the first ``n`` unknowns; the rows of all others have zeros on the right.

        Args:
            rhs: one or more right-hand sides, shape ``(n, m)``; structural zeros cost nothing.
            pairing: row of ``rhs`` that belongs to each of these unknowns.
        """
        n, m = rhs.shape
        has, solution = rhs.sparsity(), []
        for column in range(m):
            b = {k: rhs[int(row), column] for k, row in enumerate(pairing) if has.has_nz(int(row), column)}
            for k, lower, _, _ in self._steps:
                if k in b and not b[k].is_zero():
                    for i, factor in lower:
                        b[i] = b[i] - factor * b[k] if i in b else -factor * b[k]
            x: dict[int, Any] = {}
            for k, _, upper, inverse in reversed(self._steps):
                total = b.get(k, 0)
                for j, value in upper:
                    if j in x:
                        total = total - value * x[j]
                if isinstance(total, ca.SX) and not total.is_zero():
                    x[k] = total * inverse
            solution.append(ca.vertcat(*(x.get(k, 0) for k in range(n))))
        return ca.horzcat(*solution) if solution else ca.SX(n, 0)
