"""Checks across the tables of a scenario: names of nothing, networks that hang in the air, sampling that does not fit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, get_args

from pydantic import BaseModel

from pgexcite.core import registry
from pgexcite.core.config.validate import Collector
from pgexcite.core.declare import Kind
from pgexcite.core.errors import Problem
from pgexcite.core.events import BranchClose, BranchTrip, Event, Fault, HandOver, LoadStep, ParameterStep, boundary
from pgexcite.core.limiting import mismatches
from pgexcite.core.roles import TapChanger
from pgexcite.core.system import Device, System

EVENTS: dict[str, type[BaseModel]] = {
    name: cls for cls in get_args(get_args(Event)[0]) for name in get_args(cls.model_fields["type"].annotation)
}
"""Class of every type of event."""


@dataclass(frozen=True)
class Grid:
    """A system as far as it validated.

    Attributes:
        system: what validated.
        names: all names the file declares, by kind of table, sound or not.
        broken: paths of what did not validate; whatever refers into these has been complained of already.
    """

    system: System
    names: Mapping[str, tuple[str, ...]]
    broken: frozenset[str]


def check_islands(system: System, collect: Collector) -> None:
    """Every island needs something that holds its angle, and as many voltages left free as a unit fixes too much."""
    for members in system.islands():
        there = [device for device in system.devices if device.bus in members]
        where = f"bus.{members[0]}"
        if not any(device.schedule.angle is not None for device in there):
            collect.add(
                where,
                f"the island of bus {', '.join(members)} has no infinite bus and no slack unit",
                hint="connect it by a line or transformer in service, or set slack = true at one of its units",
            )
            continue
        free = [device.path for device in there if device.schedule.angle is not None and device.schedule.V is None]
        full = [device.path for device in there if _has_all(device)]
        if len(free) != len(full):
            remedy = (
                f"give V to {_listed(free)}, or Q beside P and V to a unit for each"
                if len(free) > len(full)
                else f"leave Q or V out at {_listed(full)}, or V at an infinite bus for each"
            )
            collect.add(
                where,
                f"without V: {_listed(free)}; with all of P, Q and V: {_listed(full)}; there must be as many of these as of those",
                hint=remedy,
            )


def check_limiters(system: System, collect: Collector) -> None:
    """Limiters have an exciter that takes their signals as they are made."""
    for device in system.devices:
        for found in mismatches(device):
            collect.add(found.path, found.message, hint=found.hint)


def check_taps(system: System, collect: Collector) -> None:
    """A transformer's own ratio is one its tap changer can have: outside its range an automaton is stuck."""
    changers = {device.path: device.components.get("tap_changer") for device in system.devices}
    for name, transformer in system.transformers.items():
        path = f"transformer.{name}"
        changer = changers.get(path)
        if isinstance(changer, TapChanger):
            low, high = changer.reach
            if not low <= transformer.tap <= high:
                collect.add(
                    f"{path}.tap",
                    f"must lie within its tap changer's tap_min .. tap_max = {low:g} .. {high:g}",
                    transformer.tap,
                )


def check_reference(reference: str, grid: Grid, collect: Collector) -> None:
    """The angle reference is a word or a unit that exists."""
    where, words = "simulation.reference", ("auto", "infinite_bus", "centre_of_inertia")
    if not collect.known("reference or unit", reference, [*words, *grid.names["unit"]], where):
        return
    if reference == "infinite_bus" and not grid.names["infinite_bus"]:
        collect.add(where, "there is no infinite bus here", reference, "use centre_of_inertia or a unit's name")


def check_event(event: BaseModel, where: str, grid: Grid, collect: Collector) -> None:
    """What an event refers to exists."""
    if isinstance(event, Fault):
        collect.known("bus", event.bus, grid.names["bus"], f"{where}.bus")
    elif isinstance(event, BranchTrip | BranchClose):
        kind = event.type.partition("_")[0]
        collect.known(kind, event.name, grid.names[kind], f"{where}.name")
    elif isinstance(event, LoadStep):
        collect.known("load", event.load, grid.names["load"], f"{where}.load")
    elif isinstance(event, HandOver):
        collect.known("controller", event.controller, grid.names["controller"], f"{where}.controller")
    elif isinstance(event, ParameterStep) and not any(event.path.startswith(f"{path}.") for path in grid.broken):
        _check_parameter_step(event, where, grid.system, collect)


