"""The base of every component: a frozen, typed class that is at once configuration schema and equations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, model_validator

from pgexcite.core.blocks import Block, Dynamics
from pgexcite.core.declare import Expr, Kind, Variable


@dataclass(frozen=True)
class Equations:
    """What a component states.

    Attributes:
        ode: one dynamic row (or the block that holds it) per declared state, in any order.
        alg: residuals, zero at the solution; as many as the component declares algebraic unknowns.
        out: value of every declared output port.
        current: ``(i_re, i_im)`` injected into the bus, in per unit of the device's own base, for components with a terminal.
        update: next value of every declared discrete state, evaluated at the end of each step.
        before: for every signal declared with ``before`` what it is; ``update`` sees its value at the step's beginning.
        hold: value at the initial point of every declared constant, and of the set-points that the operating point leaves open.
    """

    ode: tuple[Block | Dynamics, ...] = ()
    alg: tuple[Expr, ...] = ()
    out: Mapping[str, Expr] = field(default_factory=dict)
    current: tuple[Expr, Expr] | None = None
    update: Mapping[str, Expr] = field(default_factory=dict)
    before: Mapping[str, Expr] = field(default_factory=dict)
    hold: Mapping[str, Expr] = field(default_factory=dict)

    def rows(self) -> tuple[Dynamics, ...]:
        """The dynamic rows, taken out of their blocks."""
        return tuple(item.dynamics if isinstance(item, Block) else item for item in self.ode)


class Signals:
    """Symbols by name: a component's own variables, and what its surroundings give it.

    Surroundings of every component: ``omega_ref`` (speed of the angle reference, pu), ``omega_0`` (nominal angular frequency,
    rad/s) and ``h`` (step length, s, for timers in ``update``). A component with a terminal also has ``v_re`` and ``v_im``,
    its bus voltage in the common frame, per unit.
    """

    def __init__(self, symbols: Mapping[str, Expr]) -> None:
        self.__dict__.update(symbols)

    def __getattr__(self, name: str) -> Expr:
        raise AttributeError(f"no signal {name!r} here; declared are: {', '.join(sorted(self.__dict__))}")


@dataclass(frozen=True)
class Terminal:
    """A device's steady state at its bus, as the power flow left it, in per unit of the device's own base.

    Attributes:
        v: bus voltage phasor, pu.
        i: current injected into the bus, pu.
    """

    v: complex
    i: complex

    @property
    def s(self) -> complex:
        """Apparent power delivered to the bus, pu."""
        return self.v * self.i.conjugate()


class Component(BaseModel):
    """A model that plugs into the kernel.

    A subclass declares parameters (``K_A: float = par(...)``), variables (``v_a = state(...)``) and one method, ``equations``.
    The kernel calls it with the parameters replaced by symbols.

    Class attributes:
        role: the family (``"machine"``); set by the family's base class.
        source: where the model is published: document, edition, figure.
        ordered: pairs of parameters that must satisfy ``first < second``.
        proper: pairs (lead, lag) of time constants; a zero lag with a lead has no realisation.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", ignored_types=(Variable,), arbitrary_types_allowed=True, allow_inf_nan=False
    )

    role: ClassVar[str] = ""
    source: ClassVar[str] = ""
    has_terminal: ClassVar[bool] = False
    ordered: ClassVar[tuple[tuple[str, str], ...]] = ()
    proper: ClassVar[tuple[tuple[str, str], ...]] = ()

    @model_validator(mode="after")
    def _check_pairs(self) -> Self:
        for low, high in self.ordered:
            if not getattr(self, low) < getattr(self, high):
                raise ValueError(f"{low} = {getattr(self, low)} must be below {high} = {getattr(self, high)}")
        for lead, lag in self.proper:
            if getattr(self, lag) == 0 and getattr(self, lead) != 0:
                raise ValueError(
                    f"{lead} = {getattr(self, lead)} needs {lag} > 0: a lead without a lag has no realisation"
                )
        return self

    def equations(self, v: Signals) -> Equations:
        """State the model once, as CasADi expressions of ``self``'s parameters and the symbols in ``v``."""
        raise NotImplementedError(f"{type(self).__name__} states no equations")

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        """Where the search for the steady state starts, by variable name; what is left out starts at its declared guess.

        Args:
            terminal: the device's terminal, in per unit of the device's base; ``None`` for a device without one.
            known: guesses of the device's signals made so far (the machine's come first: ``v_t``, ``e_fd``, ``i_fd``, ``t_m``).
        """
        return {}

    def remarks(self) -> tuple[str, ...]:
        """What is valid about its parameters and yet likely not meant, a sentence each."""
        return ()

    @property
    def longest_step(self) -> float:
        """Step, s, up to which its timers keep their pace; a prediction whose steps grow past it is refused."""
        return math.inf

    @classmethod
    def variables(cls, *kinds: Kind) -> tuple[Variable, ...]:
        """The declared variables of these kinds (all when none is given), base classes first, in order of declaration."""
        found = _variables(cls)
        return tuple(item for item in found if not kinds or item.kind in kinds)

    @classmethod
    def numeric_parameters(cls) -> tuple[str, ...]:
        """Names of the parameters that become symbols: those annotated ``float``."""
        return tuple(name for name, info in cls.model_fields.items() if info.annotation is float)

    def with_symbols(self, symbols: Mapping[str, Expr]) -> Self:
        """This component with parameters replaced by symbols; only the equations ever see such a copy."""
        return self.model_copy(update=dict(symbols))


@cache
def _variables(cls: type[Component]) -> tuple[Variable, ...]:
    # A state may carry the name of the output it drives (a machine's delta): both are kept.
    found: dict[tuple[str, bool], Variable] = {}
    for base in reversed(cls.__mro__):
        for name, item in vars(base).items():
            if isinstance(item, Variable):
                found[name, item.kind is Kind.OUTPUT] = item
    return tuple(found.values())


def describe_parameters(cls: type[BaseModel]) -> list[dict[str, Any]]:
    """Parameters of a component class, one record each: name, unit, default, bounds, description."""
    records = []
    for name, info in cls.model_fields.items():
        extra = info.json_schema_extra if isinstance(info.json_schema_extra, dict) else {}
        bounds = {
            key: getattr(item, key) for item in info.metadata for key in ("ge", "gt", "le", "lt") if hasattr(item, key)
        }
        records.append(
            {
                "name": name,
                "unit": extra.get("unit", ""),
                "default": None if info.is_required() else info.default,
                "required": info.is_required(),
                "bounds": bounds,
                "description": info.description or "",
            }
        )
    return records
