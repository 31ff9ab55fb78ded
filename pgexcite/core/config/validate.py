"""Validation that collects every problem instead of stopping at the first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from pgexcite.core import registry
from pgexcite.core.errors import Problem, RegistryError

M = TypeVar("M", bound=BaseModel)


class Collector:
    """Problems of a scenario, collected while it is read.

    Attributes:
        problems: all found so far.
    """

    def __init__(self) -> None:
        self.problems: list[Problem] = []

    def add(self, path: str, message: str, value: object = None, hint: str = "") -> None:
        """Note one problem."""
        self.problems.append(Problem(path, message, value, hint))

    def validate(
        self, cls: type[M], data: object, path: str, *, also: Iterable[str] = (), strict: bool | None = True
    ) -> M | None:
        """An instance of ``cls``, or ``None`` with its problems noted below ``path``.

        Args:
            cls: the schema.
            data: what the file says.
            path: where it says so.
            also: keys that are valid in this table though not part of the schema, for the nearest name.
            strict: whether text may stand for a number (``None``: the schema decides).
        """
        try:
            return cls.model_validate(data, strict=strict)
        except ValidationError as error:
            for item in error.errors(include_url=False):
                self.problems.append(_translate(item, cls, path, also))
        return None

    def find(self, role: str, name: object, path: str) -> type[Any] | None:
        """The registered class, or ``None`` with the problem noted."""
        known = registry.names(role)
        if not isinstance(name, str) or name not in known:
            hint = registry.nearest(str(name), known)
            self.add(path, f"there is no such {role.replace('_', ' ')}", name, hint)
            return None
        try:
            return registry.find(role, name)
        except RegistryError as error:
            self.add(path, str(error), name)
        return None

    def known(self, what: str, name: object, options: Iterable[str], path: str) -> bool:
        """Whether a name is among the known ones; notes a problem where it is not."""
        options = tuple(options)
        if name in options:
            return True
        self.add(path, f"there is no such {what}", name, registry.nearest(str(name), options))
        return False


def _translate(error: Mapping[str, Any], cls: type[BaseModel], path: str, also: Iterable[str]) -> Problem:
    """One of pydantic's errors as ours."""
    loc, value = error["loc"], error["input"]
    where = ".".join([path, *map(str, loc)] if path else map(str, loc))
    siblings, field = _place(cls, loc)
    meaning = (field.description or "") if field else ""
    extra = field.json_schema_extra if field else None
    unit = f" [{extra['unit']}]" if isinstance(extra, dict) and "unit" in extra else ""
    if error["type"] == "extra_forbidden":
        known = [*siblings, *also] if len(loc) == 1 else siblings
        return Problem(where, "unknown key", value, registry.nearest(str(loc[-1]), known) if known else "remove it")
    if error["type"] == "missing":
        return Problem(where, f"is required{': ' * bool(meaning)}{meaning}{unit}")
    if error["type"] == "value_error":
        return Problem(where, str(error["ctx"]["error"]), None if isinstance(value, dict) else value)
    message = str(error["msg"]).removeprefix("Input ")
    return Problem(where, message, value, f"it is the {meaning}{unit}" if meaning else "")


def _place(cls: type[BaseModel], loc: Iterable[str | int]) -> tuple[list[str], FieldInfo | None]:
    """Keys of the innermost table a location leads into, and the field it leads to there, if any."""
    kind: Any = cls
    keys: list[str] = []
    field: FieldInfo | None = None
    for part in loc:
        inner = [item for item in get_args(kind) if item not in (Ellipsis, NoneType)]
        if get_origin(kind) in (Union, UnionType) and len(inner) == 1:
            kind = inner[0]
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            fields = {info.alias or name: info for name, info in kind.model_fields.items()}
            keys, field = list(fields), fields.get(str(part))
            kind = field.annotation if field else None
        else:  # the name of an entry, its number, or one of the kinds a value may have
            keys, kind = [], inner[-1] if inner else None
    return keys, field


def plain(record: BaseModel) -> dict[str, Any]:
    """A record as data that TOML can hold, under the names the file uses; what is not set (``None``) is left out."""
    return record.model_dump(mode="json", by_alias=True, exclude_none=True)
