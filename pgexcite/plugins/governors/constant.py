"""Constant turbine: no governor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, setpoint
from pgexcite.core.roles import Governor


class ConstantTorque(Governor):
    """The turbine's torque or power is a set-point.

        holds = "torque":  t_m = p_m              holds = "power":  t_m = p_m / omega

    ``"torque"`` is the textbooks' constant ``T_m``; ``"power"`` is what PSS/E does with a machine that has no governor.

    Not modelled: any response of the turbine to speed.
    """

    source: ClassVar[str] = (
        "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, section 12.3 (constant T_m)"
    )

    holds: Literal["torque", "power"] = par("torque", "-", "what stays constant when the speed changes")

    p_m = setpoint("pu", "mechanical power at nominal speed", guess=0.5)

    def equations(self, v: Signals) -> Equations:
        return Equations(out={"t_m": v.p_m / v.omega if self.holds == "power" else v.p_m})

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        return {"p_m": known["t_m"]}
