"""An exported controller, compiled: its replay, its symbols, and the controller itself as a library."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path

from pgexcite.core import codegen

STRICT = ["-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-Wpedantic"]


def compiler() -> str:
    cc = codegen.compiler()
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
