"""From the data of a scenario file to a system, its settings, its events and its controllers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from pgexcite.core.config import checks, tables
from pgexcite.core.config.devices import DeviceReader
from pgexcite.core.config.files import override, read
from pgexcite.core.config.validate import Collector, plain
from pgexcite.core.errors import ConfigError
from pgexcite.core.events import Change
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import System


@dataclass(frozen=True)
class Scenario:
    """A validated scenario.

    Attributes:
        title: what it shows, in a line.
        expect: how its run ought to end (``"completed"``).
        system: the grid and everything on it.
        settings: how it is integrated.
        changes: what happens, in order of time.
        controllers: controllers by name, as configured.
        sinks: names of the sinks that write its record.
        resolved: everything the file says, with all defaults, as plain data that TOML can hold.
        path: the file it came from.
    """

    title: str
    expect: str
    system: System
    settings: Settings
    changes: tuple[Change, ...]
    controllers: Mapping[str, Any]
    sinks: tuple[str, ...]
    resolved: Mapping[str, Any]
    path: Path

    def simulation(self) -> Simulation:
        """Its run, at the start.

        Raises:
            PowerFlowError, InitialisationError, AssemblyError: there is no steady state to start from.
            ConfigError: a controller refers to something that is not there.
        """
        return Simulation(self.system, self.settings, self.changes, self.controllers)


def load(path: Path | str, overrides: Sequence[str] = ()) -> Scenario:
    """Read and validate a scenario.

    Args:
        path: the TOML file.
        overrides: ``"unit.G2.exciter.K_A=250"`` and the like, applied last.

    Raises:
        ConfigError: with every problem of the file, each with its path.
    """
    return from_data(override(read(path), overrides), path)


def from_data(data: Mapping[str, Any], path: Path | str = "") -> Scenario:
    """A scenario from plain data laid out like its file.

    Raises:
        ConfigError: with every problem, each with its path.
    """
    collect = Collector()
    document = _document(data, collect)
    simulation = collect.validate(tables.SimulationTable, document.simulation, "simulation")
    base = collect.validate(tables.SystemTable, document.system, "system")
    record = collect.validate(tables.RecordTable, document.record, "record")
    for sink in record.sinks if record else ():
        collect.find("sink", sink, "record.sinks")
    devices = DeviceReader(document, base.S_base if base else 1.0, collect)
    system = System(
        S_base=base.S_base if base else 1.0,
        f_n=base.f_n if base else 1.0,
        buses=devices.network["bus"],
        lines=devices.network["line"],
        transformers=devices.network["transformer"],
        shunts=devices.network["shunt"],
        devices=tuple(devices.devices),
        reference=simulation.reference if simulation else "auto",
    )
    names = {kind: tuple(getattr(document, kind)) for kind in tables.NAMED_TABLES}
    grid = checks.Grid(system, names, frozenset(devices.broken))
    if not devices.broken:  # what is left out would make its neighbours look like an island
        checks.check_islands(system, collect)
        checks.check_limiters(system, collect)
        checks.check_taps(system, collect)
    checks.check_reference(system.reference, grid, collect)
    events = _events(document.event, grid, simulation.h if simulation else None, collect)
    controllers = _controllers(document.controller, grid, simulation.h if simulation else None, collect)
    if collect.problems or simulation is None or base is None or record is None:
        raise ConfigError(collect.problems)
    resolved = {
        "title": document.title,
        "expect": document.expect,
        "simulation": plain(simulation),
        "system": plain(base),
        **devices.resolved,
        "event": [plain(event) for event in events],
        "controller": {
            name: {"model": document.controller[name]["model"], **plain(item)} for name, item in controllers.items()
        },
        "record": plain(record),
    }
    return Scenario(
        title=document.title,
        expect=document.expect,
        system=system,
        settings=Settings(**simulation.model_dump(exclude={"reference"})),
        changes=tuple(sorted((change for event in events for change in event.changes()), key=lambda change: change.t)),
        controllers=controllers,
        sinks=tuple(record.sinks),
        resolved={key: value for key, value in resolved.items() if value != {} and value != []},
        path=Path(path),
    )


def _document(data: Mapping[str, Any], collect: Collector) -> tables.Document:
    """The top level; what is malformed is noted and left out, so that the rest is validated all the same."""
    try:
        return tables.Document.model_validate(data)
    except ValidationError as error:
        collect.validate(tables.Document, data, "", also=["include"])
        sound = {key: dict(value) if isinstance(value, dict) else value for key, value in data.items()}
        for item in error.errors():
            key, *below = item["loc"]
            if below and isinstance(sound.get(str(key)), dict):
                sound[str(key)].pop(below[0], None)
            else:
                sound.pop(str(key), None)
        return tables.Document.model_validate(sound)


def _events(entries: list[dict[str, Any]], grid: checks.Grid, h: float | None, collect: Collector) -> list[Any]:
    events: dict[int, Any] = {}
    for number, entry in enumerate(entries):
        where = f"event.{number}"
        if "type" not in entry:
            collect.add(f"{where}.type", "is required", hint=f"one of {', '.join(checks.EVENTS)}")
        elif collect.known("type of event", entry["type"], checks.EVENTS, f"{where}.type"):
            event: Any = collect.validate(checks.EVENTS[entry["type"]], entry, where)
            if event is not None:
                collect.problems += event.problems(where)
                checks.check_event(event, where, grid, collect)
                events[number] = event
    checks.check_ends(events, h, collect)
    return list(events.values())


def _controllers(
    declared: Mapping[str, dict[str, Any]], grid: checks.Grid, h: float | None, collect: Collector
) -> dict[str, BaseModel]:
    controllers = {}
    for name, table in declared.items():
        where = f"controller.{name}"
        cls = collect.find("controller", table.get("model"), f"{where}.model")
        if cls is None:
            continue
        settings = {key: value for key, value in table.items() if key != "model"}
        # A controller's schema is its own: it may hold tuples and nested tables, which a strict reading of lists would refuse.
        controller = collect.validate(cls, settings, where, also=["model"], strict=None)
        if controller is not None:
            checks.check_controller(controller, where, grid, h, collect)
            controllers[name] = controller
    return controllers
