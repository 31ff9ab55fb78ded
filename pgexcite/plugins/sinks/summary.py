"""The figures a run is judged by, as JSON."""

from __future__ import annotations

from pathlib import Path

from pgexcite.core.record import SUMMARY_FILE, write_summary
from pgexcite.core.result import RunResult


class SummarySink:
    """Writes ``summary.json``; see `pgexcite.core.record.write_summary`."""

    def write(self, result: RunResult, directory: Path) -> Path:
        """Write into an existing directory; returns the file written."""
        path = directory / SUMMARY_FILE
        write_summary(result, path)
        return path
