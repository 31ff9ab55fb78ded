"""What a run paced by the wall clock measured: latencies, work, deadlines, memory, and what the system granted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_PER_DECADE = 10
_DECADES = (-3, 4)
EDGES: Array = np.power(10.0, np.arange(_DECADES[0] * _PER_DECADE, _DECADES[1] * _PER_DECADE + 1) / _PER_DECADE)
"""Edges of the histograms' bins, ms: ten to a decade, from a microsecond to ten seconds."""

PHASES: Mapping[str, str] = {
    "wake_up": "from the beginning of the period to the process running",
    "solve": "the controllers working out their commands",
    "response": "from the beginning of the period to the commands being out",
    "work": "all work of the period: controllers, preparation of the next sample, simulated plant, recording",
}
"""What is measured in every period."""


@dataclass(frozen=True)
class Grant:
    """An option of the operating system or the interpreter, and whether it could be had.

    Attributes:
        option: its name.
        granted: whether it is in force.
        detail: its value, or why it was refused.
    """

    option: str
    granted: bool
    detail: str


@dataclass(frozen=True)
class Timing:
    """Measurements of a paced run, one entry for each period.

    Attributes:
        period: wall-clock time of a period, s.
        sample: simulated time of a period, s.
        deadline: time after the beginning of a period by which its commands had to be out, s.
        t: simulated time at the beginning of each period, s, shape ``(n,)``.
        ms: phase -> wall time, ms, shape ``(n,)``; see ``PHASES``.
        skipped: periods that went by without a sample, because an earlier one took longer than its own and theirs.
        memory: resident memory now and then, as ``(period, MiB)``; empty where the system does not tell.
        grants: options asked for.
        interrupted: whether the run was ended by an interrupt.
    """

    period: float
    sample: float
    deadline: float
    t: Array
    ms: Mapping[str, Array]
    skipped: int
    memory: tuple[tuple[int, float], ...]
    grants: tuple[Grant, ...]
    interrupted: bool = False

    @property
    def missed(self) -> int:
        """Periods whose commands were not out by the deadline; those skipped are among them."""
        return int(np.sum(self.ms["response"] > 1e3 * self.deadline)) + self.skipped

    @property
    def overruns(self) -> int:
        """Periods whose work was not done when the next began."""
        return int(np.sum(self.ms["wake_up"] + self.ms["work"] > 1e3 * self.period))

    def summary(self) -> dict[str, Any]:
        """Plain data for ``summary.json``: times in ms, memory in MiB."""
        steps = self.t.size
        return {
            "period": self.period,
            "sample": self.sample,
            "deadline": self.deadline,
            "steps": steps,
            "interrupted": self.interrupted,
            "missed": self.missed,
            "miss_rate": self.missed / (steps + self.skipped) if steps else None,
            "skipped": self.skipped,
            "overruns": self.overruns,
            **{f"{phase}_ms": statistics(times) for phase, times in self.ms.items()},
            "memory_mib": {"start": self.memory[0][1], "end": self.memory[-1][1]} if self.memory else None,
            "options": {grant.option: {"granted": grant.granted, "detail": grant.detail} for grant in self.grants},
        }


def statistics(times: Array) -> dict[str, Any] | None:
    """Median, tail, maximum and histogram of times, ms; ``None`` where there are none."""
    if not times.size:
        return None
    edges, counts = histogram(times)
    return {
        "median": float(np.median(times)),
        "p99": float(np.percentile(times, 99)),
        "p99.9": float(np.percentile(times, 99.9)),
        "max": float(np.max(times)),
        "histogram": {"edges": [float(f"{edge:.4g}") for edge in edges], "counts": [int(count) for count in counts]},
    }


def histogram(times: Array) -> tuple[Array, NDArray[np.int64]]:
    """Edges (ms, shape ``(n + 1,)``) and counts (shape ``(n,)``); empty bins at either end are left out.

    What lies beyond the first and the last edge of ``EDGES`` is counted in the outermost bins.
    """
    counts, _ = np.histogram(np.clip(times, EDGES[0], EDGES[-1]), EDGES)
    filled = np.flatnonzero(counts)
    first, last = int(filled[0]), int(filled[-1])
    return EDGES[first : last + 2], counts[first : last + 1]
