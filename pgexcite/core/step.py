"""Taking steps: trapezoidal, backward Euler and TR-BDF2, checked and rescued.

``Kernel.advance`` is the loop everything runs on; ``step`` is the same for one step, as a pure function.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from pgexcite.core.bound import bind
from pgexcite.core.codegen import generate
from pgexcite.core.compiling import CompiledLoop
from pgexcite.core.compiling import library as compiled
from pgexcite.core.model import Model, State
from pgexcite.core.pivoting import solved
from pgexcite.core.settings import Compile, Rule
from pgexcite.core.stage import ALPHA, BETA, FROZEN, GAMMA, UPDATE_WEIGHT, build_stage_functions, write_stage

Array = NDArray[np.float64]

TOLERANCE = 1e-8
"""Residual (2-norm) at which the Newton update just made is accepted; convergence is quadratic, so its own error is far below. The
update itself counts with ``sqrt(UPDATE_WEIGHT)``: it must be below 0.01."""
PROMISING = 2e-5
"""Residual below which the update just made is likely to have solved the stage, so that a check costs less than another update."""
VERIFIED = 1e-12
"""Residual at which a point is accepted as it is."""
MAX_ITERATIONS = 12
STARTUP_STEPS = 2
"""Backward-Euler steps after a discontinuity when the rule is trapezoidal."""
MOVED = 1e-6
"""A discrete state that moves an algebraic unknown by more than this, pu, makes a discontinuity."""
COMPILED_BY_DEFAULT = 10_000
"""Operations of a library's functions up to which ``compile = "auto"`` waits for the compiler: 1.2 s with gcc 12.

