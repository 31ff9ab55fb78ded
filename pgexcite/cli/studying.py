"""The command that runs studies of many runs."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from pgexcite.cli import show

FIGURES = (
    "outcome",
    "first_swing_deg",
    "recovery_5",
    "recovery_1",
    "v_t_iae",
    "damping",
    "t_crit",
    "control_energy",
    "cost",
    "fallbacks",
)
"""Columns of the table; the files of the study hold more."""


@click.command()
@click.argument("config", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Directory of the study [runs/CONFIG].")
@click.option("--workers", type=click.IntRange(1), default=2, show_default=True, help="Processes.")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def study(config: Path, out: Path | None, workers: int, as_json: bool) -> None:
    """Run the cases of a study file that have not been run yet, and print the table of all."""
    from pgexcite.studies.sweep import run_study

    def progress(done: int, total: int) -> None:
        if sys.stderr.isatty():
            click.echo(f"\r{done} of {total} cases", err=True, nl=done == total)

    found = run_study(config, out or Path("runs") / config.stem, workers=workers, progress=progress)
    if as_json:
        show.json({"title": found.title, "rows": found.rows, "directory": str(found.directory)})
    else:
        click.echo(found.title)
        columns = ("variant", "factor", *FIGURES, "error")
        show.table([{key: row[key] for key in columns if key in row} for row in found.rows])
        click.echo(f"figures of every case: {found.directory}")
    failed = sum("error" in row for row in found.rows)
    if failed:
        click.echo(f"error: {failed} of {len(found.rows)} cases could not be run", err=True)
        click.get_current_context().exit(1)
