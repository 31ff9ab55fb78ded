"""A controller's own model of the grid: the nameplate data, with whatever is known or believed to be different.

It is assembled from the same components as the plant: a mismatch is another parameter, never a second copy of the equations.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pgexcite.core import registry
from pgexcite.core.config.checks import adjustable, siblings
from pgexcite.core.config.validate import Collector
from pgexcite.core.controller import Surroundings
from pgexcite.core.errors import ConfigError
from pgexcite.core.initialise import Initial, initialise
from pgexcite.core.step import Kernel
from pgexcite.core.system import System


def own_model(surroundings: Surroundings, overrides: Mapping[str, float], where: str) -> tuple[Initial, Kernel]:
    """A model of one's own at its steady state, and a kernel for it.

    Args:
        surroundings: what every controller is told; the grid as configured is taken from it.
        overrides: parameter path (``line.L1.X``, ``unit.G2.machine.H``) -> value that replaces the nameplate's.
        where: path of the overrides in the configuration, for messages.

    Raises:
        ConfigError: an override names no parameter, or its value is not valid there.
        PowerFlowError, InitialisationError: the model has no steady state at the operating point as configured.
    """
    initial = initialise(overridden(surroundings.system, overrides, where))
    return initial, Kernel(initial.model, initial.state, initial.p, surroundings.compile)


def overridden(system: System, overrides: Mapping[str, float], where: str) -> System:
    """The system with some parameters replaced, each validated by the record it belongs to.

    Raises:
        ConfigError: with every override that names no parameter or has a value that is not valid there.
    """
    if not overrides:
        return system
    collect = Collector()
    targets = {path: target for path, target in adjustable(system).items() if target is not None}
    changed: dict[str, dict[str, float]] = {}
    for path, value in overrides.items():
        if path in targets:
            owner, name = path.rpartition(".")[0], targets[path][1]
            changed.setdefault(owner, {})[name] = value
        else:
            collect.add(
                f"{where}.{path}", "there is no such parameter", value, registry.nearest(path, siblings(path, targets))
            )
    records = {path.rpartition(".")[0]: record for path, (record, _) in targets.items()}
    fresh: dict[str, Any] = {}
    for owner, values in changed.items():
        cls = type(records[owner])
        said = {cls.model_fields[name].alias or name: value for name, value in values.items()}
        fresh[owner] = collect.validate(cls, records[owner].model_dump(by_alias=True) | said, f"{where}.{owner}")
    if collect.problems:
        raise ConfigError(collect.problems)

    def network(kind: str, items: Mapping[str, Any]) -> dict[str, Any]:
        return {name: fresh.get(f"{kind}.{name}", item) for name, item in items.items()}

    return replace(
        system,
        buses=network("bus", system.buses),
        lines=network("line", system.lines),
        transformers=network("transformer", system.transformers),
        shunts=network("shunt", system.shunts),
        devices=tuple(
            replace(
                device,
                components={
                    slot: fresh.get(device.component_path(slot), component)
                    for slot, component in device.components.items()
                },
            )
            for device in system.devices
        ),
    )
