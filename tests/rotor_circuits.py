"""Rotor circuits of a machine that is given by reactances and open-circuit time constants, under two readings of the latter."""

from __future__ import annotations

import math
from dataclasses import replace

from pgexcite.core.system import System
from pgexcite.plugins.machines.kundur_flux import KundurFlux

Circuits = tuple[float, float, float, float]
"""``L_1, R_1, L_2, R_2`` of an axis, pu: the slow circuit and the fast one."""


def apart(X: float, Xp: float, Xpp: float, X_l: float, T_1: float, T_2: float, omega_0: float) -> Circuits:
    """Each time constant is that of one circuit alone, the slower ones shorted out of the faster (Kundur, section 4.2.3)."""
    L_a = X - X_l
    L_1 = 1 / (1 / (Xp - X_l) - 1 / L_a)
    L_2 = 1 / (1 / (Xpp - X_l) - 1 / (Xp - X_l))
    return L_1, (L_a + L_1) / (T_1 * omega_0), L_2, (L_2 + Xp - X_l) / (T_2 * omega_0)


def coupled(X: float, Xp: float, Xpp: float, X_l: float, T_1: float, T_2: float, omega_0: float) -> Circuits:
    """The time constants are those of the two circuits together: the poles of the operational reactance

    X(s) = X (1 + s T_1 Xp / X) (1 + s T_2 Xpp / Xp) / ((1 + s T_1) (1 + s T_2))
    1 / (X(s) - X_l) = 1 / L_a + s G_1 / (1 + s slow) + s G_2 / (1 + s fast),    G_k = 1 / R_k, slow = L_1 / R_1, fast = L_2 / R_2
    """
    L_a = X - X_l
    short_1, short_2 = T_1 * Xp / X, T_2 * Xpp / Xp
    # (X(s) - X_l) (1 + s T_1) (1 + s T_2) = L_a (1 + s b + s^2 a), whose roots belong to the circuits alone.
    a = (X * short_1 * short_2 - X_l * T_1 * T_2) / L_a
    b = (X * (short_1 + short_2) - X_l * (T_1 + T_2)) / L_a
    slow = (b + math.sqrt(b * b - 4 * a)) / 2
    fast = b - slow
    # The coefficients of s and s^2 of the second equation.
    G_sum, G_weighted = (T_1 + T_2 - b) / L_a, (T_1 * T_2 - a) / L_a
    G_1 = (G_weighted - slow * G_sum) / (fast - slow)
    R_1, R_2 = 1 / (omega_0 * G_1), 1 / (omega_0 * (G_sum - G_1))
    return slow * omega_0 * R_1, R_1, fast * omega_0 * R_2, R_2


def with_flux_machines(system: System, rotor: dict[str, float], **options: object) -> System:
    """The system with ``KundurFlux`` for every machine, of the same inertia; ``rotor`` and ``options`` are its parameters."""
    devices = []
    for device in system.devices:
        machine = device.components.get("machine")
        if machine is not None:
            flux = KundurFlux(H=machine.H, K_D=0.0, **rotor, **options)
            device = replace(device, components={**device.components, "machine": flux})
        devices.append(device)
    return replace(system, devices=tuple(devices))
