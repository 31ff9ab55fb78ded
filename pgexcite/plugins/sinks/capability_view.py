"""Capability curves drawn into a recording, with the operating point moving over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core import recording
from pgexcite.core.recording import colour, entity
from pgexcite.core.system import Device
from pgexcite.core.trace import Trace
from pgexcite.plugins.sinks.capability import Capability

SCALE = 100.0
"""Drawn length of 1 pu; the viewer's sizes are in the drawing's units."""
ROOT = "capability"
_AXIS = (120, 130, 140)

LIMITS = (
    ("stator", "stator current", (90, 160, 255)),
    ("field", "field current", (255, 150, 50)),
    ("under_excitation", "stability limit less 0.1 pu", (235, 90, 105)),
    ("turbine", "turbine", (90, 210, 120)),
)


@dataclass(frozen=True)
class CapabilityView:
    """One view per unit: P to the right, Q upwards, both pu of the machine's base; limits at rated voltage."""

    units: Sequence[Device]

    def views(self) -> list[Any]:
        """One view, or tabs of them; none without units."""
        import rerun.blueprint as rrb

        title = (
            "operating point P-Q on the capability curve [pu of the machine]" if len(self.units) == 1 else "P-Q [pu]"
        )
        views = [
            rrb.Spatial2DView(
                origin=entity(device.path, ROOT),
                name=f"{device.name}: {title}",
                visual_bounds=rrb.VisualBounds2D(x_range=[-30, 140], y_range=[-125, 125]),
                background=rrb.Background(color=[16, 18, 20]),
            )
            for device in self.units
        ]
        return [rrb.Tabs(*views, active_tab=0)] if len(views) > 1 else views

    def draw_fixed(self, stream: Any) -> None:
        """Axes and limits."""
        for device in self.units:
            self._axes(stream, entity(device.path, ROOT))
            self._limits(stream, entity(device.path, ROOT), Capability.of(device, v_t=1.0))

    def send(self, stream: Any, trace: Trace, shown: NDArray[np.int64], first: int) -> None:
        """The operating point over time, and the way it went."""
        import rerun as rr

        index = [
            rr.TimeColumn("time", duration=trace.t[shown]),
            rr.TimeColumn("step", sequence=first + shown),
        ]
        for k, device in enumerate(self.units):
            root = entity(device.path, ROOT)
            p, q = trace[f"{device.path}.p_e"], trace[f"{device.path}.q_e"]
            points = SCALE * np.column_stack([p, -q])
            stream.send_columns(f"{root}/point", index, rr.Points2D.columns(positions=points[shown]))
            text = [f"P {p[j]:.2f}   Q {q[j]:.2f}" for j in shown]
            stream.send_columns(f"{root}/reading", index, rr.Points2D.columns(labels=text))
            jumps = np.flatnonzero(np.diff(trace.t) == 0) + 1
            way = [part for part in np.split(points, jumps) if len(part) > 1]
            faint = [*colour(k), 110]
            stream.log(
                f"{root}/way/{first}",
                rr.LineStrips2D(way, colors=[faint] * len(way), radii=[0.5] * len(way), draw_order=25.0),
                static=True,
            )

    def _axes(self, stream: Any, root: str) -> None:
        import rerun as rr

        ticks = (-1.0, -0.5, 0.5, 1.0)
        lines = [[(-40.0, 0.0), (125.0, 0.0)], [(0.0, -115.0), (0.0, 115.0)]]
        lines += [[(SCALE * v, -1.5), (SCALE * v, 1.5)] for v in ticks if v > 0]
        lines += [[(-1.5, -SCALE * v), (1.5, -SCALE * v)] for v in ticks]
        stream.log(
            f"{root}/axes", rr.LineStrips2D(lines, colors=[_AXIS] * len(lines), radii=[0.3] * len(lines)), static=True
        )
        at = (
            [(SCALE * v, 3.0) for v in ticks if v > 0]
            + [(-9.0, -SCALE * v - 2) for v in ticks]
            + [(128.0, -3.0), (0.0, -119.0)]
        )
        text = [f"{v:g}" for v in ticks if v > 0] + [f"{v:g}" for v in ticks] + ["P", "Q"]
        recording_labels(stream, f"{root}/ticks", at, text, _AXIS)

    def _limits(self, stream: Any, root: str, curve: Capability) -> None:
        import rerun as rr

        for name, label, rgb in LIMITS:
            points = getattr(curve, name)()
            if not len(points):
                continue
            drawn = SCALE * np.column_stack([points[:, 0], -points[:, 1]])
            stream.log(f"{root}/{name}", rr.LineStrips2D([drawn], colors=[rgb], radii=[0.7]), static=True)
            recording_labels(stream, f"{root}/{name}/name", [tuple(_label_place(name, drawn))], [label], rgb)
        p, q = curve.rated
        recording_labels(stream, f"{root}/rated/name", [(SCALE * p + 16, -SCALE * q - 9)], ["rated"], (255, 255, 255))
        stream.log(
            f"{root}/rated",
            rr.Points2D([(SCALE * p, -SCALE * q)], colors=[(255, 255, 255)], radii=[1.6]),
            static=True,
        )
        for k, device in enumerate(self.units):
            if entity(device.path, ROOT) == root:
                point = rr.Points2D.from_fields(colors=[colour(k)], radii=[2.6], draw_order=40.0)
                stream.log(f"{root}/point", point, static=True)
                reading = rr.Points2D.from_fields(
                    positions=[(112, -112)], colors=[colour(k)], radii=[0.01], show_labels=True
                )
                stream.log(f"{root}/reading", reading, static=True)


def recording_labels(
    stream: Any, path: str, at: list[tuple[float, float]], text: list[str], rgb: recording.Colour
) -> None:
    """Text at points, the points themselves invisible."""
    import rerun as rr

    stream.log(
        path,
        rr.Points2D(at, labels=text, colors=[rgb] * len(at), radii=[0.01] * len(at), show_labels=True),
        static=True,
    )


def _label_place(name: str, drawn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Beside the curve, where no other passes."""
    at, aside = {
        "stator": (0.93, (20.0, -12.0)),
        "field": (0.25, (0.0, 4.0)),
        "under_excitation": (0.0, (34.0, -14.0)),
        "turbine": (0.62, (-17.0, 0.0)),
    }[name]
    place: NDArray[np.float64] = drawn[int(at * (len(drawn) - 1))] + aside
    return place
