"""Limiters and the exciter they act on: every signal has somewhere to go, and acts there as it is made to."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pgexcite.core.component import Component
from pgexcite.core.declare import Kind
from pgexcite.core.roles import Exciter, Limiter
from pgexcite.core.system import Device

_WORDS = {"sum": "summed at the regulator's input", "gate": "selected by a gate"}


@dataclass(frozen=True)
class Mismatch:
    """A limiter and an exciter that do not fit together.

    Attributes:
        path: of the component to change.
        message, hint: what is wrong, and what to do.
    """

    path: str
    message: str
    hint: str


def mismatches(device: Device) -> Iterator[Mismatch]:
    """What is wrong between the limiters of a unit and its exciter: each would run, and mean nothing."""
    exciter = device.components.get("exciter")
    if not isinstance(exciter, Exciter):
        return
    driven: set[str] = set()
    for slot, component in device.components.items():
        if isinstance(component, Limiter):
            path = device.component_path(slot)
            driven |= set(_signals(component))
            yield from (m for port in _signals(component) if (m := _judge(path, port, component, exciter)))
    for port, how in exciter.takes().items():
        default = next(item.default for item in type(exciter).variables(Kind.INPUT) if item.name == port)
        if port not in driven and how in _WORDS and (how == "gate" or default != 0):
            text = f"is to have {port} {_WORDS[how]}, and no limiter of {device.path} drives it"
            yield Mismatch(device.component_path("exciter"), text, f"add a limiter or set {_position(port)} = 0")


def _judge(path: str, port: str, limiter: Limiter, exciter: Exciter) -> Mismatch | None:
    how = exciter.takes().get(port)
    if how is None:
        return Mismatch(
            path, f"drives {port}, which this unit's exciter does not have", "leave it out, or change exciter"
        )
    if how == "nothing":
        return Mismatch(path, f"drives {port}, which this unit's exciter takes nowhere", f"set its {_position(port)}")
    if limiter.acts_as not in ("either", how):
        text = f"its {port} is made to be {_WORDS[limiter.acts_as]}, and this unit's exciter has it {_WORDS[how]}"
        return Mismatch(path, text, f"see what the limiter says of its use, and the exciter of {_position(port)}")
    return None


def _signals(limiter: Component) -> list[str]:
    return [item.name for item in limiter.variables(Kind.OUTPUT) if item.name in Exciter.LIMITERS]


def _position(port: str) -> str:
    return f"{port.removeprefix('v_')}_position"
