"""Estimators: what they are told of a unit's terminals, what they answer, how they are configured, and how they look in C."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.equivalent import Equivalent
from pgexcite.core.settings import Compile

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """What a unit and the rest of the grid are believed to be.

    Attributes:
        sound: whether it may be used; where not, the estimator has diverged or is starting anew.
        value: in the order of the equivalent's ``layout``, shape ``(layout.size,)``.
        diagnostics: numbers worth recording, by name.
    """

    sound: bool
    value: Array
    diagnostics: Mapping[str, float]


class Observer(Protocol):
    """An estimator at work in one run. Its ``memory`` is all it keeps between samples."""

    def observe(self, terminals: Array | None, e_fd: float) -> Estimate:
        """One sample further.

        Args:
            terminals: measured at this instant, in the order of ``pgexcite.core.equivalent.TERMINALS``; ``None`` where lost.
            e_fd: field voltage since the last sample, pu.
        """
        ...

    def memory(self) -> Mapping[str, Array]:
        """What it remembers, as arrays."""
        ...

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        ...


class Estimator(Protocol):
    """An estimator as configured: a frozen pydantic class registered under ``pgexcite.estimators``."""

    @property
    def x_s(self) -> float:
        """Reactance between the terminals and the equivalent bus assumed at first, pu of the unit's base."""
        ...

    def start(self, equivalent: Equivalent, dt: float, compile: Compile) -> Observer:
        """Begin a run with this sample time, s."""
        ...


@dataclass(frozen=True)
class Written:
    """An observer as C, for an exported controller. ``text`` goes below the functions, constants, arrays, ``step.c``, ``dense.c``.

    It offers, for terminals as ``Observer.observe`` is told them (null where lost)::

        static double estimator_value[], estimator_told[];
        static void estimator_reset(void);
        static int estimator_observe(const double *terminals, double e_fd); /* is the estimate sound */

    Attributes:
        functions: CasADi functions it calls by their names.
        constants: macros it expects.
        arrays: constant arrays it expects.
        text: C99 that allocates nothing and names nothing that has external linkage.
        told: names of the numbers in ``estimator_told``.
    """

    functions: tuple[ca.Function, ...]
    constants: Mapping[str, object]
    arrays: Mapping[str, Array]
    text: str
    told: tuple[str, ...]


@runtime_checkable
class Writable(Protocol):
    """An observer that can be written as C."""

    def written(self) -> Written:
        """It as it is before its first sample."""
        ...
