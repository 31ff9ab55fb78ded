"""The ``pgexcite`` command: thin, it calls the library."""

from pgexcite.cli.commands import main
from pgexcite.cli.studying import study

main.add_command(study)

__all__ = ["main"]
