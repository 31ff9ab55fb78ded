"""The equal-area criterion on three power-angle curves (Kundur section 13.1; Grainger and Stevenson chapter 16).

All powers are per unit of one base, angles in rad; the curves hold for a constant voltage behind a reactance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

_GRID = 2001
_HORIZON = 20.0
"""How long the swing under a sustained fault is followed for the critical angle, s."""


@dataclass(frozen=True)
class Curve:
    """``P_e = offset + peak sin(delta - shift)``, pu; offset and shift are zero in a network without losses."""

    peak: float
    offset: float = 0.0
    shift: float = 0.0

    def __call__(self, delta: float) -> float:
        return self.offset + self.peak * math.sin(delta - self.shift)

    def energy(self, start: float, end: float) -> float:
        """Area under the curve between two angles, pu rad."""
        return self.offset * (end - start) + self.peak * (math.cos(start - self.shift) - math.cos(end - self.shift))

    def equilibria(self, p_m: float) -> tuple[float, float] | None:
        """Stable and unstable angle at which the curve meets ``p_m``; ``None`` when it never does."""
        ratio = (p_m - self.offset) / self.peak if self.peak > 0 else math.inf
        if abs(ratio) > 1.0:
            return None
        return self.shift + math.asin(ratio), self.shift + math.pi - math.asin(ratio)


@dataclass(frozen=True)
class EqualArea:
    """The construction for one machine against an infinite bus.

    Attributes:
        p_m: mechanical power, pu.
        delta_0: angle of the internal voltage before the fault, rad.
        before, during, after: power-angle curves.
        H: inertia constant on the base of the powers, s.
        f_n: nominal frequency, Hz.
    """

    p_m: float
    delta_0: float
    before: Curve
    during: Curve
    after: Curve
    H: float
    f_n: float

    @property
    def r_1(self) -> float:
        """Peak of the curve during the fault as a part of that before it."""
        return self.during.peak / self.before.peak

    @property
    def r_2(self) -> float:
        """Peak of the curve after the fault as a part of that before it."""
        return self.after.peak / self.before.peak

    @property
    def delta_limit(self) -> float | None:
        """Unstable equilibrium after the fault, rad: the farthest angle the machine comes back from."""
        met = self.after.equilibria(self.p_m)
        return None if met is None else met[1]

    def surplus(self, delta: float) -> float:
        """Accelerating minus largest decelerating area when the fault is cleared at ``delta``, pu rad; stable where negative."""
        limit = self.delta_limit
        if limit is None:
            return math.inf
        accelerating = self.p_m * (delta - self.delta_0) - self.during.energy(self.delta_0, delta)
        decelerating = self.after.energy(delta, limit) - self.p_m * (limit - delta)
        return accelerating - decelerating

    @cached_property
    def delta_crit(self) -> float | None:
        """Critical clearing angle, rad.

        ``None`` when there is none: the fault is ridden through however long it stays on (`always_stable`), or the machine is lost
        even if it is cleared at once.
        """
        limit = self.delta_limit
        if limit is None or self.surplus(self.delta_0) >= 0 or self.always_stable:
            return None
        return float(brentq(self.surplus, self.delta_0, limit, xtol=1e-13))

    @cached_property
    def always_stable(self) -> bool:
        """Whether the machine swings back under the sustained fault before it comes to the critical angle."""
        limit = self.delta_limit
        if limit is None:
            return False
        angles = np.linspace(self.delta_0, limit, _GRID)[1:]
        for delta in angles:
            if self.surplus(delta) >= 0:
                return False
            if self.p_m * (delta - self.delta_0) - self.during.energy(self.delta_0, delta) < 0:
                return True
        return True

    @cached_property
    def t_crit(self) -> float | None:
        """Critical clearing time, s: the classical swing equation under the fault, up to the critical angle."""
        return None if self.delta_crit is None else self.time_to(self.delta_crit)

    def time_to(self, delta: float) -> float | None:
        """Time the machine takes to ``delta`` under the fault, s; ``None`` when it does not come there."""

        def there(_t: float, y: np.ndarray) -> float:
            return float(y[0] - delta)

        there.terminal = True  # type: ignore[attr-defined]
        there.direction = 1  # type: ignore[attr-defined]
        swing = self._swing(self.during, self.delta_0, 0.0, _HORIZON, there)
        return float(swing.t_events[0][0]) if len(swing.t_events[0]) else None

    def delta_max(self, clearing: float) -> float | None:
        """Largest angle, rad, when the fault is cleared after ``clearing`` seconds; ``None`` when synchronism is lost."""
        delta, speed = self._swing(self.during, self.delta_0, 0.0, clearing).y[:, -1]
        limit = self.delta_limit
        kinetic = self.H / (2 * math.pi * self.f_n) * speed**2
        if limit is None or delta > limit:
            return None

        def left(angle: float) -> float:
            return float(kinetic + self.p_m * (angle - delta) - self.after.energy(delta, angle))

        return None if left(limit) >= 0 else float(brentq(left, delta, limit, xtol=1e-13))

    def _swing(self, curve: Curve, delta: float, speed: float, t_end: float, event: Any = None) -> Any:
        def slope(_t: float, y: np.ndarray) -> tuple[float, float]:
            return y[1], math.pi * self.f_n / self.H * (self.p_m - curve(y[0]))

        return solve_ivp(slope, (0.0, t_end), (delta, speed), method="DOP853", rtol=1e-11, atol=1e-12, events=event)


def lossless(p_m: float, delta_0: float, r_1: float, r_2: float, H: float, f_n: float) -> EqualArea:
    """The construction of a textbook: pure sine curves of ``P_max``, ``r_1 P_max``, ``r_2 P_max`` that start at rest.

    Args:
        p_m: mechanical power, pu.
        delta_0: initial angle, rad; with ``p_m`` it fixes ``P_max = p_m / sin(delta_0)``.
        r_1, r_2: peaks during and after the fault, parts of ``P_max``.
        H: inertia constant, s.
        f_n: nominal frequency, Hz.
    """
    peak = p_m / math.sin(delta_0)
    return EqualArea(p_m, delta_0, Curve(peak), Curve(r_1 * peak), Curve(r_2 * peak), H, f_n)


def lossless_critical_angle(area: EqualArea) -> float:
    """Critical clearing angle in closed form, rad (Grainger and Stevenson, equation 16.81); losses are left out."""
    limit = math.pi - math.asin(area.p_m / area.after.peak)
    numerator = (
        area.p_m / area.before.peak * (limit - area.delta_0)
        + area.r_2 * math.cos(limit)
        - area.r_1 * math.cos(area.delta_0)
    )
    return math.acos(numerator / (area.r_2 - area.r_1))
