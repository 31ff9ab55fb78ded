"""PSS/E's round-rotor machine GENROU, with leakage reactance and saturation of both axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Self

from pydantic import model_validator

from pgexcite.core.blocks import der, magnitude
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, par, state
from pgexcite.core.roles import Machine
from pgexcite.plugins.machines.rotor import Phasors, at_rest, behind, check_falling, guesses, outputs, stator, swing
from pgexcite.plugins.machines.saturation import Curve, check_points, excess


class GENROU(Machine):
    """Sixth order: rotor angle, speed, and two rotor circuits in each axis (E'_q, psi_1d; E'_d, psi_2q).

        e_fd --(+)--> [ 1 / sTp_d0 ] --> E'_q --> gamma_d ----------(+)--> psi''_d = E''_q
        i_fd --(-)                        |                         (+)
                                         (+)--> [ 1 / (1 + sTpp_d0) ] --> psi_1d --> 1 - gamma_d
                        (Xp_d - X_l) i_d (-)

    and alike in the q-axis, whose field is short-circuited. Saturation acts on ``|psi''|``, the voltage behind ``X''``, and is
    shared between the axes: ``S psi''_d`` in the field, ``S psi''_q (X_q - X_l) / (X_d - X_l)`` in the q-axis. ``X''_q = X''_d``.

    PSS/E reads mechanical *power*: its swing equation divides it by speed, ``(P_m - D dw) / (1 + dw) - T_e``. Here the machine
    takes a torque, and the governor decides what it holds: ``constant_torque`` with ``holds = "power"`` gives PSS/E's behaviour
    (the damping term differs by the factor ``1 + dw``).

    Not modelled: effect of speed on the stator voltage.
    """

    source: ClassVar[str] = "Siemens PTI, PSS/E Program Application Guide volume II, model GENROU"

    H: float = par(6.5, "s", "inertia constant on the machine's base", gt=0)
    D: float = par(0.0, "pu", "damping torque per unit of speed deviation", ge=0)
    R_a: float = par(0.0, "pu", "armature resistance", ge=0)
    X_d: float = par(1.8, "pu", "d-axis synchronous reactance", gt=0)
    X_q: float = par(1.7, "pu", "q-axis synchronous reactance", gt=0)
    Xp_d: float = par(0.30, "pu", "d-axis transient reactance", gt=0)
    Xp_q: float = par(0.55, "pu", "q-axis transient reactance", gt=0)
    Xpp_d: float = par(0.25, "pu", "subtransient reactance of both axes", gt=0)
    X_l: float = par(0.20, "pu", "leakage reactance", ge=0)
    Tp_d0: float = par(8.0, "s", "d-axis transient open-circuit time constant", gt=0)
    Tp_q0: float = par(0.40, "s", "q-axis transient open-circuit time constant", ge=0)
    Tpp_d0: float = par(0.03, "s", "d-axis subtransient open-circuit time constant", ge=0)
    Tpp_q0: float = par(0.05, "s", "q-axis subtransient open-circuit time constant", ge=0)
    saturation: Curve = par("none", "-", "curve through S10 and S12; PSS/E's is quadratic")
    S10: float = par(0.0, "-", "saturation at 1.0 pu", ge=0)
    S12: float = par(0.0, "-", "saturation at 1.2 pu", ge=0)

    delta = state("rad", "rotor angle against the angle reference")
    omega = state("pu", "rotor speed", guess=1.0)
    ep_q = state("pu", "transient flux of the field, d-axis", guess=1.0)
    psi_1d = state("pu", "flux of the d-axis damper", guess=1.0)
    ep_d = state("pu", "voltage behind the transient reactance, d-axis")
    psi_2q = state("pu", "flux of the second q-axis damper")

    ordered = (("X_l", "Xp_d"), ("X_l", "Xp_q"))

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_falling(self, "X_d", "Xp_d", "Xpp_d", "X_l")
        check_falling(self, "X_q", "Xp_q", "Xpp_d")
        check_points(self)
        return self

    def equations(self, v: Signals) -> Equations:
        gap_d, gap_q = self.Xp_d - self.X_l, self.Xp_q - self.X_l
        gamma_d, gamma_q = (self.Xpp_d - self.X_l) / gap_d, (self.Xpp_d - self.X_l) / gap_q
        epp_q = gamma_d * v.ep_q + (1 - gamma_d) * v.psi_1d
        epp_d = gamma_q * v.ep_d - (1 - gamma_q) * v.psi_2q
        s = stator(v, e_d=epp_d, e_q=epp_q, R_a=self.R_a, X_d=self.Xpp_d, X_q=self.Xpp_d)
        sat_d, sat_q = self._saturated(epp_d, epp_q)
        damper_d = v.ep_q - v.psi_1d - gap_d * s.i_d
        damper_q = -v.ep_d - v.psi_2q - gap_q * s.i_q
        i_fd = v.ep_q + (self.X_d - self.Xp_d) * (s.i_d + (1 - gamma_d) / gap_d * damper_d) + sat_d
        i_1q = v.ep_d - (self.X_q - self.Xp_q) * (s.i_q + (1 - gamma_q) / gap_q * damper_q) + sat_q
        rotor = (
            der(v.ep_q, v.e_fd - i_fd, T=self.Tp_d0),
            der(v.psi_1d, damper_d, T=self.Tpp_d0),
            der(v.ep_d, -i_1q, T=self.Tp_q0),
            der(v.psi_2q, damper_q, T=self.Tpp_q0),
        )
        motion = swing(v, t_e=epp_d * s.i_d + epp_q * s.i_q, H=self.H, D=self.D)
        return Equations(ode=(*motion, *rotor), out=outputs(v, s, i_fd=i_fd), current=s.current)

    def _saturated(self, epp_d: Expr, epp_q: Expr) -> tuple[Expr, Expr]:
        """What saturation adds to the field's and the q-axis circuit's current."""
        if self.saturation == "none":
            return 0.0, 0.0
        psi = magnitude(epp_d, epp_q)
        S = excess(self.saturation, psi, self.S10, self.S12) / psi
        return S * epp_q, S * (self.X_q - self.X_l) / (self.X_d - self.X_l) * epp_d

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if terminal is None:
            return {}
        psi = abs(behind(terminal, self.R_a, self.Xpp_d))
        S = float(excess(self.saturation, psi, self.S10, self.S12)) / psi
        # At rest E''_d (1 + S k) = (X_q - X''_d) i_q: the q-axis lies behind a reactance that saturation reduces.
        k = (self.X_q - self.X_l) / (self.X_d - self.X_l)
        at = at_rest(terminal, R_a=self.R_a, X_q=self.Xpp_d + (self.X_q - self.Xpp_d) / (1 + S * k))
        epp_q = at.behind(self.R_a, self.Xpp_d, self.Xpp_d)[1]
        ep_q = epp_q + (self.Xp_d - self.Xpp_d) * at.i_d
        e_fd = ep_q + (self.X_d - self.Xp_d) * at.i_d + S * epp_q
        return guesses(terminal, at, e_fd=e_fd, ep_q=ep_q, **self._fluxes(at, ep_q))

    def _fluxes(self, at: Phasors, ep_q: float) -> dict[str, float]:
        epp_d = at.behind(self.R_a, self.Xpp_d, self.Xpp_d)[0]
        ep_d = epp_d - (self.Xp_q - self.Xpp_d) * at.i_q
        psi_2q = -ep_d - (self.Xp_q - self.X_l) * at.i_q
        return {"psi_1d": ep_q - (self.Xp_d - self.X_l) * at.i_d, "ep_d": ep_d, "psi_2q": psi_2q}
