"""The result of a run, and the protocol of what writes it down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from pgexcite.core.system import System
from pgexcite.core.timing import Timing
from pgexcite.core.trace import Outcome, Trace


@dataclass(frozen=True)
class ControllerStatistics:
    """How a controller did over a run.

    Attributes:
        samples: how often it was called.
        solve_ms: wall time of each call, ms.
        fallbacks: how often its plan could not be used.
        cost: closed-loop cost accumulated over the run, by its own cost function.
    """

    samples: int = 0
    solve_ms: Sequence[float] = field(default_factory=tuple)
    fallbacks: int = 0
    cost: float = 0.0


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    Attributes:
        title: of the configuration.
        config: the resolved configuration, as plain data that TOML can hold.
        system: what was simulated.
        outcome: how it ended.
        trace: all samples and the log.
        steps: steps taken.
        wall_time: s spent stepping, controllers included.
        controllers: statistics by name.
        timing: measurements of a run paced by the wall clock, else ``None``.
    """

    title: str
    config: Mapping[str, Any]
    system: System
    outcome: Outcome
    trace: Trace
    steps: int
    wall_time: float
    controllers: Mapping[str, ControllerStatistics] = field(default_factory=dict)
    timing: Timing | None = None


class Sink(Protocol):
    """Writes one file of the record of a run."""

    def write(self, result: RunResult, directory: Path) -> Path:
        """Write into an existing directory; returns the file written."""
        ...
