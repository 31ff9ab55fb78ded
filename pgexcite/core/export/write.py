"""The files of an export."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from string import Template

from pgexcite.core.codegen import array, generate, loop
from pgexcite.core.config import Scenario
from pgexcite.core.errors import ConfigError, PgexciteError, Problem
from pgexcite.core.export import shared, text
from pgexcite.core.export.parts import Exportable, Parts
from pgexcite.core.export.recorder import Recorder
from pgexcite.core.ladder import Ladder
from pgexcite.core.registry import nearest
from pgexcite.core.shooting import Shooting
from pgexcite.core.written import program

_SHARED = ("dense.c", "qp.c", "condensed.c", "ladder.c")
"""What goes above the parts of every solver."""


class ExportError(PgexciteError):
    """A controller cannot be written as C."""


@dataclass(frozen=True)
class Exported:
    """What was written.

    Attributes:
        directory: where.
        name: prefix of files, functions and types: the controller's, with ``controller_`` before it where C would not have that.
        samples: length of the recorded closed loop.
    """

    directory: Path
    name: str
    samples: int


def export_c(scenario: Scenario, directory: Path, controller: str = "") -> Exported:
    """Write a scenario's controller as C, with the scenario's own run as its test.

    Args:
        scenario: with the controller in it.
        directory: new, empty, or of an earlier export.
        controller: its name; may be left out where there is one.

    Raises:
        ConfigError: no such controller, or something in its configuration cannot be exported.
        ExportError: something else stands in the directory.
    """
    name = _chosen(scenario, controller)
    simulation = scenario.simulation()
    session = simulation.sessions[name]
    if not isinstance(session, Ladder) or not isinstance(session.solver, Exportable):
        raise ConfigError([Problem(f"controller.{name}", "cannot be exported: its backend offers no C")])
    measured = scenario.controllers[name].measures()
    parts = session.solver.parts(f"controller.{name}", measured)
    prefix = _prefix(name, parts)
    files = _files(prefix, scenario, session, parts, len(measured))
    _ensure_ours(directory, [*files, "replay.txt"])
    if isinstance(session.solver, Shooting):
        # What is replayed was planned by other code than what replays it.
        session.solver.plan_in_python()
    recorder = Recorder(session, parts)
    simulation.run()
    files["replay.txt"] = "".join(f"{line}\n" for line in recorder.lines)
    directory.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        (directory / file).write_text(content, encoding="utf-8")
    return Exported(directory, prefix, len(recorder.lines))


def _chosen(scenario: Scenario, controller: str) -> str:
    names = list(scenario.controllers)
    if controller in names:
        return controller
    if not controller and len(names) == 1:
        return names[0]
    if controller:
        problem = Problem("controller", "there is no such controller", controller, nearest(controller, names))
    elif names:
        problem = Problem("controller", f"there are several: {', '.join(names)}", hint="choose one with --controller")
    else:
        problem = Problem("controller", "there is none to export", hint="add a [controller.NAME] table")
    raise ConfigError([problem])


def _prefix(name: str, parts: Parts) -> str:
    """The controller's name as C can have it: of an identifier, and of no function or type that is there already."""
    prefix = re.sub(r"\W", "_", name, flags=re.ASCII)
    texts = [*(loop(file) for file in (*_SHARED, *parts.loops, "replay.c")), *parts.templates]
    taken = re.compile(rf"\b{prefix}_(reset|step|prepare|input|output)\b")
    return f"controller_{prefix}" if prefix[0].isdigit() or any(map(taken.search, texts)) else prefix


def _ensure_ours(directory: Path, files: Sequence[str]) -> None:
    if directory.exists():
        foreign = sorted({path.name for path in directory.iterdir()} - set(files) - {"build"})
        if foreign:
            raise ExportError(
                f"{directory}: holds {', '.join(foreign[:3])}, which no export wrote; name another directory"
            )


def _files(name: str, scenario: Scenario, session: Ladder, parts: Parts, measured: int) -> dict[str, str]:
    commands = session.problem.commands
    words: dict[str, object] = {
        "name": name,
        "NAME": name.upper(),
        "title": text.comment(scenario.title or name),
        "config": text.comment(scenario.path.name),
        "version": version("pgexcite"),
        "about": parts.about,
        "tolerance": parts.tolerance,
        "n_commands": len(commands),
        "commands": text.listed(commands),
        **text.input_words(name, parts.inputs),
        **text.told_words(name, parts.told),
    }

    def filled(template: str) -> str:
        return Template(template).substitute(words)

    below = [filled(template) for template in (*map(loop, _SHARED), *parts.templates)]
    return {
        f"{name}.h": filled(loop("controller.h")),
        f"{name}.c": "\n".join([f'#include "{name}.h"\n', _model(session, parts, measured), *below]),
        f"{name}_replay.c": filled(loop("replay.c")),
        "CMakeLists.txt": filled(loop("CMakeLists.txt")),
    }


def _model(session: Ladder, parts: Parts, measured: int) -> str:
    """The functions of the model, the loops around them, and all numbers."""
    constants, arrays = program(parts.condensed)
    of_ladder, start = shared.ladder(session, measured)
    defined = {"pgexcite_public": "static", **constants, **of_ladder, **parts.constants}
    loops = generate(parts.functions, defined, parts.loops, parts.along)
    numbers = {**arrays, **start, **parts.arrays}
    return "\n".join([loops, *(array(name, values.ravel()) for name, values in numbers.items())]) + "\n"
