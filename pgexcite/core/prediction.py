"""Predictions: the kernel's own step rolled out over a horizon, with exact forward sensitivities to the moves.

Each stage is differentiated by the implicit function theorem with the same written-out factors that solved it:
``J dw = -(dr/db db + dr/du du)``. So a prediction is what the simulation will do, to the last bit, and its derivatives are
those of the discrete-time plant.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.codegen import build, generate, load
from pgexcite.core.linear_algebra import SymbolicLU
from pgexcite.core.model import State
from pgexcite.core.settings import Rule
from pgexcite.core.stage import ALPHA, BETA, FROZEN, write_stage
from pgexcite.core.step import RULES, STARTUP_STEPS, Kernel, bind

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rollout:
    """A prediction.

    Attributes:
        y: selected outputs at the end of each sample, shape ``(N, n_y)``.
        dy: derivatives to the moves, shape ``(N, n_y, n_moves * n_u)``, the commands of one move together; or ``None``.
    """

    y: Array
    dy: Array | None


class Predictor:
    """Rolls the kernel's step out under a sequence of moves.

    Args:
        kernel: of the model that predicts; the predictor has it for itself.
        commands: positions in ``u`` of the ``n_u`` commands the moves set.
        outputs: positions in ``y`` of the outputs wanted.
        n_moves: number of moves.
        rule: integration rule. The prediction runs as C where the kernel does.
    """

    def __init__(
        self,
        kernel: Kernel,
        commands: Sequence[int],
        outputs: Sequence[int],
        n_moves: int,
        rule: Rule,
    ) -> None:
        self._kernel, self._rule, self._n_moves = kernel, rule, n_moves
        self._commands, self._outputs = np.array(commands, dtype=np.int32), np.array(outputs, dtype=np.int32)
        columns = n_moves * self._commands.size
        self._functions = _write_sensitivities(kernel, self._commands, self._outputs, columns)
        self._compiled = self._compile(columns)
        stage, history, output = self._functions
        k, rows = kernel, (kernel.w.size, kernel.x.size, self._commands.size, self._outputs.size)
        # CasADi keeps matrices column by column, so a row of these arrays is a column of the sensitivity.
        self._S, self._S_b, self._S_c, self._S_y = (np.zeros((columns, n)) for n in rows)
        self._S_middle = np.zeros_like(self._S)
        self._S_new = np.zeros_like(self._S)
        given = [k.d, k.u, k.p]
        S, S_b, S_c, S_y, S_new = (a.reshape(-1) for a in (self._S, self._S_b, self._S_c, self._S_y, self._S_new))
        self._x, self._z = np.zeros(k.x.size), np.zeros(k.z.size)
        self._stage = bind(stage, [k.w, k.b, k.c, *given, S_b, S_c], [S_new])
        self._stage_middle = bind(stage, [k.middle, k.b_middle, k.c, *given, S_b, S_c], [S_new])
        self._history = bind(history, [self._x, self._z, *given, k.c, S, S_c], [S_b])
        self._y = np.zeros(self._outputs.size)
        self._output = bind(output, [k.x, k.z, *given, S, S_c], [self._y, S_y])

    def _compile(self, columns: int) -> Any:
        functions = self._kernel.functions
        if not self._kernel.compiled or functions.newton is None:
            return None
        sizes = {"n_commands": self._commands.size, "n_columns": columns, "n_selected": self._outputs.size}
        loop = [functions.newton, functions.history, functions.update, functions.outputs]
        source = generate([*loop, *self._functions], self._kernel.constants() | sizes, rollout=True)
        library = build(source)
        return None if library is None else load(library).pgexcite_rollout

    def roll(
        self,
        state: State,
        p: Array,
        moves: Array,
        counts: Sequence[int],
        lengths: Sequence[float],
        in_force: NDArray[np.intp],
        *,
        derivatives: bool,
    ) -> Rollout | None:
        """Predict.

        Args:
            state: where the prediction starts; its commands are those in force before the first move.
            p: parameters over the horizon, shape ``(n_p,)``.
            moves: commands, shape ``(n_moves, n_u)``.
            counts, lengths: number and length (s) of the steps in each of ``N`` samples.
            in_force: which move is in force in each sample, shape ``(N,)``.
            derivatives: whether to propagate sensitivities.

        Returns:
            The prediction, or ``None`` where the model cannot be stepped over the horizon.
        """
        y = np.empty((len(counts), self._outputs.size))
        dy = np.zeros((len(counts), self._S.shape[0], self._outputs.size)) if derivatives else np.zeros((0, 0, 0))
        roll = self._roll if self._compiled is None else self._roll_compiled
        if not roll(state, p, np.ascontiguousarray(moves, dtype=float), counts, lengths, in_force, y, dy):
            return None
        if not (np.isfinite(y).all() and np.isfinite(dy).all()):
            return None
        return Rollout(y, dy.transpose(0, 2, 1) if derivatives else None)

    def _roll_compiled(
        self,
        state: State,
        p: Array,
        moves: Array,
        counts: Sequence[int],
        lengths: Sequence[float],
        in_force: NDArray[np.intp],
        y: Array,
        dy: Array,
    ) -> bool:
        point = [np.array(a) for a in (state.x, state.z, state.d, state.u)]
        integers = [np.array(counts, dtype=np.int32), np.array(in_force, dtype=np.int32)]
        steps = np.array(lengths, dtype=float)
        done = self._compiled(
            RULES.index(self._rule),
            len(counts),
            _address(integers[0]),
            _address(steps),
            _address(integers[1]),
            _address(self._commands),
            state.startup,
            *(_address(a) for a in point),
            _address(np.ascontiguousarray(p)),
            _address(moves),
            int(dy.size > 0),
            _address(y),
            _address(dy),
        )
        return bool(done == len(counts))

    def _roll(
        self,
        state: State,
        p: Array,
        moves: Array,
        counts: Sequence[int],
        lengths: Sequence[float],
        in_force: NDArray[np.intp],
        y: Array,
        dy: Array,
    ) -> bool:
        """The same in CasADi's virtual machine."""
        kernel, sense = self._kernel, dy.size > 0
        kernel.begin(state, p)
        startup = state.startup
        self._S[:] = 0.0
        self._S_c[:] = 0.0
        for sample, (count, h, move) in enumerate(zip(counts, lengths, in_force, strict=True)):
            if sample == 0 or move != in_force[sample - 1]:
                changed = self._command(int(move), moves, sense=sense)
                if changed is None:
                    return False
                startup = STARTUP_STEPS if changed else startup
            for _ in range(count):
                stepped = self._take(h, startup, sense=sense)
                if stepped is None:
                    return False
                startup = stepped
            self._output.trigger()
            y[sample] = self._y
            if sense:
                dy[sample] = self._S_y
        return True

    def _command(self, move: int, moves: Array, *, sense: bool) -> bool | None:
        """Put a move in force; whether it changed anything, ``None`` where the algebraic unknowns have no solution then."""
        kernel, n = self._kernel, self._commands.size
        changed = not np.array_equal(kernel.u[self._commands], moves[move])
        kernel.u[self._commands] = moves[move]
        self._S_c[:] = 0.0
        self._S_c[move * n + np.arange(n), np.arange(n)] = 1.0
        if changed and not kernel.settle_here():
            return None
        if sense:
            self._sense_settling()
        return changed

    def _take(self, h: float, startup: int, *, sense: bool) -> int | None:
        """One step; the startup steps left, ``None`` where it cannot be taken."""
        kernel = self._kernel
        self._x[:], self._z[:] = kernel.x, kernel.z
        if not kernel.take(self._rule, h, startup):
            return None
        if sense:
            self._sense_step(euler=self._rule == "trapezoidal" and startup > 0)
        if kernel.d.size and kernel.renew_discrete(h):
            if sense:
                self._sense_settling()
            return STARTUP_STEPS
        return max(startup - 1, 0)

    def _sense_settling(self) -> None:
        kernel = self._kernel
        kernel.c[0] = FROZEN
        kernel.w[: kernel.x.size], kernel.w[kernel.x.size :] = kernel.x, kernel.z
        np.multiply(kernel.mass, kernel.x, out=kernel.b)
        self._S_b[:] = self._S[:, : kernel.x.size] * kernel.mass
        self._stage.trigger()
        self._S[:] = self._S_new

    def _sense_step(self, *, euler: bool) -> None:
        kernel, n_x = self._kernel, self._kernel.x.size
        if self._rule == "backward_euler" or euler:
            self._S_b[:] = self._S[:, :n_x] * kernel.mass
        else:
            self._history.trigger()
            if self._rule == "tr_bdf2":
                self._stage_middle.trigger()
                self._S_b[:] = kernel.mass * (ALPHA * self._S_new[:, :n_x] - BETA * self._S[:, :n_x])
        self._stage.trigger()
        self._S[:] = self._S_new


