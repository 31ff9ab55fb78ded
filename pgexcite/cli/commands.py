"""The commands. What is heavy is imported inside them, so that ``--help`` answers at once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from pgexcite.cli import show
from pgexcite.core.errors import AssemblyError, ConfigError, InitialisationError, PgexciteError, RegistryError

EXIT_CONFIG = 3
EXIT_INITIALISATION = 4
EXIT_OUTCOME = 5
EXIT_INTERRUPTED = 130
_EXIT: tuple[tuple[type[PgexciteError], int], ...] = (
    (InitialisationError, EXIT_INITIALISATION),
    (ConfigError, EXIT_CONFIG),
    (RegistryError, EXIT_CONFIG),
    (AssemblyError, EXIT_CONFIG),
)
_INTERRUPTED = {
    "run": ": no record was written",
    "realtime": ": no record was written",
    "study": ": the cases that are done are kept; the same command goes on",
}
"""What became of the work, by command."""


class _Commands(click.Group):
    """Turns the project's errors and the system's into a message and an exit code; a traceback is left to bugs."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except PgexciteError as error:
            click.echo(f"error: {error}", err=True)
            ctx.exit(next((code for kind, code in _EXIT if isinstance(error, kind)), 1))
        except OSError as error:
            if isinstance(error, BrokenPipeError):
                raise  # whoever read our output is gone; click ends quietly
            click.echo(f"error: {error.filename or 'the system'}: {error.strerror or error}", err=True)
            ctx.exit(1)
        except KeyboardInterrupt:
            kept = _INTERRUPTED.get(ctx.invoked_subcommand or "", "")
            click.echo(f"interrupted{kept}", err=True)
            ctx.exit(EXIT_INTERRUPTED)


class _Finite(click.FloatRange):
    """A range without NaN, which compares as within any, and without infinity."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number} is not a finite number.", param, ctx)
        return float(number)


_config = click.argument("config", type=click.Path(path_type=Path, dir_okay=False))
_set = click.option(
    "--set", "overrides", multiple=True, metavar="PATH=VALUE", help="Override a value of the scenario; may be repeated."
)
_json = click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Exit codes: 0 as expected, 1 other failure, 2 usage, 3 configuration, 4 initialisation, "
    "5 a run that ended otherwise than its scenario expects, 130 interrupted.",
)
@click.version_option(package_name="pgexcite")
def main() -> None:
    """Judge and run field-excitation controllers of synchronous generators on a realistic grid."""


@main.command()
@_config
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Directory of the record [runs/CONFIG].")
@_set
@click.option("--live", is_flag=True, help="Serve the run to a viewer while it goes on.")
@click.option("--resume", type=click.Path(path_type=Path, dir_okay=False), help="Go on from a snapshot.")
@click.option("--snapshot-at", type=_Finite(min=0), metavar="T", help="Keep a snapshot of time T (s) in the record.")
@_json
def run(
    config: Path,
    out: Path | None,
    overrides: tuple[str, ...],
    live: bool,
    resume: Path | None,
    snapshot_at: float | None,
    as_json: bool,
) -> None:
    """Simulate a scenario and write the record of the run."""
    from pgexcite.cli.running import execute
    from pgexcite.core.config import load
    from pgexcite.core.record import ensure_replaceable
    from pgexcite.core.summary import summarise

    scenario = load(config, overrides)
    end = scenario.settings.t_end
    if snapshot_at is not None and snapshot_at > end:
        raise click.BadParameter(
            f"{snapshot_at:g} s is after the end of the run at {end:g} s", param_hint="--snapshot-at"
        )
    show.remarks(scenario)
    directory = out or Path("runs") / config.stem
    ensure_replaceable(directory)
    result = execute(scenario, directory, live=live, resume=resume, snapshot_at=snapshot_at)
    summary = summarise(result)
    if as_json:
        show.json({"directory": str(directory), **summary})
    else:
        show.summary(scenario.title or config.stem, result.outcome.message, summary, directory)
    _exit_unless_expected(result.outcome.ending.value, scenario.expect)


@main.command()
@_config
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Directory of the record [runs/CONFIG].")
@_set
@click.option("--period", type=_Finite(min=0, min_open=True), help="Wall time of a period, s [sample time].")
@click.option("--steps", type=click.IntRange(min=1), help="Periods to run [to the end of the scenario].")
@click.option("--deadline", type=_Finite(min=0, min_open=True), help="ms; a plan later than that is not used.")
@click.option("--priority", type=click.IntRange(1, 99), help="Run under SCHED_FIFO with this priority.")
@click.option("--lock-memory", is_flag=True, help="Keep all pages in memory.")
@click.option("--core", type=click.IntRange(min=0), help="Processor to stay on.")
@click.option("--gc", "garbage", type=click.Choice(["on", "frozen", "off"]), default="on", show_default=True)
@click.option("--keep", type=_Finite(min=0), help="Simulated seconds kept in the trace [all].")
@_json
def realtime(
    config: Path,
    out: Path | None,
    overrides: tuple[str, ...],
    deadline: float | None,
    as_json: bool,
    **options: Any,
) -> None:
    """Run a scenario by the wall clock, and measure latencies and deadline misses."""
    from pgexcite.cli.running import execute_paced
    from pgexcite.core.compiling import compiler
    from pgexcite.core.config import load
    from pgexcite.core.realtime import RealtimeOptions
    from pgexcite.core.record import ensure_replaceable
    from pgexcite.core.summary import summarise

    scenario = load(config, overrides)
    if deadline is not None:
        later = [f"controller.{name}.deadline_ms={deadline:g}" for name in scenario.controllers]
        scenario = load(config, (*overrides, *later))
        options["deadline"] = deadline / 1e3
    directory = out or Path("runs") / config.stem
    ensure_replaceable(directory)
    if scenario.settings.compile != "never" and compiler() is None:
        click.echo(
            "note: no C compiler was found: steps and predictions take several times as long as compiled", err=True
        )
    chosen = RealtimeOptions(**{key: value for key, value in options.items() if value is not None})
    result = execute_paced(scenario, directory, chosen)
    summary = summarise(result)
    if as_json:
        show.json({"directory": str(directory), **summary})
    else:
        show.summary(scenario.title or config.stem, result.outcome.message, summary, directory)
        show.timing(summary["realtime"])
    if summary["realtime"]["interrupted"]:
        click.echo("interrupted: the record holds what ran", err=True)
        click.get_current_context().exit(EXIT_INTERRUPTED)
    _exit_unless_expected(result.outcome.ending.value, scenario.expect)


def _exit_unless_expected(ending: str, expected: str) -> None:
    if ending != expected:
        click.echo(f"error: the run ended as {ending}, the scenario expects {expected}", err=True)
        click.get_current_context().exit(EXIT_OUTCOME)


@main.command()
@_config
@_set
@_json
def check(config: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Validate a scenario, solve its initial operating point and make its controllers ready."""
    from dataclasses import replace

    from pgexcite.core.config import load

    scenario = load(config, overrides)
    show.remarks(scenario)
    # Nothing is run here: what compiled steps would save is less than what the compiler takes.
    scenario = replace(scenario, settings=replace(scenario.settings, compile="never"))
    point = show.operating_point(scenario.simulation().initial)
    if as_json:
        show.json(point)
    else:
        click.echo(f"{config} is valid; steady state with a residual of {point['residual']:.1e}")
        show.table(point["buses"])
        show.table(point["devices"])


