"""What a run leaves behind: samples by name, the log of events and notes, and how it ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Ending(Enum):
    """How a run ended."""

    COMPLETED = "completed"
    LOST_SYNCHRONISM = "lost_synchronism"
    VOLTAGE_COLLAPSE = "voltage_collapse"
    DIVERGED = "diverged"


@dataclass(frozen=True)
class Outcome:
    """How a run ended, when, and where.

    Attributes:
        ending: the kind of end.
        t: time of the last sample kept, s.
        where: path of the machine, bus or equation to blame; ``""`` when completed.
        message: a sentence for a person.
        active: of a collapse or a loss of synchronism, the limiters that act and the tap changers that have moved, each with
            what it does.
    """

    ending: Ending
    t: float
    where: str = ""
    message: str = ""
    active: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.message or self.ending.value


@dataclass(frozen=True)
class LogEntry:
    """One line of a run's log.

    Attributes:
        t: s.
        kind: ``"event"``, ``"limit"``, ``"solver"``, ``"controller"``, ``"outcome"``.
        text: what happened.
    """

    t: float
    kind: str
    text: str


def reference_of(unit: str) -> str:
    """Name under which a controller records the reference of a unit's terminal voltage: ``controller.mpc.V_ref_G2``, pu."""
    return f"V_ref_{unit}"


@dataclass(frozen=True)
class Trace:
    """Samples of every signal over a run.

    At an event two samples share one time: before and after.

    Attributes:
        t: times, s, shape ``(n,)``.
        columns: signal path -> samples of shape ``(n,)``. Signals of a unit: ``unit.G2.v_t``; its states:
            ``unit.G2.machine.delta``; set-points: ``unit.G2.exciter.v_ref``; buses: ``bus.HV.v`` [pu], ``bus.HV.angle`` [rad];
            branches: ``line.L1.p_from``, ``.q_from``, ``.p_to``, ``.q_to`` [pu of the system base, into the branch];
            controllers: ``controller.mpc.cost`` and the like, constant between samples.
        units: signal path -> unit.
        log: events and notes in order of time.
    """

    t: Array
    columns: Mapping[str, Array]
    units: Mapping[str, str]
    log: Sequence[LogEntry] = field(default_factory=tuple)

    def __getitem__(self, path: str) -> Array:
        """Samples of a signal, shape ``(n,)``.

        Raises:
            KeyError: no such signal; the message names the nearest.
        """
        try:
            return self.columns[path]
        except KeyError:
            from difflib import get_close_matches

            near = get_close_matches(path, self.columns, n=3)
            raise KeyError(f"no signal {path!r} in this trace; nearest: {', '.join(near) or 'none'}") from None

    def signals(self, prefix: str) -> dict[str, Array]:
        """All signals directly below a path, by their last name: ``signals("unit.G2")["v_t"]``."""
        start = prefix + "."
        return {
            path[len(start) :]: samples
            for path, samples in self.columns.items()
            if path.startswith(start) and "." not in path[len(start) :]
        }
