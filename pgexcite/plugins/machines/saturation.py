"""Magnetic saturation of machines: how much more field current than on the air-gap line a flux or voltage needs.

``S(E)`` is that excess divided by ``E``. Functions return the excess ``S(E) E`` itself, which stays finite at ``E = 0``.
"""

from __future__ import annotations

from typing import Any, Literal

import casadi as ca

from pgexcite.core.declare import Expr

Curve = Literal["none", "quadratic", "exponential"]
"""How ``S(1.0)`` and ``S(1.2)`` are joined: not at all, ``B (E - A)^2 / E`` above ``A`` (PSS/E), or ``S(1.0) E^n``.

PSS/E drops saturation where ``S(1.0) = 0``: that is ``"none"`` here, for ``"quadratic"`` would start at ``A = 1``.
"""

_UPPER = 1.2
"""The voltage of the second point of a saturation curve, pu; the first is at 1."""
_SMALLEST = 1e-6
"""Voltages below this count as this in the exponential curve, whose logarithm has no value at zero."""


def excess(curve: Curve, E: Expr, S10: Expr, S12: Expr) -> Expr:
    """``S(E) E`` of a curve through ``S(1.0) = S10`` and ``S(1.2) = S12``; never negative.

    Args:
        curve: choice of structure; with ``"none"`` the result is the number 0.
        E: flux or voltage, pu.
        S10, S12: the curve's two points.
    """
    if curve == "quadratic":
        return _quadratic(E, S10, S12)
    if curve == "exponential":
        exponent = ca.log(S12 / S10) / ca.log(_UPPER)
        return S10 * ca.exp((exponent + 1) * ca.log(ca.fmax(E, _SMALLEST)))
    return 0.0


def _quadratic(E: Expr, S10: Expr, S12: Expr) -> Expr:
    # With r = (1 - A) / (1.2 - A), from B (1 - A)^2 = S10 and B (1.2 - A)^2 = 1.2 S12; A = 1 where S10 = 0.
    r = ca.sqrt(S10 / (_UPPER * S12))
    A = (1 - _UPPER * r) / (1 - r)
    B = _UPPER * S12 / ((_UPPER - A) * (_UPPER - A))
    above = ca.fmax(E - A, 0.0)
    return B * above * above


def check_points(machine: Any) -> None:
    """Refuse saturation points that no curve of the chosen kind goes through.

    Raises:
        ValueError: with the values and what was expected.
    """
    S10, S12 = machine.S10, machine.S12
    if machine.saturation == "none":
        return
    if not S12 > S10:
        raise ValueError(f'S12 = {S12} must be above S10 = {S10}, or saturation = "none"')
    if machine.saturation == "exponential" and S10 == 0:
        raise ValueError('S10 must be above 0 for exponential saturation; choose "quadratic" or "none"')


def kundur_excess(psi: Expr, A_sat: Expr, B_sat: Expr, psi_T1: Expr) -> Expr:
    """``psi_I = A_sat exp(B_sat (psi - psi_T1))``, the excess of Kundur, section 3.8.2, pu.

    Kundur sets it to zero below ``psi_T1``, a jump of ``A_sat`` which he calls inconsequential but at which no Newton iteration can
    settle. Here the exponential goes on below; the difference is at most ``A_sat`` there and none above.
    """
    return A_sat * ca.exp(B_sat * (psi - psi_T1))
