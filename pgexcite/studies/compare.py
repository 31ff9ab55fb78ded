"""Several finished runs side by side: a table, a picture and one recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core import recording
from pgexcite.core.errors import PgexciteError
from pgexcite.core.record import Record, read_record
from pgexcite.core.recording import Colour, colour, entity
from pgexcite.core.summary import unit_names
from pgexcite.core.trace import Array, Trace
from pgexcite.studies.figures import PANELS, draw_runs
from pgexcite.studies.measures import swing_figures

PICTURE_FILE = "compare.png"
RECORDING_FILE = "compare.rrd"


class CompareError(PgexciteError):
    """These runs cannot be compared."""


@dataclass(frozen=True)
class Comparison:
    """A finished comparison.

    Attributes:
        rows: one per run and unit: ``label``, ``unit``, ``outcome``, ``t_end``, the unit's figures of ``summary.json``, then
            those of ``measures.swing_figures``, and over all controllers of the run ``fallbacks`` and the largest ``solve_ms_p99``.
        picture: the PNG.
        recording: the ``.rrd``.
    """

    rows: list[dict[str, Any]]
    picture: Path
    recording: Path


def compare(run_dirs: Sequence[Path | str], out_dir: Path | str, labels: Sequence[str] | None = None) -> Comparison:
    """Overlay runs.

    Args:
        run_dirs: directories of records; a run is labelled with its directory's name.
        out_dir: where the picture and the recording go; other files in it are left alone.
        labels: labels to use instead, one per run.

    Raises:
        CompareError: fewer than one run, labels that do not fit, or no unit in common.
        RecordError: a directory is not the record of a run.
    """
    records = [read_record(Path(directory).resolve()) for directory in run_dirs]
    named = dict(zip(_labels(records, labels), records, strict=True))
    runs = {label: record.trace for label, record in named.items()}
    units = _common_units(runs)
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    title = _title(records)
    return Comparison(
        rows=[_row(label, record, unit) for label, record in named.items() for unit in units],
        picture=draw_runs(runs, units, out / PICTURE_FILE, title),
        recording=overlay(runs, units, out / RECORDING_FILE, title),
    )


def overlay(runs: Mapping[str, Trace], units: Sequence[str], path: Path, title: str) -> Path:
    """One recording of several runs: a colour per run, a column per unit, all signals under ``/runs/<label>``."""
    import rerun.blueprint as rrb

    curves: dict[tuple[str, str], list[tuple[str, str, Colour]]] = {}
    for k, (label, trace) in enumerate(runs.items()):
        for unit in units:
            for signal, symbol, _ in PANELS:
                if f"unit.{unit}.{signal}" in trace.columns:
                    where = _entity(label, unit, signal)
                    curves.setdefault((unit, signal), []).append((where, f"{label} {symbol}", colour(k)))
    stream = recording.new_stream(title, [*runs, *(f"{unit}.{signal}" for unit, signal in curves)])
    titles = {
        "e_fd": "field voltage E_fd [pu]",
        "v_t": "terminal voltage V_t [pu]",
        "delta": "rotor angle δ [deg]",
        "omega": "rotor speed ω [pu]",
    }
    samples = {label: _samples(label, trace, units) for label, trace in runs.items()}
    spans = recording.spans_of({path: values for columns in samples.values() for path, values in columns.items()})
    columns = [
        rrb.Vertical(
            *(
                recording.plot(
                    f"{unit}: {titles[signal]}", [where for where, _, _ in curves[unit, signal]], spans=spans
                )
                for signal, _, _ in PANELS
                if (unit, signal) in curves
            ),
            name=unit,
        )
        for unit in units
    ]
    log = recording.text_log("Events of all runs", ["/log/**"])
    body = columns[0] if len(columns) == 1 else (rrb.Horizontal(*columns) if len(columns) <= 3 else rrb.Tabs(*columns))
    recording.save(stream, path, recording.blueprint(rrb.Vertical(body, log, row_shares=[5, 1])))
    for series in curves.values():
        for where, name, rgb in series:
            recording.style(stream, where, name, rgb)
    for label, trace in runs.items():
        recording.send_scalars(stream, samples[label], trace.t)
        recording.send_log(stream, recording.entity_of("log", label), trace.log, trace.t, label=f"{label}: ")
    recording.finish(stream)
    return path


def _samples(label: str, trace: Trace, units: Sequence[str]) -> dict[str, Array]:
    """Samples of a run by entity, rotor angles also in degrees."""
    samples = {entity(signal, "runs", label): values for signal, values in trace.columns.items()}
    for unit in units:
        if f"unit.{unit}.delta" in trace.columns:
            samples[_entity(label, unit, "delta")] = np.degrees(trace[f"unit.{unit}.delta"])
    return samples


def _entity(label: str, unit: str, signal: str) -> str:
    prefix = ("degrees", label) if signal == "delta" else ("runs", label)
    return entity(f"unit.{unit}.{signal}", *prefix)


def _labels(records: Sequence[Record], labels: Sequence[str] | None) -> list[str]:
    if not records:
        raise CompareError("no run was given; name the directories of one or more runs")
    if labels is not None:
        if len(labels) != len(records) or len(set(labels)) != len(labels):
            raise CompareError(f"{len(records)} runs need as many different labels; got {list(labels)}")
        return list(labels)
    found: list[str] = []
    for record in records:
        name, number = record.directory.name, 2
        while name in found:
            name, number = f"{record.directory.name} ({number})", number + 1
        found.append(name)
    return found


def _common_units(runs: Mapping[str, Trace]) -> list[str]:
    first, *others = [unit_names(trace) for trace in runs.values()]
    units = [unit for unit in first if all(unit in names for names in others)]
    if not units:
        raise CompareError(
            f"the runs have no unit in common; theirs are {', '.join(str(unit_names(t)) for t in runs.values())}"
        )
    return units


def _title(records: Sequence[Record]) -> str:
    titles = list(dict.fromkeys(record.title for record in records if record.title))
    return titles[0] if len(titles) == 1 else f"{len(records)} runs compared"


def _row(label: str, record: Record, unit: str) -> dict[str, Any]:
    controllers = record.summary["controllers"].values()
    solved = [item["solve_ms"]["p99"] for item in controllers if item["solve_ms"]]
    return {
        "label": label,
        "unit": unit,
        "outcome": record.summary["outcome"],
        "t_end": record.summary["t_end"],
        **record.summary["units"][unit],
        **swing_figures(record.trace, unit),
        "solve_ms_p99": max(solved, default=None),
        "fallbacks": sum(item["fallbacks"] for item in controllers),
    }
