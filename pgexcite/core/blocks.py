"""Transfer-function blocks, limits and gates that component equations are written with.

Every dynamic block is in mass form ``T x' = f``: with ``T = 0`` its row becomes the algebraic equation ``f = 0`` and nothing is
divided by zero. Block forms follow IEEE Std 421.5-2016, annex E.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import casadi as ca

from pgexcite.core.declare import Expr

_TINY = 1e-20
"""Added under the root of a magnitude: invisible at 1e-8 and above, and keeps the derivative finite at zero voltage."""


@dataclass(frozen=True)
class Dynamics:
    """One row ``mass * state' = rhs``, projected onto ``[lower, upper]`` where bounds are given (non-windup limit).

    Attributes:
        state: the state's symbol, as handed to ``equations``.
        rhs: right-hand side.
        mass: coefficient of the derivative; zero makes the row algebraic.
        lower, upper: non-windup bounds of the state, or ``None``. They may be expressions.
    """

    state: Expr
    rhs: Expr
    mass: Expr = 1.0
    lower: Expr | None = None
    upper: Expr | None = None


@dataclass(frozen=True)
class Block:
    """A block's output ``y`` and its dynamic row."""

    y: Expr
    dynamics: Dynamics


@dataclass(frozen=True)
class Limit:
    """A windup limit met while equations were written: ``lower <= signal <= upper``."""

    label: str
    signal: Expr
    lower: Expr
    upper: Expr


_released: ContextVar[list[Limit] | None] = ContextVar("released", default=None)


@contextmanager
def limits_released() -> Iterator[list[Limit]]:
    """Write equations with every windup limit released, and collect the limits instead.

    The initialisation solves the released equations, then says which limit the steady state violates: a clipped signal has no
    steady state to report.
    """
    limits: list[Limit] = []
    token = _released.set(limits)
    try:
        yield limits
    finally:
        _released.reset(token)


def clip(u: Expr, lower: Expr, upper: Expr, label: str = "signal") -> Expr:
    """Windup limit: ``u`` held between ``lower`` and ``upper``; ``label`` names the signal in messages."""
    limits = _released.get()
    if limits is None:
        return ca.fmin(ca.fmax(u, lower), upper)
    limits.append(Limit(label, u, lower, upper))
    return u


def der(x: Expr, rhs: Expr, T: Expr = 1.0, lower: Expr | None = None, upper: Expr | None = None) -> Dynamics:
    """The row ``T x' = rhs``."""
    return Dynamics(x, rhs, T, lower, upper)


def lag(u: Expr, x: Expr, *, T: Expr, K: Expr = 1.0, lower: Expr | None = None, upper: Expr | None = None) -> Block:
    """``K / (1 + sT)``; with bounds, the non-windup form of IEEE 421.5 annex E. With ``T = 0`` it is ``clip(K u)``."""
    return Block(x, Dynamics(x, K * u - x, T, lower, upper))


def integrator(u: Expr, x: Expr, *, T: Expr = 1.0, lower: Expr | None = None, upper: Expr | None = None) -> Block:
    """``1 / (sT)`` with ``T > 0``; with bounds, the non-windup form of IEEE 421.5 annex E."""
    return Block(x, Dynamics(x, u, T, lower, upper))


def lead_lag(u: Expr, x: Expr, *, T_lead: Expr, T_lag: Expr) -> Block:
    """``(1 + s T_lead) / (1 + s T_lag)``; both zero pass the signal. The state is the lagged input."""
    return Block(x + quotient(T_lead, T_lag) * (u - x), Dynamics(x, u - x, T_lag))


def washout(u: Expr, x: Expr, *, T: Expr, K: Expr = 1.0) -> Block:
    """``K sT / (1 + sT)``; the state is the lagged input."""
    return Block(K * (u - x), Dynamics(x, u - x, T))


def rate(u: Expr, x: Expr, *, T: Expr, K: Expr) -> Block:
    """``sK / (1 + sT)``, the rate feedback of an exciter; ``K = T = 0`` switches it off. The state is the lagged input."""
    return Block(quotient(K, T) * (u - x), Dynamics(x, u - x, T))


def low_value_gate(*signals: Expr) -> Expr:
    """The smallest of its inputs."""
    result = signals[0]
    for signal in signals[1:]:
        result = ca.fmin(result, signal)
    return result


def high_value_gate(*signals: Expr) -> Expr:
    """The largest of its inputs."""
    result = signals[0]
    for signal in signals[1:]:
        result = ca.fmax(result, signal)
    return result


def deadband(u: Expr, half_width: Expr) -> Expr:
    """Zero within ``+-half_width``, continued without a step outside."""
    return u - ca.fmin(ca.fmax(u, -half_width), half_width)


def magnitude(re: Expr, im: Expr) -> Expr:
    """``|re + j im|`` with a finite derivative at zero (a bolted fault puts a voltage there)."""
    return ca.sqrt(re * re + im * im + _TINY)


def share_above(before: Expr, now: Expr) -> Expr:
    """Share of a step, 0 to 1, that a signal on a straight line from ``before`` to ``now`` spends above zero."""
    return (ca.fmax(before, 0) + ca.fmax(now, 0)) / ca.fmax(ca.fabs(before) + ca.fabs(now), _TINY)


def quotient(numerator: Expr, denominator: Expr) -> Expr:
    """``numerator / denominator``, and 0 where the denominator is exactly zero (that block is switched off)."""
    off = ca.if_else(denominator == 0, 1.0, 0.0)
    return (1.0 - off) * numerator / (denominator + off)
