"""Continuous approximation of an on-load tap changer."""

from __future__ import annotations

from typing import ClassVar

import casadi as ca

from pgexcite.core.blocks import deadband, integrator, magnitude
from pgexcite.core.component import Equations, Signals
from pgexcite.core.declare import par, state
from pgexcite.core.roles import TapChanger


class ContinuousTapChanger(TapChanger):
    """The ratio follows the voltage error without steps or delays: for analysis, and for predictions that need derivatives.

        |V| - V_ref -->[ dead band +-half_deadband ]-->[ 1 / (s T_c) | tap_min..tap_max ]--> ratio

    With a half dead band of zero this is ``r' = (V - V_ref) / T_c``; the run must then start at ``V = V_ref``. A tap changer with
    step ``s`` and delay ``T`` between taps moves at about the same speed where ``T_c = T |V - V_ref| / s``.

    Not modelled: delays, the size of a step.
    """

    source: ClassVar[str] = (
        "T. Van Cutsem, C. Vournas, Voltage Stability of Electric Power Systems, Kluwer 1998, section 4.4.2"
    )
    ordered = (("tap_min", "tap_max"),)

    V_ref: float = par(1.0, "pu", "voltage held", gt=0)
    half_deadband: float = par(0.01, "pu", "deviation that is left alone", ge=0)
    T_c: float = par(30.0, "s", "time for the ratio to move by the error of the voltage", gt=0)
    tap_min: float = par(0.88, "-", "lowest ratio", gt=0)
    tap_max: float = par(1.20, "-", "highest ratio", gt=0)
    blocked: float = par(0.0, "-", "1 while the tap changer is blocked", ge=0, le=1)

    moved = state("pu", "change of the ratio since the start")

    @property
    def reach(self) -> tuple[float, float]:
        return self.tap_min, self.tap_max

    def equations(self, v: Signals) -> Equations:
        error = deadband(magnitude(v.v_re, v.v_im) - self.V_ref, self.half_deadband)
        drive = self._direction * (1 - self.blocked) * error
        moving = integrator(drive, v.moved, T=self.T_c, lower=self.tap_min - v.tap, upper=self.tap_max - v.tap)
        return Equations(ode=(moving,), out={"ratio": v.tap + moving.y}, current=(ca.SX(0), ca.SX(0)))
