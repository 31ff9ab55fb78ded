"""The project's exceptions: one tree, and every message says what, where, the value, what was expected and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

_LONGEST = 120
"""Characters shown of a value; a table where a number should be would bury its message."""


class PgexciteError(Exception):
    """Base of every error this package raises on purpose."""


@dataclass(frozen=True)
class Problem:
    """One thing wrong with an input.

    Attributes:
        path: where, as in the configuration (``unit.G2.exciter.K_A``).
        message: what is wrong and what was expected.
        value: what stood there, or ``None`` where nothing did.
        hint: what to do next (for instance the nearest valid name), or ``""``.
    """

    path: str
    message: str
    value: object = None
    hint: str = ""

    def __str__(self) -> str:
        text = repr(self.value)
        text = text if len(text) <= _LONGEST else f"{text[: _LONGEST - 4]} ..."
        shown = "" if self.value is None else f" (got {text})"
        hint = f"; {self.hint}" if self.hint else ""
        return f"{self.path}: {self.message}{shown}{hint}"


class _ProblemsError(PgexciteError):
    """An error that carries every problem found, not only the first."""

    title = "problems"

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        lines = "\n".join(f"  - {problem}" for problem in self.problems)
        super().__init__(f"{self.title}:\n{lines}")


class ConfigError(_ProblemsError):
    """The configuration is not valid; ``problems`` holds all that is wrong with it."""

    title = "the configuration is not valid"


class InitialisationError(_ProblemsError):
    """No steady state within the limits exists at the operating point that was asked for."""

    title = "the initial operating point cannot be reached"


class PowerFlowError(InitialisationError):
    """The power flow has no solution or did not converge; the problems name the buses to blame."""

    title = "the power flow failed"


class RegistryError(PgexciteError):
    """A model name is unknown, is registered twice, or its plugin cannot be loaded."""


class AssemblyError(PgexciteError):
    """Components do not fit together: an algebraic loop, two drivers of one signal, an undeclared output."""


class SnapshotError(PgexciteError):
    """A saved state does not belong to this model or cannot be read."""
