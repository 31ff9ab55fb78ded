"""An exported controller, compiled: its replay, its symbols, and the controller itself as a library."""

from __future__ import annotations

import ctypes
import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core import compiling
from pgexcite.core.config import Scenario
from pgexcite.core.controller import Sample
from pgexcite.core.export.recorder import Recorder

STRICT = ["-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-Wpedantic"]


def compiler() -> str:
    cc = compiling.compiler()
    assert cc is not None, "these tests need a C compiler"
    return cc


def build(directory: Path, name: str = "mpc") -> Path:
    """The replay program, compiled strictly."""
    for file in (name, f"{name}_replay"):
        subprocess.run([compiler(), *STRICT, "-c", f"{file}.c", "-o", f"{file}.o"], cwd=directory, check=True)
    subprocess.run([compiler(), f"{name}.o", f"{name}_replay.o", "-o", "replay", "-lm"], cwd=directory, check=True)
    return directory / "replay"


def replay(directory: Path, name: str = "mpc") -> tuple[int, dict[str, float]]:
    """Exit code of the replay program, and the figures it prints."""
    program = build(directory, name)
    done = subprocess.run([program, "replay.txt"], cwd=directory, capture_output=True, text=True, check=False)
    figures = dict(re.findall(r"^(\D*?) ((?:[\d.]|inf|nan)\S*)", done.stdout, re.MULTILINE))
    return done.returncode, {key: float(value) for key, value in figures.items()}


def replay_alike(directory: Path, samples: int) -> dict[str, float]:
    """Figures of a replay in which every answer is Python's, to 1e-9."""
    code, figures = replay(directory)
    assert figures["samples"] == samples
    assert figures["samples on another level"] == 0
    assert figures["largest difference of a command"] < 1e-9
    assert figures.get("largest difference of an estimate", 0.0) < 1e-9
    assert code == 0
    return figures


def stands_alone(directory: Path) -> None:
    """Three functions are offered; no other than those of the mathematical library are called, none that allocates."""
    build(directory)
    offered, wanted = symbols(directory)
    assert offered == {"mpc_reset", "mpc_step", "mpc_prepare"}
    assert wanted == set()


def symbols(directory: Path, name: str = "mpc") -> tuple[set[str], set[str]]:
    """What the compiled controller offers, and what it wants beyond the mathematical library and block copies."""
    listed = subprocess.run(["nm", f"{name}.o"], cwd=directory, capture_output=True, text=True, check=True).stdout
    parts = [line.split()[-2:] for line in listed.splitlines()]
    offered = {symbol for kind, symbol in parts if kind in "TDBC"}
    # "_GLOBAL_OFFSET_TABLE_" and the stack guard are the linker's.
    allowed = re.compile(
        r"mem(cpy|set|move)|__stack_chk_fail|_GLOBAL_OFFSET_TABLE_|a?(sin|cos|tan)2?|sincos|sqrt|hypot|f(max|min|abs)|exp|log|pow"
    )
    return offered, {symbol for kind, symbol in parts if kind == "U" and not allowed.fullmatch(symbol)}


class Library:
    """The controller as a shared library, with the types of its header."""

    def __init__(self, directory: Path, name: str = "mpc") -> None:
        command = [compiler(), *STRICT, "-fPIC", "-shared", f"{name}.c", "-o", f"{name}.so", "-lm"]
        subprocess.run(command, cwd=directory, check=True)
        self.library, self._name = ctypes.CDLL(str(directory / f"{name}.so")), name
        header = (directory / f"{name}.h").read_text()
        # An array without elements has one in C, and none in the recording.
        self._sizes = {key.lower(): int(size) for key, size in re.findall(rf"{name.upper()}_N_(\w+) = (\d+)", header)}
        inputs, outputs = (_structure(fields) for fields in _fields(header))
        self.input, self.output = inputs(), outputs()
        self.lines = (directory / "replay.txt").read_text().splitlines()
        self._call("reset")

    def _call(self, function: str, *arguments: object) -> None:
        getattr(self.library, f"{self._name}_{function}")(*arguments)

    def load(self, k: int) -> None:
        """Tell it sample ``k`` of the recording."""
        words, at = self.lines[k].split(), 0
        for name, kind in self.input._fields_:
            if issubclass(kind, ctypes.Array):
                count, number = self._sizes.get(name, kind._length_), float if kind._type_ is ctypes.c_double else int
                getattr(self.input, name)[:count] = [number(word) for word in words[at : at + count]]
            else:
                count, number = 1, float if kind is ctypes.c_double else int
                setattr(self.input, name, number(words[at]))
            at += count

    def step(self):
        """Answer, and prepare for the next sample with the command sent."""
        self._call("step", ctypes.byref(self.input), ctypes.byref(self.output))
        self._call("prepare", self.output.command)
        return self.output


