"""One component on the bench: its equations compiled alone, without the kernel, to be evaluated, solved and linearised."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root

from pgexcite.core.blocks import limits_released
from pgexcite.core.component import Component, Signals, Terminal
from pgexcite.core.declare import Kind

Array = NDArray[np.float64]

_OWN = (Kind.STATE, Kind.ALGEBRAIC, Kind.DISCRETE, Kind.SETPOINT, Kind.CONSTANT, Kind.INPUT, Kind.BEFORE)


@dataclass(frozen=True)
class Point:
    """Everything a component states, as numbers.

    ``rhs``, ``mass``, ``lower``, ``upper`` by state; ``alg`` in order; ``out``, ``hold`` by name; ``current`` on the device's base;
    ``limits`` by label as ``(signal, lower, upper)``, empty unless released.
    """

    rhs: dict[str, float]
    mass: dict[str, float]
    lower: dict[str, float]
    upper: dict[str, float]
    alg: tuple[float, ...]
    out: dict[str, float]
    hold: dict[str, float]
    current: complex
    limits: dict[str, tuple[float, float, float]]


class Bench:
    """A component's equations with parameters, variables and surroundings as symbols."""

    def __init__(self, component: Component, *, f_n: float = 50.0, S_n: float = 100.0, released: bool = False) -> None:
        self.component = component
        cls = type(component)
        self.states = tuple(item.name for item in cls.variables(Kind.STATE))
        self.base = {"omega_ref": 1.0, "omega_0": 2 * math.pi * f_n, "h": 0.0, "S_n": S_n}
        self.base |= {
            item.name: item.default for item in cls.variables(Kind.INPUT, Kind.DISCRETE) if item.default is not None
        }
        self.base |= {item.name: 0.0 for item in cls.variables(Kind.BEFORE)}
        own = [item.name for item in cls.variables(*_OWN)]
        around = ["omega_ref", "omega_0", "h", "S_n"] + (["v_re", "v_im"] if component.has_terminal else [])
        self.names = tuple(own + around)
        symbols = {name: ca.SX.sym(name) for name in self.names}
        parameters = {name: ca.SX.sym(name) for name in component.numeric_parameters()}
        self.parameters = {name: getattr(component, name) for name in parameters}
        copy = component.with_symbols(parameters)
        if released:
            with limits_released() as limits:
                stated = copy.equations(Signals(symbols))
        else:
            limits, stated = [], copy.equations(Signals(symbols))
        rows = {row.state.name(): row for row in stated.rows()}
        assert set(rows) == set(self.states)
        assert set(stated.out) == {item.name for item in cls.variables(Kind.OUTPUT)}
        assert set(stated.hold) == {item.name for item in cls.variables(Kind.CONSTANT)}
        assert set(stated.update) == {item.name for item in cls.variables(Kind.DISCRETE)}
        assert set(stated.before) == {item.name for item in cls.variables(Kind.BEFORE)}
        assert len(stated.alg) == len(cls.variables(Kind.ALGEBRAIC))
        assert (stated.current is not None) == component.has_terminal
        self.outputs, self.holds, self.labels = (
            tuple(stated.out),
            tuple(stated.hold),
            tuple(item.label for item in limits),
        )
        ordered = [rows[name] for name in self.states]
        groups = [
            [row.rhs for row in ordered],
            [row.mass for row in ordered],
            [-ca.inf if row.lower is None else row.lower for row in ordered],
            [ca.inf if row.upper is None else row.upper for row in ordered],
            stated.alg,
            [stated.out[name] for name in self.outputs],
            [stated.hold[name] for name in self.holds],
            stated.current or (),
            [e for item in limits for e in (item.signal, item.lower, item.upper)],
        ]
        vectors = [ca.vertcat(ca.SX(0, 1), *group) for group in groups]
        arguments = [ca.vertcat(*symbols.values()), ca.vertcat(ca.SX(0, 1), *parameters.values())]
        self.function = ca.Function("component", arguments, vectors)
        smooth = ca.vertcat(*(vectors[k] for k in (0, 4, 5, 6, 7)))
        self._smooth = ca.Function("smooth", arguments, [smooth, ca.jacobian(smooth, arguments[0])])

    def _vector(self, values: Mapping[str, float]) -> Array:
        merged = self.base | dict(values)
        return np.array([merged[name] for name in self.names], dtype=float)

    def _numbers(self, parameters: Mapping[str, float]) -> Array:
        return np.array([parameters.get(name, value) for name, value in self.parameters.items()], dtype=float)

    def __call__(self, values: Mapping[str, float], **parameters: float) -> Point:
        """Evaluate at values by name; ``parameters`` override the component's own."""
        found = [np.array(item).ravel() for item in self.function(self._vector(values), self._numbers(parameters))]
        by_state = [dict(zip(self.states, item, strict=True)) for item in found[:4]]
        out, hold = dict(zip(self.outputs, found[5], strict=True)), dict(zip(self.holds, found[6], strict=True))
        current = complex(*found[7]) if len(found[7]) else 0j
        limits = dict(zip(self.labels, (tuple(row) for row in found[8].reshape(-1, 3)), strict=True))
        return Point(*by_state, tuple(found[4]), out, hold, current, limits)

    def jacobian(self, values: Mapping[str, float]) -> Array:
        """Exact derivative of right-hand sides, residuals, outputs, held constants and current by all of ``names``."""
        return np.array(self._smooth(self._vector(values), self._numbers({}))[1])

    def jacobian_error(self, values: Mapping[str, float], step: float = 1e-6) -> float:
        """Largest difference of the exact derivative from central differences, relative to its largest entry in the row."""
        w, p = self._vector(values), self._numbers({})
        numeric = np.zeros((self._smooth.size1_out(0), len(w)))
        for k in range(len(w)):
            move = np.zeros(len(w))
            move[k] = step * max(1.0, abs(w[k]))
            ahead, behind = (np.array(self._smooth(w + sign * move, p)[0]).ravel() for sign in (1, -1))
            numeric[:, k] = (ahead - behind) / (2 * move[k])
        exact = self.jacobian(values)
        return float(np.max(np.abs(exact - numeric) / (1.0 + np.abs(exact).max(axis=1, keepdims=True))))


