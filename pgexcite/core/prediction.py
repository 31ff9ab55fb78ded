"""Predictions: the kernel's own step rolled out over a horizon, with exact forward sensitivities to the moves.

Each stage is differentiated by the implicit function theorem with the same written-out factors that solved it:
``J dw = -(dr/db db + dr/du du)``. So a prediction is what the simulation will do, to the last bit, and its derivatives are
those of the discrete-time plant. A step that the fixed order of elimination cannot take ends a prediction, in C and in the virtual
machine alike: there are no derivatives through the shorter steps or the pivoting by which a simulation would go on.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.codegen import generate
from pgexcite.core.model import State
from pgexcite.core.rollout import Horizon, Rollout, Transition
from pgexcite.core.sensing import Sensing
from pgexcite.core.sensitivity import write_sensitivities
from pgexcite.core.settings import Rule
from pgexcite.core.step import RULES, STARTUP_STEPS, Kernel

Array = NDArray[np.float64]


class Predictor:
    """Rolls the kernel's step out under a sequence of moves.

    Derivatives come in one of two ways: directly, a column for each move, or as a transition of each sample (columns for its states
    and its commands) chained afterwards. Transitions also give derivatives to the initial states, and are cheaper where there are
    more moves than states.

    Args:
        kernel: of the model that predicts; the predictor has it for itself.
        commands: positions in ``u`` of the ``n_u`` commands the moves set.
        outputs: positions in ``y`` of the outputs wanted.
        n_moves: number of moves.
        rule: integration rule. The prediction runs as C where the kernel does.
        transitions: which way; ``None`` takes the cheaper one.
    """

    def __init__(
        self,
        kernel: Kernel,
        commands: Sequence[int],
        outputs: Sequence[int],
        n_moves: int,
        rule: Rule,
        *,
        transitions: bool | None = None,
    ) -> None:
        self.kernel, self.rule, self._n_moves = kernel, rule, n_moves
        self.commands, self._outputs = np.array(commands, dtype=np.int32), np.array(outputs, dtype=np.int32)
        n_x, n_u = kernel.x.size, len(commands)
        self.transitions = n_x < (n_moves - 1) * n_u if transitions is None else transitions
        columns = n_x + n_u if self.transitions else n_moves * n_u
        self.sensitivities = write_sensitivities(kernel, self.commands, self._outputs)
        self._columns, self._n_x = columns, n_x
        self._sensing = Sensing(kernel, self.sensitivities, self.commands, columns, transitions=self.transitions)
        self._commands_at = _address(self.commands)
        self._call = _Call([np.zeros(n) for n in (n_x, kernel.z.size, kernel.d.size)], n_moves * n_u)

    @cached_property
    def _library(self) -> ctypes.CDLL | None:
        if not self.kernel.compiled:
            return None
        written, loops = self.sensitivities, ["step.c", "rollout.c", "chain.c"]
        called = [*self.kernel.stepping(), *written.functions()]
        constants = self.constants(transitions=self.transitions)
        return self.kernel.library(lambda: generate(called, constants, loops, written.along()), called)

    def make_ready(self) -> None:
        """Compile now what would be compiled for the first prediction, which may have a deadline."""
        _ = self._library

    def constants(self, *, transitions: bool) -> dict[str, object]:
        """What ``rollout.c`` needs to know, with derivatives in this way."""
        n_x, n_u = self._n_x, self.commands.size
        columns = n_x + n_u if transitions else self._n_moves * n_u
        sizes: dict[str, object] = {"n_commands": n_u, "n_columns": columns, "n_selected": self._outputs.size}
        return self.kernel.constants() | self.sensitivities.constants() | sizes | {"transition": int(transitions)}

    def roll(self, state: State, moves: Array, horizon: Horizon, *, derivatives: bool) -> Rollout | None:
        """Predict.

        Args:
            state: where the prediction starts; its commands are those in force before the first move.
            moves: commands, shape ``(n_moves, n_u)``.
            horizon: the pieces, and what is known of them.
            derivatives: whether to propagate sensitivities.

        Returns:
            The prediction, or ``None`` where the model cannot be stepped over the horizon.
        """
        N, (columns, n_x) = int(horizon.ends.sum()), (self._columns, self._n_x)
        y = np.empty((N, self._outputs.size))
        dy = np.zeros((N, columns, self._outputs.size)) if derivatives else np.zeros((0, 0, 0))
        dx = np.zeros((N, columns, n_x)) if derivatives and self.transitions else np.zeros((0, 0, 0))
        roll = self._roll if self._library is None else self._roll_compiled
        if not roll(state, np.ascontiguousarray(moves, dtype=float), horizon, y, dy, dx):
            return None
        if not (np.isfinite(y).all() and np.isfinite(dy).all()):
            return None
        if not derivatives:
            return Rollout(y)
        if not self.transitions:
            return Rollout(y, dy.transpose(0, 2, 1))
        chained = self._condense(horizon.sample_moves, dy, dx)
        return Rollout(y, chained[:, :, n_x:], chained[:, :, :n_x])

    def transition(self, state: State, p: Array, count: int, h: float) -> Transition | None:
        """Linearise ``count`` steps of ``h`` seconds with everything but the state as it is; needs ``transitions=True``.

        Returns:
            The transition, or ``None`` where the model cannot be stepped.
        """
        kernel, (columns, n_x), n_y = self.kernel, (self._columns, self._n_x), self._outputs.size
        segment = kernel.advance(state, p, self.rule, h, count)
        y, dy, dx = np.zeros((1, n_y)), np.zeros((1, columns, n_y)), np.zeros((1, columns, n_x))
        roll = self._roll if self._library is None else self._roll_compiled
        horizon = Horizon.plain(count, h, [0], state, p)
        if segment.failed or not roll(state, np.ascontiguousarray(state.u[self.commands][None]), horizon, y, dy, dx):
            return None
        y, C, D = self.outputs(segment.state, p)
        A, B = dx[0, :n_x].T.copy(), dx[0, n_x:].T.copy()
        if not (np.isfinite(dx).all() and np.isfinite(C).all()):
            return None
        return Transition(segment.state.x, y, A, B, C, D)

    def outputs(self, state: State, p: Array) -> tuple[Array, Array, Array]:
        """Selected outputs at a point and their derivatives to the states and to the commands; needs ``transitions=True``."""
        n_x = self._n_x
        self.kernel.begin(state, p)
        self._sensing.begin()
        self._sensing.point_at(0, fresh=True)
        self._sensing.settling()
        self._sensing.outputs()
        slope = self._sensing.S_y.T.copy()
        return self._sensing.y.copy(), slope[:, :n_x], slope[:, n_x:]

    def _roll_compiled(self, state: State, moves: Array, horizon: Horizon, y: Array, dy: Array, dx: Array) -> bool:
        assert self._library is not None
        call = self._call
        call.load(state, moves, horizon)
        done = self._library.pgexcite_rollout(
            RULES.index(self.rule),
            len(horizon.counts),
            *call.pieces,
            self._commands_at,
            state.startup,
            *call.point,
            *(_address(a) for a in (horizon.p, horizon.u)),
            call.moves,
            int(dy.size > 0),
            *(_address(a) for a in (y, dy, dx)),
        )
        return bool(done == len(horizon.counts))

    def _condense(self, moves: NDArray[np.int32], dy: Array, dx: Array) -> Array:
        """Chained transitions, shape ``(N, n_y, n_x + n_moves * n_u)``."""
        N, n_x, n_u = len(moves), self._n_x, self.commands.size
        columns = n_x + self._n_moves * n_u
        G = np.empty((N, columns, self._outputs.size))
        if self._library is not None:
            X = np.empty((2, columns, n_x))
            self._library.pgexcite_condense(N, self._n_moves, *(_address(a) for a in (moves, dy, dx, X, G)))
            return G.transpose(0, 2, 1)
        X = np.vstack((np.eye(n_x), np.zeros((columns - n_x, n_x))))
        for j, move in enumerate(moves):
            own = slice(n_x + move * n_u, n_x + (move + 1) * n_u)
            G[j] = X @ dy[j, :n_x]
            G[j, own] += dy[j, n_x:]
            X = X @ dx[j, :n_x]
            X[own] += dx[j, n_x:]
        return G.transpose(0, 2, 1)

    def _roll(self, state: State, moves: Array, horizon: Horizon, y: Array, dy: Array, dx: Array) -> bool:
        """The same in CasADi's virtual machine."""
        kernel, sense = self.kernel, dy.size > 0
        kernel.begin(state.with_(u=horizon.u[0]), horizon.p[0])
        self._sensing.begin()
        startup, sample, fresh, last = state.startup, 0, True, 0
        for j, (count, h, move, row) in enumerate(
            zip(horizon.counts, horizon.lengths, horizon.moves, horizon.rows, strict=True)
        ):
            changed = self._enter(horizon, moves[move], int(row), moved=j > 0 and row != last)
            if changed is None:
                return False
            startup, last = STARTUP_STEPS if changed else startup, row
            if sense and (fresh or changed):
                self._sensing.point_at(int(move), fresh=fresh)
                self._sensing.settling()
            for _ in range(count):
                stepped = self._take(float(h), startup, sense=sense)
                if stepped is None:
                    return False
                startup = stepped
            fresh = bool(horizon.ends[j])
            if fresh:
                self._sensing.outputs()
                y[sample] = self._sensing.y
                if sense:
                    dy[sample] = self._sensing.S_y
                if dx.size:
                    dx[sample] = self._sensing.S[:, : self._n_x]
                sample += 1
        return True

    def _enter(self, horizon: Horizon, move: Array, row: int, *, moved: bool) -> bool | None:
        """Put a piece's commands and parameters in force; whether they changed, ``None`` where nothing satisfies them."""
        kernel, u = self.kernel, horizon.u[row].copy()
        u[self.commands] = move
        changed = moved or not np.array_equal(u, kernel.u)
        if changed:
            if moved or self.sensitivities.commands_mass:
                kernel.begin(State(0, 0.0, kernel.x, kernel.z, kernel.d, u), horizon.p[row])
            else:
                self._sensing.command(u)
            if not kernel.settle_here():
                return None
        return changed

    def _take(self, h: float, startup: int, *, sense: bool) -> int | None:
        """One step; the startup steps left, ``None`` where it cannot be taken."""
        kernel = self.kernel
        if not kernel.take(self.rule, h, startup, pivoting=False):
            return None
        if sense:
            self._sensing.step(self.rule, euler=self.rule == "trapezoidal" and startup > 0)
        if kernel.d.size and kernel.renew_discrete(h):
            if sense:
                self._sensing.settling()
            return STARTUP_STEPS
        return max(startup - 1, 0)


class _Call:
    """Arguments of the compiled loop that stay where they are: an address costs more than copying a few numbers.

    Attributes:
        point: addresses of ``x``, ``z`` and ``d``, which the loop moves on.
        moves: address of the moves.
        pieces: addresses of the horizon's counts, lengths, moves, rows and ends.
    """

    def __init__(self, point: list[Array], n_moves: int) -> None:
        self._point, self._moves = point, np.zeros(n_moves)
        self.point, self.moves = [_address(a) for a in point], _address(self._moves)
        self._kept: tuple[NDArray[Any], ...] = ()
        self.pieces: list[ctypes.c_void_p] = []

    def load(self, state: State, moves: Array, horizon: Horizon) -> None:
        """Put a prediction's arguments in place."""
        for array, values in zip(self._point, (state.x, state.z, state.d), strict=True):
            array[:] = values
        # A transition has a single move, whatever a plan has.
        self._moves[: moves.size] = moves.ravel()
        pieces = (horizon.counts, horizon.lengths, horizon.moves, horizon.rows, horizon.ends)
        if len(self._kept) != len(pieces) or any(a is not b for a, b in zip(self._kept, pieces, strict=True)):
            self._kept, self.pieces = pieces, [_address(a) for a in pieces]


def _address(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
