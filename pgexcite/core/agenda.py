"""The events of a run in the order in which they happen, those among them that wait for a condition."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.errors import Problem
from pgexcite.core.events import Change, boundary
from pgexcite.core.memory import those_under, under
from pgexcite.core.model import Model
from pgexcite.core.triggers import Triggers

Array = NDArray[np.float64]


class Agenda:
    """What is still to happen.

    Args:
        model: its outputs are what changes may wait for.
        changes: in any order.
        h: step, s.

    Attributes:
        changes: those that have a time by now, in order of time, past ones included.
    """

    def __init__(self, model: Model, changes: Sequence[Change], h: float) -> None:
        self._h = h
        self._triggers = Triggers(model, [change for change in changes if change.when is not None], h)
        self._timed = _in_order(change for change in changes if change.when is None)
        self.changes: list[Change] = self._timed
        self._pending = list(self._timed)

    def due(self, k: int) -> list[Change]:
        """The changes that happen at step boundary ``k`` and have not been taken yet; they are taken by this."""
        due = []
        while self._pending and self._boundary(self._pending[0]) <= k:
            due.append(self._pending.pop(0))
        return due

    def next(self) -> int | None:
        """Step boundary of the next change that has a time."""
        return self._boundary(self._pending[0]) if self._pending else None

    def first(self, t: Array, y: Array) -> int | None:
        """The first of consecutive samples of the outputs, shape ``(n, n_y)``, at which a condition comes true."""
        return self._triggers.first(t, y)

    def watch(self, t: Array, y: Array) -> None:
        """Go through samples the last of which may make conditions come true; what waited for them then has a time."""
        if fired := self._triggers.take(t, y):
            self.changes, self._pending = _in_order([*self.changes, *fired]), _in_order([*self._pending, *fired])

    def memory(self, k: int) -> dict[str, Array]:
        """What it goes on from at step boundary ``k``."""
        taken = sum(self._boundary(change) == k for change in self.changes)
        taken -= sum(self._boundary(change) == k for change in self._pending)
        return {"applied_here": np.array(taken), **under("trigger", self._triggers.memory())}

    def recall(self, memory: Mapping[str, Array], k: int) -> None:
        """Take up where ``memory(k)`` left off; what happens before that is taken as past."""
        self._triggers.recall(those_under("trigger", memory))
        self.changes = _in_order([*self._timed, *self._triggers.past()])
        here = [change for change in self.changes if self._boundary(change) == k]
        later = [change for change in self.changes if self._boundary(change) > k]
        self._pending = here[int(memory["applied_here"]) :] + later

    def _boundary(self, change: Change) -> int:
        return boundary(change.t, self._h)


def _in_order(changes: Iterable[Change]) -> list[Change]:
    return sorted(changes, key=lambda change: change.t)


def objections(model: Model, changes: Sequence[Change], controllers: Iterable[str]) -> list[Problem]:
    """What changes refer to that is neither in the model nor switches one of these controllers."""
    problems, names = [], set(controllers)
    for change in changes:
        if change.when is not None and change.when.signal not in model.index["y"]:
            near = model.nearest(change.when.signal)
            problems.append(Problem(change.when.signal, f"no such output ({change.text} waits for it)", hint=near))
        for path, _, _ in change.assignments():
            known = path in model.index["u"] or path in model.index["p"]
            if not known and switched(path) not in names:
                near = model.nearest(path)
                when = f"event at t = {change.t:g} s" if change.when is None else f"event when {change.when}"
                problems.append(Problem(path, f"no such parameter or set-point ({when})", hint=near))
    return problems


def switched(path: str) -> str:
    """The controller that a path ``controller.NAME.active`` switches, or ``""``."""
    head, _, name = path.removesuffix(".active").partition(".")
    return name if head == "controller" and path.endswith(".active") else ""
