"""Writing traces into a rerun recording: what the recording of one run, an overlay of several and a live view share.

Every sample is on two timelines: ``time`` (simulated seconds) and ``step`` (index of the sample). At an event two samples share
one time; rerun keeps both rows and draws the jump as a vertical line.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core.trace import Array, LogEntry

CHUNK = 4096
"""Samples to a chunk: from 1,000 on the file's size and the time to write it no longer depend on it."""

Colour = tuple[int, int, int]

PALETTE: tuple[Colour, ...] = (
    (78, 178, 255),
    (255, 150, 50),
    (90, 210, 120),
    (245, 90, 105),
    (185, 135, 255),
    (235, 205, 70),
    (80, 215, 215),
    (250, 130, 200),
    (170, 185, 200),
    (200, 150, 110),
)
"""Colours that stay apart on the viewer's dark background, one per unit or run."""

LEVELS = {"event": "WARN", "limit": "WARN", "solver": "INFO", "controller": "INFO", "outcome": "INFO"}
LOG_COLOURS: Mapping[str, Colour] = {
    "event": (255, 190, 80),
    "limit": (250, 130, 200),
    "solver": (170, 185, 200),
    "controller": (120, 200, 255),
    "outcome": (130, 220, 140),
}


def colour(index: int) -> Colour:
    """The colour of the ``index``-th unit or run."""
    return PALETTE[index % len(PALETTE)]


def entity(path: str, *prefix: str) -> str:
    """Entity path of a signal: ``unit.G2.v_t`` becomes ``/unit/G2/v_t``, below ``prefix``."""
    return entity_of(*prefix, *path.split("."))


def entity_of(*names: str) -> str:
    """Entity path of names, escaped as rerun wants them."""
    import rerun as rr

    return str(rr.new_entity_path([*names]))


def application_id(structure: Iterable[str]) -> str:
    """An application id that changes with what is shown.

    The viewer keeps one layout per application id: an id of its own for every structure keeps a recording from being shown in
    the layout of another one.
    """
    return "pgexcite-" + hashlib.sha256("\n".join(structure).encode()).hexdigest()[:8]


def new_stream(title: str, structure: Iterable[str]) -> Any:
    """A rerun stream, not yet connected to anything; each one is a recording of its own."""
    from uuid import uuid4

    import rerun as rr

    stream = rr.RecordingStream(application_id(structure), recording_id=str(uuid4()))
    stream.send_recording_name(title or "run")
    return stream


def save(stream: Any, path: Path, blueprint: Any) -> None:
    """Send everything from here on into a file with an embedded blueprint."""
    stream.save(path, default_blueprint=blueprint)


def finish(stream: Any) -> None:
    """Write out what is pending and close the file."""
    stream.flush()
    stream.disconnect()


def times(t: Array, first: int = 0) -> list[Any]:
    """The two timelines of samples ``first`` onwards."""
    import rerun as rr

    return [rr.TimeColumn("time", duration=t), rr.TimeColumn("step", sequence=np.arange(first, first + len(t)))]


def send_scalars(stream: Any, columns: Mapping[str, Array], t: Array, first: int = 0) -> None:
    """Send series, by entity path, in chunks of `CHUNK` samples.

    Args:
        stream: the rerun stream.
        columns: entity path -> samples of shape ``(n,)``.
        t: times, s, shape ``(n,)``.
        first: index of the first sample on the timeline ``step``.
    """
    import rerun as rr

    for start in range(0, len(t), CHUNK):
        part = slice(start, start + CHUNK)
        index = times(t[part], first + start)
        for path, samples in columns.items():
            stream.send_columns(path, index, rr.Scalars.columns(scalars=samples[part]))


def style(stream: Any, path: str, name: str, rgb: Colour, width: float = 1.6) -> None:
    """Name and colour a series."""
    import rerun as rr

    stream.log(path, rr.SeriesLines(names=name, colors=[rgb], widths=[width]), static=True)


def send_log(stream: Any, path: str, log: Sequence[LogEntry], t: Array, label: str = "") -> None:
    """Send a run's log as text on both timelines; an entry stands at the first sample that is not before it."""
    import rerun as rr

    if not log:
        return
    at = np.array([entry.t for entry in log])
    steps = np.minimum(np.searchsorted(t, at - 1e-9), max(len(t) - 1, 0))
    text = [f"{label}{_clock(entry)}{entry.text}" for entry in log]
    columns = rr.TextLog.columns(
        text=text,
        level=[LEVELS.get(entry.kind, "INFO") for entry in log],
        color=[LOG_COLOURS.get(entry.kind, (220, 220, 220)) for entry in log],
    )
    stream.send_columns(path, [rr.TimeColumn("time", duration=at), rr.TimeColumn("step", sequence=steps)], columns)


Spans = Mapping[str, tuple[float, float]]
"""Smallest and largest finite sample of each entity."""


def plot(name: str, contents: Sequence[str], legend: str = "RightTop", spans: Spans | None = None) -> Any:
    """A time-series view, its time axis linked to that of every other.

    Args:
        name: its title.
        contents: entities of its series.
        legend: the corner the curves leave free.
        spans: of its series, for a vertical axis that stands from the first frame on; the viewer finds one where it is left out.
    """
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        origin="/",
        contents=[*contents],
        name=name,
        axis_y=_axis([(spans or {})[path] for path in contents if path in (spans or {})]),
        axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.auto(legend)),
    )


def spans_of(columns: Mapping[str, Array]) -> Spans:
    """Spans of these entities; one without a finite sample has none."""
    found = {}
    for path, samples in columns.items():
        finite = samples[np.isfinite(samples)]
        if finite.size:
            found[path] = float(finite.min()), float(finite.max())
    return found


def _axis(spans: Sequence[tuple[float, float]]) -> Any:
    import rerun.blueprint as rrb

    if not spans:
        return None
    low, high = min(low for low, _ in spans), max(high for _, high in spans)
    room = 0.06 * (high - low) or 0.05 * max(abs(high), 1e-3)
    return rrb.ScalarAxis(range=(low - room, high + room))


def text_log(name: str, contents: Sequence[str]) -> Any:
    """A view of logs; the text of an entry begins with its time."""
    import rerun.blueprint as rrb

    columns = rrb.TextLogColumns(timeline_columns=[], text_log_columns=["Body"])
    return rrb.TextLogView(origin="/", contents=[*contents], name=name, columns=columns)


def blueprint(*roots: Any) -> Any:
    """A blueprint with the side panels out of the way and the clock in simulated seconds."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        *roots,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="time"),
        auto_layout=False,
        auto_views=False,
    )


def _clock(entry: LogEntry) -> str:
    return f"{entry.t:.3f} s  "