The time to compile and the time a step saves grow alike with the model: C has paid after 7,000 to 14,000 steps, be it of one
machine (2,100 to 3,400 operations) or of two areas or the regional system (16,000, some 2 s). So size does not say where C pays,
only how long a first run waits (tools/bench/compiling.py)."""
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
        renewals: counts the changes of what the hoisted values depend on, beside ``c``.
    """

    def __init__(self, model: Model, state: State, p: Array, compile: Compile = "auto") -> None:
        self.model = model
        self.stage = write_stage(model)
        self.functions = build_stage_functions(model, state, p, self.stage)
        n_x, n_z, n_d = len(model.x_names), len(model.z_names), len(model.d_names)
        self._n_x = n_x
        self._here, self.w, self._w_next, self.start, self.middle = (np.zeros(n_x + n_z) for _ in range(5))
        self.x, self.z = self._here[:n_x], self._here[n_x:]
        self.b, self.b_middle, self.mass, self._slope = (np.zeros(n_x) for _ in range(4))
        self.c, self._h, self._norm2, self._norms2 = np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(2)
        self.d, self._d_next = np.zeros(n_d), np.zeros(n_d)
        self.u, self.p = np.zeros(len(model.u_names)), np.full(p.size, np.nan)
        self.y = np.zeros(len(model.y_names))
        self.renewals, self._landed = 0, False
        # Two sets, so that a renewal of discrete states, which settles, does not lose what the steps use.
        self._prepared = [_Prepared(self) for _ in range(2)]
        self._with = self._prepared[0]
        functions = self.functions
        self._update = bind(functions.update, [self.start, self._here, self.d, self.u, self.p, self._h], [self._d_next])
        self._choice = compile
        self._compiled = self._compile()

    @property
    def compiled(self) -> bool:
        """Whether steps run as C."""
        return self._compiled is not None

    def constants(self) -> dict[str, object]:
        """What the C templates need to know of this kernel."""
        sizes = {"n_x": self._n_x, "n_z": self.z.size, "n_d": self.d.size, "n_u": self.u.size, "n_p": self.p.size}
        sizes |= {"n_y": self.y.size, "n_hoisted": self.functions.prepare.numel_out(0)}
        rule = {
            "gamma": repr(GAMMA),
            "alpha": repr(ALPHA),
            "beta": repr(BETA),
            "extrapolate": repr((1 - GAMMA) / GAMMA),
        }
        limits = {
            "max_iterations": MAX_ITERATIONS,
            "tolerance2": repr(TOLERANCE * TOLERANCE),
            "update_weight": repr(UPDATE_WEIGHT),
            "promising2": repr(PROMISING * PROMISING),
            "verified2": repr(VERIFIED * VERIFIED),
            "startup_steps": STARTUP_STEPS,
        }
        switching = ", ".join(str(int(k)) for k in self.stage.switching) or "0"
        return sizes | rule | limits | {"frozen": repr(FROZEN), "moved": repr(MOVED), "switching": f"{{{switching}}}"}

    def stepping(self) -> list[ca.Function]:
        """The functions that ``step.c`` calls; only where the factors are written out."""
        f = self.functions
        assert f.newton is not None, "too large to be written out"
        return [f.prepare, f.newton, f.check, f.update]

    def _compile(self) -> CompiledLoop | None:
        if self.functions.newton is None:
            return None
        called = [*self.stepping(), self.functions.land]
        library = self.library(lambda: generate(called, self.constants(), ["step.c", "advance.c"]), called)
        return None if library is None else CompiledLoop(library)

    def library(self, write: Callable[[], str], called: Sequence[ca.Function]) -> ctypes.CDLL | None:
        """The library of a source with these functions, a copy of one's own, where ``compile`` is for it.

        Raises:
            CompilationError: it cannot be had, and ``compile = "always"``.
        """
        large = sum(function.n_instructions() for function in called) > COMPILED_BY_DEFAULT
        return compiled(write, self._choice, only_cached=large and self._choice == "auto")

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
            startup = self._finish_step(h, startup)
            rows[0][done], rows[1][done], rows[2][done], rows[3][done] = self.x, self.z, self.d, self.y
            done += 1
        k = state.k + done
        after = State(k, k * h, self.x, self.z, self.d, self.u, startup)
        x, z, d, y = (block[:done] for block in rows)
        return Segment(x, z, d, y, after, done < n, rescued)

    def _loop(self, rule: Rule, h: float, startup: int, rows: list[Array]) -> tuple[int, int]:
        """Plain steps up to the end of ``rows`` or the first that fails; how many, and the startup steps left."""
        n, n_x = rows[0].shape[0], self._n_x
        if self._compiled is not None:
            given = [self.x, self.z, self.d, self.u, self.p]
            self.renewals += self.d.size
            self._landed = False
            return self._compiled.advance(RULES.index(rule), h, n, startup, [*given, *rows])
        points, done = np.empty((n, self._here.size)), n
        for k in range(n):
            if not self.take(rule, h, startup, pivoting=False):
                done = k
                break
            startup = self._finish_step(h, startup)
            points[k], rows[2][k], rows[3][k] = self._here, self.d, self.y
        rows[0][:done], rows[1][:done] = points[:done, :n_x], points[:done, n_x:]
        return done, startup

    def _finish_step(self, h: float, startup: int) -> int:
        """Renew the discrete states and the outputs after a step; the startup steps left."""
        startup = max(startup - 1, 0)
        if self.d.size and self.renew_discrete(h):
            startup = STARTUP_STEPS
        self._land()
        return startup

    def settle(self, state: State, p: Array) -> State | None:
        """Solve the algebraic unknowns again at fixed states, after a discontinuity; ``None`` if no solution was found."""
        self.begin(state, p)
        if not self.settle_here():
            return None
        return State(state.k, state.t, self.x, self.z, self.d, self.u, STARTUP_STEPS)

    def outputs(self, state: State, p: Array) -> Array:
        """Outputs ``y`` at a state, shape ``(n_y,)``."""
        self.begin(state, p)
        self.aim(FROZEN)
        self._land()
        return self.y.copy()

    # One step at a time, on the work arrays.

    def hoisted(self) -> Iterator[tuple[float, Array]]:
        """Coefficients, and what is hoisted out of stages with them, as far as that is of the present parameters."""
        return ((with_.of[1], with_.q) for with_ in self._prepared if with_.of[0] == self.renewals)

    def begin(self, state: State, p: Array) -> None:
        """Go to a state."""
        present = zip((self.d, self.u, self.p), (state.d, state.u, p), strict=True)
        if not all(np.array_equal(old, new) for old, new in present):
            self.renewals += 1
        self.x[:], self.z[:], self.d[:], self.u[:], self.p[:] = state.x, state.z, state.d, state.u, p
        self._landed = False

    def aim(self, c: float) -> None:
        """Have the values at hand that are hoisted out of stages with this coefficient."""
        self.c[0] = c
        chosen = self._with = self._prepared[c == FROZEN]
        if chosen.of != (self.renewals, c):
            chosen.prepare.trigger()
            chosen.of = (self.renewals, c)

    def _land(self) -> None:
        """Slope and outputs at the present point, unless they are there already."""
        if not self._landed:
            self._with.land_here.trigger()
            self._landed = True

    def take(self, rule: Rule, h: float, startup: int, *, pivoting: bool = True) -> bool:
        """Move ``x`` and ``z`` one step on; ``False``, and nothing moved, where the stages do not converge.

        Args:
            rule, h: of the step.
            startup: backward-Euler steps still to be taken (trapezoidal rule only).
            pivoting: whether the pivoting solver takes over where the fixed order of elimination fails.
        """
        n_x, w, start, b = self._n_x, self.w, self.start, self.b
        euler = rule == "backward_euler" or (rule == "trapezoidal" and startup > 0)
        self.aim(h if euler else h / 2 if rule == "trapezoidal" else GAMMA * h / 2)
        self._land()
        self._landed = False
        start[:] = self._here
        np.multiply(self.mass, self.x, out=b)
        guess = self._with.reach * self._slope
        if not euler:
            b += self.c[0] * self._slope
            guess *= 2.0
        w[:] = start
        w[:n_x] += guess
        if not self._solve(pivoting, start, last=rule != "tr_bdf2"):
            return False
        if rule == "tr_bdf2":
            self.middle[:], self.b_middle[:] = w, b
            b[:] = self.mass * (ALPHA * w[:n_x] - BETA * self.x)
            w += ((1 - GAMMA) / GAMMA) * (w - start)
            if not self._solve(pivoting, last=True):
                return False
        self._here[:] = w
        return True

    def _solve(self, pivoting: bool = True, fallback: Array | None = None, *, last: bool = False) -> bool:
        """Newton on the stage from ``w``, in place; from ``fallback`` where that fails.

        Args:
            pivoting: whether the pivoting solver takes over where the fixed order of elimination fails.
            fallback: where to start again, and the pivoting solver as well.
            last: whether the solution is where the step ends.
        """
        start = self.w.copy() if fallback is None else fallback
        if self.functions.newton is not None:
            if self._iterate(last=last):
                return True
            self.w[:] = start
            if fallback is not None and self._iterate(last=last):
                return True
            if not pivoting:
                return False
        iterations = 4 * MAX_ITERATIONS
        found = solved(self._residual, start, tolerance=TOLERANCE, update_weight=UPDATE_WEIGHT, iterations=iterations)
        if found is None:
            return False
        self.w[:] = found
        return True

    def _iterate(self, *, last: bool) -> bool:
        """Newton from ``w``, where the solution is left as well.

        A point is accepted after an update made where the residual was below ``TOLERANCE`` already, or for a residual below
        ``VERIFIED`` at the point itself.
        """
        prepared, norms2 = self._with, self._norms2
        lands = last and not self.d.size
        check = prepared.land if lands else prepared.check
        for iteration in range(MAX_ITERATIONS):
            prepared.newton[iteration & 1].trigger()
            now = 1 - (iteration & 1)
            r2, update2 = norms2
            total = r2 + UPDATE_WEIGHT * update2
            done = total < TOLERANCE * TOLERANCE
            if not done and r2 < PROMISING * PROMISING and UPDATE_WEIGHT * update2 < TOLERANCE * TOLERANCE:
                check[now].trigger()
                done = self._norm2[0] < VERIFIED * VERIFIED
                self._landed = done and lands
            if done:
                if now:
                    self.w[:] = self._w_next
                return True
            if not total < 1e20:
                return False
        return False

    def _residual(self, w: Array) -> tuple[Array, sp.csc_matrix]:
        r, jacobian = self.functions.residual(w, self.b, self.c, self.d, self.u, self.p)
        return np.array(r).ravel(), jacobian.sparse()

    def _subdivide(self, rule: Rule, h: float) -> bool:
        """The same step in shorter inner steps."""
        before = self._here.copy()
        inner: Rule = "backward_euler" if rule == "trapezoidal" else rule
        for parts in SUBDIVISIONS:
            done = all(self.take(inner, h / parts, 0) for _ in range(parts))
            self.start[:] = before
            if done:
                return True
            self._here[:] = before
        return False

    def settle_here(self) -> bool:
        """Solve ``z`` again at fixed ``x``, unless it is solved."""
        self.aim(FROZEN)
        np.multiply(self.mass, self.x, out=self.b)
        self.w[:] = self._here
        self._landed = False
        self._with.check[0].trigger()
        if self._norm2[0] < VERIFIED * VERIFIED:
            return True
        if not self._solve():
            return False
        self._here[:] = self.w
        return True

    def renew_discrete(self, h: float) -> bool:
        """Renew the discrete states; True where that moved the algebraic equations, which are then solved again."""
        self._h[0] = h
        self._update.trigger()
        changed = self._d_next != self.d
        if not changed.any():
            return False
        self.d[:] = self._d_next
        self._landed = False
        if not (changed & self.stage.switching).any():
            return False
        self.renewals += 1
        before = self._here.copy()
        if not self.settle_here():
            self._here[:] = before
            return True
        return bool(np.max(np.abs(self.z - before[self._n_x :]), initial=0.0) > MOVED)


