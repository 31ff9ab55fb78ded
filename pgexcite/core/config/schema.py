"""The JSON Schema of scenario files, for editors that complete and check them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, TypeAdapter

from pgexcite.core import registry
from pgexcite.core.config import tables
from pgexcite.core.errors import RegistryError
from pgexcite.core.events import Event
from pgexcite.core.network import Bus, Line, Shunt, Transformer

_BESIDE: dict[str, tuple[str, type[tables.Table]]] = {
    "infinite_bus": ("source", tables.InfiniteBusTable),
    "load": ("load", tables.LoadTable),
}


def json_schema() -> dict[str, Any]:
    """Schema of a scenario file with every registered model; one that cannot be loaded is left out."""
    definitions: dict[str, Any] = {}

    def refer(name: str, schema: dict[str, Any]) -> dict[str, Any]:
        definitions.update(schema.pop("$defs", {}))
        definitions[name] = schema
        return {"$ref": f"#/$defs/{name}"}

    def models(role: str, own: type[tables.Table] | None = None) -> dict[str, Any]:
        """Any model of a role; ``own`` has the keys of the table that stand beside the model's."""
        return {"anyOf": [refer(f"{role}.{name}", _model(cls, name, own)) for name, cls in _loadable(role)]}

    top = tables.Document.model_json_schema()
    properties = top["properties"]
    for name, cls in (
        ("simulation", tables.SimulationTable),
        ("system", tables.SystemTable),
        ("record", tables.RecordTable),
    ):
        properties[name] = refer(name, cls.model_json_schema())
    for name, element in (("bus", Bus), ("line", Line), ("transformer", Transformer), ("shunt", Shunt)):
        schema = element.model_json_schema()
        if element is Transformer:
            schema["properties"][tables.TAP_CHANGER] = models(tables.TAP_CHANGER)
        properties[name] = _by_name(refer(name, schema))
    for name, (role, own) in _BESIDE.items():
        properties[name] = _by_name(models(role, own))
    unit = tables.UnitTable.model_json_schema()
    for slot in tables.SLOTS:
        slot_models = models(slot)
        unit["properties"][slot] = {"anyOf": [slot_models, _by_name(slot_models)]} if slot == "limiter" else slot_models
    unit["required"] = [*unit.get("required", []), "machine"]
    properties["unit"] = _by_name(refer("unit", unit))
    properties["event"] = {
        "type": "array",
        "items": refer("event", TypeAdapter(Event).json_schema(ref_template="#/$defs/{model}")),
    }
    properties["controller"] = _by_name(models("controller"))
    properties["include"] = {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}}]}
    top["required"] = ["simulation", "system", "bus"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **top, "$defs": definitions}


def _loadable(role: str) -> Iterable[tuple[str, type[BaseModel]]]:
    for name in registry.names(role):
        try:
            cls = registry.find(role, name)
        except RegistryError:
            continue
        if issubclass(cls, BaseModel):
            yield name, cls


def _model(cls: type[BaseModel], name: str, own: type[tables.Table] | None) -> dict[str, Any]:
    schema = cls.model_json_schema(ref_template="#/$defs/{model}")
    table: dict[str, Any] = own.model_json_schema() if own else {"properties": {}, "required": ["model"]}
    schema["properties"] = table["properties"] | {"model": {"const": name}} | schema.get("properties", {})
    schema["required"] = [*table.get("required", []), *schema.get("required", [])]
    return schema


def _by_name(schema: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "additionalProperties": schema}
