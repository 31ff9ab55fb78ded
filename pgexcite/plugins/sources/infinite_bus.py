"""Infinite bus: an ideal voltage source at nominal frequency, behind an impedance if wanted."""

from __future__ import annotations

import cmath
from collections.abc import Mapping
from typing import ClassVar

import casadi as ca

from pgexcite.core.blocks import der
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import algebraic, par, setpoint, state
from pgexcite.core.roles import Source


class InfiniteBus(Source):
    """A Thevenin equivalent of the grid: voltage and angle are set-points, the frequency is nominal.

        v at (angle + theta) --[ R + jX ]--> bus         theta' = omega_0 (1 - omega_ref)

    ``theta`` is how far the synchronous frame has turned against the angle reference; it stays zero where they are the same.

    Not modelled: any reaction of the grid's frequency or voltage.
    """

    source: ClassVar[str] = "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, section 12.3"

    R: float = par(0.0, "pu", "resistance behind which the source lies, system base", ge=0)
    X: float = par(0.0, "pu", "reactance behind which the source lies, system base", ge=0)

    theta = state("rad", "angle of the synchronous frame against the angle reference")
    i_re = algebraic("pu", "current injected, real part")
    i_im = algebraic("pu", "current injected, imaginary part")
    v = setpoint("pu", "voltage of the source", guess=1.0)
    angle = setpoint("rad", "angle of the source")

    def equations(self, v: Signals) -> Equations:
        turned = v.angle + v.theta
        return Equations(
            ode=(der(v.theta, v.omega_0 * (1 - v.omega_ref)),),
            alg=(
                v.v_re + self.R * v.i_re - self.X * v.i_im - v.v * ca.cos(turned),
                v.v_im + self.R * v.i_im + self.X * v.i_re - v.v * ca.sin(turned),
            ),
            out={"p": v.v_re * v.i_re + v.v_im * v.i_im, "q": v.v_im * v.i_re - v.v_re * v.i_im},
            current=(v.i_re, v.i_im),
        )

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if terminal is None:
            return {}
        behind = terminal.v + (self.R + 1j * self.X) * terminal.i
        return {"i_re": terminal.i.real, "i_im": terminal.i.imag, "v": abs(behind), "angle": cmath.phase(behind)}
