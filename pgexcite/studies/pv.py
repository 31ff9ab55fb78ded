"""P-V curves: loads of a power flow scaled at constant power factor, by continuation through the nose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.system import Device, Schedule, System
from pgexcite.studies.continuation import ContinuationError, LoadScaling, trace

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PVCurve:
    """A P-V curve from no load, or the least the schedule of the units allows, over the nose down the lower branch.

    Attributes:
        loads: paths of the loads that were scaled.
        factor: what their P and Q were multiplied with, shape ``(n,)``.
        P, Q: power of these loads together, MW and Mvar, shape ``(n,)``.
        V: bus -> voltage, pu, shape ``(n,)``.
        nose: position of the nose, whose point is exact.
        weakest: the bus whose voltage falls most at the nose.
        limited: ``(P in MW, path)`` of each unit that met its reactive limit on the way up from the base case.
        S_base: base of powers in per unit, MVA.
    """

    loads: tuple[str, ...]
    factor: Array
    P: Array
    Q: Array
    V: Mapping[str, Array]
    nose: int
    weakest: str
    limited: tuple[tuple[float, str], ...]
    S_base: float

    @property
    def P_max(self) -> float:
        """Active power at the nose, MW."""
        return float(self.P[self.nose])

    def as_dict(self) -> dict[str, Any]:
        """The nose as plain data."""
        return {
            "loads": list(self.loads),
            "P_max_MW": self.P_max,
            "factor_max": float(self.factor[self.nose]),
            "weakest_bus": self.weakest,
            "V_at_nose": {bus: float(v[self.nose]) for bus, v in self.V.items()},
            "limited": [{"P_MW": p, "unit": path} for p, path in self.limited],
            "points": len(self.P),
        }

    def row(self, label: str, bus: str, *, per_unit: bool = False) -> dict[str, Any]:
        """The nose as a row of a table, with the voltage of one bus; its power in MW or per unit of ``S_base``."""
        power = {"P_max [pu]": self.P_max / self.S_base} if per_unit else {"P_max [MW]": self.P_max}
        return {
            "curve": label,
            **power,
            "factor": float(self.factor[self.nose]),
            f"V at {bus} [pu]": float(self.V[bus][self.nose]),
            "weakest bus": self.weakest,
            "at reactive limit": ", ".join(path for _, path in self.limited) or "none",
        }


def pv_curve(system: System, loads: Sequence[str] = (), tan_phi: float | None = None) -> PVCurve:
    """Scale loads from nothing to the nose and back down the lower branch.

    Loads are constant powers here, whatever their models; the slack covers the balance. A unit that meets a reactive limit holds
    it from there on.

    Args:
        system: its power flow is the base case, factor 1.
        loads: names of the loads to scale; all where empty.
        tan_phi: ``Q / P`` given to them in place of their own.

    Raises:
        ContinuationError: nothing to scale, no such load, or no way on.
        PowerFlowError: the base case has no solution.
    """
    chosen = _chosen(system, loads)
    if tan_phi is not None:
        system = _with_power_factor(system, {device.path for device in chosen}, tan_phi)
        chosen = [system.device(device.path) for device in chosen]
    problem = LoadScaling(system, chosen)
    start = problem.base()
    down, _ = trace(problem, start, -1.0, stop=lambda y: y[-1] <= 0.0)
    unloaded = problem.at_factor(down[-1], 0.0) if down[-1][-1] < 0.0 else None
    if unloaded is not None:
        down[-1] = unloaded
    problem.release()
    up, nose = trace(problem, start, 1.0, stop=problem.at_the_end)
    if nose is None:
        raise ContinuationError(f"no nose within {len(up)} points; the loads' scaling factor reached {up[-1][-1]:.3g}")
    points = np.array([y for y in down[:0:-1] if y[-1] >= 0.0] + [y for y in up if y[-1] >= 0.0])
    v = problem.voltages(points)
    weakest = problem.names[
        int(np.argmin(problem.voltages(problem.tangent(up[nose], up[nose] - up[nose - 1])[None])[0]))
    ]
    P, Q = (-sum(getattr(device.schedule, key) or 0.0 for device in chosen) for key in ("P", "Q"))
    return PVCurve(
        tuple(device.path for device in chosen),
        points[:, -1],
        P * points[:, -1],
        Q * points[:, -1],
        dict(zip(problem.names, v.T, strict=True)),
        sum(y[-1] >= 0.0 for y in down[1:]) + nose,
        weakest,
        tuple((P * factor, path) for factor, path in problem.limited),
        system.S_base,
    )


def _chosen(system: System, loads: Sequence[str]) -> list[Device]:
    there = {device.name: device for device in system.devices if device.path.startswith("load.")}
    missing = [name for name in loads if name not in there]
    if missing:
        raise ContinuationError(f"no load is named {', '.join(missing)}; loads are {', '.join(there) or 'none'}")
    chosen = [there[name] for name in loads] if loads else list(there.values())
    if not any(device.schedule.P for device in chosen):
        raise ContinuationError("none of these loads draws active power: there is nothing to scale")
    return chosen


def _with_power_factor(system: System, paths: set[str], tan_phi: float) -> System:
    def changed(device: Device) -> Device:
        P = device.schedule.P or 0.0
        return replace(device, schedule=Schedule(P=P, Q=P * tan_phi)) if device.path in paths else device

    return replace(system, devices=tuple(changed(device) for device in system.devices))
