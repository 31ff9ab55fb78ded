"""IEEE AC1A exciter: a field-controlled alternator with a non-controlled rectifier (PSS/E's ESAC1A)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import casadi as ca

from pgexcite.core.blocks import clip, der, lag, lead_lag, rate
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, par, port_in, setpoint, state
from pgexcite.core.roles import Exciter
from pgexcite.plugins.exciters.rotating import quadratic_excess, rectifier

_SMALLEST = 1e-3
"""Alternator voltage, pu, below which the rectifier's load is computed as at this voltage."""


class AC1A(Exciter):
    """Regulator, alternator with demagnetisation and saturation, and a diode bridge loaded by the field current.

        v_t -->[ 1/(1+sT_R) ]--(-)
        v_ref -----------------(+)-->[ (1+sT_C)/(1+sT_B) ]-->[ K_A/(1+sT_A) | V_AMIN..V_AMAX ]-->[clip V_RMIN..V_RMAX]--+
        v_s, v_uel, v_oel, v_scl (+)                                                                                   |
        [ sK_F/(1+sT_F) ] -----(-)     e_fd <--[ F_EX(K_C i_fd / v_e) ]<--v_e--[ 1/(sT_E) | 0.. ]<--(+)----------------+
              ^                                                            |                       (-)
              +------------------------------------------------------------|---- v_fe -------------+
                                                   v_fe = [ K_E + S_E(v_e) ] v_e + K_D i_fd

    ``S_E(E) E = B (E - A)^2`` above ``A``, through ``(E_1, SE_1)`` and ``(E_2, SE_2)``; zeros switch it off. Limiters are summed at
    the input. The regulator's limits and the alternator's floor do not wind up, ``V_RMIN`` and ``V_RMAX`` do.

    Not modelled: the gates of limiters at the regulator's output.
    """

    source: ClassVar[str] = (
        "IEEE Std 421.5-2005, clause 6.1 (AC1A) and annex D; Siemens PTI, PSS/E Program Application Guide volume II, model ESAC1A"
    )
    ordered = (("V_AMIN", "V_AMAX"), ("V_RMIN", "V_RMAX"))
    proper = (("T_C", "T_B"), ("K_F", "T_F"))

    T_R: float = par(0.0, "s", "voltage transducer time constant", ge=0)
    T_B: float = par(0.0, "s", "lag", ge=0)
    T_C: float = par(0.0, "s", "lead", ge=0)
    K_A: float = par(400.0, "pu", "regulator gain", gt=0)
    T_A: float = par(0.02, "s", "regulator time constant", ge=0)
    V_AMAX: float = par(14.5, "pu", "highest regulator output (does not wind up)")
    V_AMIN: float = par(-14.5, "pu", "lowest regulator output (does not wind up)")
    T_E: float = par(0.80, "s", "exciter time constant", gt=0)
    K_F: float = par(0.03, "pu", "gain of the rate feedback", ge=0)
    T_F: float = par(1.0, "s", "time constant of the rate feedback", ge=0)
    K_C: float = par(0.20, "pu", "rectifier loading: commutating reactance", ge=0)
    K_D: float = par(0.38, "pu", "demagnetisation by the field current", ge=0)
    K_E: float = par(1.0, "pu", "exciter constant; 1 if separately excited")
    E_1: float = par(0.0, "pu", "first voltage of the saturation curve", ge=0)
    SE_1: float = par(0.0, "-", "saturation at E_1; 0 switches saturation off", ge=0)
    E_2: float = par(0.0, "pu", "second voltage of the saturation curve", ge=0)
    SE_2: float = par(0.0, "-", "saturation at E_2; 0 switches saturation off", ge=0)
    V_RMAX: float = par(6.03, "pu", "highest voltage at the exciter's field")
    V_RMIN: float = par(-5.43, "pu", "lowest voltage at the exciter's field")

    v_uel = port_in("pu", "underexcitation limiter's signal", default=0.0)
    v_oel = port_in("pu", "overexcitation limiter's signal", default=0.0)
    v_scl = port_in("pu", "stator-current limiter's signal", default=0.0)
    v_m = state("pu", "sensed terminal voltage", guess=1.0)
    x_b = state("pu", "lead-lag")
    v_a = state("pu", "regulator output", guess=1.0)
    v_e = state("pu", "alternator voltage", guess=1.0)
    x_f = state("pu", "exciter field current lagged by T_F", guess=1.0)
    v_ref = setpoint("pu", "voltage reference", guess=1.0)

    def equations(self, v: Signals) -> Equations:
        v_fe = self._field_current(v.v_e, v.i_fd)
        sensed = lag(v.v_t, v.v_m, T=self.T_R)
        feedback = rate(v_fe, v.x_f, T=self.T_F, K=self.K_F)
        error = v.v_ref - sensed.y - feedback.y + v.v_s + v.v_uel + v.v_oel + v.v_scl
        lead = lead_lag(error, v.x_b, T_lead=self.T_C, T_lag=self.T_B)
        regulator = lag(lead.y, v.v_a, T=self.T_A, K=self.K_A, lower=self.V_AMIN, upper=self.V_AMAX)
        v_r = clip(regulator.y, self.V_RMIN, self.V_RMAX, "voltage at the exciter's field")
        exciter = der(v.v_e, v_r - v_fe, T=self.T_E, lower=ca.SX(0))
        e_fd = v.v_e * rectifier(self.K_C * v.i_fd / ca.fmax(v.v_e, _SMALLEST))
        return Equations(ode=(sensed, lead, regulator, exciter, feedback), out={"e_fd": e_fd})

    def _field_current(self, v_e: Expr, i_fd: Expr) -> Expr:
        saturation = quadratic_excess(v_e, self.E_1, self.SE_1, self.E_2, self.SE_2)
        return self.K_E * v_e + saturation + self.K_D * i_fd

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        # The first of the rectifier's modes; in the others Newton has a little to do.
        v_t, v_e = known["v_t"], known["e_fd"] + 0.577 * self.K_C * known["i_fd"]
        v_fe = float(self._field_current(v_e, known["i_fd"]))
        error = v_fe / self.K_A
        return {"v_m": v_t, "x_b": error, "v_a": v_fe, "v_e": v_e, "x_f": v_fe, "v_ref": v_t + error}
