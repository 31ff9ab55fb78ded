"""Events: changes of parameters and set-points at step boundaries, at a time or when something happens."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from pgexcite.core.errors import Problem


class When(BaseModel):
    """A condition: a signal goes beyond a threshold and stays there. It is looked at after every step, and comes true once."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    signal: str = Field(description="path of an output: unit.G2.v_t, bus.HV.v, ...")
    below: float | None = Field(None, description="threshold it goes below")
    above: float | None = Field(None, description="threshold it goes above")
    lasting: float = Field(0.0, ge=0, description="time for which it must stay there, s")
    after: float = Field(0.0, ge=0, description="time from which on it is looked at, s")

    @property
    def threshold(self) -> float:
        """The threshold, whichever it is."""
        return float(self.above or 0.0) if self.below is None else self.below

    def __str__(self) -> str:
        beyond = f"above {self.threshold:g}" if self.below is None else f"below {self.threshold:g}"
        return f"{self.signal} {beyond}" + (f" for {self.lasting:g} s" if self.lasting else "")


@dataclass(frozen=True)
class Change:
    """Values that change together at one instant.

    Attributes:
        t: time, s; the kernel moves it to the next step boundary and says so in the log.
        values: parameter or set-point path -> new value.
        increments: path -> what is added to the present value.
        text: for the log.
        when: what it waits for; ``t`` then counts from the instant that comes true.
    """

    t: float
    values: Mapping[str, float]
    text: str
    increments: Mapping[str, float] = field(default_factory=dict)
    when: When | None = None

    def assignments(self) -> Iterator[tuple[str, float, bool]]:
        """Each path with its number, and whether that is added to the present value."""
        yield from ((path, value, False) for path, value in self.values.items())
        yield from ((path, value, True) for path, value in self.increments.items())


def boundary(t: float, h: float) -> int:
    """The step boundary at which something asked for at ``t`` (s) happens, with steps of ``h`` (s)."""
    return math.ceil(t / h - 1e-6)


class _Event(BaseModel, ABC):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    t: float | None = Field(None, ge=0, description="time, s; with when: s after that came true, 0 where left out")
    when: When | None = Field(None, description="condition it waits for")

    def changes(self) -> tuple[Change, ...]:
        """What happens, as plain changes."""
        return tuple(replace(change, when=self.when) for change in self._changes(self.t or 0.0))

    @abstractmethod
    def _changes(self, t: float) -> tuple[Change, ...]:
        """What happens from ``t`` on."""

    def problems(self, where: str) -> list[Problem]:
        """What is wrong with this event by itself, each with its path below ``where``."""
        if self.when is None:
            return [] if self.t is not None else [Problem(f"{where}.t", "is required: time, s", hint="or give when")]
        if (self.when.below is None) == (self.when.above is None):
            return [Problem(f"{where}.when", "exactly one of below and above is needed")]
        return []


class Fault(_Event):
    """A three-phase fault at a bus through an impedance, cleared by itself after ``duration`` (never, where that is left out)."""

    type: Literal["fault"]
    bus: str
    R: float = Field(0.0, ge=0, description="fault resistance, pu of the system base; 0 with X = 0 is a bolted fault")
    X: float = Field(0.0, ge=0, description="fault reactance, pu of the system base")
    duration: float | None = Field(None, gt=0, description="time until the fault clears, s; never, where left out")

    def _changes(self, t: float) -> tuple[Change, ...]:
        at = f"bus.{self.bus}."
        on = {at + "fault_status": 1.0, at + "fault_R": self.R, at + "fault_X": self.X}
        begins = Change(t, on, f"three-phase fault at bus {self.bus} (R = {self.R:g}, X = {self.X:g} pu)")
        if self.duration is None:
            return (begins,)
        return begins, Change(t + self.duration, {at + "fault_status": 0.0}, f"fault at bus {self.bus} cleared")


class BranchTrip(_Event):
    """A line or transformer opens at both ends, and closes again after ``reclose_after`` where that is given."""

    type: Literal["line_trip", "transformer_trip"]
    name: str
    reclose_after: float | None = Field(None, gt=0, description="time until it closes again, s")

    def _changes(self, t: float) -> tuple[Change, ...]:
        kind = self.type.removesuffix("_trip")
        path = f"{kind}.{self.name}.status"
        opens = Change(t, {path: 0.0}, f"{kind} {self.name} trips")
        if self.reclose_after is None:
            return (opens,)
        return opens, Change(t + self.reclose_after, {path: 1.0}, f"{kind} {self.name} recloses")


class BranchClose(_Event):
    """A line or transformer closes at both ends."""

    type: Literal["line_close", "transformer_close"]
    name: str

    def _changes(self, t: float) -> tuple[Change, ...]:
        kind = self.type.removesuffix("_close")
        return (Change(t, {f"{kind}.{self.name}.status": 1.0}, f"{kind} {self.name} closes"),)


class LoadStep(_Event):
    """A load's scheduled demand changes by ``dP`` MW and ``dQ`` Mvar."""

    type: Literal["load_step"]
    load: str
    dP: float = Field(0.0, description="active power added, MW")
    dQ: float = Field(0.0, description="reactive power added, Mvar")

    def _changes(self, t: float) -> tuple[Change, ...]:
        path = f"load.{self.load}."
        text = f"load {self.load} steps by {self.dP:+g} MW, {self.dQ:+g} Mvar"
        return (Change(t, {}, text, {path + "P": self.dP, path + "Q": self.dQ}),)


class ParameterStep(_Event):
    """Any parameter or set-point takes a new value, or changes by a step: ``path = "unit.G2.exciter.v_ref"``, ``step = 0.05``."""

    type: Literal["set", "setpoint", "parameter"]
    path: str
    value: float | None = None
    step: float | None = None

    def _changes(self, t: float) -> tuple[Change, ...]:
        if self.step is not None:
            return (Change(t, {}, f"{self.path} steps by {self.step:+g}", {self.path: self.step}),)
        return (Change(t, {self.path: float(self.value or 0.0)}, f"{self.path} set to {self.value:g}"),)

    def problems(self, where: str) -> list[Problem]:
        found = super().problems(where)
        if (self.value is None) == (self.step is None):
            found.append(Problem(where, "exactly one of value and step is needed"))
        return found


class HandOver(_Event):
    """Control passes to a controller, or from it back to the classical one."""

    type: Literal["hand_over"]
    controller: str
    to: Literal["controller", "classical"]

    def _changes(self, t: float) -> tuple[Change, ...]:
        active = {f"controller.{self.controller}.active": float(self.to == "controller")}
        whom = self.controller if self.to == "controller" else "the classical controller"
        return (Change(t, active, f"control passes to {whom}"),)


Event = Annotated[
    Fault | BranchTrip | BranchClose | LoadStep | ParameterStep | HandOver,
    Field(discriminator="type"),
]
