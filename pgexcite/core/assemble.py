"""From components to one set of equations: symbols, wiring inside devices, Kirchhoff's current law at the buses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import casadi as ca
import numpy as np

from pgexcite.core.blocks import Dynamics, Limit, limits_released, magnitude
from pgexcite.core.component import Component, Equations, Signals
from pgexcite.core.declare import Expr, Kind
from pgexcite.core.model import Model, require
from pgexcite.core.network import NetworkElement, complex_product
from pgexcite.core.system import Device, System

_TURN = 0.37
"""Real part of what the currents of a bus are multiplied with; any number that is not a ratio of admittances does."""
_LEAK = 1e-12
"""Conductance to earth at every bus, pu: far below the residual that is accepted."""


@dataclass
class _Table:
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


@dataclass(frozen=True)
class Stated:
    """A device's equations with its inputs wired, in terms of its own symbols, its bus voltage and the reference speed.

    Attributes:
        rows: ``(path, Dynamics)`` of each state, in the order of ``x``.
        alg: ``(path, residual)`` of each algebraic unknown.
        outputs: port name -> expression, of all components together.
        current: injected current in per unit of the device's base.
        updates: ``(path, expression)`` of each discrete state.
        befores: of each signal that ``updates`` want from the step's beginning, its symbol there and what it is.
        holds: ``(path, expression)`` of each constant of the initial point.
        limits: windup limits met, when stated with limits released, with the path of their component.
    """

    rows: tuple[tuple[str, Dynamics], ...]
    alg: tuple[tuple[str, Expr], ...]
    outputs: Mapping[str, Expr]
    current: tuple[Expr, Expr]
    updates: tuple[tuple[str, Expr], ...]
    befores: tuple[tuple[Expr, Expr], ...]
    holds: tuple[tuple[str, Expr], ...]
    limits: tuple[tuple[str, Limit], ...] = ()


class Symbols:
    """All symbols of a system, and the way from a device to its stated equations."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.x, self.z, self.d, self.u, self.p = _Table(), _Table(), _Table(), _Table(), _Table()
        self.units: dict[str, str] = {}
        self.h = ca.SX.sym("h")
        self.omega_ref = ca.SX.sym("omega_ref")
        self.f_n = self.p.add("system.f_n", system.f_n)
        self.units["system.f_n"] = "Hz"
        self.voltage: dict[str, tuple[Expr, Expr]] = {}
        self._own: dict[str, dict[str, Expr]] = {}
        self._copies: dict[str, Component] = {}
        self._base: dict[str, Expr] = {}
        self._network: dict[str, dict[str, Expr]] = {}
        for device in system.devices:
            self._declare(device)
        for name, bus in system.buses.items():
            self.voltage[name] = (self.z.add(f"bus.{name}.v_re"), self.z.add(f"bus.{name}.v_im"))
            self.units[f"bus.{name}.v_re"] = self.units[f"bus.{name}.v_im"] = "pu"
            self._declare_element(f"bus.{name}", bus)
        for path, branch in system.branches().items():
            self._declare_element(path, branch)
        for name, shunt in system.shunts.items():
            self._declare_element(f"shunt.{name}", shunt)

    def _declare_element(self, path: str, element: NetworkElement) -> None:
        names = element.numeric_parameters()
        self._network[path] = {name: self.p.add(f"{path}.{name}", getattr(element, name)) for name in names}
        for name in names:
            extra = type(element).model_fields[name].json_schema_extra
            self.units[f"{path}.{name}"] = str(extra.get("unit", "")) if isinstance(extra, dict) else ""

    def element(self, path: str) -> dict[str, Expr]:
        """Symbols of a network element's parameters."""
        return self._network[path]

    def base(self, device: Device) -> Expr:
        """Symbol of a device's base, MVA."""
        return self._base[device.path]

    def parameters_of(self, path: str) -> Component:
        """The copy of a component whose parameters are symbols."""
        return self._copies[path]

    def _declare(self, device: Device) -> None:
        self._base[device.path] = self.p.add(f"{device.path}.S_n", device.S_n)
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
            symbols: dict[str, Expr] = {}
            for name in component.numeric_parameters():
                symbols[name] = self.p.add(f"{path}.{name}", getattr(component, name))
                extra = type(component).model_fields[name].json_schema_extra
                self.units[f"{path}.{name}"] = str(extra.get("unit", "")) if isinstance(extra, dict) else ""
            self._copies[path] = component.with_symbols(symbols)
            own: dict[str, Expr] = {}
            for variable in component.variables(*tables):
                value = np.nan if variable.kind is Kind.CONSTANT else (variable.default or 0.0)
                own[variable.name] = tables[variable.kind].add(f"{path}.{variable.name}", value)
                self.units[f"{path}.{variable.name}"] = variable.unit
            own |= {item.name: ca.SX.sym(f"{path}.{item.name}") for item in component.variables(Kind.BEFORE)}
            self._own[path] = own

    def state(self, device: Device, *, released: bool = False) -> Stated:
        """Write a device's equations, with its windup limits in force or released.

        Raises:
            AssemblyError: an input nothing drives, two drivers of one signal, an algebraic loop, or a component that states other
                equations than it declares.
        """
        inputs: dict[str, list[Expr]] = {}
        stated: dict[str, Equations] = {}
        limits: list[tuple[str, Limit]] = []
        outputs: dict[str, Expr] = {}
        for slot, component in device.components.items():
            path = device.component_path(slot)
            equations, met = self._write(device, path, component, inputs, released)
            _check_declared(path, component, equations)
            stated[path] = equations
            limits += [(path, limit) for limit in met]
            for port, value in equations.out.items():
                if port in outputs:
                    _put_in_series(device, path, port, inputs, outputs)
                outputs[port] = value
        substitute = _wiring(device, inputs, outputs)
        rows, alg, updates, befores, holds = [], [], [], [], []
        current = (ca.SX(0), ca.SX(0))
        for path, equations in stated.items():
            own = self._own[path]
            by_symbol = {row.state.element_hash(): row for row in equations.rows()}
            component = self._copies[path]
            for item in component.variables(Kind.STATE):
                require(
                    own[item.name].element_hash() in by_symbol, f"{path}: no row is stated for the state {item.name}"
                )
            rows += [
                (f"{path}.{item.name}", _substituted(by_symbol[own[item.name].element_hash()], substitute))
                for item in component.variables(Kind.STATE)
            ]
            names = [item.name for item in component.variables(Kind.ALGEBRAIC)]
            alg += [(f"{path}.{n}", substitute(e)) for n, e in zip(names, equations.alg, strict=True)]
            updates += [
                (f"{path}.{i.name}", substitute(equations.update[i.name])) for i in component.variables(Kind.DISCRETE)
            ]
            befores += [(own[name], substitute(signal)) for name, signal in equations.before.items()]
            holds += [(f"{path}.{name}", substitute(value)) for name, value in equations.hold.items()]
            if equations.current is not None:
                current = (substitute(equations.current[0]), substitute(equations.current[1]))
        wired = {port: substitute(value) for port, value in outputs.items() if "<" not in port}
        bounded = tuple(
            (path, Limit(item.label, substitute(item.signal), substitute(item.lower), substitute(item.upper)))
            for path, item in limits
        )
        return Stated(tuple(rows), tuple(alg), wired, current, tuple(updates), tuple(befores), tuple(holds), bounded)

    def _write(
        self, device: Device, path: str, component: Component, inputs: dict[str, list[Expr]], released: bool
    ) -> tuple[Equations, list[Limit]]:
        known = dict(self._own[path])
        for variable in component.variables(Kind.INPUT):
            symbol = ca.SX.sym(f"{path}.{variable.name}")
            known[variable.name] = symbol
            inputs.setdefault(variable.name, []).append((path, symbol, variable.default))
        known |= {
            "omega_ref": self.omega_ref,
            "omega_0": 2 * np.pi * self.f_n,
            "h": self.h,
            "S_n": self._base[device.path],
        }
        if component.has_terminal:
            known["v_re"], known["v_im"] = self.voltage[device.bus]
        if device.path in self._network:
            known["tap"] = self._network[device.path]["tap"]
        copy = self._copies[path]
        if not released:
            return copy.equations(Signals(known)), []
        with limits_released() as met:
            equations = copy.equations(Signals(known))
        return equations, met


