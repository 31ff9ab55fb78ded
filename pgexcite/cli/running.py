"""A run from the command line: progress, live view, snapshots, and the record at its end."""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import click

from pgexcite.core import registry
from pgexcite.core.config import Scenario
from pgexcite.core.realtime import RealtimeOptions, run_paced, timed
from pgexcite.core.record import write_record
from pgexcite.core.result import RunResult
from pgexcite.core.simulate import Simulation
from pgexcite.core.trace import Trace

_LIVE_EVERY = 0.25
"""Seconds of wall time between two chunks sent to a live view."""


def execute(
    scenario: Scenario,
    directory: Path,
    *,
    live: bool = False,
    resume: Path | None = None,
    snapshot_at: float | None = None,
) -> RunResult:
    """Simulate a scenario and write its record.

    Args:
        scenario: what to run.
        directory: where the record goes; it appears complete or not at all.
        live: serve the run to a viewer while it goes on.
        resume: snapshot to go on from.
        snapshot_at: time of which a snapshot is kept in the record, s.

    Raises:
        PgexciteError: the run cannot start or its record cannot be written.
    """
    simulation = scenario.simulation()
    if resume is not None:
        simulation.resume(resume)
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as stack:
        report = stack.enter_context(_reporting(scenario.settings.t_end))
        view = stack.enter_context(_live(scenario, simulation)) if live else None

        def progress(t: float) -> None:
            report(t)
            if view is not None:
                view(t)

        sinks = [registry.find("sink", name)() for name in scenario.sinks]
        if snapshot_at is not None:
            simulation.run(until=snapshot_at, progress=progress)
            snapshot = Path(scratch) / f"snapshot-{snapshot_at:g}.npz"
            simulation.save(snapshot)
            sinks.append(_Keep(snapshot))
        simulation.run(progress=progress)
        result = simulation.result(scenario.title, scenario.resolved)
        write_record(result, directory, sinks)
    return result


def execute_paced(scenario: Scenario, directory: Path, options: RealtimeOptions) -> RunResult:
    """Run a scenario by the wall clock and write its record.

    Raises:
        PgexciteError: the run cannot start or its record cannot be written.
    """
    simulation = scenario.simulation()
    length = options.steps * simulation.sampling * scenario.settings.h or scenario.settings.t_end
    with _reporting(length) as report:
        timing = run_paced(simulation, options, report)
    result = timed(simulation.result(scenario.title, scenario.resolved), timing)
    write_record(result, directory, [registry.find("sink", name)() for name in scenario.sinks])
    return result


@dataclass(frozen=True)
class _Keep:
    """Takes a file along into the record."""

    file: Path

    def write(self, result: RunResult, directory: Path) -> Path:
        return Path(shutil.copy(self.file, directory))


@contextmanager
def _reporting(t_end: float) -> Iterator[Callable[[float], None]]:
    """A progress bar with simulated time and ETA on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("t = {task.completed:7.2f} of {task.total:g} s"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("run", total=t_end)
        yield lambda t: bar.update(task, completed=t)


@contextmanager
def _live(scenario: Scenario, simulation: Simulation) -> Iterator[Callable[[float], None]]:
    """Serve the run as it goes on; yields what is to be called now and then."""
    from pgexcite.plugins.sinks.rerun import serve

    sent = [0, time.monotonic() - _LIVE_EVERY]
    with serve(scenario.title, scenario.system, tuple(simulation.trace().columns)) as view:
        click.echo(f"live view: rerun {view.url}", err=True)

        def send(force: bool = False) -> None:
            if not force and time.monotonic() - sent[1] < _LIVE_EVERY:
                return
            trace = simulation.trace()
            if trace.t.size > sent[0]:
                view.send(_tail(trace, int(sent[0])))
            sent[:] = trace.t.size, time.monotonic()

        yield lambda _: send()
        send(force=True)
        if sys.stdin.isatty():
            # A run is often over before a viewer has connected; someone sits here and says when it is enough.
            click.pause("the run is over and still served; press any key to end", err=True)


def _tail(trace: Trace, start: int) -> Trace:
    """The samples from ``start`` on."""
    columns = {path: samples[start:] for path, samples in trace.columns.items()}
    since = trace.t[start]
    return Trace(
        trace.t[start:], columns, trace.units, tuple(entry for entry in trace.log if entry.t > since or start == 0)
    )
