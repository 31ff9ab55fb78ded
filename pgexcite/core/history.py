"""What a run leaves behind: samples on both sides of every jump, the log, and how the controllers did."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.controller import Action
from pgexcite.core.model import Model, State
from pgexcite.core.result import ControllerStatistics
from pgexcite.core.trace import LogEntry, Trace, reference_of

Array = NDArray[np.float64]


@dataclass
class _Acted:
    """What a controller answered, sample by sample."""

    t: list[float] = field(default_factory=list)
    diagnostics: list[Mapping[str, float]] = field(default_factory=list)
    solve_ms: list[float] = field(default_factory=list)
    fallbacks: int = 0
    cost: float = 0.0


class History:
    """Blocks of consecutive samples; inside a block commands and parameters do not change.

    Args:
        model: whose run it is.
        controllers: their names.
    """

    def __init__(self, model: Model, controllers: Iterable[str]) -> None:
        self._model = model
        self._t: list[Array] = []
        self._x: list[Array] = []
        self._z: list[Array] = []
        self._d: list[Array] = []
        self._u: list[Array] = []
        self._y: list[Array] = []
        self._log: list[LogEntry] = []
        self._acted = {name: _Acted() for name in controllers}

    def add(self, t: Array, x: Array, z: Array, d: Array, u: Array, y: Array) -> None:
        """A block: ``n`` samples of each, a row each, and the commands in force all the while, shape ``(n_u,)``."""
        self._t.append(t)
        self._x.append(x)
        self._z.append(z)
        self._d.append(d)
        self._u.append(np.broadcast_to(u, (t.size, u.size)))
        self._y.append(y)

    def add_point(self, state: State, y: Array) -> None:
        """A block of one sample."""
        self.add(np.array([state.t]), state.x[None], state.z[None], state.d[None], state.u, y[None])

    def note(self, t: float, kind: str, text: str) -> None:
        """A line of the log."""
        self._log.append(LogEntry(t, kind, text))

    def acted(self, name: str, t: float, action: Action, active: bool, solve_ms: float) -> None:
        """A controller's answer at ``t``, whether it is in charge from then on, and the wall time it took."""
        of = self._acted[name]
        of.solve_ms.append(solve_ms)
        of.t.append(t)
        of.diagnostics.append({**action.diagnostics, "active": float(active)})
        of.cost += action.stage_cost
        of.fallbacks += action.fallback
        for note in action.notes:
            self.note(t, "controller", f"{name}: {note}")

    def forget(self, before: float) -> None:
        """Drop samples older than ``before`` (s); log and statistics stay."""
        gone = sum(block[-1] < before for block in self._t[:-1])
        for blocks in (self._t, self._x, self._z, self._d, self._u, self._y):
            del blocks[:gone]
        for of in self._acted.values():
            old = sum(t < before for t in of.t[:-1])
            del of.t[:old], of.diagnostics[:old]

    def trace(self) -> Trace:
        """All samples so far."""
        m = self._model
        t = np.concatenate(self._t)
        columns: dict[str, Array] = {}
        for names, blocks in ((m.y_names, self._y), (m.x_names, self._x), (m.d_names, self._d), (m.u_names, self._u)):
            if names:
                columns |= dict(zip(names, np.ascontiguousarray(np.concatenate(blocks).T), strict=True))
        units = {path: m.units.get(path, "") for path in columns}
        for name, of in self._acted.items():
            for key in {key: None for row in of.diagnostics for key in row}:
                path = f"controller.{name}.{key}"
                columns[path] = _held(t, of.t, [row.get(key, np.nan) for row in of.diagnostics])
                units[path] = "ms" if key.endswith("_ms") else "pu" if key.startswith(reference_of("")) else ""
        return Trace(t, columns, units, tuple(sorted(self._log, key=lambda entry: entry.t)))

    def statistics(self) -> dict[str, ControllerStatistics]:
        """How each controller did, by name."""
        return {
            name: ControllerStatistics(len(of.solve_ms), tuple(of.solve_ms), of.fallbacks, of.cost)
            for name, of in self._acted.items()
        }


def _held(t: Array, instants: list[float], values: list[float]) -> Array:
    """Samples of a quantity that is constant between instants, NaN before the first."""
    position = np.searchsorted(np.array(instants), t + 1e-9, side="right") - 1
    return np.where(position >= 0, np.array(values, dtype=float)[np.maximum(position, 0)], np.nan)
