"""Sensitivities of a prediction in CasADi's virtual machine: a kernel's steps differentiated along several directions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.bound import Bound, bind
from pgexcite.core.sensitivity import Along, Sensitivities
from pgexcite.core.settings import Rule
from pgexcite.core.stage import ALPHA, BETA, FROZEN
from pgexcite.core.step import Kernel

Array = NDArray[np.float64]


class Sensing:
    """Follows a kernel step by step with the derivatives of its point along ``columns`` directions.

    Args:
        kernel: that takes the steps.
        written: the derivatives of its stages.
        commands: positions in ``u`` of the commands directions may move.
        columns: number of directions.
        transitions: whether they are each state and each command, or the commands of each move.

    Attributes:
        S: derivatives of ``(x, z)``, shape ``(columns, n_x + n_z)``.
        y: the selected outputs, shape ``(n_y,)``.
        S_y: their derivatives, shape ``(columns, n_y)``.
    """

    def __init__(
        self,
        kernel: Kernel,
        written: Sensitivities,
        commands: NDArray[np.int32],
        columns: int,
        *,
        transitions: bool,
    ) -> None:
        self.kernel, self.written, self._commands, self._transitions = kernel, written, commands, transitions
        n_w, n_x, n_y = kernel.w.size, kernel.x.size, written.output.column.numel_out(0)
        # CasADi keeps matrices column by column, so a row of these arrays is a column of the sensitivity.
        self.S, self.S_b, self.S_c, self.S_y = (np.zeros((columns, n)) for n in (n_w, n_x, commands.size, n_y))
        self.S_new, self.S_slope = np.zeros_like(self.S), np.zeros_like(self.S_b)
        # The present point, and the right side of its stage.
        self.w, self.y, self.b = np.zeros(n_w), np.zeros(n_y), np.zeros(n_x)
        self._prepared = [_Prepared(self) for _ in range(2)]
        self._commanded = _Commanded(kernel, written)

    def begin(self) -> None:
        """Go nowhere, in no direction."""
        self.S[:], self.S_c[:] = 0.0, 0.0

    def command(self, u: Array) -> None:
        """Put other commands in force, all else as it was: of what is hoisted, what depends on them alone is computed anew."""
        kernel, written, commanded = self.kernel, self.written, self._commanded
        kernel.u[:] = u
        for c, q in kernel.hoisted():
            commanded.of(c)
            q[written.of_kernel] = commanded.of_kernel
        for sensing in self._prepared:
            if sensing.of[0] == kernel.renewals:
                commanded.of(sensing.of[1])
                sensing.q[written.of_own] = commanded.of_own

    def point_at(self, move: int, *, fresh: bool) -> None:
        """Directions of the sensitivities: the commands of a move, or each state and each command by itself."""
        if self._transitions and not fresh:
            return
        n_x, n_u = self.b.size, self._commands.size
        self.S_c[:] = 0.0
        if self._transitions:
            self.S[:] = 0.0
            self.S[np.arange(n_x), np.arange(n_x)] = 1.0
            self.S_c[n_x + np.arange(n_u), np.arange(n_u)] = 1.0
        else:
            self.S_c[move * n_u + np.arange(n_u), np.arange(n_u)] = 1.0

    def _aim(self, c: float) -> _Prepared:
        """Have the values at hand that are hoisted out of the sensitivities of stages with this coefficient."""
        sensing = self._prepared[c == FROZEN]
        if sensing.of != (self.kernel.renewals, c):
            sensing.c[0] = c
            sensing.prepare.trigger()
            sensing.of = (self.kernel.renewals, c)
        return sensing

    def settling(self) -> None:
        """The algebraic unknowns have been solved again."""
        kernel, n_x = self.kernel, self.b.size
        kernel.aim(FROZEN)
        self.w[:n_x], self.w[n_x:] = kernel.x, kernel.z
        np.multiply(kernel.mass, kernel.x, out=self.b)
        self.S_b[:] = self.S[:, :n_x] * kernel.mass
        self._aim(FROZEN).settled.trigger()
        self.S[:] = self.S_new

    def step(self, rule: Rule, *, euler: bool) -> None:
        """A step has been taken; ``euler`` where the trapezoidal rule is starting."""
        kernel, n_x = self.kernel, self.b.size
        c = float(kernel.c[0])
        sensing = self._aim(c)
        self.S_b[:] = self.S[:, :n_x] * kernel.mass
        if not (rule == "backward_euler" or euler):
            sensing.slope.trigger()
            self.S_b += c * self.S_slope
            if rule == "tr_bdf2":
                sensing.middle.trigger()
                self.S_b[:] = kernel.mass * (ALPHA * self.S_new[:, :n_x] - BETA * self.S[:, :n_x])
        sensing.stage.trigger()
        self.S[:] = self.S_new

    def outputs(self) -> None:
        """Outputs of the present point."""
        kernel, n_x = self.kernel, self.b.size
        self.w[:n_x], self.w[n_x:] = kernel.x, kernel.z
        self._aim(float(kernel.c[0])).outputs.trigger()


class _Prepared:
    """The values hoisted out of the sensitivities of stages with one coefficient ``c``, and the functions bound to them.

    Attributes:
        of: ``renewals`` of the kernel and ``c`` that the values belong to.
    """

    def __init__(self, s: Sensing) -> None:
        k, written, columns = s.kernel, s.written, s.S.shape[0]
        self.of, self.c, self.q = (-1, np.nan), np.zeros(1), np.zeros(written.prepare.numel_out(0))
        self.prepare = bind(written.prepare, [self.c, k.d, k.u, k.p], [self.q])
        S, S_b, S_c, S_y, S_new, S_slope = (a.reshape(-1) for a in (s.S, s.S_b, s.S_c, s.S_y, s.S_new, s.S_slope))

        def along(of: Along, point: list[Array], beside: list[Array], directions: list[Array], to: Array) -> _Along:
            factors = np.zeros(of.size)
            return _Along(bind(of.at, point, [*beside, factors]), bind(of.of(columns), [factors, *directions], [to]))

        self.stage = along(written.stage, [k.w, k.b, self.q], [], [S_b, S_c], S_new)
        self.middle = along(written.stage, [k.middle, k.b_middle, self.q], [], [S_b, S_c], S_new)
        self.settled = along(written.stage, [s.w, s.b, self.q], [], [S_b, S_c], S_new)
        self.slope = along(written.slope, [k.start, self.q], [], [S, S_c], S_slope)
        self.outputs = along(written.output, [s.w, self.q, k.d], [s.y], [S, S_c], S_y)


class _Commanded:
    """What depends on the commands of the values hoisted, by coefficient ``c``."""

    def __init__(self, k: Kernel, written: Sensitivities) -> None:
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
