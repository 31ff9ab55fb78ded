"""The capability curve of a synchronous machine: where its operating point may lie in the P-Q plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.system import Device

COS_PHI = 0.86
"""Rated power factor assumed of a unit that states none; a usual figure for hydro units."""
_STABILITY_MARGIN = 0.10
"""Active power kept in hand against the steady-state stability limit, pu; the usual construction."""

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Capability:
    """Limits of a machine at a terminal voltage, all pu on its base (Farnham and Swarthout 1953; Kundur section 5.4).

    Saturation and armature resistance are left out of the construction.

    Attributes:
        v_t: terminal voltage the curve is drawn for.
        X_d, X_q: synchronous reactances; ``None`` for a machine that has none (the classical one).
        cos_phi: rated power factor; the turbine is rated for just this active power.
    """

    v_t: float
    X_d: float | None
    X_q: float | None
    cos_phi: float = COS_PHI

    @classmethod
    def of(cls, device: Device, v_t: float) -> Capability:
        """The curve of a generating unit, from its machine's parameters."""
        machine = device.components["machine"]
        x_d, x_q = getattr(machine, "X_d", None), getattr(machine, "X_q", None)
        return cls(v_t=v_t, X_d=x_d, X_q=x_q if x_q is not None else x_d, cos_phi=getattr(machine, "cos_phi", COS_PHI))

    @property
    def rated(self) -> tuple[float, float]:
        """The name-plate point (P, Q)."""
        return self.cos_phi, math.sqrt(1.0 - self.cos_phi**2)

    def stator(self) -> Points:
        """Circle of rated armature current, ``(n, 2)`` of (P, Q)."""
        angle = np.linspace(-math.pi / 2, math.pi / 2, 121)
        return self.v_t * np.column_stack([np.cos(angle), np.sin(angle)])

    def field(self) -> Points:
        """Circle of rated field current about ``(0, -V^2/X_d)`` through the name-plate point at rated voltage, ``(n, 2)``.

        Its radius is the paper's equation (1) times the voltage; the circle is exact for a round rotor.
        """
        if self.X_d is None:
            return np.empty((0, 2))
        p, q = self.rated
        radius = self.v_t * math.hypot(1.0 / self.X_d + q, p)
        steepest = math.acos(min(1.15 * self.v_t / radius, 1.0))  # beyond that only the stator limits
        angle = np.linspace(math.pi / 2, steepest, 121)
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle) - self.v_t**2 / self.X_d])

    def under_excitation(self) -> Points:
        """Practical stability limit, ``(n, 2)`` of (P, Q): 0.1 pu of power kept in hand at each excitation.

        At constant excitation E the power ``V E sin(d)/X_d + V^2/2 (1/X_q - 1/X_d) sin(2d)`` peaks at an angle d_m; the limit is
        the point of the same E that lies 0.1 pu below the peak.
        """
        if self.X_d is None or self.X_q is None:
            return np.empty((0, 2))
        v, saliency = self.v_t, self.v_t**2 * (1.0 / self.X_q - 1.0 / self.X_d)
        angle = np.linspace(0.0, math.pi / 2, 721)
        points = []
        for e in np.linspace(0.0, 3.0, 121):
            p = v * e * np.sin(angle) / self.X_d + saliency / 2 * np.sin(2 * angle)
            peak = int(np.argmax(p))
            if p[peak] <= _STABILITY_MARGIN:
                continue
            d = float(np.interp(p[peak] - _STABILITY_MARGIN, p[: peak + 1], angle[: peak + 1]))
            q = v * e * math.cos(d) / self.X_d - v**2 * (math.cos(d) ** 2 / self.X_d + math.sin(d) ** 2 / self.X_q)
            points.append((p[peak] - _STABILITY_MARGIN, q))
        curve = np.array(points).reshape(-1, 2)
        inside = np.hypot(curve[:, 0], curve[:, 1]) <= 1.05 * v
        if inside.any() and curve[0, 0] > 0:
            curve, inside = np.vstack([[0.0, curve[0, 1]], curve]), np.concatenate([[True], inside])
        return curve[inside]

    def turbine(self) -> Points:
        """Line of rated turbine power, ``(2, 2)``."""
        reach = math.sqrt(max(self.v_t**2 - self.cos_phi**2, 0.01))
        return np.array([[self.cos_phi, -reach], [self.cos_phi, reach]])
