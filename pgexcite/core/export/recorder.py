"""A closed loop as it was asked for and answered, line by line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.controller import Sample
from pgexcite.core.export.parts import Parts
from pgexcite.core.ladder import Ladder
from pgexcite.core.mpc import Solution

Array = NDArray[np.float64]


class Recorder:
    """A solver in a ladder that writes down what it is asked and what becomes of its answers.

    A line has the inputs of the controller in C, then what is compared: level of the ladder, commands (those in force at level 2),
    commands sent, cost (infinite where no plan was used), iterations and what is told of an estimate.

    Args:
        session: the ladder; it is given this solver in place of its own, and no deadline: the time a plan took is not repeatable.
        parts: of its solver.

    Attributes:
        lines: one a sample.
    """

    def __init__(self, session: Ladder, parts: Parts) -> None:
        self._session, self._parts, self._solver = session, parts, session.solver
        self._asked: list[Array | float] = []
        self._in_force, self._cost, self._iterations = np.empty(0), np.inf, 0
        self._told: list[float] = []
        self.lines: list[str] = []
        session.solver = self
        session.options = replace(session.options, deadline_ms=0.0)

    def solve(self, sample: Sample, u_last: Array) -> Solution:
        self._asked, self._in_force = list(self._parts.record(sample, u_last)), u_last
        self._cost, self._iterations = np.inf, 0
        solution = self._solver.solve(sample, u_last)
        self._cost, self._iterations = solution.cost, solution.iterations
        self._told = [solution.diagnostics[name] for name in self._parts.told]
        return solution

    def prepare(self, u: Array) -> None:
        problem, level = self._session.problem, self._session.level
        followed = u if level < 2 else np.clip(self._in_force, problem.u_min, problem.u_max)
        cost = self._cost if level == 0 else np.inf
        values = [*self._asked, level, followed, u, cost, self._iterations, *self._told]
        self.lines.append(" ".join(_written(value) for value in values))
        self._solver.prepare(u)

    def memory(self) -> Mapping[str, Array]:
        return self._solver.memory()

    def recall(self, memory: Mapping[str, Array]) -> None:
        self._solver.recall(memory)


def _written(value: Array | float) -> str:
    numbers = np.atleast_1d(np.asarray(value)).ravel().tolist()
    return " ".join(repr(number) for number in numbers)
