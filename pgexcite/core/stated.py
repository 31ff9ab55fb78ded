"""The equations of a device: what its components state, each input replaced by what drives it inside the device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import casadi as ca
import numpy as np

from pgexcite.core.blocks import Dynamics, Limit, limits_released
from pgexcite.core.component import Component, Equations, Signals
from pgexcite.core.declare import Expr, Kind
from pgexcite.core.errors import AssemblyError
from pgexcite.core.model import require
from pgexcite.core.symbols import Symbols
from pgexcite.core.system import Device

Inputs = dict[str, list[tuple[str, Expr, float | None]]]
"""Users of each signal: path of the component, its placeholder, and what it takes where nothing drives the signal."""


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


def equations_of(device: Device, symbols: Symbols, *, released: bool = False) -> Stated:
    """Write a device's equations, with its windup limits in force or released.

    Raises:
        AssemblyError: an input nothing drives, two drivers of one signal, an algebraic loop, or a component that states other
            equations than it declares.
    """
    inputs: Inputs = {}
    stated: dict[str, Equations] = {}
    limits: list[tuple[str, Limit]] = []
    outputs: dict[str, Expr] = {}
    for slot, component in device.components.items():
        path = device.component_path(slot)
        scope: AbstractContextManager[list[Limit]] = limits_released() if released else nullcontext([])
        with scope as met:
            equations = symbols.copies[path].equations(_signals(device, path, component, symbols, inputs))
        _check_declared(path, component, equations)
        stated[path] = equations
        limits += [(path, limit) for limit in met]
        for port, value in equations.out.items():
            if port in outputs:
                _put_in_series(device, path, port, inputs, outputs)
            outputs[port] = value
    return _wired(device, symbols, stated, outputs, limits, _wiring(device, inputs, outputs))


def _signals(device: Device, path: str, component: Component, symbols: Symbols, inputs: Inputs) -> Signals:
    """What a component may use: its own symbols, its surroundings, and for each input a placeholder, noted in ``inputs``."""
    known = dict(symbols.own[path])
    for variable in component.variables(Kind.INPUT):
        known[variable.name] = ca.SX.sym(f"{path}.{variable.name}")
        inputs.setdefault(variable.name, []).append((path, known[variable.name], variable.default))
    known |= {
        "omega_ref": symbols.omega_ref,
        "omega_0": 2 * np.pi * symbols.f_n,
        "h": symbols.h,
        "S_n": symbols.bases[device.path],
    }
    if component.has_terminal:
        known["v_re"], known["v_im"] = symbols.voltage[device.bus]
    if device.path in symbols.elements:
        known["tap"] = symbols.elements[device.path]["tap"]
    return Signals(known)


def _wired(
    device: Device,
    symbols: Symbols,
    stated: Mapping[str, Equations],
    outputs: Mapping[str, Expr],
    limits: Sequence[tuple[str, Limit]],
    substitute: Callable[[Expr], Expr],
) -> Stated:
    """What the components of a device state, with their inputs replaced by ``substitute``."""
    rows, alg, updates, befores, holds = [], [], [], [], []
    current = (ca.SX(0), ca.SX(0))
    for slot, component in device.components.items():
        path = device.component_path(slot)
        equations, own = stated[path], symbols.own[path]
        by_symbol = {row.state.element_hash(): row for row in equations.rows()}
        for item in component.variables(Kind.STATE):
            row = by_symbol.get(own[item.name].element_hash())
            if row is None:
                raise AssemblyError(f"{path}: no row is stated for the state {item.name}")
            rows.append((f"{path}.{item.name}", _substituted(row, substitute)))
        names = [item.name for item in component.variables(Kind.ALGEBRAIC)]
        alg += [(f"{path}.{n}", substitute(e)) for n, e in zip(names, equations.alg, strict=True)]
        updates += [
            (f"{path}.{i.name}", substitute(equations.update[i.name])) for i in component.variables(Kind.DISCRETE)
        ]
        befores += [(own[name], substitute(signal)) for name, signal in equations.before.items()]
        holds += [(f"{path}.{name}", substitute(value)) for name, value in equations.hold.items()]
        if equations.current is not None:
            current = (substitute(equations.current[0]), substitute(equations.current[1]))
    named = {port: substitute(value) for port, value in outputs.items() if "<" not in port}
    bounded = tuple(
        (path, Limit(item.label, substitute(item.signal), substitute(item.lower), substitute(item.upper)))
        for path, item in limits
    )
    return Stated(tuple(rows), tuple(alg), named, current, tuple(updates), tuple(befores), tuple(holds), bounded)


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
    inputs: Inputs,
    outputs: dict[str, Expr],
) -> None:
    """A component that both reads and drives a signal stands in series: it sees what the one before it drives."""
    own = [user for user in inputs.get(port, []) if user[0] == path]
    require(bool(own), f"{device.path}: two components drive {port!r}; leave one out")
    inner = f"{port}<{path}"
    inputs[port] = [user for user in inputs[port] if user[0] != path]
    inputs[inner] = own
    outputs[inner] = outputs[port]


def _wiring(device: Device, inputs: Inputs, outputs: Mapping[str, Expr]) -> Callable[[Expr], Expr]:
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
