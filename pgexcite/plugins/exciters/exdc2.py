"""PSS/E's EXDC2: a DC commutator exciter whose regulator is fed from the terminals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

from pydantic import model_validator

from pgexcite.core.blocks import der, lag, lead_lag, rate
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, port_in, setpoint, state
from pgexcite.core.roles import Exciter
from pgexcite.plugins.exciters.rotating import quadratic_excess


class EXDC2(Exciter):
    """Amplifier and DC exciter, stabilised by the rate of the field voltage; IEEE's DC2A with PSS/E's saturation.

        v_t -->[ 1/(1+sT_R) ]--(-)
        v_ref -----------------(+)-->[ (1+sT_C)/(1+sT_B) ]-->[ K_A/(1+sT_A) | v_t V_RMIN..v_t V_RMAX ]--+
        v_s, v_uel, v_oel, v_scl (+)                                                                    |
        [ sK_F/(1+sT_F1) ] ----(-)         e_fd <--[x omega]--+--[ 1/(sT_E) ]<--(+)---------------------+
              ^-----------------------------------------------+                 (-)
                                                              +--[ K_E + S_E ]---+

    ``S_E(E) E = B (E - A)^2`` above ``A``, through ``(E_1, SE_1)`` and ``(E_2, SE_2)``; zeros switch it off. Limits do not wind up.

    With ``by_speed`` the voltage of the exciter, which sits on the shaft, is multiplied by the speed behind the rate feedback.
    ``supply = "fixed"`` keeps the limits whatever ``v_t``, as EXDC1 does.

    Not modelled: ``K_E = 0`` (PSS/E then computes it); high-value gate of an underexcitation limiter.
    """

    source: ClassVar[str] = (
        "Siemens PTI, PSS/E Program Application Guide volume II, model EXDC2; IEEE Std 421.5-2005, clause 5.2 (DC2A)"
    )
    ordered = (("V_RMIN", "V_RMAX"),)
    proper = (("T_C", "T_B"), ("K_F", "T_F1"))

    T_R: float = par(0.02, "s", "voltage transducer time constant", ge=0)
    K_A: float = par(20.0, "pu", "regulator gain", gt=0)
    T_A: float = par(0.02, "s", "regulator time constant", ge=0)
    T_B: float = par(0.0, "s", "lag", ge=0)
    T_C: float = par(0.0, "s", "lead", ge=0)
    V_RMAX: float = par(5.2, "pu", "highest regulator output at rated terminal voltage (does not wind up)")
    V_RMIN: float = par(-4.16, "pu", "lowest regulator output at rated terminal voltage (does not wind up)")
    K_E: float = par(1.0, "pu", "exciter constant; 1 if separately excited")
    T_E: float = par(0.83, "s", "exciter time constant", gt=0)
    K_F: float = par(0.0754, "pu", "gain of the rate feedback", ge=0)
    T_F1: float = par(1.246, "s", "time constant of the rate feedback", ge=0)
    E_1: float = par(0.0, "pu", "first field voltage of the saturation curve", ge=0)
    SE_1: float = par(0.0, "-", "saturation at E_1; 0 switches saturation off", ge=0)
    E_2: float = par(0.0, "pu", "second field voltage of the saturation curve", ge=0)
    SE_2: float = par(0.0, "-", "saturation at E_2; 0 switches saturation off", ge=0)

    supply: Literal["terminals", "fixed"] = par("terminals", "-", "whether the regulator's limits follow v_t")
    by_speed: bool = par(True, "-", "whether the field voltage is proportional to speed")

    omega = port_in("pu", "rotor speed")
    v_uel = port_in("pu", "underexcitation limiter's signal", default=0.0)
    v_oel = port_in("pu", "overexcitation limiter's signal", default=0.0)
    v_scl = port_in("pu", "stator-current limiter's signal", default=0.0)
    v_m = state("pu", "sensed terminal voltage", guess=1.0)
    x_b = state("pu", "lead-lag")
    v_r = state("pu", "regulator output", guess=1.0)
    v_e = state("pu", "field voltage at nominal speed", guess=1.0)
    x_f = state("pu", "field voltage lagged by T_F1", guess=1.0)
    v_ref = setpoint("pu", "voltage reference", guess=1.0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.E_1 * self.SE_1 and self.E_2 * self.SE_2 and (self.E_2 - self.E_1) * (self.SE_2 - self.SE_1) <= 0:
            raise ValueError(
                f"the saturation curve must rise: S({self.E_1}) = {self.SE_1}, S({self.E_2}) = {self.SE_2}"
            )
        return self

    def equations(self, v: Signals) -> Equations:
        sensed = lag(v.v_t, v.v_m, T=self.T_R)
        feedback = rate(v.v_e, v.x_f, T=self.T_F1, K=self.K_F)
        error = v.v_ref - sensed.y - feedback.y + v.v_s + v.v_uel + v.v_oel + v.v_scl
        lead = lead_lag(error, v.x_b, T_lead=self.T_C, T_lag=self.T_B)
        supply = v.v_t if self.supply == "terminals" else 1.0
        floor, ceiling = supply * self.V_RMIN, supply * self.V_RMAX
        regulator = lag(lead.y, v.v_r, T=self.T_A, K=self.K_A, lower=floor, upper=ceiling)
        drop = self.K_E * v.v_e + quadratic_excess(v.v_e, self.E_1, self.SE_1, self.E_2, self.SE_2)
        exciter = der(v.v_e, regulator.y - drop, T=self.T_E)
        e_fd = v.omega * v.v_e if self.by_speed else v.v_e
        return Equations(ode=(sensed, lead, regulator, exciter, feedback), out={"e_fd": e_fd})

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        e_fd, v_t = known["e_fd"], known["v_t"]
        v_r = self.K_E * e_fd + float(quadratic_excess(e_fd, self.E_1, self.SE_1, self.E_2, self.SE_2))
        error = v_r / self.K_A
        return {"v_m": v_t, "x_b": error, "v_r": v_r, "v_e": e_fd, "x_f": e_fd, "v_ref": v_t + error}
