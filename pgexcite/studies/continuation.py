"""Continuation of a power flow in the size of its loads: points of the curve, its summit, and reactive limits on the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.sparse.linalg import splu

from pgexcite.core import powerflow
from pgexcite.core.errors import PgexciteError
from pgexcite.core.system import Device, System

Array = NDArray[np.float64]

_TOLERANCE = 1e-12
_MAX_ITERATIONS = 8
_LONGEST, _SHORTEST = 0.1, 1e-7
"""Arc length of a step: pu, rad and units of the scaling factor together."""
_BEND = 0.05
"""Largest distance of a point from the tangent before it, over the step: the curve turns by about twice this, rad, in a step."""
_LOWEST_VOLTAGE = 0.05
"""Bus voltage, pu, at which the lower branch is left."""
_MAX_POINTS = 3000


class ContinuationError(PgexciteError):
    """There is nothing to scale, or the continuation got stuck."""


class LoadScaling:
    """Power-flow mismatches as functions of ``y = (angles, V, factor)``, with the unknowns that are not held."""

    def __init__(self, system: System, scaled: Sequence[Device]) -> None:
        self.system = system
        self.names = list(system.buses)
        self.index = {name: k for k, name in enumerate(self.names)}
        self.admittance = powerflow.admittance_matrix(system)
        self.limited: list[tuple[float, str]] = []
        self._held: dict[str, float] = {}
        self._direction = np.zeros(len(self.names), dtype=complex)
        for device in scaled:
            power = complex(device.schedule.P or 0.0, device.schedule.Q or 0.0)
            self._direction[self.index[device.bus]] += power / system.S_base
        self.release()

    def release(self) -> None:
        """Back to the base case, where no unit is at a limit but those it starts at."""
        self._held = {}
        self.limited = []
        flow = powerflow.solve(self.system)
        for path in flow.at_limit:
            plan = self.system.device(path).schedule
            high = flow.s[path].imag * self.system.S_base > (plan.Q_min + plan.Q_max) / 2
            self._held[path] = plan.Q_max if high else plan.Q_min
        self._specify()

    def _specify(self) -> None:
        buses = powerflow.specification(self.system, self.index, self._held)
        self._buses = buses
        self._P, self._Q = np.flatnonzero(~np.isnan(buses.P)), np.flatnonzero(~np.isnan(buses.Q))
        # Every bus keeps its angle and V in y; those that are held have a row that says so.
        self._fixed_a, self._fixed_V = np.flatnonzero(~np.isnan(buses.angle)), np.flatnonzero(~np.isnan(buses.V))

    def base(self) -> Array:
        """The base case."""
        v = np.array(list(powerflow.solve(self.system).v.values()))
        return np.concatenate((np.angle(v), np.abs(v), [1.0]))

    def voltages(self, points: Array) -> Array:
        """Magnitudes, shape ``(n, n_bus)``."""
        n = len(self.names)
        return points[:, n : 2 * n]

    def at_the_end(self, y: Array) -> bool:
        """Whether the lower branch has been followed far enough."""
        n = len(self.names)
        return bool(y[-1] <= 0.0 or y[n : 2 * n].min() < _LOWEST_VOLTAGE)

    def mismatch(self, y: Array) -> tuple[Array, sp.csr_matrix]:
        """Residual, shape ``(2 n_bus,)``, and its Jacobian, shape ``(2 n_bus, 2 n_bus + 1)``."""
        n, buses = len(self.names), self._buses
        angle, V = y[:n], y[n : 2 * n]
        v = V * np.exp(1j * angle)
        extra = (y[-1] - 1.0) * self._direction
        s = v * np.conj(self.admittance @ v) - extra
        ds_da, ds_dV = powerflow.derivatives(self.admittance, v, V)
        rows = sp.hstack((ds_da, ds_dV, sp.csr_matrix(-self._direction[:, None]))).tocsr()
        unit = sp.identity(2 * n + 1, format="csr")
        r = np.concatenate(
            (
                s.real[self._P] - buses.P[self._P],
                s.imag[self._Q] - buses.Q[self._Q],
                angle[self._fixed_a] - buses.angle[self._fixed_a],
                V[self._fixed_V] - buses.V[self._fixed_V],
            )
        )
        J = sp.vstack((rows.real[self._P], rows.imag[self._Q], unit[self._fixed_a], unit[n + self._fixed_V]))
        return r, J.tocsr()

    def at_factor(self, y: Array, factor: float) -> Array | None:
        """The point of the curve near ``y`` with this scaling factor."""
        normal = np.zeros(y.size)
        normal[-1] = 1.0
        return self.correct(np.append(y[:-1], factor), normal)

    def tangent(self, y: Array, ahead: Array) -> Array:
        """Unit vector along the curve, on the side of ``ahead``."""
        J = self.mismatch(y)[1]
        right = np.zeros(y.size)
        right[-1] = 1.0
        t = splu(sp.vstack((J, sp.csr_matrix(ahead[None]))).tocsc()).solve(right)
        return np.asarray(t / np.linalg.norm(t))

    def correct(self, guess: Array, normal: Array) -> Array | None:
        """The point of the curve in the plane through ``guess``; ``None`` where Newton does not get there."""
        y = guess.copy()
        for _ in range(_MAX_ITERATIONS):
            r, J = self.mismatch(y)
            full = np.append(r, normal @ (y - guess))
            if np.abs(full).max() < _TOLERANCE:
                return y
            try:
                y = y - splu(sp.vstack((J, sp.csr_matrix(normal[None]))).tocsc()).solve(full)
            except RuntimeError:
                return None
            if not np.isfinite(y).all():
                return None
        return y if np.abs(self.mismatch(y)[0]).max() < 1e3 * _TOLERANCE else None

    def reserves(self, y: Array) -> dict[str, float]:
        """Mvar left to the reactive limit of each unit that holds its voltage; negative beyond it."""
        v = self.voltages(y[None])[0] * np.exp(1j * y[: len(self.names)])
        s = v * np.conj(self.admittance @ v) - (y[-1] - 1.0) * self._direction
        found = {}
        for device in self.system.devices:
            plan = device.schedule
            if plan.V is None or plan.Q is not None or plan.angle is not None or device.path in self._held:
                continue
            others = sum(d.schedule.Q or 0.0 for d in self.system.devices if d.bus == device.bus and d is not device)
            Q = s[self.index[device.bus]].imag * self.system.S_base - others
            found[device.path] = min(plan.Q_max - Q, Q - plan.Q_min)
        return found

    def hold(self, path: str, y: Array) -> None:
        """Let a unit hold the reactive limit it has met instead of its voltage."""
        plan = self.system.device(path).schedule
        v = self.voltages(y[None])[0] * np.exp(1j * y[: len(self.names)])
        k = self.index[self.system.device(path).bus]
        Q = (v * np.conj(self.admittance @ v))[k].imag * self.system.S_base
        self._held[path] = plan.Q_max if abs(Q - plan.Q_max) < abs(Q - plan.Q_min) else plan.Q_min
        self.limited.append((float(y[-1]), path))
        self._specify()


def trace(
    problem: LoadScaling, start: Array, way: float, stop: Callable[[Array], bool]
) -> tuple[list[Array], int | None]:
    """Points of the curve from ``start``, with the factor first growing (``way`` 1) or falling (-1), and where its nose is."""
    points, nose = [start], None
    ahead = np.zeros(start.size)
    ahead[-1] = way
    tangent, step = problem.tangent(start, ahead), _LONGEST
    while len(points) < _MAX_POINTS and not stop(points[-1]):
        y = points[-1]
        there = problem.correct(y + step * tangent, tangent)
        if there is None or np.linalg.norm(there - y - step * tangent) > _BEND * step:
            step /= 2
            if step < _SHORTEST:
                raise ContinuationError(f"the curve could not be followed beyond a scaling factor of {y[-1]:.6g}")
            continue
        met = [path for path, left in problem.reserves(there).items() if left < -1e-9]
        if met:
            there, path = _first_limit(problem, y, tangent, step, met)
            problem.hold(path, there)
            turned = problem.tangent(there, tangent)
            if way > 0 and turned[-1] < 0 and nose is None:  # the limit itself is the nose
                nose = len(points)
        else:
            turned = problem.tangent(there, tangent)
            if way > 0 and nose is None and turned[-1] < 0:
                there = _summit(problem, y, tangent, step)
                turned = problem.tangent(there, tangent)
                nose = len(points)
        points.append(there)
        if turned[-1] > 0 and (way < 0 or (nose is not None and len(points) > nose + 2)):
            break  # a second turning point: the schedule allows no less load, or the lower branch goes back up
        tangent, step = turned, min(_LONGEST, 1.5 * step)
    return points, nose


def _first_limit(problem: LoadScaling, y: Array, tangent: Array, step: float, met: Sequence[str]) -> tuple[Array, str]:
    """The point within a step at which the first of several units meets its limit."""

    def left(s: float, path: str) -> float:
        there = problem.correct(y + s * tangent, tangent)
        return -1.0 if there is None else problem.reserves(there)[path]

    lengths = {path: brentq(left, 0.0, step, args=(path,), xtol=1e-13) for path in met if left(0.0, path) > 0}
    path = min(lengths, key=lambda item: lengths[item]) if lengths else met[0]
    there = problem.correct(y + lengths.get(path, 0.0) * tangent, tangent)
    return (y if there is None else there), path


def _summit(problem: LoadScaling, y: Array, tangent: Array, step: float) -> Array:
    """The point within a step at which the factor is largest: where the tangent has no component along it."""

    def slope(s: float) -> float:
        there = problem.correct(y + s * tangent, tangent)
        return -1.0 if there is None else float(problem.tangent(there, tangent)[-1])

    if slope(0.0) <= 0.0:
        return y
    summit = problem.correct(y + brentq(slope, 0.0, step, xtol=1e-15, rtol=1e-14) * tangent, tangent)
    return y if summit is None else summit
