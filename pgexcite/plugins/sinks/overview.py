"""What a recording shows: single-line diagram, capability curves, curves against time, events, controller diagnostics."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pgexcite.core import recording
from pgexcite.core.recording import Colour, colour, entity
from pgexcite.core.system import Device, System
from pgexcite.core.trace import Array, Trace
from pgexcite.plugins.sinks import realtime_view
from pgexcite.plugins.sinks.capability_view import CapabilityView
from pgexcite.plugins.sinks.single_line_view import SingleLineView

LOG = "/log"
DEGREES = "degrees"
"""Prefix of the rotor angles shown to people; everything else is shown as it stands in the trace."""


@dataclass(frozen=True)
class Quantity:
    """A plot of the overview: its title, the signals of every unit in it with their names, and where its legend goes."""

    title: str
    signals: tuple[tuple[str, str], ...]
    legend: str = "RightTop"


QUANTITIES = (
    Quantity("Rotor angle δ [deg]", (("delta", "δ"),)),
    Quantity("Rotor speed ω [pu]", (("omega", "ω"),)),
    Quantity("Terminal voltage V_t [pu]", (("v_t", "V_t"),), "RightBottom"),
    Quantity("Active power P [pu of the machine]", (("p_e", "P"),)),
    Quantity("Reactive power Q [pu of the machine]", (("q_e", "Q"),)),
)
FIELD = Quantity("Field voltage E_fd and current i_fd [pu]", (("e_fd", "E_fd"), ("i_fd", "i_fd")))
FIELD_APART = (
    Quantity("Field voltage E_fd [pu]", (("e_fd", "E_fd"),)),
    Quantity("Field current i_fd [pu]", (("i_fd", "i_fd"),)),
)
"""Instead of `FIELD` where there are more than two units."""
BUSES = Quantity("Bus voltages [pu]", (), "RightBottom")
"""Beside them, for an even number of plots: where there are few units the diagram shows the buses well enough."""
DIAGNOSTICS = {"cost": "cost [-]", "solve_ms": "solve time [ms]"}
"""Controller signals with a plot in the overview, by the end of their name."""
ESTIMATES = {
    "x_s": "reactance x_s to the equivalent bus, ± 1 σ [pu]",
    "v_bus": "voltage V_bus of the equivalent bus, ± 1 σ [pu]",
}
"""Controllers' estimates with a plot of their band in the overview; the signal ``sigma_NAME`` has their standard deviation."""
BANDS = {"above": 1.0, "below": -1.0}
"""Prefixes of the edges of a band, and their distance from the estimate in standard deviations."""