def terminal(P: float, Q: float, V: float = 1.0, angle: float = 0.0) -> Terminal:
    """A terminal that delivers ``P + jQ`` at ``V`` and ``angle`` [rad], pu."""
    v = V * complex(math.cos(angle), math.sin(angle))
    return Terminal(v, (complex(P, Q) / v).conjugate())


def at_terminal(at: Terminal) -> dict[str, float]:
    """The bus voltage as signals."""
    return {"v_re": at.v.real, "v_im": at.v.imag}


def machine_at_rest(bench: Bench, at: Terminal) -> dict[str, float]:
    """Steady state of a machine, solved from its own equations: states, algebraics, constants, ``e_fd`` and ``t_m``."""
    known = at_terminal(at)
    guess = bench.component.guess(at, {})
    kinds = (Kind.STATE, Kind.ALGEBRAIC, Kind.CONSTANT, Kind.INPUT)
    names = [item.name for item in bench.component.variables(*kinds)]

    def residual(w: Array) -> Array:
        values = known | dict(zip(names, w, strict=True))
        return rest_residual(bench, values, at)

    found = root(residual, [guess[name] for name in names], method="lm", tol=1e-13)
    assert np.abs(found.fun).max() < 1e-10, found
    return known | dict(zip(names, found.x, strict=True))


def rest_residual(bench: Bench, values: Mapping[str, float], at: Terminal) -> Array:
    """Everything that is zero when a machine is at rest at a terminal."""
    point = bench(values)
    mismatch = point.current - at.i
    held = [values[name] - value for name, value in point.hold.items()]
    return np.array([*point.rhs.values(), *point.alg, *held, mismatch.real, mismatch.imag])


def smib_matrix(bench: Bench, values: Mapping[str, float], Z: complex) -> tuple[tuple[str, ...], Array, Array]:
    """A machine behind ``Z`` to an infinite bus: its states, ``A`` and the column of ``e_fd``, everything algebraic eliminated."""
    names = list(bench.names)
    exact = bench.jacobian(values)
    n, n_alg = len(bench.states), len(bench.component.variables(Kind.ALGEBRAIC))
    rhs, alg, current = exact[:n], exact[n : n + n_alg], exact[-2:]
    at_v = np.zeros((2, len(names)))
    at_v[0, names.index("v_re")] = at_v[1, names.index("v_im")] = 1.0
    network = at_v - np.array([[Z.real, -Z.imag], [Z.imag, Z.real]]) @ current
    mass = np.array(list(bench(values).mass.values()))
    moving, still = np.flatnonzero(mass), np.flatnonzero(mass == 0)
    f, g = rhs[moving] / mass[moving, None], np.vstack((rhs[still], alg, network))
    x = [names.index(bench.states[k]) for k in moving]
    algebraics = [item.name for item in bench.component.variables(Kind.ALGEBRAIC)]
    y = [names.index(name) for name in [*(bench.states[k] for k in still), *algebraics, "v_re", "v_im"]]
    A = f[:, x] - f[:, y] @ np.linalg.solve(g[:, y], g[:, x])
    return tuple(bench.states[k] for k in moving), A, f[:, names.index("e_fd")]


def simulate(
    bench: Bench,
    start: Mapping[str, float],
    inputs: Callable[[float], Mapping[str, float]],
    *,
    t_end: float,
    h: float = 1e-3,
) -> tuple[Array, dict[str, Array]]:
    """Projected explicit Euler for small chains of blocks: times, and states and outputs by name.

    A row without mass has the form ``0 = f - x`` and is followed by substitution.
    """
    values = dict(start)
    times = np.arange(round(t_end / h) + 1) * h
    record: dict[str, list[float]] = {name: [] for name in (*bench.states, *bench.outputs)}
    for t in times:
        values |= inputs(t)
        point = _settle(bench, values)
        for name, samples in record.items():
            samples.append(point.out[name] if name in point.out else values[name])
        for name in bench.states:
            if point.mass[name] > 0:
                moved = values[name] + h * point.rhs[name] / point.mass[name]
                values[name] = min(max(moved, point.lower[name]), point.upper[name])
    return times, {name: np.array(samples) for name, samples in record.items()}


def _settle(bench: Bench, values: dict[str, float]) -> Point:
    point = bench(values)
    still = [name for name in bench.states if point.mass[name] == 0]
    for _ in still:
        before = [values[name] for name in still]
        for name in still:
            values[name] = min(max(values[name] + point.rhs[name], point.lower[name]), point.upper[name])
        if before == [values[name] for name in still]:
            break
        point = bench(values)
    return point
