"""The steady state: power flow, then every device solved from its own equations with limits released, then the limits checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core import powerflow
from pgexcite.core.assemble import assemble
from pgexcite.core.component import Terminal
from pgexcite.core.declare import Kind
from pgexcite.core.errors import InitialisationError, Problem
from pgexcite.core.model import Model, State, require
from pgexcite.core.powerflow import PowerFlow
from pgexcite.core.stated import Stated, equations_of
from pgexcite.core.symbols import Symbols
from pgexcite.core.system import Device, System

Array = NDArray[np.float64]

_TOLERANCE = 1e-9
_MAX_ITERATIONS = 60


@dataclass(frozen=True)
class Initial:
    """A model at its steady state.

    Attributes:
        model: the assembled equations.
        state: the steady state, ``t = 0``.
        p: parameters, with the constants of the initial point filled in, shape ``(n_p,)``.
        flow: the power flow it stands on.
        residual: largest residual of all equations at this point.
    """

    model: Model
    state: State
    p: Array
    flow: PowerFlow
    residual: float


def initialise(system: System) -> Initial:
    """Solve the power flow and every device's steady state.

    Raises:
        PowerFlowError: the power flow fails.
        InitialisationError: a device has no steady state, or one outside its limits; the problems name unit, component, state,
            value and limit.
        AssemblyError: components do not fit together.
    """
    flow = powerflow.solve(system)
    model = assemble(system)
    symbols = Symbols(system)
    values: dict[str, float] = {}
    problems: list[Problem] = []
    for device in system.devices:
        found, faults = _solve_device(device, symbols, flow, system.S_base)
        values |= found
        problems += faults
    if problems:
        raise InitialisationError(problems)
    for name, v in flow.v.items():
        values[f"bus.{name}.v_re"], values[f"bus.{name}.v_im"] = v.real, v.imag
    p = model.p_0.copy()
    for path, position in model.index["p"].items():
        if path in values:
            p[position] = values[path]
    x, z, u = (np.array([values[path] for path in names]) for names in (model.x_names, model.z_names, model.u_names))
    residual = _check_residual(model, x, z, u, p)
    return Initial(model, State(0, 0.0, x, z, model.d_0, u), p, flow, residual)


def _check_residual(model: Model, x: Array, z: Array, u: Array, p: Array) -> float:
    f, _, _, _, g, _ = model.dae(x, z, model.d_0, u, p)
    residuals = np.abs(np.concatenate((np.array(f).ravel(), np.array(g).ravel())))
    names = (*model.x_names, *model.z_names)
    worst = float(residuals.max(initial=0.0))
    if not worst <= _TOLERANCE:
        bad = [k for k in np.argsort(-residuals)[:3] if not residuals[k] <= _TOLERANCE]
        raise InitialisationError(
            [
                Problem(
                    names[k],
                    f"its equation is not at rest at the initial point, residual {residuals[k]:.3g}",
                    hint="a limit, gate or switch of this component is active there: check its limits against the operating point",
                )
                for k in bad
            ]
        )
    return worst


def _solve_device(
    device: Device, symbols: Symbols, flow: PowerFlow, S_base: float
) -> tuple[dict[str, float], list[Problem]]:
    """Steady state of one device by path, and what is wrong with it."""
    stated = equations_of(device, symbols, released=True)
    v = flow.v[device.bus]
    terminal = Terminal(v, (flow.s[device.path] * S_base / device.S_n / v).conjugate())
    names, start = _start(device, terminal)
    unknowns, residual = _equations(device, symbols, stated, terminal, names)
    bus = symbols.voltage[device.bus]
    given = ca.vertcat(*bus, symbols.omega_ref, symbols.h)
    rest = ca.vertcat(terminal.v.real, terminal.v.imag, 1.0, 0.0)
    known = [s for n, s in zip(symbols.p.names, symbols.p.symbols, strict=True) if n not in names]
    numbers = np.array([value for n, value in zip(symbols.p.names, symbols.p.values, strict=True) if n not in names])
    d = symbols.d.vector
    checks = _limits(stated)
    bounded = ca.substitute(ca.vertcat(ca.SX(0, 1), *(e for _, *es in checks for e in es)), given, rest)
    residual = ca.substitute(residual, given, rest)
    function = ca.Function(
        "device", [unknowns, ca.vertcat(*known), d], [residual, ca.jacobian(residual, unknowns), bounded]
    )
    d_0 = np.array(symbols.d.values)
    solution, error = _newton(lambda w: function(w, numbers, d_0), start)
    values = dict(zip(names, solution, strict=True))
    if not error <= _TOLERANCE:
        at = f"P = {terminal.s.real:.4g}, Q = {terminal.s.imag:.4g}, V = {abs(v):.4g} pu"
        text = f"no steady state at {at} (residual {error:.2g})"
        return values, [Problem(device.path, text, hint="check its parameters against the operating point")]
    checked = np.array(function(solution, numbers, d_0)[2]).ravel().reshape(-1, 3)
    return values, [
        fault for (label, *_), row in zip(checks, checked, strict=True) for fault in _violation(label, *row)
    ]


def _start(device: Device, terminal: Terminal) -> tuple[list[str], Array]:
    """Paths of a device's unknowns and where the search starts."""
    names: list[str] = []
    values: list[float] = []
    known: dict[str, float] = {}
    for slot, component in device.components.items():
        guess = dict(component.guess(terminal, known))
        known |= guess
        for variable in component.variables(Kind.STATE, Kind.ALGEBRAIC, Kind.SETPOINT, Kind.CONSTANT):
            names.append(f"{device.component_path(slot)}.{variable.name}")
            values.append(float(guess.get(variable.name, variable.guess)))
    return names, np.array(values)


