"""Geometry of a single-line diagram: where buses, branches and devices are drawn. Plain numbers, no drawing library."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from pgexcite.core.network import Transformer
from pgexcite.core.system import System

HOP = 100.0
"""Drawn length of a branch."""
_BAR = 26.0
"""Half-length of a bus bar."""
_REACH = 52.0
"""Distance of a device's symbol from its bus."""
_RADIUS = 15.0
_STRESS_STEPS = 200

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Diagram:
    """A drawing, y downwards.

    Attributes:
        buses: bus -> bar, shape ``(2, 2)``.
        branches: branch path -> polyline, ``(n, 2)``, from the sending to the receiving end.
        symbols: device or transformer path -> polylines of its symbol.
        anchors: bus or device path -> where its label stands.
    """

    buses: dict[str, Points]
    branches: dict[str, Points]
    symbols: dict[str, list[Points]] = field(default_factory=dict)
    anchors: dict[str, tuple[float, float]] = field(default_factory=dict)

    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Ranges of x and y that hold everything, with a margin for labels."""
        lines = [
            *self.buses.values(),
            *self.branches.values(),
            *(line for item in self.symbols.values() for line in item),
        ]
        points = np.vstack(lines)
        low, high = points.min(axis=0) - 45.0, points.max(axis=0) + 45.0
        return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def diagram(system: System) -> Diagram:
    """Lay out a system: the same system gives the same drawing."""
    at = place_buses(system)
    along = {bus: _bar_direction(system, at, bus) for bus in system.buses}
    bars = {bus: np.array([at[bus] - _BAR * along[bus], at[bus] + _BAR * along[bus]]) for bus in system.buses}
    result = Diagram(bars, {})
    for bus in system.buses:
        result.anchors[bus] = tuple(at[bus] + _BAR * along[bus])
    _draw_branches(system, at, result)
    _draw_devices(system, at, along, result)
    return result


def place_buses(system: System) -> dict[str, Points]:
    """Positions with distances on paper as near as can be to distances in the network (stress majorisation, SMACOF).

    Starts from classical scaling, which draws a radial feeder as a straight line at once; needs no random numbers.
    """
    names = list(system.buses)
    index = {name: k for k, name in enumerate(names)}
    n = len(names)
    links = np.zeros((n, n))
    for branch in system.branches().values():
        links[index[branch.from_bus], index[branch.to_bus]] = 1.0
    hops = shortest_path(links, directed=False, unweighted=True)
    hops[np.isinf(hops)] = np.max(hops[np.isfinite(hops)]) + 2.0
    position = _apart(_classical_scaling(hops))
    weight = np.where(hops > 0, 1.0 / np.maximum(hops, 1.0) ** 2, 0.0)
    laplacian = np.linalg.pinv(np.diag(weight.sum(axis=1)) - weight)
    for _ in range(_STRESS_STEPS if n > 2 else 0):
        apart = np.linalg.norm(position[:, None] - position[None], axis=2)
        ratio = np.where(apart > 1e-9, -weight * hops / np.maximum(apart, 1e-9), 0.0)
        np.fill_diagonal(ratio, 0.0)
        np.fill_diagonal(ratio, -ratio.sum(axis=1))
        position = laplacian @ (ratio @ position)
    return dict(zip(names, HOP * _upright(system, position, index), strict=True))


def _classical_scaling(distance: Points) -> Points:
    n = len(distance)
    centre = np.eye(n) - 1.0 / n
    values, vectors = np.linalg.eigh(-0.5 * centre @ distance**2 @ centre)
    plane: Points = np.zeros((n, 2))
    for axis in range(min(2, n)):
        plane[:, axis] = math.sqrt(max(values[-1 - axis], 0.0)) * vectors[:, -1 - axis]
    return plane


def _apart(position: Points) -> Points:
    """Twins (two stubs of one bus) moved off one another, so that the majorisation can tell them apart."""
    gap = np.linalg.norm(position[:, None] - position[None], axis=2) + np.eye(len(position))
    twin = np.min(gap, axis=1) < 0.1 if len(position) > 1 else np.zeros(len(position), dtype=bool)
    turn = 2.399963 * np.arange(len(position))  # the golden angle: no two in one direction
    moved: Points = position + 0.2 * twin[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return moved


def _upright(system: System, position: Points, index: dict[str, int]) -> Points:
    """Turned so that the long axis is horizontal and the first unit stands left and above."""
    centred = position - position.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False) if len(centred) > 1 else (None, None, np.eye(2))
    turned: Points = centred @ axes.T
    turned[np.abs(turned) < 1e-9] = 0.0
    units = [index[device.bus] for device in system.devices if device.path.startswith("unit.")] or [0]
    for axis in range(2):
        if turned[units[0], axis] > 1e-6:
            turned[:, axis] *= -1.0
    return turned


def _bar_direction(system: System, at: dict[str, Points], bus: str) -> Points:
    """A bar is upright unless most of its branches run up and down."""
    ends = [(item.from_bus, item.to_bus) for item in system.branches().values() if bus in (item.from_bus, item.to_bus)]
    away = [at[b] - at[a] for a, b in ends]
    steep = sum(d[1] ** 2 - d[0] ** 2 for d in away) > 0
    return np.array([1.0, 0.0]) if steep else np.array([0.0, 1.0])


def _draw_branches(system: System, at: dict[str, Points], result: Diagram) -> None:
    parallel: dict[frozenset[str], list[str]] = defaultdict(list)
    branches = system.branches()
    for path, branch in branches.items():
        parallel[frozenset((branch.from_bus, branch.to_bus))].append(path)
    for paths in parallel.values():
        for k, path in enumerate(paths):
            branch = branches[path]
            start, end = at[branch.from_bus], at[branch.to_bus]
            first, second = sorted((branch.from_bus, branch.to_bus))
            along = (at[second] - at[first]) / max(float(np.linalg.norm(end - start)), 1e-9)
            spacing = min(22.0, 1.6 * _BAR / max(len(paths) - 1, 1))
            shift = (k - (len(paths) - 1) / 2) * spacing * np.array([-along[1], along[0]])
            line = np.array([start + shift, end + shift])
            result.branches[path] = line
            if isinstance(branch, Transformer):
                middle, unit = line.mean(axis=0), (end - start) / max(float(np.linalg.norm(end - start)), 1e-9)
                result.symbols[path] = [circle(middle - 6.0 * unit, 9.0), circle(middle + 6.0 * unit, 9.0)]


def _draw_devices(system: System, at: dict[str, Points], along: dict[str, Points], result: Diagram) -> None:
    taken: dict[str, list[float]] = {bus: [_angle(d), _angle(-d)] for bus, d in along.items()}
    for branch in system.branches().values():
        away = at[branch.to_bus] - at[branch.from_bus]
        taken[branch.from_bus].append(_angle(away))
        taken[branch.to_bus].append(_angle(-away))
    branches = system.branches()
    for device in system.devices:
        if device.path in branches:  # a tap changer: the transformer stands for it
            continue
        angle = _freest(taken[device.bus])
        taken[device.bus].append(angle)
        way = np.array([math.cos(angle), math.sin(angle)])
        middle = at[device.bus] + _REACH * way
        kind = device.path.partition(".")[0]
        result.symbols[device.path] = [np.array([at[device.bus], middle - _RADIUS * way]), *_symbol(kind, middle, way)]
        result.anchors[device.path] = (float(middle[0]), float(middle[1] + _RADIUS))


def _symbol(kind: str, middle: Points, way: Points) -> list[Points]:
    """A generator's circle with a wave, a grid's circle with the sign of infinity, a load's arrow head."""
    if kind == "load":
        side = np.array([-way[1], way[0]])
        back = middle - _RADIUS * way
        return [np.array([back + 9.0 * side, middle, back - 9.0 * side, back + 9.0 * side])]
    s = np.linspace(0.0, 2 * math.pi, 33)
    if kind == "unit":
        inside = np.column_stack([middle[0] + 9.0 * (s / math.pi - 1.0), middle[1] - 5.0 * np.sin(s)])
    else:
        scale = 10.0 / (1.0 + np.sin(s) ** 2)
        inside = np.column_stack([middle[0] + scale * np.cos(s), middle[1] + scale * np.sin(s) * np.cos(s)])
    return [circle(middle, _RADIUS), inside]


def circle(middle: Points, radius: float, points: int = 49) -> Points:
    """A closed polyline, shape ``(points, 2)``."""
    s = np.linspace(0.0, 2 * math.pi, points)
    return np.column_stack([middle[0] + radius * np.cos(s), middle[1] + radius * np.sin(s)])


def _angle(direction: Points) -> float:
    return math.atan2(float(direction[1]), float(direction[0]))


def _freest(taken: list[float]) -> float:
    """The compass direction farthest from all that are taken; upwards and left first among equals."""

    def room(angle: float) -> float:
        return min(abs(math.remainder(angle - other, 2 * math.pi)) for other in taken)

    compass = [k * math.pi / 4 for k in (4, 0, 5, 7, 3, 1, 6, 2)]
    return max(compass, key=lambda angle: round(room(angle), 6))
