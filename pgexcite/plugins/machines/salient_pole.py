"""Salient-pole machine with one damper circuit in each axis, voltage-behind-reactance form of fifth order."""

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


class SalientPole(Machine):
    """Fifth order: rotor angle, speed, field flux E'_q and the subtransient voltages E''_q and E''_d.

        e_fd --(+)--> [ 1 / sTp_d0 ] --> E'_q --(+)--> [ 1 / (1 + sTpp_d0) ] --> E''_q
        i_fd --(-)                              (-)
                                         (Xp_d - Xpp_d) i_d
        i_q --> [ (X_q - Xpp_q) / (1 + sTpp_q0) ] --> E''_d        i_fd = E'_q + S(E'_q) E'_q + (X_d - Xp_d) i_d

    The leakage reactance does not enter, and the damper does not act back on the field. For the default machine at rated load that
    makes the field's mode 2 % and the damping of the swing 0.4 % different from ``GENSAL``, which has both but wants
    ``X''_q = X''_d``. Defaults: a 175 MVA, 375 rpm hydro generator.

    Not modelled: saturation of the q-axis, damper currents in the field circuit.
    """

    source: ClassVar[str] = (
        "J. Machowski, J. Bialek, J. Bumby, Power System Dynamics, 2nd ed., Wiley 2008, section 11.1.7"
    )

    H: float = par(2.9, "s", "inertia constant on the machine's base", gt=0)
    D: float = par(0.0, "pu", "damping torque per unit of speed deviation", ge=0)
    R_a: float = par(0.0, "pu", "armature resistance", ge=0)
    X_d: float = par(1.24, "pu", "d-axis synchronous reactance", gt=0)
    X_q: float = par(0.70, "pu", "q-axis synchronous reactance", gt=0)
    Xp_d: float = par(0.35, "pu", "d-axis transient reactance", gt=0)
    Xpp_d: float = par(0.24, "pu", "d-axis subtransient reactance", gt=0)
    Xpp_q: float = par(0.28, "pu", "q-axis subtransient reactance", gt=0)
    Tp_d0: float = par(6.5, "s", "d-axis transient open-circuit time constant", gt=0)
    Tpp_d0: float = par(0.05, "s", "d-axis subtransient open-circuit time constant", ge=0)
    Tpp_q0: float = par(0.10, "s", "q-axis subtransient open-circuit time constant", ge=0)
    saturation: Curve = par("none", "-", "curve through S10 and S12")
    S10: float = par(0.0, "-", "saturation at 1.0 pu", ge=0)
    S12: float = par(0.0, "-", "saturation at 1.2 pu", ge=0)

    delta = state("rad", "rotor angle against the angle reference")
    omega = state("pu", "rotor speed", guess=1.0)
    ep_q = state("pu", "voltage behind the transient reactance, q-axis", guess=1.0)
    epp_q = state("pu", "voltage behind the subtransient reactance, q-axis", guess=1.0)
    epp_d = state("pu", "voltage behind the subtransient reactance, d-axis")

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_falling(self, "X_d", "Xp_d", "Xpp_d")
        check_falling(self, "X_q", "Xpp_q")
        check_points(self)
        return self

    def equations(self, v: Signals) -> Equations:
        s = stator(v, e_d=v.epp_d, e_q=v.epp_q, R_a=self.R_a, X_d=self.Xpp_d, X_q=self.Xpp_q)
        i_fd = v.ep_q + excess(self.saturation, v.ep_q, self.S10, self.S12) + (self.X_d - self.Xp_d) * s.i_d
        field = der(v.ep_q, v.e_fd - i_fd, T=self.Tp_d0)
        damper_d = der(v.epp_q, v.ep_q - v.epp_q - (self.Xp_d - self.Xpp_d) * s.i_d, T=self.Tpp_d0)
        damper_q = der(v.epp_d, (self.X_q - self.Xpp_q) * s.i_q - v.epp_d, T=self.Tpp_q0)
        t_e = v.epp_d * s.i_d + v.epp_q * s.i_q + (self.Xpp_q - self.Xpp_d) * s.i_d * s.i_q
        motion = swing(v, t_e=t_e, H=self.H, D=self.D)
        return Equations(ode=(*motion, field, damper_d, damper_q), out=outputs(v, s, i_fd=i_fd), current=s.current)

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if terminal is None:
            return {}
        at = at_rest(terminal, R_a=self.R_a, X_q=self.X_q)
        epp_d, epp_q = at.behind(self.R_a, self.Xpp_d, self.Xpp_q)
        ep_q = at.behind(self.R_a, self.Xp_d, self.X_q)[1]
        e_fd = ep_q + float(excess(self.saturation, ep_q, self.S10, self.S12)) + (self.X_d - self.Xp_d) * at.i_d
        return guesses(terminal, at, e_fd=e_fd, ep_q=ep_q, epp_q=epp_q, epp_d=epp_d)
