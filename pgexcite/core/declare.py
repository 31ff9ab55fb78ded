"""Declarations a component is made of: parameters, states, ports and set-points.

A declaration carries a unit and a description, nothing else; the kernel turns it into a symbol. Parameters are pydantic
fields, so that a component class is its own configuration schema.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

from pydantic import Field

Expr = Any
"""A CasADi ``SX`` scalar or a number; equations do not care which."""


class Kind(Enum):
    """What a declared variable is to the kernel."""

    STATE = "state"
    ALGEBRAIC = "algebraic"
    DISCRETE = "discrete"
    INPUT = "input"
    OUTPUT = "output"
    SETPOINT = "setpoint"
    CONSTANT = "constant"
    BEFORE = "before"


class Variable:
    """A declared variable of a component class; the attribute's name is the variable's name.

    Attributes:
        kind: what the kernel makes of it.
        unit: its unit; one unit to a declaration.
        description: what it is, in a few words.
        default: value of an input that nothing drives (``None``: it must be driven), or initial value of a discrete state.
        guess: where the search for the steady state starts.
    """

    __slots__ = ("default", "description", "guess", "kind", "name", "unit")

    def __init__(
        self, kind: Kind, unit: str, description: str, default: float | None = None, guess: float = 0.0
    ) -> None:
        self.kind = kind
        self.unit = unit
        self.description = description
        self.default = default
        self.guess = guess
        self.name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __repr__(self) -> str:
        return f"{self.kind.value} {self.name} [{self.unit}]: {self.description}"


def par(
    default: Any,
    unit: str,
    description: str,
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    lt: float | None = None,
) -> Any:
    """Declare a parameter.

    A parameter annotated ``float`` becomes a symbol of the compiled functions: sweeping it recompiles nothing. One annotated
    ``int``, ``bool`` or ``Literal`` is a choice of structure and is baked in.

    Args:
        default: value when the configuration is silent; ``...`` makes it required.
        unit: its unit (``"pu"``, ``"s"``, ``"-"``); machine quantities are on the machine's own base.
        description: what it is.
        ge, gt, le, lt: bounds.
    """
    return Field(
        default,
        description=description,
        ge=ge,
        gt=gt,
        le=le,
        lt=lt,
        json_schema_extra={"unit": unit},
    )


def state(unit: str, description: str, guess: float = 0.0) -> Any:
    """Declare a continuous state (a row of ``M x' = f``)."""
    return Variable(Kind.STATE, unit, description, guess=guess)


def algebraic(unit: str, description: str, guess: float = 0.0) -> Any:
    """Declare an algebraic unknown; the component gives one residual for each."""
    return Variable(Kind.ALGEBRAIC, unit, description, guess=guess)


def discrete(unit: str, description: str, initial: float = 0.0) -> Any:
    """Declare a discrete state, renewed once per step by the component's ``update``."""
    return Variable(Kind.DISCRETE, unit, description, default=initial)


def port_in(unit: str, description: str, default: float | None = None) -> Any:
    """Declare an input port; ``default`` is its value when nothing drives it, ``None`` means that something must."""
    return Variable(Kind.INPUT, unit, description, default=default)


def port_out(unit: str, description: str) -> Any:
    """Declare an output port."""
    return Variable(Kind.OUTPUT, unit, description)


def setpoint(unit: str, description: str, guess: float = 0.0) -> Any:
    """Declare a set-point: a command the initialisation solves for and events or controllers change afterwards."""
    return Variable(Kind.SETPOINT, unit, description, guess=guess)


def before(unit: str, description: str) -> Any:
    """Declare a signal's value at the beginning of a step, after an event there; ``Equations.before`` gives the signal.

    Only ``update`` may use it: with the value at the end of the step it tells where within the step a threshold was crossed.
    """
    return Variable(Kind.BEFORE, unit, description)


def constant(unit: str, description: str, guess: float = 0.0) -> Any:
    """Declare a constant fixed by the initial point (a load's initial voltage); ``Equations.hold`` gives its value."""
    return Variable(Kind.CONSTANT, unit, description, guess=guess)
