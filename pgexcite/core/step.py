"""Taking steps: trapezoidal, backward Euler and TR-BDF2, checked and rescued.

``Kernel.advance`` is the loop everything runs on; ``step`` is the same for one step, as a pure function.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from pgexcite.core.codegen import CompilationError, CompiledLoop, build, compiler, generate
from pgexcite.core.model import Model, State
from pgexcite.core.settings import Compile, Rule
from pgexcite.core.stage import ALPHA, BETA, FROZEN, GAMMA, UPDATE_WEIGHT, build_stage_functions

Array = NDArray[np.float64]

TOLERANCE = 1e-8
"""Residual (2-norm) at which the Newton update just made is accepted; convergence is quadratic, so its own error is far below. The
update itself counts with ``sqrt(UPDATE_WEIGHT)``: it must be below 0.01."""
MAX_ITERATIONS = 12
STARTUP_STEPS = 2
"""Backward-Euler steps after a discontinuity when the rule is trapezoidal."""
MOVED = 1e-6
"""A discrete state that moves an algebraic unknown by more than this, pu, makes a discontinuity."""
COMPILED_BY_DEFAULT = 400
"""Entries of the factors up to which ``compile = "auto"`` waits for the compiler (about a second)."""
SUBDIVISIONS = (2, 8, 32, 128)
"""Numbers of equal inner steps a failing step is retried in, one after the other."""

RULES: tuple[Rule, ...] = ("tr_bdf2", "trapezoidal", "backward_euler")


@dataclass(frozen=True)
class Segment:
    """Consecutive steps.

    Attributes:
        x, z, d, y: samples after each step, shapes ``(done, n)``.
        state: after the last step that was taken.
        failed: whether the step after ``state`` could not be taken at all.
        rescued: how many of the steps needed shorter inner steps or the pivoting solver.
    """

    x: Array
    z: Array
    d: Array
    y: Array
    state: State
    failed: bool = False
    rescued: int = 0


@dataclass
class Bound:
    """A compiled function bound to fixed arrays: a call costs about a microsecond instead of a hundred."""

    trigger: Callable[[], None]
    keep: list[Any] = field(default_factory=list)


def bind(function: Any, arguments: list[Array], results: list[Array]) -> Bound:
    """Bind a CasADi function to contiguous float64 arrays, which it reads and writes in place."""
    buffer, trigger = function.buffer()
    for k, array in enumerate(arguments):
        buffer.set_arg(k, array.data)
    for k, array in enumerate(results):
        buffer.set_res(k, array.data)
    return Bound(trigger, [function, buffer, *arguments, *results])


class Kernel:
    """Takes steps of one model. Holds work arrays, so a kernel serves one thread; the states it is given and returns are frozen.

    Args:
        model: the equations.
        state, p: operating point around which the fixed elimination order is chosen.
        compile: whether the loop runs as generated C; ``"auto"`` does so where a compiler is found.

    Attributes:
        x, z, d, u, p: the point the kernel is at, as work arrays (``begin`` loads them, ``take`` moves them on).
        start, middle, w: solution before the last step, at TR-BDF2's intermediate point and after it, shape ``(n_x + n_z,)``.
        b, b_middle, c: right-hand sides and coefficient of the last stages.
        mass: coefficients of the derivatives at the present parameters, shape ``(n_x,)``.
    """

    def __init__(self, model: Model, state: State, p: Array, compile: Compile = "auto") -> None:
        self.model = model
        self.functions = build_stage_functions(model, state, p)
        n_x, n_z, n_d = len(model.x_names), len(model.z_names), len(model.d_names)
        self._n_x = n_x
        self.w, self._w_next, self.start = (np.zeros(n_x + n_z) for _ in range(3))
        self.b, self.mass, self.c, self._norm = np.zeros(n_x), np.zeros(n_x), np.zeros(1), np.zeros(1)
        self.middle, self.b_middle = np.zeros(n_x + n_z), np.zeros(n_x)
        self.x, self.z = np.zeros(n_x), np.zeros(n_z)
        self.d, self._d_next, self._h = np.zeros(n_d), np.zeros(n_d), np.zeros(1)
        self.u, self.p = np.zeros(len(model.u_names)), np.zeros(p.size)
        self.y = np.zeros(len(model.y_names))
        given = [self.d, self.u, self.p]
        stage = [self.b, self.c, *given]
        functions = self.functions
        self._newton: tuple[Bound, Bound] | None = None
        if functions.newton is not None:
            self._newton = (
                bind(functions.newton, [self.w, *stage], [self._w_next, self._norm]),
                bind(functions.newton, [self._w_next, *stage], [self.w, self._norm]),
            )
        self._history = bind(functions.history, [self.x, self.z, *given, self.c], [self.b, self.mass])
        self._update = bind(functions.update, [self.x, self.z, *given, self._h], [self._d_next])
        self._outputs = bind(functions.outputs, [self.x, self.z, *given], [self.y])
        self._compiled = self._compile(compile)

    @property
    def compiled(self) -> bool:
        """Whether steps run as C."""
        return self._compiled is not None

    def constants(self) -> dict[str, object]:
        """What the C templates need to know of this kernel."""
        sizes = {"n_x": self._n_x, "n_z": self.z.size, "n_d": self.d.size, "n_u": self.u.size, "n_p": self.p.size}
        sizes["n_y"] = self.y.size
        rule = {
            "gamma": repr(GAMMA),
            "alpha": repr(ALPHA),
            "beta": repr(BETA),
            "extrapolate": repr((1 - GAMMA) / GAMMA),
        }
        limits = {
            "max_iterations": MAX_ITERATIONS,
            "tolerance2": repr(TOLERANCE * TOLERANCE),
            "startup_steps": STARTUP_STEPS,
        }
        return sizes | rule | limits | {"frozen": repr(FROZEN), "moved": repr(MOVED)}

    def _compile(self, choice: Compile) -> CompiledLoop | None:
        functions = self.functions
        if choice == "never" or functions.newton is None or (choice in ("auto", "wait") and compiler() is None):
            return None
        called = [functions.newton, functions.history, functions.update, functions.outputs]
        source = generate(called, self.constants(), ["step.c", "advance.c"])
        try:
            library = build(source, only_cached=choice == "auto" and functions.entries > COMPILED_BY_DEFAULT)
        except CompilationError:
            if choice == "always":
                raise
            return None
        return None if library is None else CompiledLoop(library)

    # The public faces: pure functions of frozen states.

    def advance(self, state: State, p: Array, rule: Rule, h: float, n: int) -> Segment:
        """Take up to ``n`` steps of length ``h`` (s); stops early only where a step cannot be taken at all."""
        self.begin(state, p)
        sizes = (self._n_x, self.z.size, self.d.size, self.y.size)
        rows = [np.empty((n, size)) for size in sizes]
        done, startup, rescued = 0, state.startup, 0
        while done < n:
            count, startup = self._loop(rule, h, startup, [block[done:] for block in rows])
            done += count
            if done == n:
                break
            # The loop gives up where the fixed order of elimination fails, in C and in the virtual machine alike.
            if not self.take(rule, h, startup) and not self._subdivide(rule, h):
                break
            rescued += 1
            startup = max(startup - 1, 0)
            if self.d.size and self.renew_discrete(h):
                startup = STARTUP_STEPS
            self._record(rows, done)
            done += 1
        k = state.k + done
        after = State(k, k * h, self.x, self.z, self.d, self.u, startup)
        x, z, d, y = (block[:done] for block in rows)
        return Segment(x, z, d, y, after, done < n, rescued)

    def _loop(self, rule: Rule, h: float, startup: int, rows: list[Array]) -> tuple[int, int]:
        """Plain steps up to the end of ``rows`` or the first that fails; how many, and the startup steps left."""
        n = rows[0].shape[0]
        if self._compiled is not None:
            given = [self.x, self.z, self.d, self.u, self.p]
            return self._compiled.advance(RULES.index(rule), h, n, startup, [*given, *rows])
        for k in range(n):
            if not self.take(rule, h, startup, pivoting=False):
                return k, startup
            startup = max(startup - 1, 0)
            if self.d.size and self.renew_discrete(h):
                startup = STARTUP_STEPS
            self._record(rows, k)
        return n, startup

    def _record(self, rows: list[Array], k: int) -> None:
        self._outputs.trigger()
        rows[0][k], rows[1][k], rows[2][k], rows[3][k] = self.x, self.z, self.d, self.y

    def settle(self, state: State, p: Array) -> State | None:
        """Solve the algebraic unknowns again at fixed states, after a discontinuity; ``None`` if no solution was found."""
        self.begin(state, p)
        if not self.settle_here():
            return None
        return State(state.k, state.t, self.x, self.z, self.d, self.u, STARTUP_STEPS)

    def outputs(self, state: State, p: Array) -> Array:
        """Outputs ``y`` at a state, shape ``(n_y,)``."""
        self.x[:], self.z[:], self.d[:], self.u[:], self.p[:] = state.x, state.z, state.d, state.u, p
        self._outputs.trigger()
        return self.y.copy()

    # One step at a time, on the work arrays.

    def begin(self, state: State, p: Array) -> None:
        """Go to a state."""
        self.x[:], self.z[:], self.d[:], self.u[:], self.p[:] = state.x, state.z, state.d, state.u, p
        self.c[0] = 0.0
        self._history.trigger()

    def take(self, rule: Rule, h: float, startup: int, *, pivoting: bool = True) -> bool:
        """Move ``x`` and ``z`` one step on; ``False``, and nothing moved, where the stages do not converge.

        Args:
            rule, h: of the step.
            startup: backward-Euler steps still to be taken (trapezoidal rule only).
            pivoting: whether the pivoting solver takes over where the fixed order of elimination fails.
        """
        n_x, w, start = self._n_x, self.w, self.start
        start[:n_x], start[n_x:] = self.x, self.z
        w[:] = start
        if rule == "backward_euler" or (rule == "trapezoidal" and startup > 0):
            self.c[0] = h
            np.multiply(self.mass, self.x, out=self.b)
        else:
            self.c[0] = h / 2 if rule == "trapezoidal" else GAMMA * h / 2
            self._history.trigger()
        if not self._solve(pivoting):
            return False
        if rule == "tr_bdf2":
            self.middle[:], self.b_middle[:] = w, self.b
            self.b[:] = self.mass * (ALPHA * w[:n_x] - BETA * self.x)
            w += ((1 - GAMMA) / GAMMA) * (w - start)
            if not self._solve(pivoting):
                return False
        self.x[:], self.z[:] = w[:n_x], w[n_x:]
        return True

    def _solve(self, pivoting: bool = True) -> bool:
        """Newton on the stage from ``w``, in place."""
        if self._newton is not None:
            start = self.w.copy()
            for iteration in range(MAX_ITERATIONS):
                self._newton[iteration & 1].trigger()
                if self._norm[0] < TOLERANCE * TOLERANCE:
                    if not iteration & 1:
                        self.w[:] = self._w_next
                    return bool(np.isfinite(self.w.sum()))
                if not self._norm[0] < 1e20:
                    break
            self.w[:] = start
            if not pivoting:
                return False
        return self._solve_pivoting()

    @np.errstate(over="ignore", invalid="ignore")
    def _solve_pivoting(self) -> bool:
        """Damped Newton on the stage with a pivoting sparse LU, where the fixed order fails or does not exist."""
        w = self.w.copy()
        r, jacobian = self._residual(w)
        error = float(np.linalg.norm(r))
        for _ in range(4 * MAX_ITERATIONS):
            if not np.isfinite(error):
                return False
            try:
                step = splu(jacobian).solve(r)
            except RuntimeError:
                return False
            scale = 1.0
            while True:
                trial = w - scale * step
                r_trial, jacobian_trial = self._residual(trial)
                error_trial = float(np.linalg.norm(r_trial))
                if error_trial < (1 - 0.1 * scale) * error or error_trial < TOLERANCE or scale < 1e-3:
                    break
                scale /= 2
            update = scale * float(np.linalg.norm(step)) * UPDATE_WEIGHT**0.5
            converged = error < TOLERANCE and error_trial < TOLERANCE and update < TOLERANCE
            if not error_trial < error and not converged:
                return False
            w, r, jacobian, error = trial, r_trial, jacobian_trial, error_trial
            if converged:
                self.w[:] = w
                return True
        return False

    def _residual(self, w: Array) -> tuple[Array, sp.csc_matrix]:
        r, jacobian = self.functions.residual(w, self.b, self.c, self.d, self.u, self.p)
        return np.array(r).ravel(), jacobian.sparse()

    def _subdivide(self, rule: Rule, h: float) -> bool:
        """The same step in shorter inner steps."""
        x, z = self.x.copy(), self.z.copy()
        inner: Rule = "backward_euler" if rule == "trapezoidal" else rule
        for parts in SUBDIVISIONS:
            if all(self.take(inner, h / parts, 0) for _ in range(parts)):
                return True
            self.x[:], self.z[:] = x, z
        return False

    def settle_here(self) -> bool:
        """Solve ``z`` again at fixed ``x``."""
        self.c[0] = FROZEN
        np.multiply(self.mass, self.x, out=self.b)
        n_x = self._n_x
        self.w[:n_x], self.w[n_x:] = self.x, self.z
        if not self._solve():
            return False
        self.x[:], self.z[:] = self.w[:n_x], self.w[n_x:]
        return True

    def renew_discrete(self, h: float) -> bool:
        """Renew the discrete states; True where that moved the algebraic equations, which are then solved again."""
        self._h[0] = h
        self._update.trigger()
        if np.array_equal(self._d_next, self.d):
            return False
        self.d[:] = self._d_next
        x, z = self.x.copy(), self.z.copy()
        if not self.settle_here():
            self.x[:], self.z[:] = x, z
            return True
        return bool(np.max(np.abs(self.z - z), initial=0.0) > MOVED)


def step(kernel: Kernel, state: State, p: Array, h: float, rule: Rule = "tr_bdf2") -> State | None:
    """One step as a pure function; ``None`` if it cannot be taken."""
    segment = kernel.advance(state, p, rule, h, 1)
    return None if segment.failed else segment.state