def check_ends(events: Mapping[int, BaseModel], h: float | None, collect: Collector) -> None:
    """What ends by itself lasts a step at least, and a fault begins after the one before it at its bus has cleared.

    Args:
        events: sound events by their number in the file.
        h: step, s; ``None`` where it is not known.
    """
    faults: dict[str, list[tuple[float, float, int]]] = {}
    for number, event in events.items():
        if not isinstance(event, Fault | BranchTrip):
            continue
        key, begin = "duration" if isinstance(event, Fault) else "reclose_after", event.t or 0.0
        lasts = getattr(event, key)
        end = math.inf if lasts is None else begin + lasts
        if lasts is not None and h is not None and boundary(end, h) <= boundary(begin, h):
            collect.add(
                f"event.{number}.{key}",
                f"ends on the step boundary it begins on: events move to the next whole step of simulation.h = {h:g} s",
                lasts,
                "make it longer or simulation.h shorter",
            )
        if isinstance(event, Fault) and event.when is None:
            faults.setdefault(event.bus, []).append((begin, end, number))
    for bus, there in faults.items():
        there.sort()
        for (_, end, first), (begin, _, second) in pairwise(there):
            if begin <= end or (h is not None and boundary(begin, h) <= boundary(end, h)):
                text = f"bus {bus} is still faulted then by event.{first}, whose clearing would clear this fault, too"
                collect.add(f"event.{second}.t", text, begin, "make them one fault, or let it begin a step later")


def check_controller(controller: BaseModel, where: str, grid: Grid, h: float | None, collect: Collector) -> None:
    """A controller's sample time fits the step, and the unit it names exists."""
    dt = getattr(controller, "dt", None)
    if isinstance(dt, float) and h is not None:
        ratio = dt / h
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            fitting = max(1, round(ratio)) * h
            collect.add(
                f"{where}.dt",
                f"must be a whole multiple of the step simulation.h = {h:g} s",
                dt,
                f"{fitting:g} would do",
            )
    named = getattr(controller, "unit", None)
    for unit in (named,) if isinstance(named, str) else named or ():
        collect.known("unit", unit, grid.names["unit"], f"{where}.unit")


def adjustable(system: System) -> dict[str, tuple[BaseModel, str] | None]:
    """Paths of everything an event may change: the record and field a parameter belongs to, or ``None`` for a set-point."""
    found: dict[str, tuple[BaseModel, str] | None] = {}
    network: dict[str, Any] = {f"bus.{name}": item for name, item in system.buses.items()}
    network |= {f"shunt.{name}": item for name, item in system.shunts.items()} | system.branches()
    for path, item in network.items():
        found |= {f"{path}.{name}": (item, name) for name in item.numeric_parameters()}
    for device in system.devices:
        for slot, component in device.components.items():
            path = device.component_path(slot)
            found |= {f"{path}.{name}": (component, name) for name in component.numeric_parameters()}
            found |= {f"{path}.{item.name}": None for item in component.variables(Kind.SETPOINT)}
    return found


def _check_parameter_step(event: ParameterStep, where: str, system: System, collect: Collector) -> None:
    targets = adjustable(system)
    if event.path not in targets:
        hint = registry.nearest(event.path, siblings(event.path, targets))
        collect.add(f"{where}.path", "there is no such parameter or set-point", event.path, hint)
        return
    if event.value is not None:
        for problem in refusals(targets, event.path, event.value):
            collect.add(f"{where}.value", f"{event.path} {problem.message}", event.value, problem.hint)


def refusals(targets: Mapping[str, tuple[BaseModel, str] | None], path: str, value: float) -> tuple[Problem, ...]:
    """What the record that a parameter belongs to says against a value; a set-point has none."""
    target = targets.get(path)
    if target is None:
        return ()
    record, name = target
    info = type(record).model_fields[name]
    trial = Collector()
    trial.validate(
        type(record), record.model_dump(by_alias=True) | {info.alias or name: value}, path.rpartition(".")[0]
    )
    return tuple(trial.problems)


def siblings(path: str, targets: Mapping[str, object]) -> list[str]:
    """Targets that share the longest leading part of a path, so that the list offered is a short one."""
    parts = path.split(".")
    for count in range(len(parts) - 1, 0, -1):
        start = ".".join(parts[:count]) + "."
        if found := [target for target in targets if target.startswith(start)]:
            return found
    return list(targets)


def _has_all(device: Device) -> bool:
    plan = device.schedule
    return plan.P is not None and plan.Q is not None and plan.V is not None


def _listed(paths: list[str]) -> str:
    return ", ".join(paths) or "none"
