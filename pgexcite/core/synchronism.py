"""Loss of synchronism: a rotor that has turned too far from what it should turn with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.model import Model
from pgexcite.core.network import islands

Array = NDArray[np.float64]


class RotorAngles:
    """Rotor angles against the infinite bus of their island, or its centre of inertia where it has none.

    Islands are those of the branches in service: machines cut off from the infinite bus are out of step with one another or not at
    all.
    """

    def __init__(self, model: Model) -> None:
        system = model.system
        machines = [d for d in system.devices if "machine" in d.components]
        self.names = [d.path for d in machines]
        self.columns = np.array([model.position("y", f"{d.path}.delta") for d in machines], dtype=int)
        self._buses = [d.bus for d in machines]
        self._inertia = np.array([float(getattr(d.components["machine"], "H", 0.0)) * d.S_n for d in machines])
        sources = [d for d in system.devices if next((c.role for c in d.components.values()), "") == "source"]
        self._sources = {d.bus: model.index["x"].get(f"{d.path}.theta") for d in sources}
        branches = system.branches()
        self._ends = [(branch.from_bus, branch.to_bus) for branch in branches.values()]
        self._switches = np.array([model.position("p", f"{path}.status") for path in branches], dtype=int)
        self._all = tuple(system.buses)
        self._in_service: NDArray[np.bool_] | None = None
        self._weights, self._thetas = np.zeros((0, 0)), np.zeros(0, dtype=int)

    def follow(self, p: Array) -> None:
        """Take the islands from the branches' status in ``p``."""
        in_service = p[self._switches] > 0
        if self._in_service is not None and np.array_equal(in_service, self._in_service):
            return
        self._in_service = in_service
        island = islands(self._all, [ends for ends, on in zip(self._ends, in_service, strict=True) if on])
        n = len(self.names)
        # An angle's reference is (angles @ weights) plus the theta of column thetas; -1 is none.
        self._weights, self._thetas = np.zeros((n, n)), np.full(n, -1)
        sources = {island[bus]: theta for bus, theta in reversed(self._sources.items())}
        for one in {island[bus] for bus in self._buses}:
            members = np.array([island[bus] == one for bus in self._buses])
            inertia = np.where(members, self._inertia, 0.0)
            if one in sources:
                theta = sources[one]
                self._thetas[members] = -1 if theta is None else theta
            elif np.all(inertia[members] > 0):
                self._weights[:, members] = (inertia / inertia.sum())[:, None]

    def first_beyond(self, x: Array, y: Array, limit_deg: float) -> tuple[int, str, float] | None:
        """First sample at which a machine is out of step: row, unit, angle in degrees."""
        if not y.shape[0] or not self.columns.size:
            return None
        angles = y[:, self.columns]
        angles = angles - angles @ self._weights - np.where(self._thetas >= 0, x[:, self._thetas], 0.0)
        beyond = np.abs(angles) > np.radians(limit_deg)
        if not beyond.any():
            return None
        row = int(np.argmax(beyond.any(axis=1)))
        unit = int(np.argmax(np.abs(angles[row])))
        return row, self.names[unit], float(np.degrees(angles[row, unit]))

    def reference(self, unit: str) -> str:
        """What the angle of a unit (a path) is measured against, in words."""
        weights = self._weights[self.names.index(unit)]
        return "the centre of inertia of its island" if weights.any() else "the infinite bus"


def dead_buses(model: Model, p: Array) -> tuple[str, ...]:
    """Buses that no branch in service joins to a machine or a source, at parameters ``p``."""
    system = model.system
    live = [b for path, b in system.branches().items() if p[model.position("p", f"{path}.status")] > 0]
    island = islands(tuple(system.buses), [(branch.from_bus, branch.to_bus) for branch in live])
    fed = {island[d.bus] for d in system.devices if any(c.role in {"machine", "source"} for c in d.components.values())}
    return tuple(bus for bus in system.buses if island[bus] not in fed)
