"""One-axis machine: field flux, no damper circuits (Sauer and Pai, section 5.6; IEEE Std 1110 model 1.0)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Self

from pydantic import model_validator

from pgexcite.core.blocks import der
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, state
from pgexcite.core.roles import Machine
from pgexcite.plugins.machines.rotor import at_rest, check_falling, guesses, outputs, stator, swing
from pgexcite.plugins.machines.saturation import Curve, check_points, excess


class OneAxis(Machine):
    """Third order: rotor angle, speed and the field flux E'_q.

        e_fd --(+)--> [ 1 / sTp_d0 ] --> E'_q        i_fd = E'_q + S(E'_q) E'_q + (X_d - Xp_d) i_d
        i_fd --(-)

    Not modelled: damper circuits; put their damping into ``D``.
    """

    source: ClassVar[str] = (
        "P. W. Sauer and M. A. Pai, Power System Dynamics and Stability, Prentice Hall 1998, section 5.6"
    )

    H: float = par(3.5, "s", "inertia constant on the machine's base", gt=0)
    D: float = par(0.0, "pu", "damping torque per unit of speed deviation", ge=0)
    R_a: float = par(0.0, "pu", "armature resistance", ge=0)
    X_d: float = par(1.8, "pu", "d-axis synchronous reactance", gt=0)
    X_q: float = par(1.7, "pu", "q-axis synchronous reactance", gt=0)
    Xp_d: float = par(0.3, "pu", "d-axis transient reactance", gt=0)
    Tp_d0: float = par(8.0, "s", "d-axis transient open-circuit time constant", gt=0)
    saturation: Curve = par("none", "-", "curve through S10 and S12")
    S10: float = par(0.0, "-", "saturation at 1.0 pu", ge=0)
    S12: float = par(0.0, "-", "saturation at 1.2 pu", ge=0)

    delta = state("rad", "rotor angle against the angle reference")
    omega = state("pu", "rotor speed", guess=1.0)
    ep_q = state("pu", "voltage behind the transient reactance, q-axis", guess=1.0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_falling(self, "X_d", "Xp_d")
        check_points(self)
        return self

    def equations(self, v: Signals) -> Equations:
        s = stator(v, e_d=0.0, e_q=v.ep_q, R_a=self.R_a, X_d=self.Xp_d, X_q=self.X_q)
        i_fd = v.ep_q + excess(self.saturation, v.ep_q, self.S10, self.S12) + (self.X_d - self.Xp_d) * s.i_d
        field = der(v.ep_q, v.e_fd - i_fd, T=self.Tp_d0)
        t_e = v.ep_q * s.i_q + (self.X_q - self.Xp_d) * s.i_d * s.i_q
        motion = swing(v, t_e=t_e, H=self.H, D=self.D)
        return Equations(ode=(*motion, field), out=outputs(v, s, i_fd=i_fd), current=s.current)

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if terminal is None:
            return {}
        at = at_rest(terminal, R_a=self.R_a, X_q=self.X_q)
        ep_q = at.behind(self.R_a, self.Xp_d, self.X_q)[1]
        saturated = float(excess(self.saturation, ep_q, self.S10, self.S12))
        return guesses(terminal, at, e_fd=ep_q + saturated + (self.X_d - self.Xp_d) * at.i_d, ep_q=ep_q)
