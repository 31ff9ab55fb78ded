"""IEEE UEL1 underexcitation limiter: a circle in the P-Q plane."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import casadi as ca

from pgexcite.core.blocks import integrator, lead_lag, magnitude
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, par, port_in, port_out, state
from pgexcite.core.roles import Limiter

_LOWEST_VOLTAGE = 0.1
"""Terminal voltage, pu, below which the armature current is no longer computed from power and voltage."""

_EMPTYING = 0.1
"""Time constant, s, with which the integrator empties inside the circle at the fastest."""


class UEL1(Limiter):
    """Raises the excitation where the operating point leaves a circle around ``Q = K_UC V^2``.

        |K_UC v_t - j i_t| (<= V_UCMAX) ----(+)-->[ K_UL + K_UI/s | V_UIMIN..V_UIMAX ]-->[ (1+sT_U1)/(1+sT_U2) ]
        K_UR v_t           (<= V_URMAX) ----(-)         -->[ (1+sT_U3)/(1+sT_U4) ]-->[clip V_UIMIN..V_UIMAX]--> v_uel

    Inside the circle the signal is negative: for a high-value gate (ST1A's uel_position 2 or 3). With ``V_UIMIN = 0`` it is zero
    there, for a sum at the regulator's input. The integrator works beyond the circle only, between 0 and ``V_UIMAX``. The gains
    are in per unit of the gate's signal.

    Not modelled: the excitation system's stabiliser signal (``K_UF``).
    """

    source: ClassVar[str] = "IEEE Std 421.5-2005, clause 10.1 (UEL1), kept in the 2016 edition"
    ordered = (("V_UIMIN", "V_UIMAX"),)
    proper = (("T_U1", "T_U2"), ("T_U3", "T_U4"))

    K_UC: float = par(1.38, "pu", "centre of the circle", gt=0)
    K_UR: float = par(1.95, "pu", "radius of the circle", gt=0)
    V_UCMAX: float = par(5.8, "pu", "highest centre signal", gt=0)
    V_URMAX: float = par(5.8, "pu", "highest radius signal", gt=0)
    K_UL: float = par(100.0, "pu", "proportional gain", ge=0)
    K_UI: float = par(0.0, "pu/s", "integral gain", ge=0)
    V_UIMAX: float = par(18.0, "pu", "highest signal")
    V_UIMIN: float = par(-18.0, "pu", "lowest signal")
    T_U1: float = par(0.0, "s", "lead of the first lead-lag", ge=0)
    T_U2: float = par(0.05, "s", "lag of the first lead-lag", ge=0)
    T_U3: float = par(0.0, "s", "lead of the second lead-lag", ge=0)
    T_U4: float = par(0.0, "s", "lag of the second lead-lag", ge=0)

    v_t = port_in("pu", "terminal voltage")
    p_e = port_in("pu", "active power delivered")
    q_e = port_in("pu", "reactive power delivered")
    v_uel = port_out("pu", "limiter's signal")
    x_i = state("pu", "integrator")
    x_1 = state("pu", "first lead-lag")
    x_2 = state("pu", "second lead-lag")

    @property
    def acts_as(self) -> Literal["sum", "gate"]:
        return "sum" if self.V_UIMIN == 0 else "gate"

    def equations(self, v: Signals) -> Equations:
        error = self._error(v.v_t, v.p_e, v.q_e)
        # Inside the circle the integrator empties and rests at zero: wound down to V_UIMIN it would have no steady state.
        drive = ca.fmax(self.K_UI * error, -v.x_i / _EMPTYING)
        integral = integrator(drive, v.x_i, lower=ca.SX(0), upper=self.V_UIMAX)
        bounded = self._held(self.K_UL * error + integral.y)
        first = lead_lag(bounded, v.x_1, T_lead=self.T_U1, T_lag=self.T_U2)
        second = lead_lag(first.y, v.x_2, T_lead=self.T_U3, T_lag=self.T_U4)
        return Equations(ode=(integral, first, second), out={"v_uel": self._held(second.y)})

    def _error(self, v_t: Expr, p_e: Expr, q_e: Expr) -> Expr:
        voltage = ca.fmax(v_t, _LOWEST_VOLTAGE)
        centre = magnitude(self.K_UC * v_t - q_e / voltage, p_e / voltage)
        return ca.fmin(centre, self.V_UCMAX) - ca.fmin(self.K_UR * v_t, self.V_URMAX)

    def _held(self, signal: Expr) -> Expr:
        # A bound that is meant to be reached in normal operation: no limit of the operating point.
        return ca.fmin(ca.fmax(signal, self.V_UIMIN), self.V_UIMAX)

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if "p_e" not in known:
            return {}
        error = self._error(known["v_t"], known["p_e"], known["q_e"])
        signal = float(self._held(self.K_UL * error))
        return {"x_1": signal, "x_2": signal}
