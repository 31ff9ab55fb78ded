"""P-V curves with regulators and limiters at work, by a slow ramp of an impedance.

A power flow knows units that hold their voltage or their reactive power; a unit at constant field or at its limiter does neither.
So the whole system runs while the admittance of a load grows step by step: its power rises to the nose and falls beyond it, and an
impedance has a solution on both branches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.events import Change
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import System
from pgexcite.core.trace import Trace

Array = NDArray[np.float64]

_UNLOADING, _PIECES = 5.0, 5
"""Time between the steps by which the load goes to its least share, s, and how many they are."""

_ROUNDING = 1e-6
"""Of a number of steps."""


@dataclass(frozen=True)
class Pace:
    """How fast the load grows.

    Attributes:
        light, heavy: shares of its admittance at the start of the run it goes from and to.
        growth: ratio of two steps.
        every: time of a step, s; long against the swings and the limiters' delays.
        begins: when it begins to grow, s; the load goes to ``light`` in the first 25 s.
    """

    light: float = 0.5
    heavy: float = 6.0
    growth: float = 1.02
    every: float = 10.0
    begins: float = 100.0


@dataclass(frozen=True)
class Ramp:
    """The curve of a ramp.

    Attributes:
        P: power of the load at the end of each step, MW, shape ``(n,)``.
        V: voltage of its bus there, pu, shape ``(n,)``.
        acted: limiter -> power in MW and voltage at which it first acted.
        ended: how the run ended; beyond the nose machines may fall out of step.
    """

    P: Array
    V: Array
    acted: dict[str, tuple[float, float]]
    ended: str

    @property
    def nose(self) -> tuple[float, float]:
        """Largest power, MW, and the voltage there, pu."""
        k = int(np.argmax(self.P))
        return float(self.P[k]), float(self.V[k])


def pv_by_ramp(
    system: System, settings: Settings, load: str, changes: Sequence[Change] = (), pace: Pace | None = None
) -> Ramp:
    """The curve of a load that is a constant impedance.

    Args:
        system: its steady state with the whole load is where set-points come from.
        settings: of the run; its duration is that of the ramp.
        load: name of the load.
        changes: what else happens, before the ramp begins (a line that trips).
        pace: how the load grows.
    """
    pace = pace or Pace()
    device = system.device(f"load.{load}")
    demand = {f"load.{load}.{name}": -(getattr(device.schedule, name) or 0.0) for name in ("P", "Q")}

    def step(t: float, share: float) -> Change:
        increments = {path: power * share for path, power in demand.items()}
        return Change(t, {}, f"load {load} changes by {share:+.3g} of its demand", increments)

    count = int(np.log(pace.heavy / pace.light) / np.log(pace.growth) + _ROUNDING)
    shares = pace.light * pace.growth ** np.arange(count + 1)
    steps = [step(_UNLOADING * k, (pace.light - 1.0) / _PIECES) for k in range(_PIECES)]
    steps += [step(pace.begins + pace.every * k, float(share)) for k, share in enumerate(np.diff(shares))]
    simulation = Simulation(
        system,
        replace(settings, t_end=pace.begins + pace.every * count),
        sorted([*changes, *steps], key=lambda change: change.t),
    )
    outcome, trace = simulation.run(), simulation.trace()
    whole = int(np.floor((outcome.t - pace.begins) / pace.every + _ROUNDING))
    ends = np.searchsorted(trace.t, pace.begins + pace.every * np.arange(whole + 1) - 1e-6) - 1
    P, V = system.S_base * trace[f"load.{load}.p"], trace[f"bus.{device.bus}.v"]
    return Ramp(P[ends], V[ends], _acted(trace, P, V), str(outcome))


def _acted(trace: Trace, P: Array, V: Array) -> dict[str, tuple[float, float]]:
    """The first point at which each limiter acts."""
    found = {}
    for path in (path for path in trace.columns if path.startswith("unit.") and path.endswith(".active")):
        if (trace[path] > 0).any():
            k = int(np.argmax(trace[path] > 0))
            found[path.removesuffix(".active")] = (float(P[k]), float(V[k]))
    return found
