"""From components to one set of equations: what devices state, and Kirchhoff's current law at the buses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import casadi as ca
import numpy as np

from pgexcite.core.blocks import magnitude
from pgexcite.core.declare import Expr, Kind
from pgexcite.core.errors import AssemblyError
from pgexcite.core.limiting import mismatches
from pgexcite.core.model import Model, require
from pgexcite.core.network import complex_product
from pgexcite.core.stated import Stated, equations_of
from pgexcite.core.symbols import Symbols
from pgexcite.core.system import System

_TURN = 0.37
"""Real part of what the currents of a bus are multiplied with; any number that is not a ratio of admittances does."""
_LEAK = 1e-12
"""Conductance to earth at every bus, pu: far below the residual that is accepted."""


def assemble(system: System) -> Model:
    """Compile a system into one set of equations.

    Raises:
        AssemblyError: components do not fit together.
    """
    for device in system.devices:
        for found in mismatches(device):
            raise AssemblyError(f"{found.path}: {found.message}; {found.hint}")
    symbols = Symbols(system)
    stated = {device.path: equations_of(device, symbols) for device in system.devices}
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
            n: cast(Any, symbols.copies[f"{d.path}.machine"]).H * symbols.bases[d.path] for n, d in units.items()
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
        ratio = symbols.bases[device.path] / system.S_base
        current = stated[device.path].current
        add(device.bus, (current[0] * ratio, current[1] * ratio), 1.0)
    for path, branch in system.branches().items():
        p = symbols.elements[path]
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
        p = symbols.elements[f"shunt.{name}"]
        add(shunt.bus, complex_product(p["status"] * p["G"], p["status"] * p["B"], symbols.voltage[shunt.bus]), -1.0)
    rows: list[Expr] = []
    for name in system.buses:
        # Exact for a bolted fault too: with status 1 the rows read (R + jX) * sum(i) = v, and v = 0 where R = X = 0. Without a
        # fault the current is turned by (w + j): each row then depends on its own voltage through conductance and susceptance
        # alike, so that one pairing of rows and unknowns has nonzero pivots with a fault and without, at a bus of a lossless
        # network and at one that is left alone with a resistor. The leak puts a bus that is cut off from everything to zero.
        p, v = symbols.elements[f"bus.{name}"], symbols.voltage[name]
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
