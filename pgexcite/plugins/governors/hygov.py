"""Hydro turbine and governor HYGOV."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import casadi as ca

from pgexcite.core.blocks import clip, der, integrator, lag
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, setpoint, state
from pgexcite.core.roles import Governor

_LEAKAGE = 1e-4
"""Gate opening, pu, that the water column still sees at a closed gate: with none the head ``(q / gate)^2`` would be 0/0."""


class HYGOV(Governor):
    """A governor with permanent and temporary droop, a gate servo, and a turbine on an inelastic water column.

        n_ref --(+)-->[ 1/(1+sT_f) ]-->[ (1+sT_r)/(r s T_r), rate +-VELM | G_MIN..G_MAX ]--c-->[ 1/(1+sT_g) ]--> gate
        omega - 1 (-)                                                                   |
        R c ------(-)-------------------------------------------------------------------+

        T_w q' = 1 - h,    h = q |q| / gate^2      p_m = A_t h (q - q_NL) - D_turb gate (omega - 1)

    ``holds`` says what ``p_m`` is to the machine: ``"power"`` (PSS/E) gives ``t_m = p_m / omega``, ``"torque"`` gives
    ``t_m = p_m``. The gate's end stops do not wind up. To the head a gate below 0.0001 pu is one of 0.0001 pu: it leaks.

    Not modelled: elasticity of the water column, surge tank, dead band, the turbine's efficiency curve.
    """

    source: ClassVar[str] = "Siemens PTI, PSS/E Program Application Guide volume II, model HYGOV"
    ordered = (("G_MIN", "G_MAX"),)

    R: float = par(0.05, "pu", "permanent droop", ge=0)
    r: float = par(0.30, "pu", "temporary droop", gt=0)
    T_r: float = par(5.0, "s", "dashpot time constant", gt=0)
    T_f: float = par(0.05, "s", "filter time constant", gt=0)
    T_g: float = par(0.5, "s", "gate servo time constant", ge=0)
    VELM: float = par(0.2, "pu/s", "highest speed of the gate", gt=0)
    G_MAX: float = par(1.0, "pu", "highest gate position")
    G_MIN: float = par(0.0, "pu", "lowest gate position", ge=0)
    T_w: float = par(1.0, "s", "water starting time", gt=0)
    A_t: float = par(1.2, "-", "turbine gain", gt=0)
    D_turb: float = par(0.0, "pu", "turbine damping", ge=0)
    q_NL: float = par(0.08, "pu", "flow at no load", ge=0)
    holds: Literal["torque", "power"] = par("power", "-", "what the turbine's output is to the machine")

    x_f = state("pu", "filtered error")
    c = state("pu", "desired gate position", guess=0.5)
    g = state("pu", "gate position", guess=0.5)
    q = state("pu", "flow", guess=0.5)
    n_ref = setpoint("pu", "speed reference, above nominal", guess=0.025)

    def equations(self, v: Signals) -> Equations:
        deviation = v.omega - 1
        error = v.n_ref - deviation - self.R * v.c
        filtered = lag(error, v.x_f, T=self.T_f)
        wanted = (v.x_f + self.T_r * (error - v.x_f) / self.T_f) / (self.r * self.T_r)
        desired = integrator(clip(wanted, -self.VELM, self.VELM, "gate speed"), v.c, lower=self.G_MIN, upper=self.G_MAX)
        gate = lag(desired.y, v.g, T=self.T_g)
        opening = ca.fmax(gate.y, _LEAKAGE)
        # With the flow's sign: the square alone rests with the flow running back, too, which a long step can fall into.
        head = v.q * ca.fabs(v.q) / (opening * opening)
        flow = der(v.q, 1 - head, T=self.T_w)
        p_m = self.A_t * head * (v.q - self.q_NL) - self.D_turb * gate.y * deviation
        t_m = p_m / v.omega if self.holds == "power" else p_m
        return Equations(ode=(filtered, desired, gate, flow), out={"t_m": t_m})

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        g = known["t_m"] / self.A_t + self.q_NL
        return {"c": g, "g": g, "q": g, "n_ref": self.R * g}
