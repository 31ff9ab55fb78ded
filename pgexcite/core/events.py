"""Events: changes of parameters and set-points at step boundaries."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from pgexcite.core.errors import Problem


@dataclass(frozen=True)
class Change:
    """Values that change together at one instant.

    Attributes:
        t: time, s; the kernel moves it to the next step boundary and says so in the log.
        values: parameter or set-point path -> new value.
        increments: path -> what is added to the present value.
        text: for the log.
    """

    t: float
    values: Mapping[str, float]
    text: str
    increments: Mapping[str, float] | None = None


def boundary(t: float, h: float) -> int:
    """The step boundary at which something asked for at ``t`` (s) happens, with steps of ``h`` (s)."""
    return math.ceil(t / h - 1e-6)


class _Event(BaseModel, ABC):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    t: float = Field(ge=0, description="time, s")

    @abstractmethod
    def changes(self) -> tuple[Change, ...]:
        """What happens, as plain changes."""

    def problems(self, where: str) -> list[Problem]:
        """What is wrong with this event by itself, each with its path below ``where``."""
        return []


class Fault(_Event):
    """A three-phase fault at a bus through an impedance, cleared by itself after ``duration`` (never, where that is left out)."""

    type: Literal["fault"]
    bus: str
    R: float = Field(0.0, ge=0, description="fault resistance, pu of the system base; 0 with X = 0 is a bolted fault")
    X: float = Field(0.0, ge=0, description="fault reactance, pu of the system base")
    duration: float | None = Field(None, gt=0, description="s until the fault clears; never, where left out")

    def changes(self) -> tuple[Change, ...]:
        at = f"bus.{self.bus}."
        on = {at + "fault_status": 1.0, at + "fault_R": self.R, at + "fault_X": self.X}
        begins = Change(self.t, on, f"three-phase fault at bus {self.bus} (R = {self.R:g}, X = {self.X:g} pu)")
        if self.duration is None:
            return (begins,)
        return begins, Change(self.t + self.duration, {at + "fault_status": 0.0}, f"fault at bus {self.bus} cleared")


class BranchTrip(_Event):
    """A line or transformer opens at both ends, and closes again after ``reclose_after`` where that is given."""

    type: Literal["line_trip", "transformer_trip"]
    name: str
    reclose_after: float | None = Field(None, gt=0, description="s until it closes again")

    def changes(self) -> tuple[Change, ...]:
        kind = self.type.removesuffix("_trip")
        path = f"{kind}.{self.name}.status"
        opens = Change(self.t, {path: 0.0}, f"{kind} {self.name} trips")
        if self.reclose_after is None:
            return (opens,)
        return opens, Change(self.t + self.reclose_after, {path: 1.0}, f"{kind} {self.name} recloses")


class BranchClose(_Event):
    """A line or transformer closes at both ends."""

    type: Literal["line_close", "transformer_close"]
    name: str

    def changes(self) -> tuple[Change, ...]:
        kind = self.type.removesuffix("_close")
        return (Change(self.t, {f"{kind}.{self.name}.status": 1.0}, f"{kind} {self.name} closes"),)


class LoadStep(_Event):
    """A load's scheduled demand changes by ``dP`` MW and ``dQ`` Mvar."""

    type: Literal["load_step"]
    load: str
    dP: float = Field(0.0, description="MW added")
    dQ: float = Field(0.0, description="Mvar added")

    def changes(self) -> tuple[Change, ...]:
        path = f"load.{self.load}."
        text = f"load {self.load} steps by {self.dP:+g} MW, {self.dQ:+g} Mvar"
        return (Change(self.t, {}, text, {path + "P": self.dP, path + "Q": self.dQ}),)


class ParameterStep(_Event):
    """Any parameter or set-point takes a new value, or changes by a step: ``path = "unit.G2.exciter.v_ref"``, ``step = 0.05``."""

    type: Literal["set", "setpoint", "parameter"]
    path: str
    value: float | None = None
    step: float | None = None

    def changes(self) -> tuple[Change, ...]:
        if self.step is not None:
            return (Change(self.t, {}, f"{self.path} steps by {self.step:+g}", {self.path: self.step}),)
        return (Change(self.t, {self.path: float(self.value or 0.0)}, f"{self.path} set to {self.value:g}"),)

    def problems(self, where: str) -> list[Problem]:
        if (self.value is None) == (self.step is None):
            return [Problem(where, "exactly one of value and step is needed")]
        return []


class HandOver(_Event):
    """Control passes to a controller, or from it back to the classical one."""

    type: Literal["hand_over"]
    controller: str
    to: Literal["controller", "classical"]

    def changes(self) -> tuple[Change, ...]:
        active = {f"controller.{self.controller}.active": float(self.to == "controller")}
        whom = self.controller if self.to == "controller" else "the classical controller"
        return (Change(self.t, active, f"control passes to {whom}"),)


Event = Annotated[
    Fault | BranchTrip | BranchClose | LoadStep | ParameterStep | HandOver,
    Field(discriminator="type"),
]
