"""Steam turbine and governor TGOV1."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pgexcite.core.blocks import lag, lead_lag
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, setpoint, state
from pgexcite.core.roles import Governor


class TGOV1(Governor):
    """A droop governor, a steam chest and a reheater.

        p_ref --(+)-->[ 1/R ]-->[ 1/(1+sT_1) | V_MIN..V_MAX ]-->[ (1+sT_2)/(1+sT_3) ]--(+)--> p_m
        omega - 1 (-)                                       D_t (omega - 1) -----------(-)

    ``holds`` says what ``p_m`` is to the machine: ``"power"`` (PSS/E) gives ``t_m = p_m / omega``, ``"torque"`` gives
    ``t_m = p_m``. The limits do not wind up. The load reference ``p_ref`` is in per unit of speed: ``R`` times the power.

    Not modelled: the dead band of the governor.
    """

    source: ClassVar[str] = "Siemens PTI, PSS/E Program Application Guide volume II, model TGOV1"
    ordered = (("V_MIN", "V_MAX"),)
    proper = (("T_2", "T_3"),)

    R: float = par(0.05, "pu", "permanent droop", gt=0)
    T_1: float = par(0.5, "s", "steam bowl time constant", ge=0)
    V_MAX: float = par(1.0, "pu", "highest valve position")
    V_MIN: float = par(0.0, "pu", "lowest valve position")
    T_2: float = par(2.1, "s", "lead: share of the high-pressure turbine times T_3", ge=0)
    T_3: float = par(7.0, "s", "reheater time constant", ge=0)
    D_t: float = par(0.0, "pu", "turbine damping", ge=0)
    holds: Literal["torque", "power"] = par("power", "-", "what the turbine's output is to the machine")

    x_v = state("pu", "valve position", guess=0.5)
    x_r = state("pu", "reheater", guess=0.5)
    p_ref = setpoint("pu", "load reference", guess=0.025)

    def equations(self, v: Signals) -> Equations:
        deviation = v.omega - 1
        valve = lag((v.p_ref - deviation) / self.R, v.x_v, T=self.T_1, lower=self.V_MIN, upper=self.V_MAX)
        turbine = lead_lag(valve.y, v.x_r, T_lead=self.T_2, T_lag=self.T_3)
        p_m = turbine.y - self.D_t * deviation
        return Equations(ode=(valve, turbine), out={"t_m": p_m / v.omega if self.holds == "power" else p_m})

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        p_m = known["t_m"]
        return {"x_v": p_m, "x_r": p_m, "p_ref": self.R * p_m}
