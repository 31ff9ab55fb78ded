"""The network and the devices of a scenario: from tables to records, components and power-flow schedules."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from math import inf, radians
from typing import Any

from pgexcite.core import registry
from pgexcite.core.component import Component
from pgexcite.core.config import tables
from pgexcite.core.config.validate import Collector, plain
from pgexcite.core.network import Bus, Line, Shunt, Transformer
from pgexcite.core.system import Device, Schedule

_NAME = re.compile(r"[\w-]+")
_NETWORK: dict[str, type[Any]] = {"bus": Bus, "line": Line, "transformer": Transformer, "shunt": Shunt}


class DeviceReader:
    """Reads table after table; what does not validate is left out, its problems noted.

    Attributes:
        network: records of buses, lines, transformers and shunts, by kind and name.
        devices: units, loads and sources.
        resolved: what every table says with all its defaults.
        broken: paths of tables that did not validate.
    """

    def __init__(self, document: tables.Document, S_base: float, collect: Collector) -> None:
        self.network: dict[str, dict[str, Any]] = {kind: {} for kind in _NETWORK}
        self.devices: list[Device] = []
        self.resolved: dict[str, Any] = {}
        self.broken: set[str] = set()
        self._buses = tuple(document.bus)
        self._S_base = S_base
        self._collect = collect
        readers: dict[str, Callable[[str, str, Mapping[str, Any]], dict[str, Any]]] = {
            **dict.fromkeys(_NETWORK, self._element),
            "transformer": self._transformer,
            "infinite_bus": self._source,
            "unit": self._unit,
            "load": self._load,
        }
        if not document.bus:
            collect.add("bus", "there is no bus", hint="declare one as [bus.NAME]")
        for kind, reader in readers.items():
            for name, table in getattr(document, kind).items():
                self._read(reader, kind, name, table)

    def _read(self, reader: Callable[..., dict[str, Any]], kind: str, name: str, table: Mapping[str, Any]) -> None:
        path, before = f"{kind}.{name}", len(self._collect.problems)
        if not _NAME.fullmatch(name):
            self._collect.add(path, "a name may hold letters, digits, _ and - only", name, "rename it")
        resolved = reader(kind, name, table)
        if len(self._collect.problems) > before:
            self.broken.add(path)
        self.resolved.setdefault(kind, {})[name] = resolved

    def _transformer(self, kind: str, name: str, table: Mapping[str, Any]) -> dict[str, Any]:
        """A transformer, with the tap changer that drives its ratio as a device at the bus whose voltage it holds."""
        path, slot = f"{kind}.{name}", tables.TAP_CHANGER
        own = {key: value for key, value in table.items() if key != slot}
        resolved = self._element(kind, name, own, also=[slot])
        filled = self._slot(table, slot, slot, None, path) if slot in table else None
        if filled is None or not resolved:
            return resolved
        model, component = filled
        bus = resolved[component.regulates]
        self.devices.append(Device(path, bus, self._S_base, {slot: component}, Schedule(P=0.0, Q=0.0)))
        return resolved | {slot: {"model": model, **plain(component)}}

    def _element(self, kind: str, name: str, table: Mapping[str, Any], *, also: Iterable[str] = ()) -> dict[str, Any]:
        path = f"{kind}.{name}"
        for end in ("bus", "from", "to"):
            if end in table:
                self._check_bus(table[end], f"{path}.{end}")
        element = self._collect.validate(_NETWORK[kind], table, path, also=also)
        if element is None:
            return {}
        self.network[kind][name] = element
        unsaid = {key for key in ("fault_status", "fault_R", "fault_X") if key not in element.model_fields_set}
        return {key: value for key, value in plain(element).items() if key not in unsaid}

    def _source(self, kind: str, name: str, table: Mapping[str, Any]) -> dict[str, Any]:
        said, model = self._at_bus("source", tables.InfiniteBusTable, table, f"{kind}.{name}")
        if said is None or model is None:
            return {}
        schedule = Schedule(V=said.V, angle=radians(said.angle_deg))
        self.devices.append(Device(f"{kind}.{name}", said.bus, self._S_base, {"": model}, schedule))
        return plain(said) | plain(model)

    def _load(self, kind: str, name: str, table: Mapping[str, Any]) -> dict[str, Any]:
        path = f"{kind}.{name}"
        said, model = self._at_bus("load", tables.LoadTable, table, path)
        if said is None or model is None:
            return {}
        if not {"P", "Q"} <= set(model.numeric_parameters()):
            self._collect.add(
                f"{path}.model", "a load's class must have the parameters P [MW] and Q [Mvar]", said.model
            )
            return {}
        self.devices.append(Device(path, said.bus, self._S_base, {"": model}, Schedule(P=-model.P, Q=-model.Q)))
        return plain(said) | plain(model)

    def _at_bus(self, role: str, cls: type[tables.Table], table: Mapping[str, Any], path: str) -> tuple[Any, Any]:
        """What a table says of a device of one component, and the component, whose parameters stand beside it."""
        own = {key: value for key, value in table.items() if key in cls.model_fields}
        said: Any = self._collect.validate(cls, own, path)
        if said is None:
            return None, None
        self._check_bus(said.bus, f"{path}.bus")
        rest = {key: value for key, value in table.items() if key not in own}
        return said, self._component(role, said.model, rest, path, also=cls.model_fields)

    def _unit(self, kind: str, name: str, table: Mapping[str, Any]) -> dict[str, Any]:
        path = f"{kind}.{name}"
        own = {key: value for key, value in table.items() if key not in tables.SLOTS}
        said = self._collect.validate(tables.UnitTable, own, path, also=tables.SLOTS)
        components: dict[str, Component] = {}
        resolved: dict[str, Any] = {}
        for slot, role, default in _slots(table):
            filled = self._slot(table, slot, role, default, path)
            if filled is not None:
                model, components[slot] = filled
                _store(resolved, slot.split("."), {"model": model, **plain(components[slot])})
        if said is None:
            return {}
        self._check_bus(said.bus, f"{path}.bus")
        schedule = self._schedule(said, path)
        self.devices.append(Device(path, said.bus, said.S_n, components, schedule))
        return plain(said) | resolved

    def _slot(
        self, table: Mapping[str, Any], slot: str, role: str, default: str | None, path: str
    ) -> tuple[str, Any] | None:
        """A slot's model by name and the component that fills it."""
        content: Any = table
        for key in slot.split("."):
            content = content.get(key, {})
        where = f"{path}.{slot}"
        if not isinstance(content, dict):
            self._collect.add(where, "should be a table with a model and its parameters", content)
            return None
        model = content.get("model", default)
        if model is None:
            self._collect.add(f"{where}.model", "is required", hint=registry.nearest("", registry.names(role)))
            return None
        rest = {key: value for key, value in content.items() if key != "model"}
        component = self._component(role, model, rest, where, also=["model"])
        return None if component is None else (model, component)

    def _component(
        self, role: str, name: object, table: Mapping[str, Any], path: str, *, also: Any
    ) -> Component | None:
        cls = self._collect.find(role, name, f"{path}.model")
        return None if cls is None else self._collect.validate(cls, table, path, also=also)

    def _schedule(self, said: tables.UnitTable, path: str) -> Schedule:
        """What the power flow is told of a unit; notes what is too much and what is missing."""
        add = self._collect.add
        limits = {
            "Q_min": -inf if said.Q_min is None else said.Q_min,
            "Q_max": inf if said.Q_max is None else said.Q_max,
        }
        if limits["Q_min"] > limits["Q_max"]:
            add(f"{path}.Q_min", f"must not exceed Q_max = {said.Q_max:g} Mvar", said.Q_min)
        if said.slack:
            for key in ("P", "Q"):
                if getattr(said, key) is not None:
                    add(
                        f"{path}.{key}",
                        "a slack's power follows from the power flow",
                        getattr(said, key),
                        f"leave {key} out",
                    )
            if said.V is None:
                add(f"{path}.V", "is required of a slack: terminal voltage held, pu")
            return Schedule(V=said.V, angle=radians(said.angle_deg or 0.0), **limits)
        if said.P is None:
            add(f"{path}.P", "is required of a unit that is no slack: active power delivered, MW")
        if said.V is None and said.Q is None:
            add(f"{path}.V", "V (pu) or Q (Mvar) is required of a unit that is no slack")
        if said.angle_deg is not None:
            add(
                f"{path}.angle_deg",
                "only a slack's angle can be given",
                said.angle_deg,
                "leave it out, or set slack = true",
            )
        return Schedule(P=said.P, Q=said.Q, V=said.V, **limits)

    def _check_bus(self, bus: object, path: str) -> None:
        if isinstance(bus, str):  # anything else is the schema's complaint
            self._collect.known("bus", bus, self._buses, path)


def _slots(table: Mapping[str, Any]) -> list[tuple[str, str, str | None]]:
    """Slots to fill, as (slot, role, default model): those that are required, have a default or are in the table."""
    found: list[tuple[str, str, str | None]] = []
    for slot, default in tables.SLOTS.items():
        content = table.get(slot)
        if content is None and default is None and slot != "machine":
            continue
        if slot == "limiter" and isinstance(content, dict) and content and not _is_model(content):
            found += [(f"limiter.{name}", "limiter", None) for name in content]
        else:
            found.append((slot, slot, default))
    return found


def _is_model(table: Mapping[str, Any]) -> bool:
    return "model" in table or not all(isinstance(value, dict) for value in table.values())


def _store(data: dict[str, Any], parts: list[str], value: dict[str, Any]) -> None:
    for part in parts[:-1]:
        data = data.setdefault(part, {})
    data[parts[-1]] = value
