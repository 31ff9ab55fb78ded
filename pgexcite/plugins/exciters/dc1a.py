"""IEEE DC1A exciter: a DC commutator exciter with a continuously acting regulator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from pgexcite.core.blocks import der, lag, lead_lag, rate
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, port_in, setpoint, state
from pgexcite.core.roles import Exciter
from pgexcite.plugins.exciters.rotating import exponential_excess


class DC1A(Exciter):
    """Amplifier and DC exciter, stabilised by the rate of the field voltage.

        v_t -->[ 1/(1+sT_R) ]--(-)
        v_ref -----------------(+)-->[ (1+sT_C)/(1+sT_B) ]-->[ K_A/(1+sT_A) | V_RMIN..V_RMAX ]--+
        v_s, v_uel, v_oel, v_scl (+)                                                            |
        [ sK_F/(1+sT_F) ] -----(-)         e_fd <--+--[ 1/(sT_E) ]<--(+)------------------------+
              ^------------------------------------+                 (-)
                                                   +--[ K_E + A_EX exp(B_EX e_fd) ]--+

    The limits do not wind up. Limiters are summed at the input.

    Defaults: the exciter of Kundur's two-area example.

    Not modelled: high-value gate of an underexcitation limiter; supply from the terminals (DC2A); effect of speed on the exciter.
    """

    source: ClassVar[str] = "IEEE Std 421.5-2005, clause 5.1 (DC1A)"
    ordered = (("V_RMIN", "V_RMAX"),)
    proper = (("T_C", "T_B"), ("K_F", "T_F"))

    T_R: float = par(0.05, "s", "voltage transducer time constant", ge=0)
    T_C: float = par(0.0, "s", "lead", ge=0)
    T_B: float = par(0.0, "s", "lag", ge=0)
    K_A: float = par(20.0, "pu", "regulator gain", gt=0)
    T_A: float = par(0.055, "s", "regulator time constant", ge=0)
    V_RMIN: float = par(-3.0, "pu", "lowest regulator output (does not wind up)")
    V_RMAX: float = par(5.0, "pu", "highest regulator output (does not wind up)")
    K_E: float = par(1.0, "pu", "exciter constant; 1 if separately excited")
    T_E: float = par(0.36, "s", "exciter time constant", gt=0)
    K_F: float = par(0.125, "pu", "gain of the rate feedback", ge=0)
    T_F: float = par(1.8, "s", "time constant of the rate feedback", ge=0)
    A_EX: float = par(0.0056, "-", "factor of the saturation function", ge=0)
    B_EX: float = par(1.075, "-", "exponent of the saturation function, per pu of field voltage", ge=0)

    v_uel = port_in("pu", "underexcitation limiter's signal", default=0.0)
    v_oel = port_in("pu", "overexcitation limiter's signal", default=0.0)
    v_scl = port_in("pu", "stator-current limiter's signal", default=0.0)
    v_m = state("pu", "sensed terminal voltage", guess=1.0)
    x_b = state("pu", "lead-lag")
    v_r = state("pu", "regulator output", guess=1.0)
    v_e = state("pu", "field voltage", guess=1.0)
    x_f = state("pu", "field voltage lagged by T_F", guess=1.0)
    v_ref = setpoint("pu", "voltage reference", guess=1.0)

    def equations(self, v: Signals) -> Equations:
        sensed = lag(v.v_t, v.v_m, T=self.T_R)
        feedback = rate(v.v_e, v.x_f, T=self.T_F, K=self.K_F)
        error = v.v_ref - sensed.y - feedback.y + v.v_s + v.v_uel + v.v_oel + v.v_scl
        lead = lead_lag(error, v.x_b, T_lead=self.T_C, T_lag=self.T_B)
        regulator = lag(lead.y, v.v_r, T=self.T_A, K=self.K_A, lower=self.V_RMIN, upper=self.V_RMAX)
        drop = self.K_E * v.v_e + exponential_excess(v.v_e, self.A_EX, self.B_EX)
        exciter = der(v.v_e, regulator.y - drop, T=self.T_E)
        return Equations(ode=(sensed, lead, regulator, exciter, feedback), out={"e_fd": v.v_e})

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        e_fd, v_t = known["e_fd"], known["v_t"]
        v_r = self.K_E * e_fd + self.A_EX * math.exp(self.B_EX * abs(e_fd)) * e_fd
        error = v_r / self.K_A
        return {"v_m": v_t, "x_b": error, "v_r": v_r, "v_e": e_fd, "x_f": e_fd, "v_ref": v_t + error}
