"""What a prediction is asked and what it answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.model import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Horizon:
    """A horizon as consecutive pieces of equal steps; a sample is one piece, or several where something known happens inside it.

    Attributes:
        counts, lengths: number and length (s) of the steps of each piece, shape ``(n,)``.
        moves: which move is in force in each piece.
        rows: which row of ``p`` and ``u`` holds in each piece.
        ends: 1 where a sample ends with the piece.
        p: parameters, shape ``(n_rows, n_p)``.
        u: commands; those that the moves set are overwritten, shape ``(n_rows, n_u)``.
    """

    counts: NDArray[np.int32]
    lengths: Array
    moves: NDArray[np.int32]
    rows: NDArray[np.int32]
    ends: NDArray[np.int32]
    p: Array
    u: Array

    @staticmethod
    def plain(count: int, h: float, moves: Sequence[int], state: State, p: Array) -> Horizon:
        """Samples of ``count`` steps of ``h`` seconds with everything but the moves as it is; ``moves`` has one entry a sample."""
        n = len(moves)
        return Horizon(
            np.full(n, count, dtype=np.int32),
            np.full(n, h),
            np.array(moves, dtype=np.int32),
            np.zeros(n, dtype=np.int32),
            np.ones(n, dtype=np.int32),
            np.ascontiguousarray(p, dtype=float)[None],
            np.array(state.u)[None],
        )

    @property
    def sample_moves(self) -> NDArray[np.int32]:
        """The move in force in each sample, shape ``(N,)``."""
        return np.ascontiguousarray(self.moves[self.ends > 0])


@dataclass(frozen=True)
class Rollout:
    """A prediction.

    Attributes:
        y: selected outputs at the end of each sample, shape ``(N, n_y)``.
        dy: derivatives to the moves, shape ``(N, n_y, n_moves * n_u)``, the commands of one move together; or ``None``.
        dx: derivatives to the initial states, shape ``(N, n_y, n_x)``; or ``None``.
    """

    y: Array
    dy: Array | None = None
    dx: Array | None = None


@dataclass(frozen=True)
class Transition:
    """Consecutive steps linearised: where they end, and how that depends on where they begin and on the commands.

    Attributes:
        x, y: states and selected outputs at the end, shapes ``(n_x,)`` and ``(n_y,)``.
        A, B: derivatives of ``x`` to the states at the beginning and to the commands, shapes ``(n_x, n_x)`` and ``(n_x, n_u)``.
        C, D: derivatives of ``y`` to the states at the end and to the commands, shapes ``(n_y, n_x)`` and ``(n_y, n_u)``.
    """

    x: Array
    y: Array
    A: Array
    B: Array
    C: Array
    D: Array
