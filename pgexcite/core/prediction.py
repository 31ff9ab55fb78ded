"""Predictions: the kernel's own step rolled out over a horizon, with exact forward sensitivities to the moves.

Each stage is differentiated by the implicit function theorem with the same written-out factors that solved it:
``J dw = -(dr/db db + dr/du du)``. So a prediction is what the simulation will do, to the last bit, and its derivatives are
those of the discrete-time plant. A step that the fixed order of elimination cannot take ends a prediction, in C and in the virtual
machine alike: there are no derivatives through the shorter steps or the pivoting by which a simulation would go on.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.bound import Bound, bind
from pgexcite.core.codegen import generate, load
from pgexcite.core.model import State
from pgexcite.core.sensitivity import Along, write_sensitivities
from pgexcite.core.settings import Rule
from pgexcite.core.stage import ALPHA, BETA, FROZEN
from pgexcite.core.step import RULES, STARTUP_STEPS, Kernel

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
        rows = (kernel.w.size, n_x, n_u, self._outputs.size)
        # CasADi keeps matrices column by column, so a row of these arrays is a column of the sensitivity.
        self._S, self._S_b, self._S_c, self._S_y = (np.zeros((columns, n)) for n in rows)
        self._S_new, self._S_slope = np.zeros_like(self._S), np.zeros_like(self._S_b)
        self._w, self._b, self._y = np.zeros(kernel.w.size), np.zeros(n_x), np.zeros(self._outputs.size)
        self._sensing = [_Sensing(self) for _ in range(2)]
        self._commanded = _Commanded(self)
        self._commands_at = _address(self.commands)
        self._call = _Call([np.zeros(n) for n in (n_x, kernel.z.size, kernel.d.size)], n_moves * n_u)

    @cached_property
    def _library(self) -> ctypes.CDLL | None:
        if not self.kernel.compiled:
            return None
        written, loops = self.sensitivities, ["step.c", "rollout.c", "chain.c"]
        called = [*self.kernel.stepping(), *written.functions()]
        source = generate(called, self.constants(transitions=self.transitions), loops, written.along())
        library = self.kernel.library(source, called)
        return None if library is None else load(library)

    def constants(self, *, transitions: bool) -> dict[str, object]:
        """What ``rollout.c`` needs to know, with derivatives in this way."""
        n_x, n_u = self._b.size, self.commands.size
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
        N, (columns, n_x) = int(horizon.ends.sum()), (self._S.shape[0], self._b.size)
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
        kernel, (columns, n_x), n_y = self.kernel, (self._S.shape[0], self._b.size), self._outputs.size
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
        n_x = self._b.size
        self.kernel.begin(state, p)
        self._S[:], self._S_c[:] = 0.0, 0.0
        self._point_at(0, fresh=True)
        self._sense_settling()
        self._sense_outputs()
        slope = self._S_y.T.copy()
        return self._y.copy(), slope[:, :n_x], slope[:, n_x:]

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
        N, n_x, n_u = len(moves), self._b.size, self.commands.size
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
        self._S[:], self._S_c[:] = 0.0, 0.0
        startup, sample, fresh, last = state.startup, 0, True, 0
        for j, (count, h, move, row) in enumerate(
            zip(horizon.counts, horizon.lengths, horizon.moves, horizon.rows, strict=True)
        ):
            changed = self._enter(horizon, moves[move], int(row), moved=j > 0 and row != last)
            if changed is None:
                return False
            startup, last = STARTUP_STEPS if changed else startup, row
            if sense and (fresh or changed):
                self._point_at(int(move), fresh=fresh)
                self._sense_settling()
            for _ in range(count):
                stepped = self._take(float(h), startup, sense=sense)
                if stepped is None:
                    return False
                startup = stepped
            fresh = bool(horizon.ends[j])
            if fresh:
                self._sense_outputs()
                y[sample] = self._y
                if sense:
                    dy[sample] = self._S_y
                if dx.size:
                    dx[sample] = self._S[:, : self._b.size]
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
                self._command(u)
            if not kernel.settle_here():
                return None
        return changed

    def _command(self, u: Array) -> None:
        """Put other commands in force, all else as it was: of what is hoisted, what depends on them alone is computed anew."""
        kernel, written, commanded = self.kernel, self.sensitivities, self._commanded
        kernel.u[:] = u
        for c, q in kernel.hoisted():
            commanded.of(c)
            q[written.of_kernel] = commanded.of_kernel
        for sensing in self._sensing:
            if sensing.of[0] == kernel.renewals:
                commanded.of(sensing.of[1])
                sensing.q[written.of_own] = commanded.of_own

    def _point_at(self, move: int, *, fresh: bool) -> None:
        """Directions of the sensitivities: the commands of a move, or each state and each command by itself."""
        if self.transitions and not fresh:
            return
        n_x, n_u = self._b.size, self.commands.size
        self._S_c[:] = 0.0
        if self.transitions:
            self._S[:] = 0.0
            self._S[np.arange(n_x), np.arange(n_x)] = 1.0
            self._S_c[n_x + np.arange(n_u), np.arange(n_u)] = 1.0
        else:
            self._S_c[move * n_u + np.arange(n_u), np.arange(n_u)] = 1.0

    def _take(self, h: float, startup: int, *, sense: bool) -> int | None:
        """One step; the startup steps left, ``None`` where it cannot be taken."""
        kernel = self.kernel
        if not kernel.take(self.rule, h, startup, pivoting=False):
            return None
        if sense:
            self._sense_step(euler=self.rule == "trapezoidal" and startup > 0)
        if kernel.d.size and kernel.renew_discrete(h):
            if sense:
                self._sense_settling()
            return STARTUP_STEPS
        return max(startup - 1, 0)

    def _aim(self, c: float) -> _Sensing:
        """Have the values at hand that are hoisted out of the sensitivities of stages with this coefficient."""
        sensing = self._sensing[c == FROZEN]
        if sensing.of != (self.kernel.renewals, c):
            sensing.c[0] = c
            sensing.prepare.trigger()
            sensing.of = (self.kernel.renewals, c)
        return sensing

    def _sense_settling(self) -> None:
        kernel, n_x = self.kernel, self._b.size
        kernel.aim(FROZEN)
        self._w[:n_x], self._w[n_x:] = kernel.x, kernel.z
        np.multiply(kernel.mass, kernel.x, out=self._b)
        self._S_b[:] = self._S[:, :n_x] * kernel.mass
        self._aim(FROZEN).settled.trigger()
        self._S[:] = self._S_new

    def _sense_step(self, *, euler: bool) -> None:
        kernel, n_x = self.kernel, self._b.size
        c = float(kernel.c[0])
        sensing = self._aim(c)
        self._S_b[:] = self._S[:, :n_x] * kernel.mass
        if not (self.rule == "backward_euler" or euler):
            sensing.slope.trigger()
            self._S_b += c * self._S_slope
            if self.rule == "tr_bdf2":
                sensing.middle.trigger()
                self._S_b[:] = kernel.mass * (ALPHA * self._S_new[:, :n_x] - BETA * self._S[:, :n_x])
        sensing.stage.trigger()
        self._S[:] = self._S_new

    def _sense_outputs(self) -> None:
        kernel, n_x = self.kernel, self._b.size
        self._w[:n_x], self._w[n_x:] = kernel.x, kernel.z
        self._aim(float(kernel.c[0])).outputs.trigger()


class _Sensing:
    """The values hoisted out of the sensitivities of stages with one coefficient ``c``, and the functions bound to them.

    Attributes:
        of: ``renewals`` of the kernel and ``c`` that the values belong to.
    """

    def __init__(self, predictor: Predictor) -> None:
        k, s, written = predictor.kernel, predictor, predictor.sensitivities
        columns = s._S.shape[0]
        self.of, self.c, self.q = (-1, np.nan), np.zeros(1), np.zeros(written.prepare.numel_out(0))
        self.prepare = bind(written.prepare, [self.c, k.d, k.u, k.p], [self.q])
        S, S_b, S_c, S_y, S_new, S_slope = (a.reshape(-1) for a in (s._S, s._S_b, s._S_c, s._S_y, s._S_new, s._S_slope))

        def along(of: Along, point: list[Array], beside: list[Array], directions: list[Array], to: Array) -> _Along:
            factors = np.zeros(of.size)
            return _Along(bind(of.at, point, [*beside, factors]), bind(of.of(columns), [factors, *directions], [to]))

        self.stage = along(written.stage, [k.w, k.b, self.q], [], [S_b, S_c], S_new)
        self.middle = along(written.stage, [k.middle, k.b_middle, self.q], [], [S_b, S_c], S_new)
        self.settled = along(written.stage, [s._w, s._b, self.q], [], [S_b, S_c], S_new)
        self.slope = along(written.slope, [k.start, self.q], [], [S, S_c], S_slope)
        self.outputs = along(written.output, [s._w, self.q, k.d], [s._y], [S, S_c], S_y)


class _Commanded:
    """What depends on the commands of the values hoisted, by coefficient ``c``."""

    def __init__(self, predictor: Predictor) -> None:
        k, written = predictor.kernel, predictor.sensitivities
        self._c, self.of_kernel, self.of_own = (np.zeros(n) for n in (1, written.of_kernel.size, written.of_own.size))
        self._compute = bind(written.commanded, [self._c, k.d, k.u, k.p], [self.of_kernel, self.of_own])

    def of(self, c: float) -> None:
        """Compute them."""
        self._c[0] = c
        self._compute.trigger()


class _Along(NamedTuple):
    """A derivative bound to its arrays: what it takes from the point, and along all directions."""

    at: Bound
    columns: Bound

    def trigger(self) -> None:
        """Compute it."""
        self.at.trigger()
        self.columns.trigger()


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