class _Prepared:
    """The hoisted values of stages with one coefficient, and the functions bound to them.

    Attributes:
        of: ``renewals`` of the kernel and ``c`` that the values belong to.
        reach: see ``StageFunctions.prepare``.
    """

    def __init__(self, kernel: Kernel) -> None:
        functions, k = kernel.functions, kernel
        self.q = q = np.zeros(functions.prepare.numel_out(0))
        self.reach = np.zeros(k.x.size)
        self.of = (-1, np.nan)
        self.prepare = bind(functions.prepare, [k.c, k.d, k.u, k.p], [q, k.mass, self.reach])
        points = (k.w, k._w_next)
        newton = functions.newton
        pairs = [] if newton is None else list(zip(points, reversed(points), strict=True))
        self.newton = [bind(newton, [w, k.b, q], [w_next, k._norms2]) for w, w_next in pairs]
        self.check = [bind(functions.check, [w, k.b, q], [k._norm2, k._slope]) for w in points]
        landed = [k._norm2, k._slope, k.y]
        self.land = [bind(functions.land, [w, k.b, q, k.d], landed) for w in points]
        self.land_here = bind(functions.land, [k._here, k.b, q, k.d], landed)


def step(kernel: Kernel, state: State, p: Array, h: float, rule: Rule = "tr_bdf2") -> State | None:
    """One step as a pure function; ``None`` if it cannot be taken."""
    segment = kernel.advance(state, p, rule, h, 1)
    return None if segment.failed else segment.state
