"""Static loads: constant impedance, current and power, and mixtures of them (ZIP)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Self

import casadi as ca
from pydantic import model_validator

from pgexcite.core.blocks import magnitude
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, constant, par
from pgexcite.core.roles import Load

_SHARE_SLACK = 1e-9
"""How far shares may sum away from one: the rounding of decimal fractions."""

Shares = tuple[Expr, Expr, Expr]
"""Shares of constant impedance, constant current and constant power."""


class StaticLoad(Load):
    """A load that depends on its bus voltage alone: ``P`` and ``Q`` at the initial voltage ``v_0``.

        P(V) = P [ p_z (V / v_0)^2 + p_i (V / v_0) + p_p ]   for V >= V_min, and alike for Q

    Below ``V_min`` it keeps the impedance it has there: a constant current or power has no solution at a faulted bus. A load that
    starts below ``V_min`` changes over at ``v_0`` instead. The equations are written with admittances, so nothing is divided by
    the bus voltage.

    Not modelled: dependence on frequency, recovery in time.
    """

    source: ClassVar[str] = "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, section 7.1.1"

    P: float = par(..., "MW", "active power drawn at the initial voltage")
    Q: float = par(0.0, "Mvar", "reactive power drawn at the initial voltage")
    V_min: float = par(0.7, "pu", "voltage below which the load is a constant impedance", gt=0)

    v_0 = constant("pu", "initial voltage", guess=1.0)

    def shares(self) -> tuple[Shares, Shares]:
        """Shares of active and of reactive power."""
        raise NotImplementedError(f"{type(self).__name__} says nothing of its shares")

    def equations(self, v: Signals) -> Equations:
        square = v.v_re * v.v_re + v.v_im * v.v_im
        voltage = magnitude(v.v_re, v.v_im)
        inverse = v.v_0 / ca.fmax(voltage, ca.fmin(self.V_min, v.v_0))
        per_base = 1 / (v.S_n * v.v_0 * v.v_0)
        g, b = (
            demand * per_base * (share_z + inverse * (share_i + inverse * share_p))
            for demand, (share_z, share_i, share_p) in zip((self.P, self.Q), self.shares(), strict=True)
        )
        return Equations(
            out={"p": g * square, "q": b * square},
            current=(-g * v.v_re - b * v.v_im, b * v.v_re - g * v.v_im),
            hold={"v_0": voltage},
        )

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        return {} if terminal is None else {"v_0": abs(terminal.v)}


class ZIPLoad(StaticLoad):
    """A mixture by shares, which sum to one for P and for Q. Defaults: P constant current, Q constant impedance.

    Not modelled: dependence on frequency, recovery in time.
    """

    p_z: float = par(0.0, "-", "share of P at constant impedance")
    p_i: float = par(1.0, "-", "share of P at constant current")
    p_p: float = par(0.0, "-", "share of P at constant power")
    q_z: float = par(1.0, "-", "share of Q at constant impedance")
    q_i: float = par(0.0, "-", "share of Q at constant current")
    q_p: float = par(0.0, "-", "share of Q at constant power")

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name, of in zip("pq", self.shares(), strict=True):
            if abs(sum(of) - 1) > _SHARE_SLACK:
                raise ValueError(
                    f"the shares {name}_z + {name}_i + {name}_p must sum to 1, not to {sum(of):g}: give all three"
                )
        return self

    def shares(self) -> tuple[Shares, Shares]:
        return (self.p_z, self.p_i, self.p_p), (self.q_z, self.q_i, self.q_p)


class ConstantImpedance(StaticLoad):
    """P and Q with the square of the voltage; ``V_min`` has no effect."""

    def shares(self) -> tuple[Shares, Shares]:
        return (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)


class ConstantCurrent(StaticLoad):
    """P and Q in proportion to the voltage, above ``V_min``."""

    def shares(self) -> tuple[Shares, Shares]:
        return (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)


class ConstantPower(StaticLoad):
    """P and Q whatever the voltage, above ``V_min``."""

    def shares(self) -> tuple[Shares, Shares]:
        return (0.0, 0.0, 1.0), (0.0, 0.0, 1.0)
