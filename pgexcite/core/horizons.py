"""Horizons of a control problem: its intervals cut into steps, with what is known to happen on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.events import Change
from pgexcite.core.model import Model
from pgexcite.core.mpc import ControlProblem
from pgexcite.core.rollout import Horizon

Array = NDArray[np.float64]

_SAME_INSTANT = 1e-9


@dataclass(frozen=True)
class _Plain:
    """A horizon on which nothing is known to happen.

    Attributes:
        pieces: counts, lengths, moves, rows and ends, as ``Horizon`` has them.
        ends: of the intervals, s from the start, shape ``(N,)``.
    """

    pieces: tuple[NDArray[np.int32], Array, NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]
    ends: Array

    @staticmethod
    def of(intervals: Array, count: int, moves: NDArray[np.int32]) -> _Plain:
        """Intervals (s) of ``count`` steps each."""
        n = intervals.size
        counts, rows, ends = np.full(n, count, np.int32), np.zeros(n, np.int32), np.ones(n, np.int32)
        return _Plain((counts, intervals / count, moves, rows, ends), np.cumsum(intervals))


@dataclass(frozen=True)
class Horizons:
    """Makes the horizon of each sample.

    Args:
        model: the model that predicts.
        problem: the control problem.
        h: prediction step in the first interval, s; it grows with the intervals.
        grid: the plant's step, s: a known event takes place at the first of its ends not before it. It divides the sample time.
    """

    model: Model
    problem: ControlProblem
    h: float
    grid: float

    def at(self, t: float, u: Array, p: Array) -> Horizon:
        """The horizon that begins at ``t`` with commands ``u`` and parameters ``p`` in force."""
        return self._cut(self._whole, t, u, p)

    def first(self, t: float, u: Array, p: Array) -> Horizon:
        """Its first interval alone, in the plant's own steps."""
        return self._cut(self._sample, t, u, p)

    def on_grid(self, length: float) -> float:
        """A piece's step, and the plant's own where it is that but for rounding: timers are expected to the last bit."""
        return self.grid if abs(length - self.grid) < 1e-9 * self.grid else float(length)

    @cached_property
    def _whole(self) -> _Plain:
        problem = self.problem
        count = max(1, round(problem.dt / self.h))
        return _Plain.of(problem.intervals(), count, problem.moves_per_sample())

    @cached_property
    def _sample(self) -> _Plain:
        dt = self.problem.dt
        return _Plain.of(np.array([dt]), max(1, round(dt / self.grid)), np.zeros(1, dtype=np.int32))

    def _cut(self, plain: _Plain, t: float, u: Array, p: Array) -> Horizon:
        row_u, row_p = self._fixed(u), np.array(p, dtype=float)
        ends = t + plain.ends
        pending = [(self.instant(change), change) for change in self.problem.known]
        pending = [item for item in pending if t + _SAME_INSTANT < item[0] < ends[-1] - _SAME_INSTANT]
        if not pending:
            return Horizon(*plain.pieces, row_p[None], row_u[None])
        us, ps = [row_u], [row_p]
        pieces: list[tuple[int, float, int, int, int]] = []
        here = t
        for end, h, count, move in zip(ends, *(plain.pieces[k] for k in (1, 0, 2)), strict=True):
            begun = len(ps)
            while pending and pending[0][0] < end - _SAME_INSTANT:
                instant, change = pending.pop(0)
                pieces += _piece(instant - here, h, int(move), len(ps) - 1, ends=False)
                row_u, row_p = self._changed(row_u, row_p, change)
                us.append(row_u)
                ps.append(row_p)
                here = max(here, instant)
            if len(ps) == begun:
                pieces.append((int(count), float(h), int(move), len(ps) - 1, 1))
            else:
                pieces += _piece(end - here, h, int(move), len(ps) - 1, ends=True)
            here = end
            while pending and pending[0][0] <= end + _SAME_INSTANT:
                _, change = pending.pop(0)
                row_u, row_p = self._changed(row_u, row_p, change)
                us.append(row_u)
                ps.append(row_p)
        counts, lengths, moves, rows, closing = zip(*pieces, strict=True)
        return Horizon(
            np.array(counts, dtype=np.int32),
            np.array(lengths),
            np.array(moves, dtype=np.int32),
            np.array(rows, dtype=np.int32),
            np.array(closing, dtype=np.int32),
            np.array(ps),
            np.array(us),
        )

    def until(self, t: float, u: Array, p: Array) -> tuple[Array, Array]:
        """Commands and parameters in force at ``t``, from those at the start of the run and the changes that are known."""
        u = self._fixed(u)
        for change in self.problem.known:
            if self.instant(change) <= t + _SAME_INSTANT:
                u, p = self._changed(u, p, change)
        return u, p

    def between(self, t: float, until: float, u: Array, p: Array) -> tuple[Array, Array]:
        """Commands and parameters in force at ``until`` where ``u`` and ``p`` were at ``t``, as far as changes are known."""
        for change in self.problem.known:
            if t + _SAME_INSTANT < self.instant(change) <= until + _SAME_INSTANT:
                u, p = self._changed(u, p, change)
        return u, p

    def changes_at(self, t: float) -> bool:
        """Whether a known change takes place at ``t``."""
        return any(abs(self.instant(change) - t) <= _SAME_INSTANT for change in self.problem.known)

    def instant(self, change: Change) -> float:
        """When a known change takes place, s."""
        return float(np.ceil(change.t / self.grid - 1e-6) * self.grid)

    def _fixed(self, u: Array) -> Array:
        u = np.array(u, dtype=float)
        for path, value in self.problem.fixed.items():
            u[self.model.position("u", path)] = value
        return u

    def _changed(self, u: Array, p: Array, change: Change) -> tuple[Array, Array]:
        """Commands and parameters after a change; what this model does not have is left out."""
        u, p, index = u.copy(), p.copy(), self.model.index
        for path, value, added in change.assignments():
            for array, group in ((u, "u"), (p, "p")):
                if path in index[group]:
                    k = index[group][path]
                    array[k] = array[k] + value if added else value
        return self._fixed(u), p


def _piece(duration: float, h: float, move: int, row: int, *, ends: bool) -> Sequence[tuple[int, float, int, int, int]]:
    """A piece of this duration in equal steps of about ``h``; none for a duration of zero that ends no sample."""
    if duration <= _SAME_INSTANT and not ends:
        return []
    count = max(1, int(np.ceil(duration / h - 1e-6)))
    return [(count, duration / count, move, row, int(ends))]
