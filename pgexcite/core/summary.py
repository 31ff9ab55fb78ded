"""The figures a run is judged by, taken from its trace."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.result import ControllerStatistics, RunResult
from pgexcite.core.trace import Array, Ending, Trace, reference_of

SETTLING_BAND = 0.01
"""Half-width of the band a settled terminal voltage stays in, as a part of its final value."""
SETTLING_HOLD = 1.0
"""How long at least the voltage must have been inside the band when the run ends, s (half the time that is left, if shorter)."""


def summarise(result: RunResult) -> dict[str, Any]:
    """The content of ``summary.json``, as plain data.

    Of the run: ``outcome``, ``where`` and ``active`` (see ``Outcome``), ``t_end`` [s], ``steps``, ``wall_time`` [s]. Of each
    unit, ``None`` where the unit has no such signal:

    - ``delta_max_deg``: largest rotor angle against the angle reference, degrees;
    - ``v_t_min``: smallest terminal voltage, pu;
    - ``v_t_iae``: integral of ``|v_t - target|``, pu s, with the target of `voltage_target`;
    - ``omega_max``: largest speed, pu; ``e_fd_max``, ``i_fd_max``: largest field voltage and current, pu (air-gap-line base);
    - ``settled_at``: see `settled_at`.

    Of each controller: ``samples``, ``solve_ms`` (``median``, ``p99``, ``max``; ``None`` when it never solved), ``fallbacks``,
    ``cost``.

    Of a run paced by the wall clock, ``realtime``: see ``pgexcite.core.timing.Timing``.
    """
    realtime = {} if result.timing is None else {"realtime": result.timing.summary()}
    return {
        "outcome": result.outcome.ending.value,
        "where": result.outcome.where,
        "active": list(result.outcome.active),
        "t_end": float(result.outcome.t),
        "steps": int(result.steps),
        "wall_time": float(result.wall_time),
        "units": {name: _unit(result, name) for name in unit_names(result.trace)},
        "controllers": {name: _controller(statistics) for name, statistics in result.controllers.items()},
        **realtime,
    }


def unit_names(trace: Trace) -> tuple[str, ...]:
    """Names of the generating units in a trace, in its order."""
    found = {path.split(".")[1]: None for path in trace.columns if path.startswith("unit.") and path.count(".") == 2}
    return tuple(found)


def event_times(trace: Trace) -> tuple[float, ...]:
    """Times of the events in a trace's log, s, ascending."""
    return tuple(sorted(entry.t for entry in trace.log if entry.kind == "event"))


def after(trace: Trace, t: float) -> int:
    """Index of the first sample at or after ``t``; of two samples at an event's instant, the one behind the jump."""
    start = int(np.searchsorted(trace.t, t - 1e-9, side="left"))
    if start + 1 < len(trace.t) and trace.t[start + 1] == trace.t[start]:
        start += 1
    return min(start, len(trace.t) - 1)


def voltage_target(trace: Trace, unit: str) -> Array:
    """What a unit's terminal voltage is measured against, pu, shape ``(n,)``.

    The initial voltage, plus every step an *event* made in the exciter's ``v_ref``. A reference that a controller moves between
    events is its means and not its aim, so it does not count.
    """
    target: Array = np.full(len(trace.t), float(trace[f"unit.{unit}.v_t"][0]))
    reference = trace.columns.get(f"unit.{unit}.exciter.v_ref")
    if reference is not None:
        jumps = np.where(np.diff(trace.t) == 0, np.diff(reference), 0.0)
        target[1:] += np.cumsum(jumps)
    for path, aim in trace.columns.items():
        if path.startswith("controller.") and path.endswith(f".{reference_of(unit)}"):
            in_charge = trace[f"{path.rpartition('.')[0]}.active"] > 0
            target = np.where(in_charge & np.isfinite(aim), aim, target)
    return target


def last_outside(inside: NDArray[np.bool_]) -> int:
    """Index of the last sample that is outside a band; -1 when none is."""
    outside = np.flatnonzero(~inside)
    return int(outside[-1]) if outside.size else -1


def settled_at(trace: Trace, unit: str) -> float | None:
    """Time from which the terminal voltage stays within 1 % of its final value, s on the run's clock.

    The final value is the voltage's mean over the last second (half the time since the last event, where that is shorter). Not
    before the last event; ``None`` when the voltage has not been inside the band for all of that last second.
    """
    v_t = trace[f"unit.{unit}.v_t"]
    events = event_times(trace)
    begin = after(trace, events[-1]) if events else 0
    remaining = float(trace.t[-1] - trace.t[begin])
    hold = min(SETTLING_HOLD, remaining / 2)
    if hold <= 0:
        return None
    tail = trace.t >= trace.t[-1] - hold
    span = float(trace.t[tail][-1] - trace.t[tail][0])
    final = float(np.trapezoid(v_t[tail], trace.t[tail]) / span) if span > 0 else float(v_t[-1])
    index = max(begin, last_outside(np.abs(v_t - final) <= SETTLING_BAND * abs(final)) + 1)
    if index >= len(trace.t) or trace.t[index] > trace.t[-1] - hold:
        return None
    return float(trace.t[index])


def _unit(result: RunResult, name: str) -> dict[str, float | None]:
    trace = result.trace
    signals = trace.signals(f"unit.{name}")
    iae = settled = None
    if "v_t" in signals:
        iae = float(np.trapezoid(np.abs(signals["v_t"] - voltage_target(trace, name)), trace.t))
        settled = settled_at(trace, name) if result.outcome.ending is Ending.COMPLETED else None
    delta_max = _extreme(signals, "delta", np.max)
    return {
        "delta_max_deg": None if delta_max is None else math.degrees(delta_max),
        "v_t_min": _extreme(signals, "v_t", np.min),
        "v_t_iae": _finite(iae),
        "omega_max": _extreme(signals, "omega", np.max),
        "e_fd_max": _extreme(signals, "e_fd", np.max),
        "i_fd_max": _extreme(signals, "i_fd", np.max),
        "settled_at": settled,
    }


def _extreme(signals: Mapping[str, Array], name: str, pick: Any) -> float | None:
    return _finite(float(pick(signals[name]))) if name in signals else None


def _finite(value: float | None) -> float | None:
    """JSON has no NaN: what is not a number is absent."""
    return value if value is not None and math.isfinite(value) else None


def _controller(statistics: ControllerStatistics) -> dict[str, Any]:
    times = np.asarray(statistics.solve_ms, dtype=float)
    solve = None
    if times.size:
        solve = {
            "median": float(np.median(times)),
            "p99": float(np.percentile(times, 99)),
            "max": float(np.max(times)),
        }
    return {
        "samples": int(statistics.samples),
        "solve_ms": solve,
        "fallbacks": int(statistics.fallbacks),
        "cost": _finite(float(statistics.cost)),
    }