def _fields(header: str) -> list[list[tuple[str, str, str]]]:
    """Type, name and size of the fields of input and output."""
    structures = re.findall(r"typedef struct \{\n(.*?)\n\} \w+;", header, re.DOTALL)
    return [re.findall(r"^    (double|int) (\w+)(?:\[(\d+)\])?;", body, re.MULTILINE) for body in structures]


def _structure(fields: list[tuple[str, str, str]]) -> type[ctypes.Structure]:
    kinds = {"double": ctypes.c_double, "int": ctypes.c_int}
    layout = tuple((name, kinds[kind] * int(size) if size else kinds[kind]) for kind, name, size in fields)
    return type("Fields", (ctypes.Structure,), {"_fields_": layout})


GARBAGE = [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e12, 999.0, -999.0, 0.0, 1e-300]


def record_trouble(case: Scenario, directory: Path, signals: Sequence[str], n: int, seed: int = 4) -> list[int]:
    """Replace the recording by one of ``n`` samples in trouble with these signals; the levels of the ladder.

    Samples of the scenario's own run come over and over: lost, hanging or absurd for a while, in charge or not.
    """
    session = session_of(case)
    recorder, levels = Recorder(session, session.solver.parts("", case.controllers["mpc"].measures())), []
    for sample in _troubled(_samples(case), np.random.default_rng(seed), signals, n):
        session.act(sample)
        session.prepare()
        levels.append(session.level)
    (directory / "replay.txt").write_text("".join(f"{line}\n" for line in recorder.lines))
    return levels


def session_of(case: Scenario) -> Any:
    """The controller of a scenario, at the start of a run."""
    return case.simulation().sessions["mpc"]


def _samples(case: Scenario) -> list[Sample]:
    """What the controller is handed in a run."""
    simulation = case.simulation()
    session, samples = simulation.sessions["mpc"], []
    act = session.act

    def recorded(sample: Sample) -> Any:
        samples.append(sample)
        return act(sample)

    session.act = recorded
    simulation.run()
    return samples


def _troubled(samples: list[Sample], rng: np.random.Generator, signals: Sequence[str], n: int) -> Iterator[Sample]:
    before, left, trouble, active = samples[0].measured, 0, "", True
    for k in range(n):
        sample = samples[k % len(samples)]
        measured = dict(sample.measured)
        if left == 0:
            trouble = str(rng.choice(["", "", "lost", "hangs", "wild", "absurd"]))
            left = int(rng.integers(1, 12))
        left -= 1
        if rng.random() < 0.03:
            active = not active
        if trouble == "hangs":
            measured = before
        elif trouble == "lost":
            measured = dict.fromkeys(measured, np.nan)
        elif trouble:
            for signal in signals:
                measured[signal] += (1.0 if trouble == "wild" else 1e3) * rng.normal()
        before = measured
        yield replace(sample, t=0.05 * k, measured=measured, active=active)


def replay_garbage(directory: Path, width: int, times: int = 10) -> str:
    """What is printed of a replay with garbage among its first ``width`` numbers, under the sanitizers of the compiler.

    Empty where the compiler has none of addresses and undefined behaviour.
    """
    sanitizers = ["-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]
    sources = ["mpc.c", "mpc_replay.c", "-o", "checked", "-lm"]
    command = [compiler(), "-std=c99", "-O1", "-g", *sanitizers, *sources]
    if subprocess.run(command, cwd=directory, capture_output=True, check=False).returncode:
        return ""
    rng, lines = np.random.default_rng(5), []
    for line in (directory / "replay.txt").read_text().splitlines() * times:
        words = line.split()
        for k in range(width):
            if k != 1 and rng.random() < 0.1:
                words[k] = str(rng.choice(GARBAGE))
        lines.append(" ".join(words))
    (directory / "garbage.txt").write_text("\n".join(lines) + "\n")
    done = subprocess.run(["./checked", "garbage.txt"], cwd=directory, capture_output=True, text=True, check=False)
    return done.stderr + done.stdout
