"""The samples of a run as Parquet, units and description in its metadata."""

from __future__ import annotations

from pathlib import Path

from pgexcite.core.record import TRACE_FILE, write_trace
from pgexcite.core.result import RunResult


class ParquetSink:
    """Writes ``trace.parquet``; see `pgexcite.core.record.write_trace`."""

    def write(self, result: RunResult, directory: Path) -> Path:
        """Write into an existing directory; returns the file written."""
        path = directory / TRACE_FILE
        write_trace(result, path)
        return path