def _check_declared(path: str, component: Component, equations: Equations) -> None:
    """A component must state one equation for each thing it declares."""
    declared = {kind: [item.name for item in component.variables(kind)] for kind in Kind}
    rows = len(equations.rows())
    require(
        rows == len(declared[Kind.STATE]),
        f"{path}: {len(declared[Kind.STATE])} states are declared, {rows} rows are stated",
    )
    count = len(declared[Kind.ALGEBRAIC])
    require(
        len(equations.alg) == count,
        f"{path}: {count} algebraic unknowns are declared, {len(equations.alg)} residuals are stated",
    )
    held = {name: value for name, value in equations.hold.items() if name not in declared[Kind.SETPOINT]}
    mappings = {Kind.OUTPUT: equations.out, Kind.DISCRETE: equations.update, Kind.BEFORE: equations.before}
    for kind, stated in (*mappings.items(), (Kind.CONSTANT, held)):
        missing, extra = set(declared[kind]) - set(stated), set(stated) - set(declared[kind])
        require(not missing, f"{path}: {kind.value} {', '.join(sorted(missing))} declared but not stated")
        require(not extra, f"{path}: {kind.value} {', '.join(sorted(extra))} stated but not declared")
    require(
        not component.has_terminal or equations.current is not None, f"{path}: has a terminal but states no current"
    )


