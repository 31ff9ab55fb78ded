"""The implicit stage all rules of the kernel share, written out as one straight-line Newton iteration.

All three rules solve stages of one form, ``M x+ - b - c f(x+, z+) = 0`` with ``0 = g(x+, z+)``, where ``b`` and the scalar ``c``
are the rule's: backward Euler has ``b = M x`` and ``c = h``; the trapezoidal rule ``b = M x + c f(x, z)`` and ``c = h/2``;
TR-BDF2 (Bank et al. 1985; Hosea and Shampine 1996) is a trapezoidal stage over ``gamma h`` and a BDF2 stage, both with
``c = gamma h/2``. With ``c = 0+`` the same stage solves the algebraic unknowns again at fixed states.

A row with ``M = 0`` has ``b = 0``: it is imposed at the new point only. A state with a non-windup limit takes the projected form
``x+ = clip(x+ - s r(x+), lower, upper)`` of its row ``r``, for which Newton is semismooth and cannot chatter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.hoist import gather, hashes, hoist, jacobian
from pgexcite.core.linear_algebra import SymbolicLU, pair_equations
from pgexcite.core.model import Model, State
from pgexcite.core.tape import linear_system

Array = NDArray[np.float64]


GAMMA = 2.0 - math.sqrt(2.0)
"""TR-BDF2's intermediate point: both stages then share one coefficient, and the rule is L-stable."""
ALPHA = 1.0 / (GAMMA * (2.0 - GAMMA))
BETA = (1.0 - GAMMA) ** 2 / (GAMMA * (2.0 - GAMMA))

FROZEN = 1e-30
"""Stage coefficient at which states cannot move: the algebraic unknowns are solved at fixed states."""
LARGEST_WRITTEN_OUT = 1500
"""Unknowns above which factors are no longer written out and a numeric sparse LU takes every stage."""
UPDATE_WEIGHT = 1e-12
"""Weight of the squared Newton update against the squared residual. Where the network has no solution a small residual is not
enough: the current of a constant power vanishes as its voltage runs away to infinity, and only the update tells."""
_AT_BOUND = 1e-9
_SINGULAR = 1e12
"""Condition number of a Jacobian from which no order of elimination can be judged by."""
_ANYWHERE = 6
"""Points at which all unknowns are moved by up to 180 degrees, or as many per unit, without a fault and with each."""


@dataclass(frozen=True)
class StageFunctions:
    """The compiled pieces of a step.

    All but ``residual`` and ``update`` read what depends on parameters only from a vector ``q``, which ``prepare`` computes
    when these, the rule or the step have changed.

    Attributes:
        prepare: ``(c, d, u, p) -> (q, mass, reach)``: beside ``q`` the coefficients of the derivatives, and what a slope is
            multiplied with to guess how far a state moves.
        newton: ``(w, b, q) -> (w_next, norms2)``, one Newton iteration on ``w = (x+, z+)``, and the squares of the residual at
            ``w`` and of the update, shape ``(2,)``; ``None`` above ``LARGEST_WRITTEN_OUT`` unknowns.
        check: ``(w, b, q) -> (norm2, slope)``: the squared residual at ``w``, and ``f`` there, slopes of limited states
            projected, those of algebraic rows zero. The slope depends on neither ``b`` nor ``c``.
        land: ``(w, b, q, d) -> (norm2, slope, y)``: the same with the outputs.
        residual: ``(w, b, c, d, u, p) -> (r, J)`` for the numeric solver.
        update: ``(w_0, w, d, u, p, h) -> d_next`` of a step from ``w_0`` to ``w``.
        pairing: equation each unknown is eliminated with.
        factors: of the linearised equations, in the symbols of the stage; ``None`` where they are not written out.
    """

    prepare: ca.Function
    newton: ca.Function | None
    check: ca.Function
    land: ca.Function
    residual: ca.Function
    update: ca.Function
    pairing: NDArray[np.intp]
    factors: SymbolicLU | None


