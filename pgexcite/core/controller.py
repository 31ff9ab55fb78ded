"""Controllers: what they are told, what they answer, and the privilege of perfect information."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.events import Change
from pgexcite.core.measurement import Measurement
from pgexcite.core.model import Model, State
from pgexcite.core.settings import Compile, Rule
from pgexcite.core.step import Kernel
from pgexcite.core.system import System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surroundings:
    """What every controller is told before the run: names, and the plant's sampling.

    Attributes:
        h: step of the simulation, s.
        rule: integration rule of the simulation.
        u_0: commands at the initial point, by path.
        y_0: outputs at the initial point, by path: those the controller measures; all of them with perfect information.
        system: the grid as configured, for controllers that build a model of their own from its nameplate data.
        changes: the events of the run that have a time, for controllers that declare them known.
        compile: whether steps are compiled to C, for such models too.
    """

    h: float
    rule: Rule
    u_0: Mapping[str, float]
    y_0: Mapping[str, float]
    system: System
    changes: tuple[Change, ...] = ()
    compile: Compile = "auto"


@dataclass(frozen=True)
class Plant:
    """The plant itself, handed only to controllers that declare ``information = "perfect"``.

    Attributes:
        model: its equations.
        kernel: a kernel of the controller's own (work arrays are not shared with the simulation).
        p: its parameters at the start; later ones come with each sample.
    """

    model: Model
    kernel: Kernel
    p: Array


@dataclass(frozen=True)
class Sample:
    """What a controller is handed at a sampling instant.

    Attributes:
        t: s.
        active: whether the controller is in charge; a controller on standby keeps track and its commands are not used.
        measured: signal path -> value, of the signals the controller asked for; NaN where the sample was lost. Set-points asked for
            are read back.
        ordered: whether an event has said who is in charge since the last sample.
        state, p: the plant's state and parameters, for perfect information only, else ``None``.
    """

    t: float
    measured: Mapping[str, float]
    active: bool = True
    state: State | None = None
    p: Array | None = None
    ordered: bool = False


@dataclass(frozen=True)
class Action:
    """What a controller answers.

    Attributes:
        commands: set-point path -> value.
        diagnostics: name -> number, recorded as ``controller.<name>.<key>``.
        stage_cost: cost of the sample that just passed, by the controller's own cost function.
        fallback: whether its plan could not be used.
        release: whether it hands control back to the classical controller, or takes it (``False``); ``None`` leaves that as it is.
        notes: lines for the log.
    """

    commands: Mapping[str, float]
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    stage_cost: float = 0.0
    fallback: bool = False
    release: bool | None = None
    notes: Sequence[str] = ()


class Session(Protocol):
    """A controller at work in one run. Its ``memory`` is all it keeps between samples."""

    def act(self, sample: Sample) -> Action:
        """The commands for the interval that begins now."""
        ...

    def prepare(self) -> None:
        """Work for the next sample that needs nothing of it; called once the commands are sent."""
        ...

    def memory(self) -> Mapping[str, Array]:
        """What it remembers, as arrays; a snapshot holds it."""
        ...

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        ...


class Controller(Protocol):
    """A controller as configured: a frozen pydantic class registered under ``pgexcite.controllers``."""

    @property
    def dt(self) -> float:
        """Sample time, s; a whole multiple of the step."""
        ...

    @property
    def information(self) -> Literal["perfect", "measured"]:
        """Whether it is handed the plant's state and model."""
        ...

    @property
    def measurement(self) -> Measurement:
        """What its instruments do to what it measures."""
        ...

    @property
    def active(self) -> bool:
        """Whether it is in charge from the start, or on standby."""
        ...

    @property
    def disturbance_known(self) -> bool:
        """Whether it is told the events of the run in advance."""
        ...

    def measures(self) -> Sequence[str]:
        """Paths of the outputs it measures and of the set-points it reads back."""
        ...

    def start(self, surroundings: Surroundings, plant: Plant | None) -> Session:
        """Begin a run; ``plant`` is ``None`` unless it has perfect information."""
        ...