def _put_in_series(
    device: Device,
    path: str,
    port: str,
    inputs: dict[str, list[tuple[str, Expr, float | None]]],
    outputs: dict[str, Expr],
) -> None:
    """A component that both reads and drives a signal stands in series: it sees what the one before it drives."""
    own = [user for user in inputs.get(port, []) if user[0] == path]
    require(bool(own), f"{device.path}: two components drive {port!r}; leave one out")
    inner = f"{port}<{path}"
    inputs[port] = [user for user in inputs[port] if user[0] != path]
    inputs[inner] = own
    outputs[inner] = outputs[port]


def _wiring(
    device: Device, inputs: Mapping[str, list[tuple[str, Expr, float | None]]], outputs: Mapping[str, Expr]
) -> Callable[[Expr], Expr]:
    """A function that replaces the input placeholders of a device by what drives them."""
    placeholders: dict[int, str] = {}
    for port, users in inputs.items():
        for path, symbol, default in users:
            require(
                port in outputs or default is not None,
                f"{path}: nothing in {device.path} drives its input {port!r}; add a component with that output",
            )
            placeholders[symbol.element_hash()] = port
    defaults = {port: next((d for _, _, d in users if d is not None), 0.0) for port, users in inputs.items()}
    resolved: dict[str, Expr] = {}
    pending: list[str] = []

    def value(port: str) -> Expr:
        if port not in outputs:
            return ca.SX(defaults[port])
        if port in resolved:
            return resolved[port]
        require(
            port not in pending, f"{device.path}: algebraic loop through the signals {' -> '.join([*pending, port])}"
        )
        pending.append(port)
        resolved[port] = substitute(ca.SX(outputs[port]))
        pending.pop()
        return resolved[port]

    def substitute(expression: Expr) -> Expr:
        expression = ca.SX(expression)
        used = [s for s in ca.symvar(expression) if s.element_hash() in placeholders]
        if not used:
            return expression
        drivers = [value(placeholders[s.element_hash()]) for s in used]
        return ca.substitute(expression, ca.vertcat(*used), ca.vertcat(*drivers))

    return substitute


def _substituted(row: Dynamics, substitute: Callable[[Expr], Expr]) -> Dynamics:
    bounds = [None if bound is None else substitute(bound) for bound in (row.lower, row.upper)]
    return Dynamics(row.state, substitute(row.rhs), substitute(row.mass), bounds[0], bounds[1])


