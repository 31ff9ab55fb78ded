"""Loads whose power follows a power of the voltage: at once, or recovering in time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from pgexcite.core.blocks import der, magnitude
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, constant, par, state
from pgexcite.core.roles import Load


@dataclass(frozen=True)
class Voltage:
    """A load's voltage.

    Attributes:
        square: its square, pu.
        bounded: its magnitude, held at ``V_min`` below that, pu; a load that starts below ``V_min`` is held at its initial voltage.
        relative: ``bounded`` over the initial voltage.
    """

    square: Expr
    bounded: Expr
    relative: Expr

    @staticmethod
    def of(v: Signals, V_min: Expr) -> Voltage:
        """The voltage of a load with the constant ``v_0``."""
        bounded = ca.fmax(magnitude(v.v_re, v.v_im), ca.fmin(V_min, v.v_0))
        return Voltage(v.v_re * v.v_re + v.v_im * v.v_im, bounded, bounded / v.v_0)

    def power(self, exponent: Expr) -> Expr:
        """``(V / v_0) ^ exponent``, held below ``V_min``."""
        return ca.exp(exponent * ca.log(self.relative))


class _VoltageDependent(Load):
    """P and Q at the initial voltage, times a factor each; below ``V_min`` the load keeps its admittance."""

    P: float = par(..., "MW", "active power drawn at the initial voltage")
    Q: float = par(0.0, "Mvar", "reactive power drawn at the initial voltage")
    V_min: float = par(0.7, "pu", "voltage below which the load is a constant impedance", gt=0)

    v_0 = constant("pu", "initial voltage", guess=1.0)

    def _drawn(self, v: Signals, voltage: Voltage, factor_p: Expr, factor_q: Expr) -> Equations:
        scale = 1 / (v.S_n * voltage.bounded * voltage.bounded)
        g, b = self.P * factor_p * scale, self.Q * factor_q * scale
        return Equations(
            out={"p": g * voltage.square, "q": b * voltage.square},
            current=(-g * v.v_re - b * v.v_im, b * v.v_re - g * v.v_im),
            hold={"v_0": magnitude(v.v_re, v.v_im)},
        )

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        return {} if terminal is None else {"v_0": abs(terminal.v)}


class ExponentialLoad(_VoltageDependent):
    """A static load with an exponent each for P and Q.

        P(V) = P (V / v_0)^alpha        Q(V) = Q (V / v_0)^beta        for V >= V_min

    Below ``V_min`` it keeps the admittance it has there. Exponents of 2, 1 and 0 are constant impedance, current and power.

    Not modelled: dependence on frequency, recovery in time.
    """

    source: ClassVar[str] = "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, section 7.1.1"

    alpha: float = par(1.5, "-", "exponent of active power")
    beta: float = par(2.5, "-", "exponent of reactive power")

    def equations(self, v: Signals) -> Equations:
        voltage = Voltage.of(v, self.V_min)
        return self._drawn(v, voltage, voltage.power(self.alpha), voltage.power(self.beta))


class _Recovering(_VoltageDependent):
    """Exponents at once (``alpha_t``, ``beta_t``) and in the end (``alpha_s``, ``beta_s``), with a time constant each."""

    alpha_t: float = par(2.0, "-", "transient exponent of active power")
    alpha_s: float = par(0.0, "-", "steady-state exponent of active power")
    beta_t: float = par(2.0, "-", "transient exponent of reactive power")
    beta_s: float = par(0.0, "-", "steady-state exponent of reactive power")
    T_p: float = par(60.0, "s", "recovery time constant of active power", gt=0)
    T_q: float = par(60.0, "s", "recovery time constant of reactive power", gt=0)


class AdditiveRecovery(_Recovering):
    """Exponential recovery in the additive form of Karlsson and Hill.

        P = P_0 [ x_p + (V/v_0)^alpha_t ]        T_p x_p' = (V/v_0)^alpha_s - (V/v_0)^alpha_t - x_p        and alike for Q

    After a step of the voltage ``P(t) = P_s + (P_t - P_s) exp(-t / T_p)``, exactly. Below ``V_min`` voltages count as ``V_min`` and
    the load is an admittance that goes on recovering towards the one it would end with there.

    Not modelled: dependence on frequency; an end to the recovery (a thermostat that stays on).
    """

    source: ClassVar[str] = (
        "D. Karlsson, D. J. Hill, Modelling and Identification of Nonlinear Dynamic Loads in Power Systems, "
        "IEEE Trans. Power Systems 9 (1994) 157"
    )

    x_p = state("-", "recovered active power, as a share of P")
    x_q = state("-", "recovered reactive power, as a share of Q")

    def equations(self, v: Signals) -> Equations:
        voltage = Voltage.of(v, self.V_min)
        p_t, q_t = voltage.power(self.alpha_t), voltage.power(self.beta_t)
        drawn = self._drawn(v, voltage, v.x_p + p_t, v.x_q + q_t)
        rows = (
            der(v.x_p, voltage.power(self.alpha_s) - p_t - v.x_p, T=self.T_p),
            der(v.x_q, voltage.power(self.beta_s) - q_t - v.x_q, T=self.T_q),
        )
        return Equations(ode=rows, out=drawn.out, current=drawn.current, hold=drawn.hold)


class MultiplicativeRecovery(_Recovering):
    """Exponential recovery in the multiplicative form of Van Cutsem.

        P = P_0 z_p (V/v_0)^alpha_t        T_p z_p' = (V/v_0)^alpha_s - z_p (V/v_0)^alpha_t        and alike for Q

    After a step of the voltage power recovers with the time constant ``T_p (V/v_0)^-alpha_t``. Below ``V_min`` voltages count as
    ``V_min`` and the load is an admittance that goes on recovering. ``z_MIN`` and ``z_MAX`` bound what recovery can do.

    Not modelled: dependence on frequency.
    """

    source: ClassVar[str] = (
        "T. Van Cutsem, C. Vournas, Voltage Stability of Electric Power Systems, Kluwer 1998, section 4.6"
    )
    ordered = (("z_MIN", "z_MAX"),)

    z_MIN: float = par(0.0, "-", "lowest recovery", ge=0, lt=1)
    z_MAX: float = par(1e3, "-", "highest recovery; the default is out of reach", gt=1)

    z_p = state("-", "recovery of active power", guess=1.0)
    z_q = state("-", "recovery of reactive power", guess=1.0)

    def equations(self, v: Signals) -> Equations:
        voltage = Voltage.of(v, self.V_min)
        p, q = v.z_p * voltage.power(self.alpha_t), v.z_q * voltage.power(self.beta_t)
        drawn = self._drawn(v, voltage, p, q)
        rows = (
            der(v.z_p, voltage.power(self.alpha_s) - p, T=self.T_p, lower=self.z_MIN, upper=self.z_MAX),
            der(v.z_q, voltage.power(self.beta_s) - q, T=self.T_q, lower=self.z_MIN, upper=self.z_MAX),
        )
        return Equations(ode=rows, out=drawn.out, current=drawn.current, hold=drawn.hold)
