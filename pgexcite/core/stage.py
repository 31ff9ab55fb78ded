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

from pgexcite.core.linear_algebra import SymbolicLU, pair_equations
from pgexcite.core.model import Model, State

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


@dataclass(frozen=True)
class StageFunctions:
    """The compiled pieces of a step.

    Attributes:
        newton: ``(w, b, c, d, u, p) -> (w_next, norm2)``, one Newton iteration on ``w = (x+, z+)``, and the squared residual at
            ``w`` plus ``UPDATE_WEIGHT`` times the squared update; ``None`` above ``LARGEST_WRITTEN_OUT`` unknowns.
        history: ``(x, z, d, u, p, c) -> (b, mass)``.
        residual: ``(w, b, c, d, u, p) -> (r, J)`` for the numeric solver.
        update: ``(x, z, d, u, p, h) -> d_next``.
        outputs: ``(x, z, d, u, p) -> y``.
        pairing: equation each unknown is eliminated with.
        entries: nonzeros of the written-out factors.
    """

    newton: ca.Function | None
    history: ca.Function
    residual: ca.Function
    update: ca.Function
    outputs: ca.Function
    pairing: NDArray[np.intp]
    entries: int


@dataclass(frozen=True)
class Stage:
    """A stage written out symbolically, for whoever builds more on it (sensitivities, generated C)."""

    w: ca.SX
    b: ca.SX
    c: ca.SX
    d: ca.SX
    u: ca.SX
    p: ca.SX
    r: ca.SX
    jacobian: ca.SX


def write_stage(model: Model) -> Stage:
    """The stage residual ``r(w; b, c, d, u, p)``, shape ``(n_x + n_z,)``, and its Jacobian in ``w``, as SX."""
    n_x, n_z = len(model.x_names), len(model.z_names)
    x, z = ca.SX.sym("x", n_x), ca.SX.sym("z", n_z)
    b, c = ca.SX.sym("b", n_x), ca.SX.sym("c")
    d, u, p = ca.SX.sym("d", len(model.d_names)), ca.SX.sym("u", len(model.u_names)), ca.SX.sym("p", len(model.p_names))
    f, mass, lower, upper, g, _, _ = model.dae(x, z, d, u, p, 0.0)
    rows = []
    for k in range(n_x):
        defect = mass[k] * x[k] - b[k] - c * f[k]
        if model.limited[k]:
            rows.append(x[k] - _clip(x[k] - defect / (mass[k] + c * _decay(f[k], x[k], p)), lower[k], upper[k]))
        else:
            rows.append(defect / (mass[k] + c))
    r = ca.vertcat(*rows, g)
    w = ca.vertcat(x, z)
    return Stage(w, b, c, d, u, p, r, ca.jacobian(r, w))


def _clip(value: ca.SX, lower: ca.SX, upper: ca.SX) -> ca.SX:
    return ca.fmin(ca.fmax(value, lower), upper)


def _decay(f: ca.SX, x: ca.SX, p: ca.SX) -> ca.SX:
    """``-df/dx`` where it is a constant of the parameters: with it the projected value no longer depends on ``x+`` itself."""
    slope = -ca.jacobian(f, x)
    own = {s.element_hash() for s in ca.vertsplit(p)} if p.numel() else set()
    if all(s.element_hash() in own for s in ca.symvar(slope)):
        return slope
    return ca.SX(1)


def build_stage_functions(model: Model, state: State, p: Array, stage: Stage | None = None) -> StageFunctions:
    """Compile the pieces of a step, pairing equations with unknowns around this operating point."""
    stage = stage or write_stage(model)
    arguments = [stage.w, stage.b, stage.c, stage.d, stage.u, stage.p]
    residual = ca.Function("residual", arguments, [stage.r, stage.jacobian])
    pairing = pair_equations(
        [_sample(residual, *point) for point in _sample_points(model, state, p)],
        np.array(ca.DM(stage.jacobian.sparsity(), 1).full() != 0),
    )
    newton, entries = None, 0
    if stage.w.numel() <= LARGEST_WRITTEN_OUT:
        lu = SymbolicLU(stage.jacobian, pairing)
        entries = lu.entries
        update = lu.solve(stage.r)
        norm2 = ca.sumsqr(stage.r) + UPDATE_WEIGHT * ca.sumsqr(update)
        newton = ca.Function("newton", arguments, [stage.w - update, norm2], {"cse": True})
    x, z, d, u, p_ = stage.w[: len(model.x_names)], stage.w[len(model.x_names) :], stage.d, stage.u, stage.p
    h = ca.SX.sym("h")
    d_next, y = model.dae(x, z, d, u, p_, h)[5:]
    return StageFunctions(
        newton=newton,
        history=write_history(model),
        residual=residual,
        update=ca.Function("update", [x, z, d, u, p_, h], [d_next]),
        outputs=ca.Function("outputs", [x, z, d, u, p_], [ca.substitute(y, h, 0)]),
        pairing=pairing,
        entries=entries,
    )


def write_history(model: Model) -> ca.Function:
    """``(x, z, d, u, p, c) -> (b, mass)``: ``M x + c f``, slopes of limited states projected, those of algebraic rows zero."""
    x, z = ca.SX.sym("x", len(model.x_names)), ca.SX.sym("z", len(model.z_names))
    c = ca.SX.sym("c")
    d, u, p = ca.SX.sym("d", len(model.d_names)), ca.SX.sym("u", len(model.u_names)), ca.SX.sym("p", len(model.p_names))
    f, mass, lower, upper, *_ = model.dae(x, z, d, u, p, 0.0)
    rows = []
    for k in range(len(model.x_names)):
        slope = f[k]
        if model.limited[k]:
            slope = ca.if_else(x[k] >= upper[k] - _AT_BOUND, ca.fmin(slope, 0), slope)
            slope = ca.if_else(x[k] <= lower[k] + _AT_BOUND, ca.fmax(slope, 0), slope)
        rows.append(mass[k] * x[k] + c * ca.if_else(mass[k] == 0, 0, slope))
    return ca.Function("history", [x, z, d, u, p, c], [ca.vertcat(ca.SX(0, 1), *rows), mass], {"cse": True})


def _sample(residual: ca.Function, *arguments: Array | float) -> Array:
    return np.array(residual(*arguments)[1].full())


def _sample_points(model: Model, state: State, p: Array) -> list[tuple[Array | float, ...]]:
    """Points at which pivots must hold: short and long steps, limits on either side, every bus faulted."""
    x, z, d, u = state.x, state.z, state.d, state.u
    w, b = np.concatenate((x, z)), x.copy()
    fault = p.copy()
    for name, k in model.index["p"].items():
        if name.startswith("bus.") and name.endswith(".fault_status"):
            fault[k] = 1.0
    # Only states that have a limit are moved past it: elsewhere an exponential would overflow.
    far = np.where(model.limited, 1e3, 0.0)
    beyond = np.concatenate((x + far, z)), np.concatenate((x - far, z))
    points: list[tuple[Array | float, ...]] = [(w, b, c, d, u, p) for c in (FROZEN, 1e-3, 0.5)]
    points += [(beyond[0], b + far, 1e-3, d, u, p), (beyond[1], b - far, 1e-3, d, u, p), (w, b, 1e-3, d, u, fault)]
    return points
