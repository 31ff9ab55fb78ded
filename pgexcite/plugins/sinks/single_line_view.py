"""The single-line diagram drawn into a recording: voltages as colours, flows as text."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.recording import Colour, colour
from pgexcite.core.system import System
from pgexcite.core.trace import Array, Trace
from pgexcite.plugins.sinks.single_line import Diagram, diagram

ROOT = "/grid"
_WIRE: Colour = (150, 160, 170)
_OPEN: Colour = (70, 72, 76)
_NOTE: Colour = (205, 212, 220)

_ROOM_FOR_FLOWS = 6
_ROOM_FOR_NAMES = 30
"""In grids of more buses than this labels would cover one another; the viewer then shows one on hovering."""

VOLTAGE_COLOURS = (
    (0.00, (150, 60, 230)),
    (0.50, (70, 90, 255)),
    (0.80, (60, 170, 255)),
    (0.95, (70, 215, 170)),
    (1.00, (100, 220, 110)),
    (1.05, (190, 215, 80)),
    (1.15, (255, 90, 60)),
)
"""Bus voltage in pu -> colour, linear in between: green is nominal, blue low, violet none, red high."""


def voltage_colours(v: Array) -> NDArray[np.uint8]:
    """Colours of voltages, shape ``(n,)`` to ``(n, 3)``."""
    at = [level for level, _ in VOLTAGE_COLOURS]
    channels = [np.interp(v, at, [rgb[k] for _, rgb in VOLTAGE_COLOURS]) for k in range(3)]
    return np.column_stack(channels).round().astype(np.uint8)


@dataclass(frozen=True)
class SingleLineView:
    """The grid of a run."""

    system: System
    signals: frozenset[str]

    @cached_property
    def diagram(self) -> Diagram:
        return diagram(self.system)

    @cached_property
    def branches(self) -> tuple[str, ...]:
        """Branches whose flow is in the trace."""
        return tuple(path for path in self.diagram.branches if {f"{path}.p_from", f"{path}.q_from"} <= self.signals)

    @cached_property
    def buses(self) -> tuple[str, ...]:
        """Buses whose voltage is in the trace."""
        return tuple(bus for bus in self.diagram.buses if f"bus.{bus}.v" in self.signals)

    @property
    def _names(self) -> bool:
        return len(self.system.buses) <= _ROOM_FOR_NAMES

    def share(self) -> float:
        """Height of the view for the width it has, against 1 for a square one."""
        (left, right), (top, bottom) = self.diagram.bounds()
        return float(np.clip((bottom - top) / (right - left), 0.45, 1.2))

    def view(self) -> Any:
        """The view of it."""
        import rerun.blueprint as rrb

        x, y = self.diagram.bounds()
        return rrb.Spatial2DView(
            origin=ROOT,
            name="Single-line diagram (bus voltage: green 1 pu, blue low, red high)",
            visual_bounds=rrb.VisualBounds2D(x_range=[*x], y_range=[*y]),
            background=rrb.Background(color=[16, 18, 20]),
        )

    def draw_fixed(self, stream: Any) -> None:
        """Wires, symbols, names."""
        import rerun as rr

        drawing = self.diagram
        wires = list(drawing.branches.values())
        stream.log(f"{ROOT}/branches", _strips(wires, _WIRE, 0.7), static=True)
        units = {
            device.path: k for k, device in enumerate(d for d in self.system.devices if d.path.startswith("unit."))
        }
        for kind in ("unit", "load", "other"):
            lines, colours = [], []
            for path, symbol in drawing.symbols.items():
                own = path.partition(".")[0]
                if kind == (own if own in ("unit", "load") else "other"):
                    lines += symbol
                    colours += [colour(units[path]) if path in units else _WIRE] * len(symbol)
            if lines:
                strips = rr.LineStrips2D(lines, colors=colours, radii=[0.8] * len(lines), draw_order=22.0)
                stream.log(f"{ROOT}/symbols/{kind}", strips, static=True)
        names = {device.path: device.name for device in self.system.devices if device.path in drawing.anchors}
        at = [drawing.anchors[path] for path in names]
        stream.log(
            f"{ROOT}/devices",
            rr.Points2D(
                at, labels=[*names.values()], colors=[_NOTE] * len(at), radii=[0.01] * len(at), show_labels=self._names
            ),
            static=True,
        )
        bars = [drawing.buses[bus] for bus in self.buses]
        stream.log(
            f"{ROOT}/buses",
            rr.LineStrips2D.from_fields(strips=bars, radii=[2.4] * len(bars), draw_order=30.0),
            static=True,
        )
        ends = [drawing.anchors[bus] for bus in self.buses]
        stream.log(
            f"{ROOT}/voltages",
            rr.Points2D.from_fields(positions=ends, radii=[0.01] * len(ends), show_labels=self._names),
            static=True,
        )
        middles = [drawing.branches[path].mean(axis=0) - (0.0, 33.0) for path in self.branches]
        stream.log(
            f"{ROOT}/flows",
            rr.Points2D.from_fields(
                positions=middles,
                colors=[_NOTE] * len(middles),
                radii=[0.01] * len(middles),
                show_labels=len(bars) <= _ROOM_FOR_FLOWS,
            ),
            static=True,
        )

    def send(self, stream: Any, trace: Trace, shown: NDArray[np.int64], first: int) -> None:
        """Colours and texts over time."""
        import rerun as rr

        index = [rr.TimeColumn("time", duration=trace.t[shown]), rr.TimeColumn("step", sequence=first + shown)]
        if self.buses:
            v = np.column_stack([trace[f"bus.{bus}.v"][shown] for bus in self.buses])
            rgb = voltage_colours(v.ravel())
            unit = " pu" if len(self.buses) <= _ROOM_FOR_FLOWS else ""
            text = [f"{bus}  {value:.3f}{unit}" for row in v for bus, value in zip(self.buses, row, strict=True)]
            sizes = [len(self.buses)] * len(shown)
            stream.send_columns(f"{ROOT}/buses", index, rr.LineStrips2D.columns(colors=rgb).partition(sizes))
            stream.send_columns(
                f"{ROOT}/voltages", index, rr.Points2D.columns(labels=text, colors=rgb).partition(sizes)
            )
        if self.branches:
            flows = [(trace[f"{path}.p_from"][shown], trace[f"{path}.q_from"][shown]) for path in self.branches]
            text = [
                self._flow(path, p[k], q[k])
                for k in range(len(shown))
                for path, (p, q) in zip(self.branches, flows, strict=True)
            ]
            sizes = [len(self.branches)] * len(shown)
            stream.send_columns(f"{ROOT}/flows", index, rr.Points2D.columns(labels=text).partition(sizes))

    def _flow(self, path: str, p: float, q: float) -> str:
        name = path.partition(".")[2]
        if p == 0.0 and q == 0.0:
            return f"{name}  open"
        line = self.diagram.branches[path]
        forward = (line[1, 0] - line[0, 0]) * p >= 0
        active = f"{abs(p) * self.system.S_base:.0f} MW"
        return f"{name}  {active} →" if forward else f"← {active}  {name}"


def _strips(lines: list[NDArray[np.float64]], rgb: Colour, radius: float) -> Any:
    import rerun as rr

    return rr.LineStrips2D(lines, colors=[rgb] * len(lines), radii=[radius] * len(lines))
