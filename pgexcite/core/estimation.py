"""Estimators: what they are told of a unit's terminals, what they answer, and how they are configured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

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
