"""The ``pgexcite`` command: thin, it calls the library."""

from pgexcite.cli.commands import main

__all__ = ["main"]