def assemble(system: System) -> Model:
    """Compile a system into one set of equations.

    Raises:
        AssemblyError: components do not fit together.
    """
    symbols = Symbols(system)
    stated = {device.path: symbols.state(device) for device in system.devices}
    reference, omega_ref = _reference(system, symbols, stated)
    rows = [item for s in stated.values() for item in s.rows]
    alg = [item for s in stated.values() for item in s.alg]
    flows, kirchhoff = _network(system, symbols, stated)
    y, units = _outputs(system, symbols, stated, flows)
    infinity = ca.SX(np.inf)
    f, mass, lower, upper, g, y_vector = (
        ca.substitute(ca.vertcat(*items) if items else ca.SX(0, 1), symbols.omega_ref, omega_ref)
        for items in (
            [row.rhs for _, row in rows],
            [row.mass for _, row in rows],
            [-infinity if row.lower is None else row.lower for _, row in rows],
            [infinity if row.upper is None else row.upper for _, row in rows],
            [e for _, e in alg] + kirchhoff,
            list(y.values()),
        )
    )
    arguments = [table.vector for table in (symbols.x, symbols.z, symbols.d, symbols.u, symbols.p)]
    dae = ca.Function(
        "dae",
        arguments,
        [ca.densify(e) for e in (f, mass, lower, upper, g, y_vector)],
        ["x", "z", "d", "u", "p"],
        ["f", "mass", "lower", "upper", "g", "y"],
    )
    return Model(
        system=system,
        dae=dae,
        renew=_renewal(symbols, stated, omega_ref),
        x_names=tuple(symbols.x.names),
        z_names=tuple(symbols.z.names),
        d_names=tuple(symbols.d.names),
        u_names=tuple(symbols.u.names),
        p_names=tuple(symbols.p.names),
        y_names=tuple(y),
        p_0=np.array(symbols.p.values),
        d_0=np.array(symbols.d.values),
        limited=np.array([row.lower is not None or row.upper is not None for _, row in rows], dtype=bool),
        inert=np.array([bool(f[k].is_zero()) for k in range(len(rows))], dtype=bool),
        units=symbols.units | units,
        reference=reference,
    )


def _renewal(symbols: Symbols, stated: Mapping[str, Stated], omega_ref: Expr) -> ca.Function:
    """The discrete states after a step, from where it began and where it ended."""
    x, z, d, u, p = (table.vector for table in (symbols.x, symbols.z, symbols.d, symbols.u, symbols.p))
    x_0, z_0 = ca.SX.sym("x_0", x.numel()), ca.SX.sym("z_0", z.numel())
    befores = [item for s in stated.values() for item in s.befores]
    empty = ca.SX(0, 1)
    updates = ca.vertcat(empty, *(e for s in stated.values() for _, e in s.updates))
    at_start, signals = (ca.vertcat(empty, *(item[k] for item in befores)) for k in (0, 1))
    updates, signals = ca.substitute([updates, signals], [symbols.omega_ref], [omega_ref])
    signals = ca.substitute(signals, ca.vertcat(x, z), ca.vertcat(x_0, z_0))
    updates = ca.densify(ca.substitute(updates, at_start, signals))
    return ca.Function("renew", [x_0, z_0, x, z, d, u, p, symbols.h], [updates])


def _reference(system: System, symbols: Symbols, stated: Mapping[str, Stated]) -> tuple[str, Expr]:
    """What rotor angles are measured against, and its speed."""
    units = {d.name: d for d in system.devices if "machine" in d.components}
    infinite = [d.path for d in system.devices if "" in d.components and d.components[""].role == "source"]
    infinite += [d.path for d in units.values() if getattr(d.components["machine"], "H", 1.0) == 0.0]
    choice = system.reference
    if choice == "auto":
        choice = "infinite_bus" if infinite or not units else "centre_of_inertia"
    if choice == "infinite_bus":
        return (infinite[0] if infinite else "infinite_bus"), ca.SX(1)
    if choice == "centre_of_inertia":
        require(bool(units), "simulation.reference: a centre of inertia needs at least one machine")
        weights = {
            n: cast(Any, symbols.parameters_of(f"{d.path}.machine")).H * symbols.base(d) for n, d in units.items()
        }
        total = ca.sum1(ca.vertcat(*weights.values()))
        speed = ca.sum1(ca.vertcat(*(w * stated[units[n].path].outputs["omega"] for n, w in weights.items()))) / total
        return "centre_of_inertia", speed
    require(choice in units, f"simulation.reference: no unit {choice!r}; units are {', '.join(units) or 'none'}")
    return units[choice].path, stated[units[choice].path].outputs["omega"]