@dataclass(frozen=True)
class Stage:
    """A stage written out symbolically, for whoever builds more on it (sensitivities, generated C).

    Attributes:
        w, b, c, d, u, p: symbols.
        q, values: what is hoisted out of the expressions below, as symbols and as expressions of ``c, d, u, p``.
        r: residual, shape ``(n_x + n_z,)``, of ``w``, ``b`` and ``q``.
        slope, y: projected ``f`` and outputs, of ``w``, ``q`` and, outputs only, ``d``.
        mass, reach: coefficients of the derivatives; and ``c`` over the diagonal of ``M + c (-df/dx)``, zero for states with a
            limit and for algebraic rows. Of ``c, d, u, p``.
        switching: for each discrete state whether ``r`` contains it, shape ``(n_d,)``. The others (timers run on in each
            step) are no reason to hoist anew.
    """

    w: ca.SX
    b: ca.SX
    c: ca.SX
    d: ca.SX
    u: ca.SX
    p: ca.SX
    q: ca.SX
    values: ca.SX
    r: ca.SX
    slope: ca.SX
    y: ca.SX
    mass: ca.SX
    reach: ca.SX
    switching: NDArray[np.bool_]

    @property
    def parameters(self) -> list[ca.SX]:
        """What does not change while a stage is solved, ``b`` apart."""
        return [self.c, self.d, self.u, self.p]

    def in_parameters(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Expressions of ``q`` as expressions of the parameters."""
        return ca.substitute(expressions, [self.q], [self.values])


def write_stage(model: Model) -> Stage:
    """The stage residual and what belongs to it, as SX."""
    n_x, n_z = len(model.x_names), len(model.z_names)
    x, z = ca.SX.sym("x", n_x), ca.SX.sym("z", n_z)
    b, c = ca.SX.sym("b", n_x), ca.SX.sym("c")
    d, u, p = ca.SX.sym("d", len(model.d_names)), ca.SX.sym("u", len(model.u_names)), ca.SX.sym("p", len(model.p_names))
    f, mass, lower, upper, g, y = model.dae(x, z, d, u, p)
    w = ca.vertcat(x, z)
    f, g = gather(f, w, [d, u, p]), gather(g, w, [d, u, p])
    rows, slopes, reaches = [], [], []
    for k in range(n_x):
        algebraic = mass[k] == 0
        slope, decay = f[k], _decay(f[k], x[k], p)
        if model.limited[k]:
            if decay is None:
                # Any factor does: where the row is satisfied, the projected value is what is inside.
                value = x[k] - (mass[k] * x[k] - b[k] - c * f[k]) * (1 / (mass[k] + c))
            else:
                # The projected value does not depend on x+ itself.
                value = (b[k] + c * ca.substitute(f[k], x[k], 0)) * (1 / (mass[k] + c * decay))
            rows.append(x[k] - _clip(value, lower[k], upper[k]))
            slope = ca.if_else(x[k] >= upper[k] - _AT_BOUND, ca.fmin(slope, 0), slope)
            slope = ca.if_else(x[k] <= lower[k] + _AT_BOUND, ca.fmax(slope, 0), slope)
            reaches.append(ca.SX(0))
        else:
            inverse = 1 / (mass[k] + c)
            rows.append((mass[k] * x[k] - b[k]) * inverse - (c * inverse) * f[k])
            damping = 0 if decay is None else ca.fmax(decay, 0)
            reaches.append(ca.if_else(algebraic, 0, c / (mass[k] + c * damping + algebraic)))
        slopes.append(ca.if_else(mass[k] != 0, slope, 0))
    r, column = ca.vertcat(*rows, g), ca.SX(0, 1)
    contained = {symbol.element_hash() for symbol in ca.symvar(r)}
    discrete = ca.vertsplit(d) if d.numel() else []
    switching = np.array([symbol.element_hash() in contained for symbol in discrete], dtype=np.bool_)
    fixed = [c, d[np.flatnonzero(switching).tolist()], u, p]
    hoisted = hoist([r, ca.densify(ca.vertcat(column, *slopes)), ca.densify(y)], fixed)
    r, slope, y = hoisted.expressions
    mass, reach = ca.densify(mass), ca.densify(ca.vertcat(column, *reaches))
    return Stage(w, b, c, d, u, p, hoisted.q, hoisted.values, r, slope, y, mass, reach, switching)


def _clip(value: ca.SX, lower: ca.SX, upper: ca.SX) -> ca.SX:
    return ca.fmin(ca.fmax(value, lower), upper)


def _decay(f: ca.SX, x: ca.SX, p: ca.SX) -> ca.SX | None:
    """``-df/dx`` where it is a constant of the parameters."""
    slope = -ca.jacobian(f, x)
    own = hashes(p)
    return ca.densify(slope) if all(s.element_hash() in own for s in ca.symvar(slope)) else None


def build_stage_functions(model: Model, state: State, p: Array, stage: Stage) -> StageFunctions:
    """Compile the pieces of a step, pairing equations with unknowns around this operating point."""
    w, options = stage.w, {"cse": True}
    slopes = jacobian(stage.r, w)
    residual = ca.Function("residual", [w, stage.b, *stage.parameters], stage.in_parameters([stage.r, slopes]))
    points = _sample_points(model, state, p)
    pattern = np.array(ca.DM(slopes.sparsity(), 1).full() != 0)
    pairing = pair_equations([np.array(residual(*point)[1].full()) for point in points], pattern)
    factors, update = None, ca.SX(0, 1)
    if w.numel() <= LARGEST_WRITTEN_OUT:
        factors = _factorise(stage, pairing, residual, points, _faults(model, p))
        update = factors.solve(stage.r, pairing)
    hoisted = hoist([stage.r, update, stage.slope, stage.y], [stage.q])
    r, update, slope, y = hoisted.expressions
    values = stage.in_parameters([hoisted.values])[0]
    arguments, norm2 = [w, stage.b, hoisted.q], ca.sumsqr(r)
    iteration = [w - update, ca.vertcat(norm2, ca.sumsqr(update))]
    n_x, h = len(model.x_names), ca.SX.sym("h")
    w_0 = ca.SX.sym("w_0", w.numel())
    d_next = model.renew(w_0[:n_x], w_0[n_x:], w[:n_x], w[n_x:], stage.d, stage.u, stage.p, h)
    return StageFunctions(
        prepare=ca.Function("prepare", stage.parameters, [values, stage.mass, stage.reach], options),
        newton=None if factors is None else ca.Function("newton", arguments, iteration, options),
        check=ca.Function("check", arguments, [norm2, slope], options),
        land=ca.Function("land", [*arguments, stage.d], [norm2, slope, y], options),
        residual=residual,
        update=ca.Function("update", [w_0, w, stage.d, stage.u, stage.p, h], [d_next]),
        pairing=pairing,
        factors=factors,
    )


def _factorise(
    stage: Stage,
    pairing: NDArray[np.intp],
    residual: ca.Function,
    points: list[tuple[Array | float, ...]],
    faults: list[Array],
) -> SymbolicLU:
    """Factors in the cheapest order with pivots that hold at all sample points, as far as there is one."""
    n, arguments = stage.w.numel(), [stage.w, stage.b, *stage.parameters]
    regular = [point for point in _disturbed(points, n, faults) if _is_regular(residual(*point)[1])]

    def sample(column: ca.SX) -> Array:
        function = ca.Function("sample", arguments, stage.in_parameters([ca.densify(column)]))
        values = [function(*point).full().ravel() for point in regular]
        return np.array(values).reshape(len(regular), column.numel())

    return SymbolicLU(linear_system(stage.r, stage.w, stage.q, pairing, sample))


def _disturbed(points: list[tuple[Array | float, ...]], n: int, faults: list[Array]) -> list[tuple[Array | float, ...]]:
    """Points all over the state space: rotors take every angle, and no order may rest on the one they start from."""
    anywhere = np.random.default_rng(0).uniform(-np.pi, np.pi, (_ANYWHERE, n))
    w, b, _, d, u, p = points[0]
    given = [(1e-3, d, u, p_) for p_ in (p, *faults)] + [(5e-2, d, u, p)]
    return [*points, *((w + shift, b, *rest) for rest in given for shift in anywhere)]


def _is_regular(jacobian: ca.DM) -> bool:
    """Whether there is an update at all: a source behind a bolted fault has none."""
    J = jacobian.full()
    return bool(np.isfinite(J).all() and np.linalg.cond(J) < _SINGULAR)


def _sample_points(model: Model, state: State, p: Array) -> list[tuple[Array | float, ...]]:
    """Points at which pivots must hold: short and long steps, limits on either side, every bus faulted."""
    x, z, d, u = state.x, state.z, state.d, state.u
    w, b = np.concatenate((x, z)), x.copy()
    # Only states that have a limit are moved past it: elsewhere an exponential would overflow.
    far = np.where(model.limited, 1e3, 0.0)
    beyond = np.concatenate((x + far, z)), np.concatenate((x - far, z))
    points: list[tuple[Array | float, ...]] = [(w, b, c, d, u, p) for c in (FROZEN, 1e-3, 0.5)]
    points += [
        (beyond[0], b + far, 1e-3, d, u, p),
        (beyond[1], b - far, 1e-3, d, u, p),
        (w, b, 1e-3, d, u, np.maximum.reduce(_faults(model, p))),
    ]
    return points


def _faults(model: Model, p: Array) -> list[Array]:
    """Parameters with one bus faulted, each in turn."""
    places = [k for name, k in model.index["p"].items() if name.startswith("bus.") and name.endswith(".fault_status")]
    faulted = np.tile(p, (len(places), 1))
    faulted[np.arange(len(places)), places] = 1.0
    return list(faulted)
