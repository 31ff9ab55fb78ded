"""Conditions that events wait for: a signal goes beyond a threshold and stays there, as a relay sees it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.events import Change, When
from pgexcite.core.model import Model

Array = NDArray[np.float64]

_ROUNDING = 1e-9


class Triggers:
    """Watches the conditions of the changes that wait for one. Each condition comes true once.

    Args:
        model: its outputs are watched.
        changes: those that wait (``when`` is not ``None``).
        h: time between samples, s.

    Attributes:
        elapsed: s for which each condition has held since its first sample, negative where it does not, shape ``(n,)``.
        fired: when each came true, s; NaN until then, shape ``(n,)``.
    """

    def __init__(self, model: Model, changes: Sequence[Change], h: float) -> None:
        self._changes, self._h = changes, h
        self._conditions = tuple(dict.fromkeys(change.when for change in changes if change.when is not None))
        self._columns = np.array([model.position("y", when.signal) for when in self._conditions], dtype=int)
        self._sign = np.array([1.0 if when.below is None else -1.0 for when in self._conditions])
        self._threshold = np.array([when.threshold for when in self._conditions])
        self._after = np.array([when.after for when in self._conditions])
        self._lasting = np.array([when.lasting for when in self._conditions])
        self.elapsed: Array = np.full(len(self._conditions), -1.0)
        self.fired: Array = np.full(len(self._conditions), np.nan)

    def first(self, t: Array, y: Array) -> int | None:
        """The first of consecutive samples of the outputs, shape ``(n, n_y)``, at which a condition comes true."""
        if not self._columns.size or not t.size:
            return None
        due = self._due(self._held(t, y)).any(axis=1)
        return int(np.argmax(due)) if due.any() else None

    def take(self, t: Array, y: Array) -> list[Change]:
        """Go through samples the last of which may make conditions come true; the changes that then have a time."""
        if not self._columns.size or not t.size:
            return []
        held, now = self._held(t, y)[-1], float(t[-1])
        due = self._due(held)
        self.elapsed = held
        self.fired[due] = now
        return self._timed([self._conditions[k] for k in np.flatnonzero(due)], now)

    def past(self) -> list[Change]:
        """The changes of all conditions that have come true, with their times."""
        return [
            change
            for when, t in zip(self._conditions, self.fired.tolist(), strict=True)
            for change in self._timed([when], t)
            if not np.isnan(t)
        ]

    def memory(self) -> dict[str, Array]:
        """``elapsed`` and ``fired`` of each condition, under what it says."""
        both = np.column_stack((self.elapsed, self.fired))
        return {repr(when): row for when, row in zip(self._conditions, both, strict=True)}

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off; a condition that is not in it has never held."""
        for k, when in enumerate(self._conditions):
            self.elapsed[k], self.fired[k] = memory.get(repr(when), (-1.0, np.nan))

    def _held(self, t: Array, y: Array) -> Array:
        """For how long each condition has held at each sample, s; negative where it does not."""
        armed = t[:, None] >= self._after - _ROUNDING
        holds = armed & (self._sign * (y[:, self._columns] - self._threshold) > 0)
        steps = np.arange(1, t.size + 1)[:, None]
        last_out = np.maximum.accumulate(np.where(holds, 0, steps), axis=0)
        goes_on = (last_out == 0) & (self.elapsed >= 0)
        return np.where(holds, (steps - last_out) * self._h + np.where(goes_on, self.elapsed, -self._h), -1.0)

    def _due(self, held: Array) -> NDArray[np.bool_]:
        return (held >= self._lasting - _ROUNDING) & np.isnan(self.fired)

    def _timed(self, conditions: Sequence[When], t: float) -> list[Change]:
        return [
            replace(change, t=t + change.t, when=None, text=f"{change.text}, for {change.when}")
            for change in self._changes
            if change.when in conditions
        ]
