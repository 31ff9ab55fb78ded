"""Induction motor as a load."""

from __future__ import annotations

import cmath
from collections.abc import Mapping
from typing import ClassVar, Self

import casadi as ca
from pydantic import model_validator

from pgexcite.core.blocks import der, magnitude
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, constant, par, state
from pgexcite.core.roles import Load


class InductionMotor(Load):
    """Third order: speed, and the voltage ``e'`` behind the transient reactance of a single-cage rotor.

        v = e' + (R_s + j X') i        T'_0 e'' = -[e' - j (X_0 - X') i] - j omega_0 (omega_ref - omega_m) T'_0 e'
        2H omega_m' = Re(e' i*) - t_0 (P / p_0) omega_m^m
        X_0 = X_s + X_m        X' = X_s + X_m X_r / (X_m + X_r)        T'_0 = (X_r + X_m) / (omega_0 R_r)

    where ``i`` flows into the motor and ``e''`` is the derivative of ``e'`` in the network's frame. Reactances are on the base
    ``S_m`` of the motor. The mechanical load is the one at which the motor draws P at the initial voltage; a capacitor beside it
    makes up the difference between its reactive power and Q. A step of P changes the mechanical torque, one of Q the capacitor.
    Defaults: an aggregate of industrial motors.

    Not modelled: a second cage, saturation, contactors that drop out; a stalled motor stays connected.
    """

    source: ClassVar[str] = "P. Kundur, Power System Stability and Control, McGraw-Hill 1994, section 7.2"

    P: float = par(..., "MW", "active power drawn at the initial voltage", gt=0)
    Q: float = par(0.0, "Mvar", "reactive power drawn at the initial voltage, capacitor included")
    S_m: float = par(..., "MVA", "base of the motor", gt=0)
    H: float = par(0.7, "s", "inertia constant of motor and load", gt=0)
    R_s: float = par(0.031, "pu", "stator resistance", ge=0)
    X_s: float = par(0.1, "pu", "stator leakage reactance", gt=0)
    X_m: float = par(3.2, "pu", "magnetising reactance", gt=0)
    R_r: float = par(0.018, "pu", "rotor resistance", gt=0)
    X_r: float = par(0.18, "pu", "rotor leakage reactance", gt=0)
    m: float = par(2.0, "-", "exponent of the mechanical torque with speed", ge=0)

    omega_m = state("pu", "rotor speed", guess=0.98)
    e_re = state("pu", "voltage behind the transient reactance, real part", guess=0.9)
    e_im = state("pu", "voltage behind the transient reactance, imaginary part", guess=-0.2)
    t_0 = constant("pu", "mechanical torque at nominal speed", guess=0.5)
    p_0 = constant("MW", "P at the initial point", guess=1.0)
    b_0 = constant("pu", "reactive power the motor draws at the initial point, over the voltage's square")
    v_0 = constant("pu", "initial voltage", guess=1.0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.S_m < self.P:
            raise ValueError(f"S_m = {self.S_m} MVA is too small for a motor that draws P = {self.P} MW")
        return self

    def equations(self, v: Signals) -> Equations:
        X_0, Xp, Tp_0 = self._transient(v.omega_0)
        i_re, i_im = _current(v.v_re - v.e_re, v.v_im - v.e_im, self.R_s, Xp)
        slip = v.omega_0 * (v.omega_ref - v.omega_m) * Tp_0
        fluxes = (
            der(v.e_re, -v.e_re - (X_0 - Xp) * i_im + slip * v.e_im, T=Tp_0),
            der(v.e_im, -v.e_im + (X_0 - Xp) * i_re - slip * v.e_re, T=Tp_0),
        )
        t_e = v.e_re * i_re + v.e_im * i_im
        t_m = v.t_0 * self.P / v.p_0 * ca.exp(self.m * ca.log(ca.fmax(v.omega_m, 1e-6)))
        motion = der(v.omega_m, t_e - t_m, T=2 * self.H)
        k = self.S_m / v.S_n
        square = v.v_re * v.v_re + v.v_im * v.v_im
        p, q = k * (v.v_re * i_re + v.v_im * i_im), k * (v.v_im * i_re - v.v_re * i_im)
        b = v.b_0 - self.Q / (v.S_n * v.v_0 * v.v_0)
        return Equations(
            ode=(motion, *fluxes),
            out={"p": p, "q": q - b * square},
            current=(-k * i_re + b * v.v_im, -k * i_im - b * v.v_re),
            # The swing equation at rest gives t_0; what is left to say of it is that the motor then draws P.
            hold={
                "t_0": v.t_0 + self.P / v.S_n - p,
                "p_0": self.P,
                "b_0": q / square,
                "v_0": magnitude(v.v_re, v.v_im),
            },
        )

    def _transient(self, omega_0: Expr) -> tuple[Expr, Expr, Expr]:
        parallel = self.X_m * self.X_r / (self.X_m + self.X_r)
        return self.X_s + self.X_m, self.X_s + parallel, (self.X_r + self.X_m) / (omega_0 * self.R_r)

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        if terminal is None:
            return {}
        X_0, Xp, _ = self._transient(1.0)
        p = self.P / self.S_m / abs(terminal.v) ** 2
        # Torque-slip line near synchronism; Newton does the rest.
        slip = p * self.R_r * (X_0 / self.X_m) ** 2
        rotor = 1j * self.X_m * (self.R_r / slip + 1j * self.X_r) / (self.R_r / slip + 1j * (self.X_m + self.X_r))
        i = terminal.v / (self.R_s + 1j * self.X_s + rotor)
        e = terminal.v - (self.R_s + 1j * Xp) * i
        q = (terminal.v * i.conjugate()).imag / abs(terminal.v) ** 2
        t_0 = (e * i.conjugate()).real / (1 - slip) ** self.m
        start = {"omega_m": 1 - slip, "e_re": e.real, "e_im": e.imag, "t_0": t_0, "p_0": self.P, "v_0": abs(terminal.v)}
        return start | {"b_0": q} if cmath.isfinite(e) else {}


def _current(v_re: Expr, v_im: Expr, R: Expr, X: Expr) -> tuple[Expr, Expr]:
    """``(v_re + j v_im) / (R + jX)``."""
    square = R * R + X * X
    return (R * v_re + X * v_im) / square, (R * v_im - X * v_re) / square