@dataclass(frozen=True)
class Overview:
    """The layout of one system's recording, and what it takes to fill it."""

    system: System
    signals: frozenset[str]

    @classmethod
    def of(cls, system: System, signals: Iterable[str]) -> Overview:
        """For a system and the paths of the signals there will be."""
        return cls(system, frozenset(signals))

    @cached_property
    def units(self) -> tuple[Device, ...]:
        return tuple(device for device in self.system.devices if device.path.startswith("unit."))

    @cached_property
    def capability(self) -> CapabilityView:
        return CapabilityView([d for d in self.units if {f"{d.path}.p_e", f"{d.path}.q_e"} <= self.signals])

    @cached_property
    def single_line(self) -> SingleLineView:
        return SingleLineView(self.system, self.signals)

    def blueprint(self, trace: Trace | None = None) -> Any:
        """The layout: grid on the left, curves on the right, log below, components on a second tab.

        Args:
            trace: fixes the axes of the curves, where it is there already.
        """
        import rerun.blueprint as rrb

        spans = {} if trace is None else recording.spans_of(self._columns(trace))
        curves = [
            recording.plot(quantity.title, [path for path, _, _ in series], quantity.legend, spans)
            for quantity, series in self._curves()
        ]
        curves += self._diagnostics(spans) + self._bands(spans)
        shares = [self.single_line.share(), *[1.0 for _ in self.capability.units[:1]]]
        left = rrb.Vertical(self.single_line.view(), *self.capability.views(), row_shares=shares)
        log = recording.text_log("Events", [LOG])
        right = rrb.Vertical(rrb.Grid(*curves, grid_columns=2), log, row_shares=[5, 1])
        overview = rrb.Horizontal(left, right, column_shares=[2, 3], name="Overview")
        inside = self._component_plots(spans)
        tabs = [overview, rrb.Grid(*inside, grid_columns=2, name="Components")] if inside else [overview]
        if any(path.startswith("realtime.") for path in self.signals):
            tabs.append(realtime_view.tab())
        return recording.blueprint(rrb.Tabs(*tabs, active_tab=0) if len(tabs) > 1 else overview)

    def draw_fixed(self, stream: Any) -> None:
        """Send what does not change: names, colours, diagram, capability curves."""
        for _, series in self._curves():
            for path, name, rgb in series:
                recording.style(stream, path, name, rgb)
        for k, path in enumerate(sorted(self.signals)):
            slot, _, name = path.rpartition(".")
            if slot.count(".") == 2 or slot.startswith("controller."):
                recording.style(stream, entity(path), f"{slot.split('.')[1]} {name}", colour(k))
        for k, path in enumerate(self._estimates()):
            name = " ".join(path.split(".")[1:])
            recording.style(stream, entity(path), name, colour(k), 2.0)
            for side, sigmas in BANDS.items():
                recording.style(stream, entity(path, side), f"{name} {sigmas:+.0f} σ", _paler(colour(k)), 0.8)
        self.single_line.draw_fixed(stream)
        self.capability.draw_fixed(stream)

    def send(self, stream: Any, trace: Trace, first: int = 0) -> None:
        """Send samples; ``first`` is the index of the first one in the whole run."""
        recording.send_scalars(stream, self._columns(trace), trace.t, first)
        recording.send_log(stream, LOG, trace.log, trace.t)
        shown = frames(trace)
        self.single_line.send(stream, trace, shown, first)
        self.capability.send(stream, trace, shown, first)

    def _columns(self, trace: Trace) -> dict[str, Array]:
        """Samples by entity, rotor angles also in degrees, and the edges of estimates' bands."""
        columns = {entity(path): samples for path, samples in trace.columns.items()}
        for device in self.units:
            path = f"{device.path}.delta"
            if path in trace.columns:
                columns[entity(path, DEGREES)] = np.degrees(trace[path])
        for path in self._estimates():
            if path in trace.columns:
                for side, sigmas in BANDS.items():
                    columns[entity(path, side)] = trace[path] + sigmas * trace[_sigma(path)]
        return columns

    def _estimates(self) -> list[str]:
        """Signals that are estimates with a standard deviation, the same quantity of all controllers together."""
        found = [path for path in self.signals if path.startswith("controller.") and _sigma(path) in self.signals]
        return sorted(path for path in found if path.rpartition(".")[2] in ESTIMATES)

    def _curves(self) -> list[tuple[Quantity, list[tuple[str, str, Colour]]]]:
        """The plots with anything in them, each with (entity, name, colour) of its series."""
        found = []
        field = FIELD_APART if len(self.units) > 2 else (FIELD,)
        for quantity in (*QUANTITIES[:3], *field, *QUANTITIES[3:]):
            series = []
            for k, device in enumerate(self.units):
                for shade, (signal, label) in enumerate(quantity.signals):
                    path = f"{device.path}.{signal}"
                    if path in self.signals:
                        where = entity(path, DEGREES) if signal == "delta" else entity(path)
                        series.append((where, f"{device.name} {label}", colour(k + shade * 5)))
            if series:
                found.append((quantity, series))
        buses = [bus for bus in self.system.buses if f"bus.{bus}.v" in self.signals]
        if len(self.units) > 2 and buses:
            found.append((BUSES, [(entity(f"bus.{bus}.v"), bus, colour(k)) for k, bus in enumerate(buses)]))
        return found

    def _diagnostics(self, spans: recording.Spans) -> list[Any]:
        found = sorted(path for path in self.signals if path.startswith("controller."))
        return [
            recording.plot(f"Controllers: {title}", [entity(path) for path in paths], spans=spans)
            for name, title in DIAGNOSTICS.items()
            if (paths := [path for path in found if path.endswith(name)])
        ]

    def _bands(self, spans: recording.Spans) -> list[Any]:
        plots = []
        for name, title in ESTIMATES.items():
            paths = [path for path in self._estimates() if path.endswith(f".{name}")]
            shown = [entity(path, *side) for path in paths for side in ((), *((side,) for side in BANDS))]
            if shown:
                plots.append(recording.plot(f"Estimated {title}", shown, spans=spans))
        return plots

    def _component_plots(self, spans: recording.Spans) -> list[Any]:
        """A plot per component of a unit and per controller: states, set-points, everything a person may want to look into."""
        slots: dict[str, list[str]] = {}
        for path in sorted(self.signals):
            slot = path.rpartition(".")[0]
            if (slot.startswith("unit.") and slot.count(".") == 2) or slot.startswith("controller."):
                slots.setdefault(slot, []).append(entity(path))
        return [recording.plot(" ".join(slot.split(".")[1:]), paths, spans=spans) for slot, paths in slots.items()]


def _sigma(path: str) -> str:
    """Signal of an estimate's standard deviation."""
    head, _, name = path.rpartition(".")
    return f"{head}.sigma_{name}"


def _paler(rgb: Colour) -> Colour:
    red, green, blue = (int(0.55 * part) for part in rgb)
    return red, green, blue


def frames(trace: Trace, spacing: float = 0.02) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Indices of the samples drawn as pictures: one in ``spacing`` seconds, both sides of every event, and the last."""
    t = trace.t
    keep = np.zeros(len(t), dtype=bool)
    keep[np.unique(np.floor((t - t[0]) / spacing + 1e-6), return_index=True)[1]] = True
    twin = np.flatnonzero(np.diff(t) == 0)
    keep[twin] = keep[twin + 1] = keep[-1] = True
    return np.flatnonzero(keep)
