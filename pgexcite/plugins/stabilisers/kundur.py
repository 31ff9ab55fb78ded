"""Kundur's generic power system stabiliser: gain, washout, phase compensation."""

from __future__ import annotations

from typing import ClassVar

from pgexcite.core.blocks import clip, lead_lag, washout
from pgexcite.core.component import Equations, Signals
from pgexcite.core.declare import par, port_in, state
from pgexcite.core.roles import Stabiliser


class KundurPSS(Stabiliser):
    """Damping torque from the rotor's speed, shifted to make up for the lag of exciter and field.

        omega - 1 -->[ K_STAB ]-->[ sT_W/(1+sT_W) ]-->[ (1+sT_1)/(1+sT_2) ]-->[ (1+sT_3)/(1+sT_4) ]-->[clip V_SMIN..V_SMAX]--> v_s

    ``T_3 = T_4 = 0`` takes the second lead-lag out; the limits wind up. Defaults: example 12.5.

    Not modelled: torsional filter, transducer.
    """

    source: ClassVar[str] = (
        "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, section 12.5 and example 12.5"
    )
    ordered = (("V_SMIN", "V_SMAX"),)
    proper = (("T_1", "T_2"), ("T_3", "T_4"))

    K_STAB: float = par(9.5, "pu", "gain, per pu of speed deviation")
    T_W: float = par(1.4, "s", "washout time constant; 0 switches the stabiliser off", ge=0)
    T_1: float = par(0.154, "s", "lead of the first lead-lag", ge=0)
    T_2: float = par(0.033, "s", "lag of the first lead-lag", ge=0)
    T_3: float = par(0.0, "s", "lead of the second lead-lag", ge=0)
    T_4: float = par(0.0, "s", "lag of the second lead-lag", ge=0)
    V_SMIN: float = par(-0.1, "pu", "lowest signal", le=0)
    V_SMAX: float = par(0.1, "pu", "highest signal", ge=0)

    omega = port_in("pu", "rotor speed")
    x_w = state("pu", "washout")
    x_1 = state("pu", "first lead-lag")
    x_2 = state("pu", "second lead-lag")

    def equations(self, v: Signals) -> Equations:
        washed = washout(self.K_STAB * (v.omega - 1), v.x_w, T=self.T_W)
        first = lead_lag(washed.y, v.x_1, T_lead=self.T_1, T_lag=self.T_2)
        second = lead_lag(first.y, v.x_2, T_lead=self.T_3, T_lag=self.T_4)
        v_s = clip(second.y, self.V_SMIN, self.V_SMAX, "stabiliser signal")
        return Equations(ode=(washed, first, second), out={"v_s": v_s})
