"""What things remember, as named arrays: enough to go on from, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.model import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Memory:
    """All that a simulation goes on from; a snapshot holds it.

    Attributes:
        state: the plant's.
        p: its parameters, shape ``(n_p,)``.
        kept: what all else remembers, by name: ``controller:NAME:...``, ``instruments:NAME``, ...
    """

    state: State
    p: Array
    kept: Mapping[str, Array]


def as_arrays(values: Mapping[str, Any]) -> dict[str, Array]:
    """Numbers and sequences as float arrays."""
    return {key: np.asarray(value, dtype=float) for key, value in values.items()}


def under(name: str, memory: Mapping[str, Array]) -> dict[str, Array]:
    """The memory of a part, with the part's name before each of its own."""
    return {f"{name}:{key}": value for key, value in memory.items()}


def those_under(name: str, memory: Mapping[str, Array]) -> dict[str, Array]:
    """The memory of a part back from that of the whole, where ``under`` has put it."""
    start = f"{name}:"
    return {key.removeprefix(start): value for key, value in memory.items() if key.startswith(start)}
