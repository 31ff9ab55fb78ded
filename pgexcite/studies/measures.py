"""Figures of a swing, taken from a trace: what a comparison tells beyond the summary."""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import find_peaks

from pgexcite.core.summary import after, event_times, last_outside, voltage_target
from pgexcite.core.trace import Array, Trace

_SMALLEST_SWING = math.radians(0.1)
"""Turning points with less swing between them than this are noise, rad."""
_FADED = 0.1
"""A swing below this part of the first one is no longer measured: the ratio of two small numbers says little."""

_MOVED = 1e-6
"""A target that changes by less has not been moved, pu."""


def swing_figures(trace: Trace, unit: str) -> dict[str, float | None]:
    """All figures of this module for a unit, by name; ``None`` where one cannot be had.

    ``first_swing_deg``, ``recovery_5`` and ``recovery_1`` [s], ``damping`` and ``control_energy`` [pu^2 s].
    """
    has = trace.signals(f"unit.{unit}")
    return {
        "first_swing_deg": first_swing_max(trace, unit) if "delta" in has else None,
        "recovery_5": recovery_time(trace, unit, 0.05) if "v_t" in has else None,
        "recovery_1": recovery_time(trace, unit, 0.01) if "v_t" in has else None,
        "damping": swing_damping(trace, unit) if "delta" in has else None,
        "control_energy": control_energy(trace, unit) if "e_fd" in has else None,
    }


def control_energy(trace: Trace, unit: str) -> float:
    """Integral of the squared deviation of the field voltage from its initial value, pu^2 s."""
    e_fd = trace[f"unit.{unit}.e_fd"]
    return float(np.trapezoid((e_fd - e_fd[0]) ** 2, trace.t))


def first_swing_max(trace: Trace, unit: str) -> float | None:
    """Rotor angle at the first crest behind the first event, degrees; ``None`` when there is none (synchronism is lost)."""
    events = event_times(trace)
    delta = trace[f"unit.{unit}.delta"][after(trace, events[0]) if events else 0 :]
    crests, _ = find_peaks(delta, prominence=_SMALLEST_SWING)
    return math.degrees(float(delta[crests[0]])) if crests.size else None


def recovery_time(trace: Trace, unit: str, band: float) -> float | None:
    """Time from the last event until the terminal voltage stays within ``band`` (0.05: 5 %) of its target for good, s.

    The target is that of ``voltage_target``; where it changes without an event (a controller's own), that counts as
    one. ``None`` when the voltage is outside at the end.
    """
    events = event_times(trace)
    target = voltage_target(trace, unit)
    moved = np.flatnonzero(np.abs(np.diff(target)) > _MOVED) + 1
    begin = max(after(trace, events[-1]) if events else 0, int(moved[-1]) if moved.size else 0)
    inside = np.abs(trace[f"unit.{unit}.v_t"] - target) <= band * np.abs(target)
    index = max(begin, last_outside(inside) + 1)
    return float(trace.t[index] - trace.t[begin]) if index < len(trace.t) else None


def swing_damping(trace: Trace, unit: str) -> float | None:
    """Damping ratio of the rotor's swing behind the last event, from its logarithmic decrement.

    The ratio of neighbouring swings (crest to trough, trough to crest) is averaged over all that are larger than 10 % of the first;
    differences between turning points do not care about a drifting mean. ``None`` with fewer than three turning points.
    """
    events = event_times(trace)
    begin = after(trace, events[-1]) if events else 0
    swings = np.abs(np.diff(_turning_points(trace[f"unit.{unit}.delta"][begin:])))
    if swings.size < 2:
        return None
    large = swings[: int(np.argmax(swings < _FADED * swings[0])) or swings.size]
    if large.size < 2:
        return None
    decrement = math.log(large[0] / large[-1]) / (large.size - 1)
    return decrement / math.hypot(math.pi, decrement)


def _turning_points(delta: Array) -> Array:
    crests, _ = find_peaks(delta, prominence=_SMALLEST_SWING)
    troughs, _ = find_peaks(-delta, prominence=_SMALLEST_SWING)
    points: Array = delta[np.sort(np.concatenate([crests, troughs]))]
    return points
