"""Judge and run field-excitation controllers of synchronous generators on a realistic grid.

The public names are loaded when they are first used, so that importing the package stays cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pgexcite.core.config import Scenario, load
    from pgexcite.core.errors import ConfigError, InitialisationError, PgexciteError, PowerFlowError, RegistryError
    from pgexcite.core.events import Change
    from pgexcite.core.linearise import linearise
    from pgexcite.core.settings import Settings
    from pgexcite.core.simulate import Simulation
    from pgexcite.core.system import Device, Schedule, System
    from pgexcite.core.trace import Ending, Outcome, Trace

__version__ = "0.1.0"

_HOME = {
    "Change": "events",
    "ConfigError": "errors",
    "Device": "system",
    "Ending": "trace",
    "InitialisationError": "errors",
    "Outcome": "trace",
    "PgexciteError": "errors",
    "PowerFlowError": "errors",
    "RegistryError": "errors",
    "Scenario": "config",
    "Schedule": "system",
    "Settings": "settings",
    "Simulation": "simulate",
    "System": "system",
    "Trace": "trace",
    "linearise": "linearise",
    "load": "config",
}

__all__ = [
    "Change",
    "ConfigError",
    "Device",
    "Ending",
    "InitialisationError",
    "Outcome",
    "PgexciteError",
    "PowerFlowError",
    "RegistryError",
    "Scenario",
    "Schedule",
    "Settings",
    "Simulation",
    "System",
    "Trace",
    "linearise",
    "load",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pgexcite.core.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
