"""A symbol for every number of a system that may change: states, unknowns, discrete states, commands and parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from pgexcite.core.component import Component
from pgexcite.core.declare import Expr, Kind
from pgexcite.core.network import NetworkElement
from pgexcite.core.system import Device, System


@dataclass
class Table:
    """Named symbols of one kind, with the numbers and units that belong to them."""

    names: list[str] = field(default_factory=list)
    symbols: list[Expr] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def add(self, path: str, value: float = 0.0) -> Expr:
        symbol = ca.SX.sym(path)
        self.names.append(path)
        self.symbols.append(symbol)
        self.values.append(value)
        return symbol

    @property
    def vector(self) -> Expr:
        return ca.vertcat(*self.symbols) if self.symbols else ca.SX(0, 1)


class Symbols:
    """All symbols of a system.

    Attributes:
        x, z, d, u, p: those of the model's vectors, in order.
        units: of each, by path.
        h, omega_ref: step, s, and speed of the reference of rotor angles, pu.
        f_n: nominal frequency, Hz.
        voltage: ``(v_re, v_im)`` of each bus.
        bases: of each device, MVA, by path.
        own: by path of a component, what it declares, by name.
        copies: by path of a component, its copy whose parameters are symbols.
        elements: by path of a bus, branch or shunt, its parameters, by name.
    """

    def __init__(self, system: System) -> None:
        self.x, self.z, self.d, self.u, self.p = Table(), Table(), Table(), Table(), Table()
        self.units: dict[str, str] = {}
        self.h = ca.SX.sym("h")
        self.omega_ref = ca.SX.sym("omega_ref")
        self.f_n = self.p.add("system.f_n", system.f_n)
        self.units["system.f_n"] = "Hz"
        self.voltage: dict[str, tuple[Expr, Expr]] = {}
        self.bases: dict[str, Expr] = {}
        self.own: dict[str, dict[str, Expr]] = {}
        self.copies: dict[str, Component] = {}
        self.elements: dict[str, dict[str, Expr]] = {}
        for device in system.devices:
            self._declare(device)
        for name, bus in system.buses.items():
            self.voltage[name] = (self.z.add(f"bus.{name}.v_re"), self.z.add(f"bus.{name}.v_im"))
            self.units[f"bus.{name}.v_re"] = self.units[f"bus.{name}.v_im"] = "pu"
            self.elements[f"bus.{name}"] = self._parameters(f"bus.{name}", bus)
        for path, branch in system.branches().items():
            self.elements[path] = self._parameters(path, branch)
        for name, shunt in system.shunts.items():
            self.elements[f"shunt.{name}"] = self._parameters(f"shunt.{name}", shunt)

    def _parameters(self, path: str, of: Component | NetworkElement) -> dict[str, Expr]:
        symbols = {}
        for name in of.numeric_parameters():
            symbols[name] = self.p.add(f"{path}.{name}", getattr(of, name))
            extra = type(of).model_fields[name].json_schema_extra
            self.units[f"{path}.{name}"] = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
        return symbols

    def _declare(self, device: Device) -> None:
        self.bases[device.path] = self.p.add(f"{device.path}.S_n", device.S_n)
        self.units[f"{device.path}.S_n"] = "MVA"
        tables = {
            Kind.STATE: self.x,
            Kind.ALGEBRAIC: self.z,
            Kind.DISCRETE: self.d,
            Kind.SETPOINT: self.u,
            Kind.CONSTANT: self.p,
        }
        for slot, component in device.components.items():
            path = device.component_path(slot)
            self.copies[path] = component.with_symbols(self._parameters(path, component))
            own: dict[str, Expr] = {}
            for variable in component.variables(*tables):
                value = np.nan if variable.kind is Kind.CONSTANT else (variable.default or 0.0)
                own[variable.name] = tables[variable.kind].add(f"{path}.{variable.name}", value)
                self.units[f"{path}.{variable.name}"] = variable.unit
            own |= {item.name: ca.SX.sym(f"{path}.{item.name}") for item in component.variables(Kind.BEFORE)}
            self.own[path] = own