@main.command(name="list")
@click.option("--role", help="Only this family of models.")
@_json
def list_models(role: str | None, as_json: bool) -> None:
    """List every registered model, the broken ones with the cause."""
    from dataclasses import asdict

    from pgexcite.core import registry

    if role is not None:
        registry.names(role)
    found = [asdict(item) for item in registry.health() if role in (None, item.role)]
    if as_json:
        show.json(found)
    else:
        show.table([{**item, "error": item["error"] or "ok"} for item in found], rename={"error": "state"})


@main.command()
@click.argument("model")
@_json
def describe(model: str, as_json: bool) -> None:
    """Describe a model: its parameters, units, ports and source. MODEL is a name, or role.name."""
    from pgexcite.cli.describing import describe_model

    for description in describe_model(model):
        if as_json:
            show.json(description)
        else:
            show.description(description)


@main.command()
@_config
@_set
@_json
def eig(config: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Modes at the initial operating point: eigenvalues, damping, participation; controllers are left out."""
    from pgexcite.core.config import load
    from pgexcite.core.initialise import initialise
    from pgexcite.core.linearise import linearise

    initial = initialise(load(config, overrides).system)
    modes = [mode.as_dict() for mode in linearise(initial.model, initial.state, initial.p).modes()]
    if as_json:
        show.json({"modes": modes})
    else:
        show.modes(modes)


@main.command()
@_config
@_set
@click.option("--tolerance", type=_Finite(min=1e-6), default=1e-4, show_default=True, help="Width of the bracket, s.")
@_json
def cct(config: Path, overrides: tuple[str, ...], tolerance: float, as_json: bool) -> None:
    """Critical clearing time of the scenario's fault, by bisection."""
    from dataclasses import asdict

    from pgexcite.core.config import load
    from pgexcite.studies.cct import critical_clearing_time

    found = critical_clearing_time(load(config, overrides), tolerance)
    if as_json:
        show.json(asdict(found))
    else:
        click.echo(
            f"critical clearing time   {found.t_crit:.5f} s (stable at {found.bracket[0]:.5f}, not at {found.bracket[1]:.5f})"
        )
        click.echo(f"rotor angle at clearing  {found.delta_crit_deg:.2f} deg, {found.unit}")
        click.echo(f"beyond it                {found.outcome}; {found.runs} runs")


@main.command(name="equal-area")
@_config
@_set
@click.option(
    "--figure", type=click.Path(path_type=Path, dir_okay=False), help="Draw the construction into this file (PNG)."
)
@_json
def equal_area(config: Path, overrides: tuple[str, ...], figure: Path | None, as_json: bool) -> None:
    """Equal-area construction of the scenario's fault, for one machine against an infinite bus."""
    from pgexcite.core.config import load
    from pgexcite.studies.equal_area import equal_area as construct

    found = construct(load(config, overrides))
    if figure is not None:
        found.figure(figure)
    if as_json:
        show.json(found.as_dict())
    else:
        show.table(found.rows())


@main.command()
@_config
@_set
@click.option("--load", "loads", multiple=True, metavar="NAME", help="A load to scale; may be repeated [all].")
@click.option(
    "--tan-phi", "tangents", multiple=True, type=float, help="Q/P given to these loads; may be repeated [own]."
)
@click.option("--bus", help="Bus whose voltage is drawn [the weakest].")
@click.option("--figure", type=click.Path(path_type=Path, dir_okay=False), help="Draw the curves into this file (PNG).")
@click.option("--per-unit", is_flag=True, help="Powers in per unit of S_base instead of MW and Mvar.")
@_json
def pv(
    config: Path,
    overrides: tuple[str, ...],
    loads: tuple[str, ...],
    tangents: tuple[float, ...],
    bus: str | None,
    figure: Path | None,
    per_unit: bool,
    as_json: bool,
) -> None:
    """P-V curve: loads scaled at constant power factor, through the nose.

    Three values of --tan-phi or more also draw the surface they span over P and Q.
    """
    from pgexcite.core.config import load
    from pgexcite.studies.pv import pv_curve

    scenario = load(config, overrides)
    if bus is not None and bus not in scenario.system.buses:
        raise click.BadParameter(
            f"there is no bus {bus}; buses are {', '.join(scenario.system.buses)}", param_hint="--bus"
        )
    curves = [
        ("own power factor" if tangent is None else f"tan φ = {tangent:g}", pv_curve(scenario.system, loads, tangent))
        for tangent in (tangents or (None,))
    ]
    shown = bus or curves[0][1].weakest
    if figure is not None:
        from pgexcite.studies.pv_figure import draw_pv

        draw_pv(curves, shown, figure, scenario.title or config.stem, per_unit=per_unit)
    if as_json:
        show.json({"curves": [{"label": label, **curve.as_dict()} for label, curve in curves]})
    else:
        show.table([curve.row(label, shown, per_unit=per_unit) for label, curve in curves])


@main.command(name="export-c")
@_config
@click.argument("directory", type=click.Path(path_type=Path, file_okay=False))
@_set
@click.option("--controller", default="", metavar="NAME", help="Which controller, where there are several.")
@_json
def export_c(config: Path, directory: Path, overrides: tuple[str, ...], controller: str, as_json: bool) -> None:
    """Write a controller as self-contained C into DIRECTORY, with the scenario's run as its test."""
    from pgexcite.core.config import load
    from pgexcite.core.export import export_c as export

    found = export(load(config, overrides), directory, controller)
    files = sorted(path.name for path in found.directory.iterdir() if path.is_file())
    if as_json:
        show.json({"directory": str(found.directory), "name": found.name, "samples": found.samples, "files": files})
    else:
        click.echo(f"{found.directory}: {', '.join(files)}; {found.samples} samples to replay")
        click.echo(f"cmake -S {directory} -B build && cmake --build build && ctest --test-dir build")


@main.command()
@click.argument("runs", nargs=-1, required=True, type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), help="Where picture and recording go [runs/compare]."
)
@_json
def compare(runs: tuple[Path, ...], out: Path | None, as_json: bool) -> None:
    """Overlay several runs in one recording and one picture, with a table of their figures."""
    from pgexcite.studies.compare import compare as overlay

    found = overlay(list(runs), out or Path("runs") / "compare")
    if as_json:
        show.json({"rows": found.rows, "picture": str(found.picture), "recording": str(found.recording)})
    else:
        show.side_by_side(found.rows)
        click.echo(f"picture:   {found.picture}")
        click.echo(f"recording: {found.recording}   (open it with: rerun {found.recording})")


@main.command()
def schema() -> None:
    """Print the JSON Schema of scenario files, for editors."""
    from pgexcite.core.config import json_schema

    show.json(json_schema())
