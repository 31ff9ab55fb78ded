"""What a solver must say of itself to be written as C."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.condensed import Condensed
from pgexcite.core.controller import Sample
from pgexcite.core.written import Numbers

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Input:
    """A field of the controller's input.

    Attributes:
        name: of the field.
        comment: what it is.
        size: number of elements; ``None`` for a number by itself.
        kind: type of the elements.
        elements: their names, listed in the header and counted there as ``N_<NAME>``; ``None`` where that would say nothing.
    """

    name: str
    comment: str
    size: int | None = None
    kind: Literal["double", "int"] = "double"
    elements: Sequence[str] | None = None

    @staticmethod
    def of(name: str, comment: str, elements: Sequence[str]) -> Input:
        """A field with a number for each of these elements."""
        return Input(name, comment, len(elements), elements=elements)


@dataclass(frozen=True)
class Parts:
    """The C of one solver, but for the quadratic program and the ladder.

    Attributes:
        about: what it does, for the head of the header; lines of 120 characters at the most.
        inputs: fields of the input, in order; ``u_last`` (the commands in force until the plan begins) and ``active`` (whether the
            controller is in charge) among them.
        record: values of the inputs, one after the other, from a sample and the commands in force.
        condensed: the quadratic program.
        functions: generated functions of the model, no more than are called.
        along: those among them that are called with several directions at a time.
        loops: files of ``core/c`` around them; see ``pgexcite.core.codegen.generate``.
        constants: what the templates are to know, by name; written as macros in capitals.
        arrays: constant arrays, by name.
        templates: text that goes below ``ladder.c``, in order; the last one has the public functions. ``${name}`` and
            ``${NAME}`` stand for the controller's name.
        tolerance: difference of a command, in its unit, and of what is told (relative where it is large), up to which the replay
            agrees with Python.
        told: names of numbers among a solution's diagnostics that the controller in C answers too, in its output's ``estimate``.
    """

    about: str
    inputs: Sequence[Input]
    record: Callable[[Sample, Array], Sequence[Array | float]]
    condensed: Condensed
    functions: Sequence[ca.Function]
    along: Sequence[ca.Function]
    loops: Sequence[str]
    constants: Mapping[str, object]
    arrays: Mapping[str, Numbers]
    templates: Sequence[str]
    tolerance: float
    told: Sequence[str] = ()


@runtime_checkable
class Exportable(Protocol):
    """A solver that can be written as C."""

    def parts(self, where: str, measured: Sequence[str]) -> Parts:
        """Its parts.

        Args:
            where: path of the controller in the configuration, for messages.
            measured: paths of what the controller measures, in the order in which a sample has them.

        Raises:
            ConfigError: something in its configuration cannot be exported.
        """
        ...
