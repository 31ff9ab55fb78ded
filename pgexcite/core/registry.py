"""The registry: models by role and name, found through the entry points of installed distributions.

Built-in models register exactly as a third party's do: an entry point in the role's group names a class. Nothing is imported until
it is asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pgexcite.core.errors import RegistryError

GROUPS = {
    "machine": "pgexcite.machines",
    "exciter": "pgexcite.exciters",
    "stabiliser": "pgexcite.stabilisers",
    "limiter": "pgexcite.limiters",
    "governor": "pgexcite.governors",
    "tap_changer": "pgexcite.tap_changers",
    "load": "pgexcite.loads",
    "source": "pgexcite.sources",
    "transfer": "pgexcite.transfers",
    "controller": "pgexcite.controllers",
    "estimator": "pgexcite.estimators",
    "mpc_backend": "pgexcite.mpc_backends",
    "sink": "pgexcite.sinks",
}
"""Entry-point group of every role."""

COMPONENT_ROLES = frozenset(
    {"machine", "exciter", "stabiliser", "limiter", "governor", "tap_changer", "load", "source", "transfer"}
)
"""Roles whose classes are components, with equations the kernel assembles."""


@dataclass(frozen=True)
class Registration:
    """One registered model.

    Attributes:
        role: the family.
        name: its name in a configuration.
        target: ``module:Class``.
        distribution: name and version of what registered it.
        error: why it cannot be used, or ``""``.
    """

    role: str
    name: str
    target: str
    distribution: str
    error: str = ""


def names(role: str) -> tuple[str, ...]:
    """Registered names of a role, sorted; nothing is imported.

    Raises:
        RegistryError: there is no such role.
    """
    return tuple(sorted(_entries(role)))


def find(role: str, name: str) -> type[Any]:
    """The class registered under a name.

    Raises:
        RegistryError: the role or name is unknown (the nearest is offered), is registered by two distributions, or its plugin
            cannot be loaded or is of the wrong kind.
    """
    registered = _entries(role)
    if name not in registered:
        raise RegistryError(f"no {role} is named {name!r}; {nearest(name, registered)}")
    found = registered[name]
    if len(found) > 1:
        owners = " and ".join(f"{_owner(item)} ({item.value})" for item in found)
        raise RegistryError(
            f"the {role} {name!r} is registered more than once, by {owners}; uninstall one of them, or rename its entry point"
        )
    return _load(role, found[0])


def registrations(role: str) -> Iterator[Registration]:
    """All registrations of a role, by name; nothing is imported."""
    for name, found in sorted(_entries(role).items()):
        for item in found:
            yield Registration(role, name, item.value, _owner(item))


def health() -> Iterator[Registration]:
    """Load every registered model and say which cannot be used, and why; one that is broken does not stop the others."""
    for role in GROUPS:
        for item in registrations(role):
            try:
                find(role, item.name)
            except RegistryError as problem:
                yield replace(item, error=str(problem))
            else:
                yield item


def refresh() -> None:
    """Look for installed distributions again (one may have been installed since)."""
    _entries.cache_clear()
    _load.cache_clear()


def nearest(name: str, known: Iterable[str]) -> str:
    """A hint for a name that is unknown: the nearest known one, and the list (its first twenty)."""
    options = sorted(known)
    if not options:
        return "none is known here"
    folded = {option.casefold(): option for option in options}
    close = get_close_matches(name.casefold(), folded, n=1, cutoff=0.5)
    listed = ", ".join(options[:20]) + (", ..." if len(options) > 20 else "")
    return (f"did you mean {folded[close[0]]!r}? " if close else "") + f"known: {listed}"


@cache
def _entries(role: str) -> dict[str, list[EntryPoint]]:
    if role not in GROUPS:
        raise RegistryError(f"there is no role {role!r}; {nearest(role, GROUPS)}")
    found: dict[str, list[EntryPoint]] = {}
    for item in entry_points(group=GROUPS[role]):
        found.setdefault(item.name, []).append(item)
    return found


@cache
def _load(role: str, item: EntryPoint) -> type[Any]:
    try:
        cls = item.load()
    except Exception as cause:  # importing someone else's module may raise anything
        raise RegistryError(
            f"the {role} {item.name!r} of {_owner(item)} cannot be loaded from {item.value}: {type(cause).__name__}: {cause}; "
            "repair or uninstall that distribution"
        ) from cause
    problem = _wrong_kind(role, cls)
    if problem:
        raise RegistryError(f"the {role} {item.name!r} of {_owner(item)} ({item.value}) {problem}")
    return cls


def _wrong_kind(role: str, cls: object) -> str:
    """Why an object cannot be a model of this role, or ``""``."""
    if not isinstance(cls, type):
        return f"is not a class but {cls!r}"
    if role not in COMPONENT_ROLES:
        return ""
    from pgexcite.core.component import Component  # it imports CasADi, which listing names does not need

    if not issubclass(cls, Component):
        return "is not a subclass of pgexcite.core.component.Component"
    if cls.role != role:
        return f"has the role {cls.role!r}; register it in the group {GROUPS.get(cls.role, 'of its role')!r} instead"
    return ""


def _owner(item: EntryPoint) -> str:
    return "an unknown distribution" if item.dist is None else f"{item.dist.name} {item.dist.version}"
