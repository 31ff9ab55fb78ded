"""Simplified excitation system SEXS, as in PSS/E and PowerFactory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pgexcite.core.blocks import lag, lead_lag
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, port_in, setpoint, state
from pgexcite.core.roles import Exciter


class SEXS(Exciter):
    """A lead-lag and a limited lag: any exciter, seen from far away.

        v_t -->[ 1/(1+sT_R) ]--(-)
        v_ref ------------------(+)-->[ (1+sT_A)/(1+sT_B) ]-->[ K/(1+sT_E) | E_MIN..E_MAX ]--> e_fd
        v_s, v_uel, v_oel, v_scl (+)

    PSS/E's record gives the ratio ``TA/TB`` in place of ``T_A`` and has no transducer (``T_R = 0``). The limits do not wind up.

    Not modelled: ceilings that follow the terminal voltage; gates.
    """

    source: ClassVar[str] = "Siemens PTI, PSS/E Program Application Guide volume II, model SEXS"
    ordered = (("E_MIN", "E_MAX"),)
    proper = (("T_A", "T_B"),)

    T_R: float = par(0.0, "s", "voltage transducer time constant", ge=0)
    T_A: float = par(2.0, "s", "lead", ge=0)
    T_B: float = par(5.0, "s", "lag", ge=0)
    K: float = par(20.0, "pu", "gain", gt=0)
    T_E: float = par(1.0, "s", "exciter time constant", ge=0)
    E_MIN: float = par(0.0, "pu", "lowest field voltage (does not wind up)")
    E_MAX: float = par(5.0, "pu", "highest field voltage (does not wind up)")

    v_uel = port_in("pu", "underexcitation limiter's signal", default=0.0)
    v_oel = port_in("pu", "overexcitation limiter's signal", default=0.0)
    v_scl = port_in("pu", "stator-current limiter's signal", default=0.0)
    v_m = state("pu", "sensed terminal voltage", guess=1.0)
    x_b = state("pu", "lead-lag")
    v_e = state("pu", "field voltage", guess=1.0)
    v_ref = setpoint("pu", "voltage reference", guess=1.0)

    def equations(self, v: Signals) -> Equations:
        sensed = lag(v.v_t, v.v_m, T=self.T_R)
        error = v.v_ref - sensed.y + v.v_s + v.v_uel + v.v_oel + v.v_scl
        lead = lead_lag(error, v.x_b, T_lead=self.T_A, T_lag=self.T_B)
        exciter = lag(lead.y, v.v_e, T=self.T_E, K=self.K, lower=self.E_MIN, upper=self.E_MAX)
        return Equations(ode=(sensed, lead, exciter), out={"e_fd": exciter.y})

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        error = known["e_fd"] / self.K
        return {"v_m": known["v_t"], "x_b": error, "v_e": known["e_fd"], "v_ref": known["v_t"] + error}
