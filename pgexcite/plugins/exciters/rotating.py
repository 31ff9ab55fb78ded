"""What exciters with a rotating machine share: saturation of the exciter."""

from __future__ import annotations

import casadi as ca

from pgexcite.core.declare import Expr


def exponential_excess(e_fd: Expr, A_EX: Expr, B_EX: Expr) -> Expr:
    """``S_E(E) E`` with ``S_E = A_EX exp(B_EX |E|)`` (IEEE Std 421.5, annex C)."""
    return A_EX * ca.exp(B_EX * ca.fabs(e_fd)) * e_fd


def quadratic_excess(e_fd: Expr, E_1: Expr, SE_1: Expr, E_2: Expr, SE_2: Expr) -> Expr:
    """``S_E(E) E = B (E - A)^2`` above ``A``, through ``SE_1`` at ``E_1`` and ``SE_2`` at ``E_2`` (PSS/E).

    Nothing where ``SE_1`` or ``SE_2`` is zero, as in PSS/E.
    """
    on = ca.if_else(ca.logic_and(SE_1 * E_1 > 0, SE_2 * E_2 > 0), 1.0, 0.0)
    # Where it is off a curve that exists takes its place, so that nothing is divided by zero.
    s_1 = on * SE_1 * E_1 + (1 - on) * 0.25
    s_2 = on * SE_2 * E_2 + (1 - on) * 1.0
    e_1, e_2 = on * E_1 + (1 - on) * 0.5, on * E_2 + (1 - on) * 1.0
    r = ca.sqrt(s_1 / s_2)
    A = (e_1 - r * e_2) / (1 - r)
    B = s_2 / ((e_2 - A) * (e_2 - A))
    above = ca.fmax(e_fd - A, 0.0)
    return on * B * above * above


def rectifier(load: Expr) -> Expr:
    """``F_EX``: share of a diode bridge's open-circuit voltage left at this normalised load (IEEE Std 421.5, annex D)."""
    middle = ca.sqrt(ca.fmax(0.75 - load * load, 1e-12))
    light = ca.fmin(1.0 - 0.577 * load, 1.0)
    heavy = ca.fmax(1.732 * (1.0 - load), 0.0)
    return ca.if_else(load <= 0.433, light, ca.if_else(load < 0.75, middle, heavy))
