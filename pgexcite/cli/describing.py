"""What can be said of a model: its documentation, parameters and variables."""

from __future__ import annotations

import inspect
from typing import Any

from pydantic import BaseModel

from pgexcite.core import registry
from pgexcite.core.component import Component, describe_parameters
from pgexcite.core.errors import RegistryError


def describe_model(name: str) -> list[dict[str, Any]]:
    """Descriptions of every model of this name (``"st1a"``, or ``"exciter.st1a"`` for one role only).

    Raises:
        RegistryError: there is none, or it cannot be loaded.
    """
    role, dot, short = name.partition(".")
    if dot:
        return [_describe(role, short)]
    roles = [role for role in registry.GROUPS if name in registry.names(role)]
    if not roles:
        known = [known for role in registry.GROUPS for known in registry.names(role)]
        raise RegistryError(f"no model is named {name!r}; {registry.nearest(name, known)}")
    return [_describe(role, name) for role in roles]


def _describe(role: str, name: str) -> dict[str, Any]:
    cls = registry.find(role, name)
    owner = next(item for item in registry.registrations(role) if item.name == name)
    return {
        "role": role,
        "name": name,
        "class": f"{cls.__module__}.{cls.__qualname__}",
        "distribution": owner.distribution,
        "description": inspect.getdoc(cls) or "",
        "source": getattr(cls, "source", ""),
        "parameters": [_parameter(cls, record) for record in describe_parameters(cls)]
        if issubclass(cls, BaseModel)
        else [],
        "variables": _variables(cls) if issubclass(cls, Component) else [],
    }


def _parameter(cls: type[BaseModel], record: dict[str, Any]) -> dict[str, Any]:
    info = cls.model_fields[record["name"]]
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    bounds = ", ".join(f"{signs[key]} {value:g}" for key, value in record["bounds"].items() if value is not None)
    return {
        "name": record["name"],
        "unit": record["unit"],
        "default": "required" if info.is_required() else info.get_default(call_default_factory=True),
        "bounds": bounds,
        "description": record["description"],
    }


def _variables(cls: type[Component]) -> list[dict[str, Any]]:
    return [
        {"name": item.name, "kind": item.kind.value, "unit": item.unit, "description": item.description}
        for item in cls.variables()
    ]