def _equations(
    device: Device, symbols: Symbols, stated: Stated, terminal: Terminal, names: list[str]
) -> tuple[ca.SX, ca.SX]:
    """Unknowns and residual of a device at rest at its terminal."""
    by_path = {
        name: symbol
        for table in (symbols.x, symbols.z, symbols.u, symbols.p)
        for name, symbol in zip(table.names, table.symbols, strict=True)
    }
    unknowns = ca.vertcat(*(by_path[name] for name in names)) if names else ca.SX(0, 1)
    rows = [row.rhs for _, row in stated.rows] + [e for _, e in stated.alg]
    rows += [by_path[path] - value for path, value in stated.holds]
    setpoints = sum(len(c.variables(Kind.SETPOINT)) for c in device.components.values())
    if setpoints >= len(names) - len(rows) == 2:
        rows += [stated.current[0] - terminal.i.real, stated.current[1] - terminal.i.imag]
    require(
        len(rows) == len(names),
        f"{device.path}: {len(rows)} equations for {len(names)} unknowns at the steady state; "
        "a unit has two set-points, one of its governor and one of its exciter",
    )
    return unknowns, ca.vertcat(ca.SX(0, 1), *rows)


def _limits(stated: Stated) -> list[tuple[str, ca.SX, ca.SX, ca.SX]]:
    checks = [(f"{path}.{limit.label}", limit.signal, limit.lower, limit.upper) for path, limit in stated.limits]
    checks += [
        (path, row.state, -ca.inf if row.lower is None else row.lower, ca.inf if row.upper is None else row.upper)
        for path, row in stated.rows
        if row.lower is not None or row.upper is not None
    ]
    return [(label, ca.SX(s), ca.SX(lo), ca.SX(hi)) for label, s, lo, hi in checks]


def _violation(label: str, value: float, lower: float, upper: float) -> list[Problem]:
    slack = _TOLERANCE * max(1.0, abs(value))
    if value > upper + slack:
        text = f"the operating point needs {value:.5g}, above the upper limit {upper:.5g}"
    elif value < lower - slack:
        text = f"the operating point needs {value:.5g}, below the lower limit {lower:.5g}"
    else:
        return []
    return [Problem(label, text, hint="move the operating point or widen the limit")]


def _newton(function: Callable[[Array], Any], start: Array) -> tuple[Array, float]:
    """Damped Newton with least-squares steps: what an equation leaves open (an inert state) stays at its guess."""
    w = start.copy()
    r, jacobian = _evaluate(function, w)
    error = float(np.abs(r).max(initial=0.0))
    for _ in range(_MAX_ITERATIONS):
        if not np.isfinite(error) or error <= 1e-13:
            break
        step = np.linalg.lstsq(jacobian, -r, rcond=1e-13)[0]
        scale = 1.0
        while True:
            trial = w + scale * step
            r_trial, jacobian_trial = _evaluate(function, trial)
            error_trial = float(np.abs(r_trial).max(initial=0.0))
            if error_trial < error or scale < 1e-4:
                break
            scale /= 2
        if not error_trial < error:
            break
        w, r, jacobian, error = trial, r_trial, jacobian_trial, error_trial
    return w, error


def _evaluate(function: Callable[[Array], Any], w: Array) -> tuple[Array, Array]:
    r, jacobian, _ = function(w)
    return np.array(r).ravel(), np.array(jacobian)
