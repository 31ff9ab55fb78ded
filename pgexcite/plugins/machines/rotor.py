"""What the machine models share: the dq frame, the stator's algebraic equations, the swing equation and the outputs.

Convention (Kundur, section 5.1): generator currents; the q-axis leads the real axis of the network's frame by ``delta`` and the
d-axis lags the q-axis by 90 degrees, so ``v_d + j v_q = (v_re + j v_im) exp(j (pi/2 - delta))``. Stator transients are neglected,
as in every phasor-domain stability program; so is the effect of speed on the stator voltages, unless a machine asks for it.
"""

from __future__ import annotations

import cmath
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca

from pgexcite.core.blocks import Dynamics, der, magnitude
from pgexcite.core.component import Signals, Terminal
from pgexcite.core.declare import Expr


@dataclass(frozen=True)
class Stator:
    """Terminal voltage and armature current of a machine, pu of its base.

    Attributes:
        v_d, v_q: voltage in the rotor's frame.
        i_d, i_q: current in the rotor's frame.
        current: ``(i_re, i_im)``, the same current in the network's frame.
    """

    v_d: Expr
    v_q: Expr
    i_d: Expr
    i_q: Expr
    current: tuple[Expr, Expr]


def stator(v: Signals, *, e_d: Expr, e_q: Expr, R_a: Expr, X_d: Expr, X_q: Expr, speed: Expr = 1.0) -> Stator:
    """Solve ``v_d = w (e_d + X_q i_q) - R_a i_d``, ``v_q = w (e_q - X_d i_d) - R_a i_q`` for the current.

    Args:
        v: signals of the machine: ``delta``, ``v_re``, ``v_im``.
        e_d, e_q: voltage behind the reactances, pu.
        R_a, X_d, X_q: armature resistance and the reactances that belong to ``e_d``, ``e_q``, pu at nominal speed.
        speed: ``w``, at which the fluxes turn, pu; 1 neglects the effect of speed on the stator voltage.
    """
    e_d, e_q, X_d, X_q = speed * e_d, speed * e_q, speed * X_d, speed * X_q
    sine, cosine = ca.sin(v.delta), ca.cos(v.delta)
    v_d = v.v_re * sine - v.v_im * cosine
    v_q = v.v_re * cosine + v.v_im * sine
    drop_d, drop_q = e_d - v_d, e_q - v_q
    inverse = 1 / (R_a * R_a + X_d * X_q)
    i_d = (R_a * drop_d + X_q * drop_q) * inverse
    i_q = (R_a * drop_q - X_d * drop_d) * inverse
    return Stator(v_d, v_q, i_d, i_q, (i_d * sine + i_q * cosine, i_q * sine - i_d * cosine))


def swing(v: Signals, *, t_e: Expr, H: Expr, D: Expr) -> tuple[Dynamics, Dynamics]:
    """``delta' = omega_0 (omega - omega_ref)`` and ``2H omega' = t_m - t_e - D (omega - 1)`` (Kundur, section 3.9)."""
    return angle(v), der(v.omega, v.t_m - t_e - D * (v.omega - 1), T=2 * H)


def angle(v: Signals) -> Dynamics:
    """``delta' = omega_0 (omega - omega_ref)``."""
    return der(v.delta, v.omega_0 * (v.omega - v.omega_ref))


def outputs(v: Signals, s: Stator, *, i_fd: Expr) -> dict[str, Expr]:
    """The ports every machine has."""
    return {
        "v_t": magnitude(v.v_re, v.v_im),
        "i_fd": i_fd,
        "omega": v.omega,
        "delta": v.delta,
        "p_e": s.v_d * s.i_d + s.v_q * s.i_q,
        "q_e": s.v_q * s.i_d - s.v_d * s.i_q,
    }


@dataclass(frozen=True)
class Phasors:
    """A machine at rest at its terminal, pu of its base and rad.

    Attributes:
        delta: rotor angle.
        v_d, v_q, i_d, i_q: voltage and current in the rotor's frame.
        t_e: air-gap torque.
    """

    delta: float
    v_d: float
    v_q: float
    i_d: float
    i_q: float
    t_e: float

    def behind(self, R: float, X_d: float, X_q: float) -> tuple[float, float]:
        """Voltage ``(e_d, e_q)`` behind ``R``, ``X_d`` and ``X_q``."""
        return self.v_d + R * self.i_d - X_q * self.i_q, self.v_q + R * self.i_q + X_d * self.i_d


def at_rest(terminal: Terminal, *, R_a: float, X_q: float) -> Phasors:
    """The q-axis lies along ``E_Q = v + (R_a + j X_q) i`` (Kundur, section 3.6.3)."""
    delta = cmath.phase(behind(terminal, R_a, X_q))
    turn = cmath.rect(1.0, cmath.pi / 2 - delta)
    v, i = terminal.v * turn, terminal.i * turn
    return Phasors(delta, v.real, v.imag, i.real, i.imag, terminal.s.real + R_a * abs(terminal.i) ** 2)


def behind(terminal: Terminal, R: float, X: float) -> complex:
    """Voltage phasor behind ``R + jX`` in the network's frame, pu."""
    return terminal.v + (R + 1j * X) * terminal.i


def guesses(terminal: Terminal, at: Phasors, *, e_fd: float, **states: float) -> Mapping[str, float]:
    """A machine's guesses by name: its states, and the signals its exciter and governor start from."""
    common = {"delta": at.delta, "omega": 1.0, "v_t": abs(terminal.v), "e_fd": e_fd, "i_fd": e_fd, "t_m": at.t_e}
    return {**common, "p_e": terminal.s.real, "q_e": terminal.s.imag, **states}


def check_falling(machine: Any, *names: str) -> None:
    """Refuse a machine whose reactances do not fall from synchronous to subtransient.

    Raises:
        ValueError: one of these parameters is larger than the one before it.
    """
    for larger, smaller in pairwise(names):
        if getattr(machine, smaller) > getattr(machine, larger):
            raise ValueError(
                f"{smaller} = {getattr(machine, smaller)} must not exceed {larger} = {getattr(machine, larger)}"
            )
