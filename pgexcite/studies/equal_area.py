"""Equal-area study of a scenario: one machine, one infinite bus, one fault."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pgexcite.core import powerflow
from pgexcite.core.events import Change
from pgexcite.core.system import Device, System
from pgexcite.studies.power_angle import Curve, EqualArea
from pgexcite.studies.reduction import TABLES, EqualAreaError, source_impedance, transfer, with_changes

_SAME_INSTANT = 1e-6


class Case(Protocol):
    """What is needed of a scenario."""

    @property
    def title(self) -> str: ...
    @property
    def system(self) -> System: ...
    @property
    def changes(self) -> tuple[Change, ...]: ...


@dataclass(frozen=True)
class EqualAreaStudy:
    """The construction, and the plant it belongs to. Powers are pu of the unit's base; losses are kept.

    Attributes:
        title: of the scenario.
        unit: path of the machine's unit.
        area: curves, critical angle and time.
        e_prime: voltage behind the transient reactance, pu; its angle against the infinite bus is ``area.delta_0``.
        v_infinite: voltage of the infinite bus, pu.
        delta_q: angle of the rotor's q-axis against the infinite bus before the fault, rad; what a machine model calls delta. It
            stays ``delta_q - area.delta_0`` ahead of E' only as long as the flux does.
        clearing: clearing time of the scenario's fault, s; ``None`` when it is never cleared.
        stages: what happens at the fault and at its clearing.
    """

    title: str
    unit: str
    area: EqualArea
    e_prime: float
    v_infinite: float
    delta_q: float
    clearing: float | None
    stages: tuple[str, str]

    @property
    def delta_max(self) -> float | None:
        """Largest angle of E' for the scenario's own clearing time, rad; ``None`` when synchronism is lost or nothing clears."""
        return None if self.clearing is None else self.area.delta_max(self.clearing)

    def as_dict(self) -> dict[str, Any]:
        """All figures, angles in degrees, as plain data."""
        area = self.area
        return {
            "unit": self.unit,
            "p_m": area.p_m,
            "e_prime": self.e_prime,
            "v_infinite": self.v_infinite,
            "delta_0_deg": math.degrees(area.delta_0),
            "delta_q_deg": math.degrees(self.delta_q),
            "p_max_before": area.before.peak + area.before.offset,
            "p_max_during": area.during.peak + area.during.offset,
            "p_max_after": area.after.peak + area.after.offset,
            "r_1": area.r_1,
            "r_2": area.r_2,
            "delta_limit_deg": _degrees(area.delta_limit),
            "always_stable": area.always_stable,
            "delta_crit_deg": _degrees(area.delta_crit),
            "t_crit": area.t_crit,
            "clearing": self.clearing,
            "delta_max_deg": _degrees(self.delta_max),
        }

    def rows(self) -> list[dict[str, str]]:
        """The figures as a table for people: ``quantity``, ``value``, ``unit``."""
        found = self.as_dict()
        never = "none: rides through" if found["always_stable"] else "none: unstable at once"
        table = (
            ("mechanical power P_m", found["p_m"], "pu", ""),
            ("voltage behind Xp_d, E'", found["e_prime"], "pu", ""),
            ("infinite bus voltage", found["v_infinite"], "pu", ""),
            ("angle of E' before the fault, delta_0", found["delta_0_deg"], "deg", ""),
            ("angle of the rotor's q-axis", found["delta_q_deg"], "deg", ""),
            ("largest power before the fault", found["p_max_before"], "pu", ""),
            ("largest power during the fault", found["p_max_during"], "pu", ""),
            ("largest power after the fault", found["p_max_after"], "pu", ""),
            ("r_1 (sine during / before)", found["r_1"], "-", ""),
            ("r_2 (sine after / before)", found["r_2"], "-", ""),
            ("angle of no return", found["delta_limit_deg"], "deg", "none"),
            ("critical clearing angle", found["delta_crit_deg"], "deg", never),
            ("critical clearing time", found["t_crit"], "s", never),
            ("clearing time of the scenario", found["clearing"], "s", "never cleared"),
            ("largest angle then", found["delta_max_deg"], "deg", "synchronism is lost"),
        )
        return [
            {
                "quantity": name,
                "value": otherwise if value is None else f"{value:.4f}",
                "unit": "" if value is None else unit,
            }
            for name, value, unit, otherwise in table
        ]

    def figure(self, path: Path) -> Path:
        """Draw the power-angle picture, areas shaded, as PNG; returns the path."""
        from pgexcite.studies.figures import draw_equal_area

        return draw_equal_area(self.area, path, self.title)


def equal_area(scenario: Case) -> EqualAreaStudy:
    """The equal-area construction of a scenario's fault.

    The machine is a constant voltage behind its transient reactance, loads are impedances that draw their initial power at their
    initial voltage, and the network is reduced to the machine and the infinite bus, with its losses and the fault's impedance.

    Raises:
        EqualAreaError: there is more or less than one machine and one infinite bus, no fault, or something happens that three
            curves cannot show.
        PowerFlowError: the initial power flow has no solution.
    """
    system = scenario.system
    unit, infinite = _pair(system)
    at_fault, at_clearing, clearing = _stages(scenario.changes)
    flow = powerflow.solve(system)
    machine = unit.components["machine"]
    for name in ("H", "Xp_d"):
        if getattr(machine, name, None) is None:
            raise EqualAreaError(
                f"{unit.path}.machine: {type(machine).__name__} has no {name}; the construction needs it"
            )
    scale = unit.S_n / system.S_base
    v = flow.v[unit.bus]
    current = (flow.s[unit.path] / v).conjugate() / scale
    source = source_impedance(infinite, system)
    e_infinite = flow.v[infinite.bus] + source * (flow.s[infinite.path] / flow.v[infinite.bus]).conjugate()
    z = complex(getattr(machine, "R_a", 0.0), machine.Xp_d)  # type: ignore[attr-defined]
    e = v + z * current
    on_q = v + complex(z.real, getattr(machine, "X_q", z.imag)) * current
    delta_0 = cmath.phase(e / e_infinite)
    loads = {
        d.path: -flow.s[d.path].conjugate() / abs(flow.v[d.bus]) ** 2
        for d in system.devices
        if d not in (unit, infinite)
    }

    def curve(values: Mapping[str, float]) -> Curve:
        own, mutual = transfer(with_changes(system, values), loads, (unit, z / scale), (infinite, source))
        peak = abs(e * e_infinite * mutual) / scale
        return Curve(peak, abs(e) ** 2 * own.real / scale, -cmath.phase(complex(mutual.imag, mutual.real)))

    before = curve({})
    during = curve(_values(at_fault))
    after = curve(_values((*at_fault, *at_clearing)))
    area = EqualArea(before(delta_0), delta_0, before, during, after, float(machine.H), system.f_n)  # type: ignore[attr-defined]
    texts = tuple("; ".join(change.text for change in stage) for stage in (at_fault, at_clearing))
    return EqualAreaStudy(
        title=scenario.title,
        unit=unit.path,
        area=area,
        e_prime=abs(e),
        v_infinite=abs(e_infinite),
        delta_q=cmath.phase(on_q / e_infinite),
        clearing=clearing,
        stages=(texts[0], texts[1]),
    )


def _pair(system: System) -> tuple[Device, Device]:
    """The one machine and the one infinite bus (a classical machine with H = 0 is one)."""
    units: list[Device] = []
    infinite: list[Device] = []
    for device in system.devices:
        if device.path.startswith("unit."):
            still = getattr(device.components["machine"], "H", None) == 0
            (infinite if still else units).append(device)
        elif device.path.startswith("infinite_bus."):
            infinite.append(device)
    if len(units) != 1 or len(infinite) != 1:
        raise EqualAreaError(
            f"the equal-area construction needs one machine and one infinite bus; here are {len(units)} machines "
            f"({', '.join(d.path for d in units) or 'none'}) and {len(infinite)} infinite buses "
            f"({', '.join(d.path for d in infinite) or 'none'}); use the critical clearing time by simulation instead"
        )
    return units[0], infinite[0]


def _stages(changes: Sequence[Change]) -> tuple[tuple[Change, ...], tuple[Change, ...], float | None]:
    """Changes at the fault, changes at its clearing (both without what follows), and the time between."""
    ordered = sorted((change for change in changes if change.when is None), key=lambda change: change.t)
    begins = [c.t for c in ordered if any(p.endswith(".fault_status") and v > 0 for p, v in c.values.items())]
    ends = [c.t for c in ordered if any(p.endswith(".fault_status") and v == 0 for p, v in c.values.items())]
    if len(begins) != 1:
        raise EqualAreaError(
            f"the equal-area construction needs one fault; this scenario has {len(begins)} (event type 'fault')"
        )
    t_on, t_off = begins[0], (ends[0] if ends else None)
    at_fault = tuple(c for c in ordered if abs(c.t - t_on) < _SAME_INSTANT)
    if t_off is None:
        cleared = {path: 0.0 for c in at_fault for path in c.values if path.endswith(".fault_status")}
        return at_fault, (Change(t_on, cleared, "fault cleared"),), None
    stray = [c for c in ordered if c.t < t_off - _SAME_INSTANT and c not in at_fault]
    if stray:
        raise EqualAreaError(
            f"{stray[0].text!r} at {stray[0].t:g} s: only a fault and what happens as it clears can be shown in three curves; "
            "leave other events before the clearing out"
        )
    return at_fault, tuple(c for c in ordered if abs(c.t - t_off) < _SAME_INSTANT), t_off - t_on


def _values(changes: Sequence[Change]) -> dict[str, float]:
    merged: dict[str, float] = {}
    for change in changes:
        foreign = [p for p, _, _ in change.assignments() if p.split(".")[0] not in TABLES]
        if foreign:
            raise EqualAreaError(f"{foreign[0]} changes with the fault ({change.text}); only the network may")
        merged.update(change.values)
    return merged


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(angle)
