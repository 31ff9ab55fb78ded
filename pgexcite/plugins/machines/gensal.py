"""PSS/E's salient-pole machine GENSAL, with leakage reactance and saturation of the d-axis."""

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


class GENSAL(Machine):
    """Fifth order: rotor angle, speed, field flux E'_q, damper fluxes psi_1d and psi''_q (here as the voltage E''_d = -psi''_q).

        e_fd --(+)--> [ 1 / sTp_d0 ] --> E'_q --> gamma ----------(+)--> psi''_d = E''_q
        i_fd --(-)                        |                       (+)
                                         (+)--> [ 1 / (1 + sTpp_d0) ] --> psi_1d --> 1 - gamma
                        (Xp_d - X_l) i_d (-)                              gamma = (Xpp_d - X_l) / (Xp_d - X_l)

    ``X''_q = X''_d``. PSS/E reads mechanical *power*: its swing equation divides it by speed, ``(P_m - D dw) / (1 + dw) - T_e``.
    Here the machine takes a torque, and the governor decides what it holds: ``constant_torque`` with ``holds = "power"`` gives
    PSS/E's behaviour (the damping term differs by the factor ``1 + dw``).

    Not modelled: saturation of the q-axis; effect of speed on the stator voltage.
    """

    source: ClassVar[str] = "Siemens PTI, PSS/E Program Application Guide volume II, model GENSAL"

    H: float = par(5.0, "s", "inertia constant on the machine's base", gt=0)
    D: float = par(0.0, "pu", "damping torque per unit of speed deviation", ge=0)
    R_a: float = par(0.0, "pu", "armature resistance", ge=0)
    X_d: float = par(1.0, "pu", "d-axis synchronous reactance", gt=0)
    X_q: float = par(0.75, "pu", "q-axis synchronous reactance", gt=0)
    Xp_d: float = par(0.40, "pu", "d-axis transient reactance", gt=0)
    Xpp_d: float = par(0.25, "pu", "subtransient reactance of both axes", gt=0)
    X_l: float = par(0.10, "pu", "leakage reactance", ge=0)
    Tp_d0: float = par(5.0, "s", "d-axis transient open-circuit time constant", gt=0)
    Tpp_d0: float = par(0.05, "s", "d-axis subtransient open-circuit time constant", ge=0)
    Tpp_q0: float = par(0.20, "s", "q-axis subtransient open-circuit time constant", ge=0)
    saturation: Curve = par("none", "-", "curve through S10 and S12; PSS/E's is quadratic")
    S10: float = par(0.0, "-", "saturation at 1.0 pu", ge=0)
    S12: float = par(0.0, "-", "saturation at 1.2 pu", ge=0)

    delta = state("rad", "rotor angle against the angle reference")
    omega = state("pu", "rotor speed", guess=1.0)
    ep_q = state("pu", "transient flux of the field, d-axis", guess=1.0)
    psi_1d = state("pu", "flux of the d-axis damper", guess=1.0)
    epp_d = state("pu", "voltage behind the subtransient reactance, d-axis")

    ordered = (("X_l", "Xp_d"),)

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_falling(self, "X_d", "Xp_d", "Xpp_d", "X_l")
        check_falling(self, "X_q", "Xpp_d")
        check_points(self)
        return self

    def equations(self, v: Signals) -> Equations:
        above_leakage = self.Xp_d - self.X_l
        gamma = (self.Xpp_d - self.X_l) / above_leakage
        epp_q = gamma * v.ep_q + (1 - gamma) * v.psi_1d
        s = stator(v, e_d=v.epp_d, e_q=epp_q, R_a=self.R_a, X_d=self.Xpp_d, X_q=self.Xpp_d)
        damper = v.ep_q - v.psi_1d - above_leakage * s.i_d
        through_damper = (1 - gamma) / above_leakage * damper
        i_fd = (
            v.ep_q
            + excess(self.saturation, v.ep_q, self.S10, self.S12)
            + (self.X_d - self.Xp_d) * (s.i_d + through_damper)
        )
        field = der(v.ep_q, v.e_fd - i_fd, T=self.Tp_d0)
        damper_d = der(v.psi_1d, damper, T=self.Tpp_d0)
        damper_q = der(v.epp_d, (self.X_q - self.Xpp_d) * s.i_q - v.epp_d, T=self.Tpp_q0)
        motion = swing(v, t_e=v.epp_d * s.i_d + epp_q * s.i_q, H=self.H, D=self.D)
        return Equations(ode=(*motion, field, damper_d, damper_q), out=outputs(v, s, i_fd=i_fd), current=s.current)

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if terminal is None:
            return {}
        at = at_rest(terminal, R_a=self.R_a, X_q=self.X_q)
        ep_q = at.behind(self.R_a, self.Xp_d, self.X_q)[1]
        e_fd = ep_q + float(excess(self.saturation, ep_q, self.S10, self.S12)) + (self.X_d - self.Xp_d) * at.i_d
        psi_1d = ep_q - (self.Xp_d - self.X_l) * at.i_d
        return guesses(terminal, at, e_fd=e_fd, ep_q=ep_q, psi_1d=psi_1d, epp_d=(self.X_q - self.Xpp_d) * at.i_q)
