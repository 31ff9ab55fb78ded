"""Classical machine: a constant voltage behind the transient reactance (Kundur, section 5.3.1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import casadi as ca

from pgexcite.core.blocks import der
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, state
from pgexcite.core.roles import Machine
from pgexcite.plugins.machines.rotor import angle, at_rest, guesses, outputs, stator


class Classical(Machine):
    """Second order: rotor angle and speed. ``e_fd`` *is* the internal voltage E', so a constant field means a constant E'.

        e_fd = E' at delta --[ R_a + j Xp_d ]--> bus          t_m --(+)--> [ 1 / 2H s ] --> omega
                                                              t_e --(-)

    ``H = 0`` makes it an infinite bus behind ``Xp_d``, as PSS/E reads GENCLS: its speed never changes.

    Not modelled: field and damper circuits, saliency, saturation.
    """

    source: ClassVar[str] = "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, section 5.3.1"

    H: float = par(3.5, "s", "inertia constant on the machine's base; 0 makes an infinite bus", ge=0)
    D: float = par(0.0, "pu", "damping torque per unit of speed deviation", ge=0)
    R_a: float = par(0.0, "pu", "armature resistance", ge=0)
    Xp_d: float = par(0.3, "pu", "transient reactance", gt=0)

    delta = state("rad", "rotor angle against the angle reference")
    omega = state("pu", "rotor speed", guess=1.0)

    def equations(self, v: Signals) -> Equations:
        s = stator(v, e_d=0.0, e_q=v.e_fd, R_a=self.R_a, X_d=self.Xp_d, X_q=self.Xp_d)
        t_e = v.e_fd * s.i_q
        frozen = ca.if_else(self.H == 0, 1.0, 0.0)
        torque = v.t_m - t_e - self.D * (v.omega - 1)
        speed = der(v.omega, (1 - frozen) * torque, T=2 * self.H + frozen)
        return Equations(ode=(angle(v), speed), out=outputs(v, s, i_fd=v.e_fd), current=s.current)

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if terminal is None:
            return {}
        at = at_rest(terminal, R_a=self.R_a, X_q=self.Xp_d)
        return guesses(terminal, at, e_fd=at.behind(self.R_a, self.Xp_d, self.Xp_d)[1])
