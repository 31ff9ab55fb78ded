"""The resolved configuration of a run, as TOML that runs again."""

from __future__ import annotations

from pathlib import Path

from pgexcite.core.record import CONFIG_FILE
from pgexcite.core.result import RunResult


class ConfigSink:
    """Writes ``config.toml``: the configuration with every default and override filled in."""

    def write(self, result: RunResult, directory: Path) -> Path:
        """Write into an existing directory; returns the file written."""
        import tomli_w

        path = directory / CONFIG_FILE
        path.write_text(tomli_w.dumps(result.config), encoding="utf-8")
        return path
