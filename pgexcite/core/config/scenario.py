"""From the data of a scenario file to a system, its settings, its events and its controllers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, radians
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from pgexcite.core.component import Component
from pgexcite.core.config import checks, tables
from pgexcite.core.config.files import override, read
from pgexcite.core.config.validate import Collector
from pgexcite.core.errors import ConfigError
from pgexcite.core.events import Change
from pgexcite.core.network import Bus, Line, NetworkElement, Shunt, Transformer
from pgexcite.core.settings import Settings
from pgexcite.core.system import Device, Schedule, System

_NAME = re.compile(r"[\w-]+")
_NETWORK: dict[str, type[NetworkElement]] = {"bus": Bus, "line": Line, "transformer": Transformer, "shunt": Shunt}


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


def load(path: Path | str, overrides: Sequence[str] = ()) -> Scenario:
    """Read and validate a scenario.

    Args:
        path: the TOML file.
        overrides: ``"unit.G2.exciter.K_A=250"`` and the like, applied last.

    Raises:
        ConfigError: with every problem of the file, each with its path.
    """
    return from_data(override(read(path), overrides), Path(path))


def from_data(data: Mapping[str, Any], path: Path | str = "") -> Scenario:
    """A scenario from plain data laid out like its file.

    Raises:
        ConfigError: with every problem, each with its path.
    """
    reader = _Reader()
    scenario = reader.scenario(data, Path(path))
    if reader.collect.problems or scenario is None:
        raise ConfigError(reader.collect.problems)
    return scenario


class _Reader:
    """Validates table after table and keeps what each resolved to. What did not validate is left out, its problems noted."""

    def __init__(self) -> None:
        self.collect = Collector()
        self.resolved: dict[str, Any] = {}
        self.network: dict[str, dict[str, Any]] = {}
        self.devices: list[Device] = []

    def scenario(self, data: Mapping[str, Any], path: Path) -> Scenario | None:
        document = self.collect.validate(tables.Document, data, "", also=["include"])
        if document is None:
            # What is well-formed is validated all the same: all problems of a file come at once.
            document = tables.Document.model_construct(**_well_formed(data))
        simulation = self._single(tables.SimulationTable, document.simulation, "simulation")
        base = self._single(tables.SystemTable, document.system, "system")
        record = self._single(tables.RecordTable, document.record, "record")
        for sink in record.sinks if record else ():
            self.collect.find("sink", sink, "record.sinks")
        for kind, cls in _NETWORK.items():
            self._network(kind, cls, getattr(document, kind))
        S_base = base.S_base if base else 1.0
        for kind, add in (("infinite_bus", self._source), ("unit", self._unit), ("load", self._load)):
            self._each(kind, getattr(document, kind), lambda where, table, add=add: add(where, table, S_base))
        system = System(
            S_base=S_base,
            f_n=base.f_n if base else 1.0,
            buses=self.network["bus"],
            lines=self.network["line"],
            transformers=self.network["transformer"],
            shunts=self.network["shunt"],
            devices=tuple(self.devices),
            reference=simulation.reference if simulation else "auto",
        )
        sound = not self.collect.problems
        changes = self._events(document.event, system)
        controllers = self._controllers(document.controller, system, simulation.h if simulation else None)
        if sound:  # a table that did not validate would make these complain of what is only its consequence
            checks.check_islands(system, self.collect)
        if simulation is None or self.collect.problems:
            if simulation is not None:
                checks.check_reference(simulation.reference, system, self.collect)
            return None
        checks.check_reference(simulation.reference, system, self.collect)
        settings = Settings(**simulation.model_dump(exclude={"reference"}))
        resolved = {"title": document.title, "expect": document.expect, **self.resolved}
        sinks = tuple(record.sinks) if record else ()
        return Scenario(document.title, document.expect, system, settings, changes, controllers, sinks, resolved, path)

    def _single(self, cls: type[tables.Table], table: Any, name: str) -> Any:
        found = self.collect.validate(cls, table, name)
        if found is not None:
            self.resolved[name] = _plain(found)
        return found
