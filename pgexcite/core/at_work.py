"""A controller at work in a run: started on what it may know, told what it measures, asked for its commands."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.controller import Action, Controller, Plant, Sample, Session, Surroundings
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.events import Change
from pgexcite.core.initialise import Initial
from pgexcite.core.measurement import Instruments
from pgexcite.core.model import State
from pgexcite.core.settings import Settings
from pgexcite.core.step import Kernel

Array = NDArray[np.float64]


@dataclass
class AtWork:
    """A controller in one run.

    Attributes:
        controller: as configured.
        perfect: whether it is handed the plant's state and parameters.
        session: it at work.
        instruments: what it measures with.
        every: its sample time in steps.
        columns: of outputs and commands in one row, those it measures.
        active: whether it is in charge.
        ordered: whether an event has said so since its last sample.
    """

    controller: Controller
    perfect: bool
    session: Session
    instruments: Instruments
    every: int
    columns: NDArray[np.int_]
    active: bool
    ordered: bool = False

    def act(self, state: State, p: Array, y: Array) -> tuple[Action, float]:
        """Its answer at this point, of which ``y`` are the outputs, and the wall time that took, ms."""
        measured = self.instruments.read(state.k // self.every, np.concatenate((y, state.u))[self.columns])
        own, parameters = (state, p.copy()) if self.perfect else (None, None)
        sample = Sample(state.t, measured, self.active, own, parameters, self.ordered)
        self.ordered = False
        began = time.perf_counter()
        action = self.session.act(sample)
        took = 1e3 * (time.perf_counter() - began)
        if action.release is not None:
            self.active = not action.release
        return action, took


def start(
    name: str, controller: Controller, initial: Initial, y: Array, settings: Settings, changes: Sequence[Change]
) -> AtWork:
    """Begin a run.

    Args:
        name: of the controller, for messages.
        controller: as configured.
        initial: the point from which the run starts.
        y: outputs there.
        settings: of the run.
        changes: the events of the run that have a time.

    Raises:
        ConfigError: its sample time is no whole multiple of the step, or it measures what does not exist.
    """
    every = round(controller.dt / settings.h)
    if every < 1 or abs(every * settings.h - controller.dt) > 1e-9:
        text = f"its sample time must be a whole multiple of the step {settings.h:g} s"
        raise ConfigError([Problem(f"controller.{name}.dt", text, controller.dt)])
    model, index, names = initial.model, initial.model.index, tuple(controller.measures())
    missing = [path for path in names if path not in index["y"] and path not in index["u"]]
    if missing:
        where = f"controller.{name}"
        raise ConfigError(
            [Problem(where, f"measures {path}, which does not exist", hint=model.nearest(path)) for path in missing]
        )
    perfect, plant = controller.information == "perfect", None
    outputs = dict(zip(model.y_names, y, strict=True))
    surroundings = Surroundings(
        h=settings.h,
        rule=settings.rule,
        u_0=dict(zip(model.u_names, initial.state.u, strict=True)),
        y_0=outputs if perfect else {path: outputs[path] for path in names if path in outputs},
        system=model.system,
        changes=tuple(changes) if controller.disturbance_known else (),
        compile=settings.compile,
    )
    if perfect:
        plant = Plant(model, Kernel(model, initial.state, initial.p, settings.compile), initial.p.copy())
    # Outputs and commands in one row: a controller may read back the set-points it moves.
    setpoints = np.array([path in index["u"] for path in names], dtype=bool)
    n_y = len(model.y_names)
    columns = np.array(
        [n_y + index["u"][path] if path in index["u"] else index["y"][path] for path in names], dtype=int
    )
    session = controller.start(surroundings, plant)
    instruments = Instruments(controller.measurement, names, setpoints)
    return AtWork(controller, perfect, session, instruments, every, columns, controller.active)