def _address(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def _write_sensitivities(
    kernel: Kernel, commands: NDArray[np.int32], outputs: NDArray[np.int32], columns: int
) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Derivatives of a stage, of its history and of the selected outputs to ``columns`` moves.

    ``stage_sensitivity(w, b, c, d, u, p, S_b, S_c) -> S_w``, ``history_sensitivity(x, z, d, u, p, c, S_w, S_c) -> S_b`` and
    ``output_sensitivity(x, z, d, u, p, S_w, S_c) -> (y, S_y)``; ``S_c`` has a row for each command.
    """
    model = kernel.model
    n_x, n_z = len(model.x_names), len(model.z_names)
    stage = write_stage(model)
    S_w, S_b = ca.SX.sym("S_w", n_x + n_z, columns), ca.SX.sym("S_b", n_x, columns)
    S_c = ca.SX.sym("S_c", commands.size, columns)
    chosen = [int(k) for k in commands]
    rhs = ca.mtimes(ca.jacobian(stage.r, stage.b), S_b) + ca.mtimes(ca.jacobian(stage.r, stage.u)[:, chosen], S_c)
    solved = -SymbolicLU(stage.jacobian, kernel.functions.pairing).solve(ca.densify(rhs))
    given = [stage.d, stage.u, stage.p]
    options = {"cse": True}
    of_stage = ca.Function(
        "stage_sensitivity", [stage.w, stage.b, stage.c, *given, S_b, S_c], [ca.densify(solved)], options
    )
    x, z = ca.SX.sym("x", n_x), ca.SX.sym("z", n_z)
    b = kernel.functions.history(x, z, *given, stage.c)[0]
    y = kernel.functions.outputs(x, z, *given)[[int(k) for k in outputs]]
    S_x, S_z = S_w[:n_x, :], S_w[n_x:, :]

    def along(expression: ca.SX) -> ca.SX:
        total = ca.mtimes(ca.jacobian(expression, x), S_x) + ca.mtimes(ca.jacobian(expression, z), S_z)
        return ca.densify(total + ca.mtimes(ca.jacobian(expression, stage.u)[:, chosen], S_c))

    of_history = ca.Function("history_sensitivity", [x, z, *given, stage.c, S_w, S_c], [along(b)], options)
    of_output = ca.Function("output_sensitivity", [x, z, *given, S_w, S_c], [ca.densify(y), along(y)], options)
    return of_stage, of_history, of_output
