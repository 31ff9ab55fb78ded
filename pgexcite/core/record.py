"""The record of a run on disk: a directory that appears whole or not at all, and the trace file in it."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core.errors import PgexciteError
from pgexcite.core.result import RunResult, Sink
from pgexcite.core.summary import summarise
from pgexcite.core.trace import Ending, LogEntry, Outcome, Trace

TRACE_FILE = "trace.parquet"
SUMMARY_FILE = "summary.json"
CONFIG_FILE = "config.toml"
RECORDING_FILE = "run.rrd"

FORMAT = "pgexcite-run-1"
"""Value of ``format`` in a summary: marks its directory as the record of a run."""
TIME_COLUMN = "t"


class RecordError(PgexciteError):
    """A record of a run cannot be written or read."""


@dataclass(frozen=True)
class Record:
    """A record read back.

    Attributes:
        directory: where it lies.
        title: of the configuration.
        outcome: how the run ended.
        summary: content of ``summary.json``.
        config: the resolved configuration.
        trace: all samples and the log.
    """

    directory: Path
    title: str
    outcome: Outcome
    summary: Mapping[str, Any]
    config: Mapping[str, Any]
    trace: Trace


def write_record(result: RunResult, directory: Path, sinks: Iterable[Sink]) -> Path:
    """Write the record of a run: all of it, or nothing.

    The files are written into a hidden sibling, which takes the directory's name once it is complete. An earlier record of that
    name is replaced as a whole. The summary is written even when no sink is asked for it: it marks the directory as a record.

    Returns:
        The directory.

    Raises:
        RecordError: something that is not the record of a run stands at ``directory``, or it cannot be written.
    """
    directory = Path(directory).resolve()
    ensure_replaceable(directory)
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{directory.name}-", dir=directory.parent))
    except OSError as error:
        raise RecordError(
            f"{directory}: cannot write here ({error.strerror}); name another directory with --out"
        ) from error
    try:
        fresh = work / "new"
        fresh.mkdir()
        for sink in sinks:
            sink.write(result, fresh)
        if not (fresh / SUMMARY_FILE).exists():
            write_summary(result, fresh / SUMMARY_FILE)
        _swap(fresh, directory, work / "old")
    except OSError as error:
        raise RecordError(f"{directory}: the record could not be written ({error}); nothing was changed") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return directory


def ensure_replaceable(directory: Path) -> None:
    """Check that nothing but an earlier record (or nothing at all) stands where a record is to be written.

    Raises:
        RecordError: something else stands there.
    """
    if not directory.exists() or (directory.is_dir() and (is_record(directory) or not any(directory.iterdir()))):
        return
    kind = "a directory" if directory.is_dir() else "a file"
    raise RecordError(
        f"{directory}: {kind} that is not the record of a run stands here (no {SUMMARY_FILE} of ours in it) and is left alone; "
        "name another directory, or remove it first"
    )


def is_record(directory: Path) -> bool:
    """Whether a directory is the record of a run: it holds a summary with our mark."""
    try:
        summary = json.loads((directory / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(summary, dict) and summary.get("format") == FORMAT


def write_summary(result: RunResult, path: Path) -> None:
    """Write `summarise`'s figures and the mark of a record."""
    content = {"format": FORMAT, **summarise(result)}
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def write_trace(result: RunResult, path: Path) -> None:
    """Write a run's samples as Parquet: one column per signal, its unit in the field's metadata ``unit``, time in column ``t``.

    The schema's metadata holds ``title``, ``outcome``, ``log``, ``config``, ``steps`` and ``wall_time`` as JSON. Floats are split
    by bytes before zstd, which packs smooth curves better than zstd alone.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    trace = result.trace
    units = {TIME_COLUMN: "s", **{path: trace.units.get(path, "") for path in trace.columns}}
    arrays = [pa.array(trace.t), *(pa.array(np.ascontiguousarray(samples)) for samples in trace.columns.values())]
    fields = [
        pa.field(name, array.type, nullable=False, metadata={"unit": unit})
        for (name, unit), array in zip(units.items(), arrays, strict=True)
    ]
    about = {
        "title": result.title,
        "outcome": {**asdict(result.outcome), "ending": result.outcome.ending.value},
        "log": [asdict(entry) for entry in trace.log],
        "config": result.config,
        "steps": result.steps,
        "wall_time": result.wall_time,
    }
    metadata = {"format": FORMAT, **{key: json.dumps(value) for key, value in about.items()}}
    table = pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=metadata))
    pq.write_table(table, path, compression="zstd", use_dictionary=False, use_byte_stream_split=True)


def read_trace(path: Path) -> Trace:
    """Read a trace written by `write_trace`, bit for bit.

    Args:
        path: the file, or the directory of a record.

    Raises:
        RecordError: there is no such file, or it is not one of ours.
    """
    return _read(path)[0]


def read_record(directory: Path) -> Record:
    """Read the record of a run.

    Raises:
        RecordError: the directory is not the record of a run, or has no trace.
    """
    directory = Path(directory)
    if not is_record(directory):
        raise RecordError(
            f"{directory}: not the record of a run (no {SUMMARY_FILE} of ours); give the directory a run wrote"
        )
    trace, about = _read(directory)
    outcome = about["outcome"]
    return Record(
        directory=directory,
        title=about["title"],
        outcome=Outcome(**{**outcome, "ending": Ending(outcome["ending"]), "active": tuple(outcome.get("active", ()))}),
        summary=json.loads((directory / SUMMARY_FILE).read_text(encoding="utf-8")),
        config=about["config"],
        trace=trace,
    )


def _read(path: Path) -> tuple[Trace, dict[str, Any]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = path / TRACE_FILE if Path(path).is_dir() else Path(path)
    try:
        table = pq.read_table(file)
    except (OSError, pa.ArrowInvalid) as error:
        raise RecordError(
            f"{file}: cannot be read as a trace ({error}); a run writes it with the sink 'parquet'"
        ) from error
    metadata = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    if metadata.pop("format", None) != FORMAT:
        raise RecordError(f"{file}: a Parquet file, but not the trace of a run (its metadata lack format = {FORMAT!r})")
    about = {key: json.loads(value) for key, value in metadata.items() if not key.startswith("ARROW:")}
    names = [name for name in table.column_names if name != TIME_COLUMN]
    trace = Trace(
        t=table[TIME_COLUMN].to_numpy(),
        columns={name: table[name].to_numpy() for name in names},
        units={name: table.schema.field(name).metadata[b"unit"].decode() for name in names},
        log=tuple(LogEntry(**entry) for entry in about["log"]),
    )
    return trace, about


def _swap(fresh: Path, target: Path, aside: Path) -> None:
    """Put ``fresh`` in the place of ``target``; an earlier record steps aside first and comes back if that fails."""
    replaced = target.exists()
    if replaced:
        target.rename(aside)
    try:
        fresh.rename(target)
    except OSError:
        if replaced:
            aside.rename(target)
        raise
