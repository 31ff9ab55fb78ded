"""Constant field voltage: no regulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pgexcite.core.blocks import clip
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, setpoint
from pgexcite.core.roles import Exciter


class ConstantField(Exciter):
    """The field voltage is a set-point, for manual control, for a controller that commands it, and for classical machines.

        e_fd_ref --> [clip E_MIN..E_MAX] --> e_fd

    Not modelled: anything of the exciter but its ceiling.
    """

    source: ClassVar[str] = (
        "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, section 12.3 (constant E_fd)"
    )
    ordered = (("E_MIN", "E_MAX"),)

    E_MIN: float = par(-1e3, "pu", "lowest field voltage; the default is out of reach")
    E_MAX: float = par(1e3, "pu", "highest field voltage; the default is out of reach")

    e_fd_ref = setpoint("pu", "field voltage", guess=1.0)

    def equations(self, v: Signals) -> Equations:
        return Equations(out={"e_fd": clip(v.e_fd_ref, self.E_MIN, self.E_MAX, "field voltage")})

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        return {"e_fd_ref": known["e_fd"]}
