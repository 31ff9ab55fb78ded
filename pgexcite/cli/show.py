"""How figures are shown: tables for a person, JSON for a program."""

from __future__ import annotations

import json as _json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from pgexcite.core.config import Scenario
    from pgexcite.core.initialise import Initial


def json(data: object) -> None:
    """Print data as JSON; what is not a finite number becomes ``null``."""
    click.echo(_json.dumps(_finite(data), indent=2))


def table(rows: Sequence[Mapping[str, Any]], rename: Mapping[str, str] | None = None) -> None:
    """Print records as a table; its columns are the keys of all of them."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    keys = list(dict.fromkeys(key for row in rows for key in row))
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for key in keys:
        numeric = any(isinstance(row.get(key), int | float) for row in rows)
        grid.add_column((rename or {}).get(key, key), justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        grid.add_row(*(_cell(row.get(key)) for key in keys))
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = 1000  # a pipe has no width; the default of 80 would break every line
    console.print(grid)


def side_by_side(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the figures of several runs, one run to a column."""
    heads = [
        f"{row['label']} {row['unit']}" if len({r["unit"] for r in rows}) > 1 else str(row["label"]) for row in rows
    ]
    keys = [key for key in dict.fromkeys(key for row in rows for key in row) if key != "label"]
    table([{"": key, **dict(zip(heads, (row.get(key) for row in rows), strict=True))} for key in keys])


def summary(title: str, message: str, figures: Mapping[str, Any], directory: Path) -> None:
    """Print how a run ended and its figures."""
    click.echo(f"{title}: {message}")
    table([{"unit": name, **values} for name, values in figures["units"].items()])
    if figures["controllers"]:
        rows = []
        for name, values in figures["controllers"].items():
            times = {f"solve_ms.{key}": time for key, time in (values["solve_ms"] or {}).items()}
            rows.append(
                {"controller": name, **{key: value for key, value in values.items() if key != "solve_ms"}, **times}
            )
        table(rows)
    click.echo(f"{figures['steps']} steps in {figures['wall_time']:.3g} s; record: {directory}")


def remarks(scenario: Scenario) -> None:
    """Say on standard error what is valid and yet likely not what was meant."""
    from pgexcite.core.config import remarks as made

    for text in made(scenario):
        click.echo(f"note: {text}", err=True)


def timing(figures: Mapping[str, Any]) -> None:
    """Print what a paced run measured."""
    phases = {key.removesuffix("_ms"): values for key, values in figures.items() if key.endswith("_ms") and values}
    table(
        [
            {"ms": phase.replace("_", "-"), **{key: value for key, value in values.items() if key != "histogram"}}
            for phase, values in phases.items()
        ]
    )
    for option, found in figures["options"].items():
        click.echo(f"{option}: {'granted' if found['granted'] else 'refused'}, {found['detail']}")
    memory = figures["memory_mib"]
    if memory is not None:
        click.echo(f"resident memory {memory['start']:.1f} MiB at the start, {memory['end']:.1f} MiB at the end")
    click.echo(
        f"{figures['steps']} periods of {1e3 * figures['period']:g} ms ({1e3 * figures['sample']:g} ms simulated): "
        f"{figures['missed']} deadlines of {1e3 * figures['deadline']:g} ms missed, {figures['skipped']} periods of them skipped; "
        f"{figures['overruns']} overruns"
    )


def modes(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print modes, each with the states that take part most."""
    table(
        [
            {
                "re [1/s]": row["re"],
                "im [rad/s]": row["im"],
                "damping [%]": 100 * row["damping"],
                "f [Hz]": row["frequency_hz"],
                "participation": ", ".join(
                    f"{name} {share:.2f}" for name, share in list(row["participation"].items())[:3]
                ),
            }
            for row in rows
        ]
    )


def description(model: Mapping[str, Any]) -> None:
    """Print what ``describe_model`` gives."""
    click.echo(f"{model['role']} {model['name']}: {model['class']} ({model['distribution']})\n")
    click.echo(model["description"])
    if model["source"]:
        click.echo(f"\nSource: {model['source']}")
    for heading in ("parameters", "variables"):
        if model[heading]:
            click.echo(f"\n{heading.capitalize()}:")
            table(model[heading])


def operating_point(initial: Initial) -> dict[str, Any]:
    """The steady state a run starts from, as plain data: bus voltages, devices' powers, the residual."""
    flow, system = initial.flow, initial.model.system
    buses = [
        {"bus": name, "V [pu]": abs(v), "angle [deg]": math.degrees(math.atan2(v.imag, v.real))}
        for name, v in flow.v.items()
    ]
    devices = [
        {
            "device": device.path,
            "bus": device.bus,
            "P [MW]": flow.s[device.path].real * system.S_base,
            "Q [Mvar]": flow.s[device.path].imag * system.S_base,
        }
        for device in system.devices
        if device.path not in system.branches()  # a tap changer delivers nothing
    ]
    return {"residual": initial.residual, "buses": buses, "devices": devices}


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _finite(data: Any) -> Any:
    if isinstance(data, Mapping):
        return {str(key): _finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    if isinstance(data, float):
        return float(data) if math.isfinite(data) else None
    return data if isinstance(data, str | int | bool | None) else str(data)
