"""What is to be simulated, as data: buses, branches and the devices on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from pgexcite.core.component import Component
from pgexcite.core.network import Bus, Line, Shunt, Transformer, islands


@dataclass(frozen=True)
class Schedule:
    """What the power flow is told of a device, in MW, Mvar, per unit and rad.

    Two of the four are given for most devices; the third of a device whose bus has all of P, Q and V leaves one elsewhere free (an
    infinite bus without a voltage).

    Attributes:
        P, Q: delivered to the bus; negative for a load. ``None``: the power flow finds it.
        V: voltage magnitude held at the bus.
        angle: voltage angle held at the bus; a device with an angle is a slack.
        Q_min, Q_max: reactive limits in Mvar; a device beyond them holds the limit instead of V.
    """

    P: float | None = None
    Q: float | None = None
    V: float | None = None
    angle: float | None = None
    Q_min: float = float("-inf")
    Q_max: float = float("inf")


@dataclass(frozen=True)
class Device:
    """Components that share a bus and a per-unit base: a generating unit, a load, a source.

    Attributes:
        path: ``"unit.G2"``, ``"load.L1"``, ``"infinite_bus.grid"``.
        bus: name of the bus.
        S_n: base of the device in MVA.
        components: by slot. A unit has ``machine``, ``exciter``, ``governor`` and may have ``stabiliser`` and limiters; a device
            of a single component has the slot ``""``.
        schedule: for the power flow.
    """

    path: str
    bus: str
    S_n: float
    components: Mapping[str, Component]
    schedule: Schedule

    @property
    def name(self) -> str:
        return self.path.partition(".")[2]

    def component_path(self, slot: str) -> str:
        """Path of a component, as in the configuration: ``unit.G2.exciter``."""
        return f"{self.path}.{slot}" if slot else self.path


@dataclass(frozen=True)
class System:
    """A grid with everything on it.

    Attributes:
        S_base: system base, MVA.
        f_n: nominal frequency, Hz.
        reference: what rotor angles are measured against: ``"infinite_bus"`` (the synchronous frame), ``"centre_of_inertia"``,
            the name of a unit, or ``"auto"`` (the infinite bus where there is one, else the centre of inertia).
    """

    S_base: float
    f_n: float
    buses: Mapping[str, Bus]
    lines: Mapping[str, Line] = field(default_factory=dict)
    transformers: Mapping[str, Transformer] = field(default_factory=dict)
    shunts: Mapping[str, Shunt] = field(default_factory=dict)
    devices: tuple[Device, ...] = ()
    reference: str = "auto"

    def branches(self) -> dict[str, Line | Transformer]:
        """All branches by path: ``line.L1``, ``transformer.T1``."""
        found: dict[str, Line | Transformer] = {f"line.{name}": item for name, item in self.lines.items()}
        found.update({f"transformer.{name}": item for name, item in self.transformers.items()})
        return found

    def islands(self) -> list[tuple[str, ...]]:
        """Buses in groups that branches in service hold together; a branch from or to a bus that does not exist holds none."""
        live = [branch for branch in self.branches().values() if branch.status > 0]
        links = [(b.from_bus, b.to_bus) for b in live if b.from_bus in self.buses and b.to_bus in self.buses]
        return list(dict.fromkeys(islands(self.buses, links).values()))

    def device(self, path: str) -> Device:
        """The device at this path.

        Raises:
            KeyError: there is none.
        """
        for item in self.devices:
            if item.path == path:
                return item
        raise KeyError(path)