def _network(
    system: System, symbols: Symbols, stated: Mapping[str, Stated]
) -> tuple[dict[str, tuple[Expr, Expr]], list[Expr]]:
    """Branch flows by signal path, and two rows of Kirchhoff's current law per bus."""
    total = {name: [ca.SX(0), ca.SX(0)] for name in system.buses}
    flows: dict[str, tuple[Expr, Expr]] = {}

    def add(bus: str, current: tuple[Expr, Expr], sign: float) -> None:
        total[bus][0] += sign * current[0]
        total[bus][1] += sign * current[1]

    for device in system.devices:
        # The one place where machine per unit becomes system per unit.
        ratio = symbols.base(device) / system.S_base
        current = stated[device.path].current
        add(device.bus, (current[0] * ratio, current[1] * ratio), 1.0)
    for path, branch in system.branches().items():
        p = symbols.element(path)
        if path in stated:  # a tap changer drives this transformer's ratio
            p = p | {"tap": stated[path].outputs["ratio"]}
        g_ff, b_ff, g_ft, b_ft, g_tf, b_tf, g_tt, b_tt = branch.admittances(p)
        v_f, v_t = symbols.voltage[branch.from_bus], symbols.voltage[branch.to_bus]
        for end, bus, v, terms in (
            ("from", branch.from_bus, v_f, ((g_ff, b_ff, v_f), (g_ft, b_ft, v_t))),
            ("to", branch.to_bus, v_t, ((g_tf, b_tf, v_f), (g_tt, b_tt, v_t))),
        ):
            parts = [complex_product(*term) for term in terms]
            current = (parts[0][0] + parts[1][0], parts[0][1] + parts[1][1])
            add(bus, current, -1.0)
            flows[f"{path}.p_{end}"] = v[0] * current[0] + v[1] * current[1]
            flows[f"{path}.q_{end}"] = v[1] * current[0] - v[0] * current[1]
    for name, shunt in system.shunts.items():
        p = symbols.element(f"shunt.{name}")
        add(shunt.bus, complex_product(p["status"] * p["G"], p["status"] * p["B"], symbols.voltage[shunt.bus]), -1.0)
    rows: list[Expr] = []
    for name in system.buses:
        # Exact for a bolted fault too: with status 1 the rows read (R + jX) * sum(i) = v, and v = 0 where R = X = 0. Without a
        # fault the current is turned by (w + j): each row then depends on its own voltage through conductance and susceptance
        # alike, so that one pairing of rows and unknowns has nonzero pivots with a fault and without, at a bus of a lossless
        # network and at one that is left alone with a resistor. The leak puts a bus that is cut off from everything to zero.
        p, v = symbols.element(f"bus.{name}"), symbols.voltage[name]
        i = [total[name][k] - _LEAK * v[k] for k in (0, 1)]
        on, R, X = p["fault_status"], p["fault_R"], p["fault_X"]
        rows.append((1 - on) * (_TURN * i[0] - i[1]) + on * (R * i[0] - X * i[1] - v[0]))
        rows.append((1 - on) * (i[0] + _TURN * i[1]) + on * (R * i[1] + X * i[0] - v[1]))
    return flows, rows


def _outputs(
    system: System, symbols: Symbols, stated: Mapping[str, Stated], flows: Mapping[str, Expr]
) -> tuple[dict[str, Expr], dict[str, str]]:
    y: dict[str, Expr] = {}
    units: dict[str, str] = {}
    for device in system.devices:
        declared = {v.name: v.unit for c in device.components.values() for v in c.variables(Kind.OUTPUT)}
        for port, expression in stated[device.path].outputs.items():
            y[f"{device.path}.{port}"] = expression
            units[f"{device.path}.{port}"] = declared[port]
    for name, (re, im) in symbols.voltage.items():
        y[f"bus.{name}.v"], units[f"bus.{name}.v"] = magnitude(re, im), "pu"
        y[f"bus.{name}.angle"], units[f"bus.{name}.angle"] = ca.atan2(im, re), "rad"
    for path, flow in flows.items():
        y[path], units[path] = flow, "pu"
    return y, units
