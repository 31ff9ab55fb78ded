"""Kundur's flux-linkage machine from fundamental parameters, with the saturation of his small-signal examples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from pgexcite.core.blocks import Dynamics, der, magnitude
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, algebraic, constant, par, state
from pgexcite.core.roles import Machine
from pgexcite.plugins.machines.rotor import at_rest, behind, guesses, outputs, stator, swing
from pgexcite.plugins.machines.saturation import kundur_excess


@dataclass(frozen=True)
class _Axis:
    """A mutual flux ``psi_a = L (offset + sum psi_k / L_k - i)`` of the rotor circuits ``k`` and the armature current ``i``."""

    L: Expr
    source: Expr

    def flux(self, i: Expr) -> Expr:
        return self.source - self.L * i


class KundurFlux(Machine):
    """Rotor angle, speed, and the flux of the field and of up to three amortisseurs (1d, 1q, 2q).

        psi_ad = L_ads (i_fd + i_1d - i_d)        e_d = -R_a i_d + L_l i_q - psi_aq
        psi_aq = L_aqs (i_1q + i_2q - i_q)        e_q = -R_a i_q - L_l i_d + psi_ad
        psi_fd' = omega_0 ((R_fd / L_adu) e_fd - R_fd i_fd),    psi_k' = -omega_0 R_k i_k,    i_k = (psi_k - psi_a) / L_k

    Ports carry the air-gap-line base: ``e_fd = (L_adu / R_fd) e_fd_reciprocal`` and ``i_fd = L_adu i_fd_reciprocal``.

    ``saturation``, with ``K_s`` from the air-gap flux for both axes (Kundur, section 3.8.2):

    - ``"none"``: L_adu, L_aqu throughout;
    - ``"total"``: ``K_s = psi_at / (psi_at + psi_I)`` at every instant;
    - ``"incremental"``: total at the initial point, and from there along the tangent of the air-gap characteristic,
      ``K_s(incr) = 1 / (1 + B_sat psi_I)``, frozen (section 12.3.2). Right for small deviations only.

    With ``speed_voltage`` the fluxes induce ``omega psi`` in the stator, while the network's reactances stay those of nominal
    frequency: what RAMSES computes (STEPSS documentation, "Synchronous Machine Model"). Without it, as in Kundur's examples, torque
    and air-gap power are equal in pu at any speed. On his two-area system it moves the modes by up to 0.07 1/s.

    An amortisseur that is switched off stays as an algebraic zero. Defaults: example 12.3 (field circuit alone), and the
    amortisseurs of example 3.2's 555 MVA machine.

    Not modelled: saturation of the leakage paths; Kundur's jump of ``A_sat`` at ``psi_T1`` (see ``kundur_excess``).
    """

    source: ClassVar[str] = (
        "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, sections 3.6, 3.8.2, 12.3 and 12.6"
    )

    H: float = par(3.5, "s", "inertia constant on the machine's base", gt=0)
    K_D: float = par(0.0, "pu", "damping torque per unit of speed deviation")
    R_a: float = par(0.003, "pu", "armature resistance", ge=0)
    L_l: float = par(0.16, "pu", "leakage inductance", gt=0)
    L_adu: float = par(1.65, "pu", "d-axis mutual inductance, unsaturated", gt=0)
    L_aqu: float = par(1.60, "pu", "q-axis mutual inductance, unsaturated", gt=0)
    L_fd: float = par(0.153, "pu", "field leakage inductance, reciprocal base", gt=0)
    R_fd: float = par(0.0006, "pu", "field resistance, reciprocal base", gt=0)
    damper_1d: bool = par(False, "-", "whether there is a d-axis amortisseur")
    damper_1q: bool = par(False, "-", "whether there is a first q-axis amortisseur")
    damper_2q: bool = par(False, "-", "whether there is a second q-axis amortisseur")
    L_1d: float = par(0.1713, "pu", "leakage inductance of 1d", gt=0)
    R_1d: float = par(0.0284, "pu", "resistance of 1d", gt=0)
    L_1q: float = par(0.7252, "pu", "leakage inductance of 1q", gt=0)
    R_1q: float = par(0.00619, "pu", "resistance of 1q", gt=0)
    L_2q: float = par(0.125, "pu", "leakage inductance of 2q", gt=0)
    R_2q: float = par(0.02368, "pu", "resistance of 2q", gt=0)
    saturation: Literal["none", "total", "incremental"] = par("none", "-", "how the air-gap characteristic is followed")
    speed_voltage: bool = par(False, "-", "whether the voltages that fluxes induce in the stator grow with speed")
    A_sat: float = par(0.031, "pu", "flux lost to saturation at psi_T1", ge=0)
    B_sat: float = par(6.93, "-", "exponent of saturation, per pu of flux", ge=0)
    psi_T1: float = par(0.8, "pu", "air-gap flux where saturation sets in", ge=0)

    delta = state("rad", "rotor angle against the angle reference")
    omega = state("pu", "rotor speed", guess=1.0)
    psi_fd = state("pu", "field flux linkage", guess=1.0)
    psi_1d = state("pu", "flux linkage of 1d", guess=1.0)
    psi_1q = state("pu", "flux linkage of 1q")
    psi_2q = state("pu", "flux linkage of 2q")
    psi_at = algebraic("pu", "air-gap flux", guess=1.0)
    psi_ad0 = constant("pu", "d-axis air-gap flux at the initial point", guess=1.0)
    psi_aq0 = constant("pu", "q-axis air-gap flux at the initial point")
    k_s0 = constant("-", "total saturation factor at the initial point", guess=1.0)
    k_incr0 = constant("-", "incremental saturation factor at the initial point", guess=1.0)

    def equations(self, v: Signals) -> Equations:
        rotor_d = [("psi_fd", self.L_fd), *([("psi_1d", self.L_1d)] if self.damper_1d else [])]
        rotor_q = [
            *([("psi_1q", self.L_1q)] if self.damper_1q else []),
            *([("psi_2q", self.L_2q)] if self.damper_2q else []),
        ]
        d = self._axis(v, self.L_adu, v.psi_ad0, rotor_d)
        q = self._axis(v, self.L_aqu, v.psi_aq0, rotor_q)
        speed = v.omega if self.speed_voltage else 1.0
        s = stator(v, e_d=-q.source, e_q=d.source, R_a=self.R_a, X_d=d.L + self.L_l, X_q=q.L + self.L_l, speed=speed)
        psi_ad, psi_aq = d.flux(s.i_d), q.flux(s.i_q)
        i_fd = (v.psi_fd - psi_ad) / self.L_fd
        e_fd = self.R_fd / self.L_adu * v.e_fd
        circuits = (
            der(v.psi_fd, v.omega_0 * (e_fd - self.R_fd * i_fd)),
            _amortisseur(self.damper_1d, v, v.psi_1d, psi_ad, self.R_1d, self.L_1d),
            _amortisseur(self.damper_1q, v, v.psi_1q, psi_aq, self.R_1q, self.L_1q),
            _amortisseur(self.damper_2q, v, v.psi_2q, psi_aq, self.R_2q, self.L_2q),
        )
        motion = swing(v, t_e=psi_ad * s.i_q - psi_aq * s.i_d, H=self.H, D=self.K_D)
        psi_at = magnitude(psi_ad, psi_aq)
        k_s0, k_incr0 = self._factors(psi_at)
        return Equations(
            ode=(*motion, *circuits),
            alg=(v.psi_at - psi_at,),
            out=outputs(v, s, i_fd=self.L_adu * i_fd),
            current=s.current,
            hold={"psi_ad0": psi_ad, "psi_aq0": psi_aq, "k_s0": k_s0, "k_incr0": k_incr0},
        )

    def _axis(self, v: Signals, L_au: Expr, psi_a0: Expr, rotor: list[tuple[str, Expr]]) -> _Axis:
        """Eliminate the rotor currents: ``psi_a (1/L_a + sum 1/L_k) = offset + sum psi_k / L_k - i``."""
        offset: Expr = 0.0
        L_a = L_au
        if self.saturation == "total":
            L_a = self._factors(v.psi_at)[0] * L_au
        elif self.saturation == "incremental":
            # psi_a = psi_a0 + L_a (i_a - i_a0), with i_a0 the magnetising current of psi_a0 by total saturation.
            L_a = v.k_incr0 * L_au
            offset = psi_a0 / L_a - psi_a0 / (v.k_s0 * L_au)
        L = 1 / (1 / L_a + sum(1 / L_k for _, L_k in rotor))
        return _Axis(L, L * (offset + sum(getattr(v, name) / L_k for name, L_k in rotor)))

    def _factors(self, psi_at: Expr) -> tuple[Expr, Expr]:
        """Total and incremental saturation factor at an air-gap flux."""
        if self.saturation == "none":
            return 1.0, 1.0
        psi_I = kundur_excess(psi_at, self.A_sat, self.B_sat, self.psi_T1)
        return psi_at / (psi_at + psi_I), 1 / (1 + self.B_sat * psi_I)

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if terminal is None:
            return {}
        psi_at = abs(behind(terminal, self.R_a, self.L_l))
        k_s, k_incr = (float(k) for k in self._factors(psi_at))
        at = at_rest(terminal, R_a=self.R_a, X_q=k_s * self.L_aqu + self.L_l)
        e_d, psi_ad = at.behind(self.R_a, self.L_l, self.L_l)
        i_fd = psi_ad / (k_s * self.L_adu) + at.i_d
        return guesses(
            terminal, at, e_fd=self.L_adu * i_fd, psi_fd=psi_ad + self.L_fd * i_fd, psi_at=psi_at, psi_ad0=psi_ad, psi_aq0=-e_d,
            psi_1d=psi_ad if self.damper_1d else 0.0, psi_1q=-e_d if self.damper_1q else 0.0,
            psi_2q=-e_d if self.damper_2q else 0.0, k_s0=k_s, k_incr0=k_incr,
        )  # fmt: skip


def _amortisseur(present: bool, v: Signals, psi: Expr, psi_a: Expr, R: Expr, L: Expr) -> Dynamics:
    """``psi' = -omega_0 R i`` of a short-circuited winding, or ``0 = psi`` where there is none."""
    if not present:
        return der(psi, -psi, T=0.0)
    return der(psi, -v.omega_0 * R * (psi - psi_a) / L)
