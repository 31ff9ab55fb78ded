"""Models written as C: the same functions in the same order of operations, below loops written by hand."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.errors import PgexciteError

_LOOPS = Path(__file__).parent / "c"


class CompilationError(PgexciteError):
    """C code was asked for and could not be had."""


def generate(
    functions: Sequence[ca.Function],
    constants: Mapping[str, object],
    loops: Sequence[str],
    along: Sequence[ca.Function] = (),
) -> str:
    """C source of these functions and of loops around them.

    Args:
        functions: what the loops call.
        constants: what the loops need to know.
        loops: files of ``c``, in order: ``step.c`` and ``advance.c`` take steps (``Kernel.stepping``; ``land``), ``rollout.c`` and
            ``chain.c`` predict (``pgexcite.core.sensitivity.Sensitivities``).
        along: what the loops call with several directions at a time, see ``write_along``.
    """
    sizes = {key: max(1, *(getattr(f, key)() for f in functions)) for key in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
    values = {"pgexcite_public": "", **constants, **sizes}
    lanes = [loop("lanes.c"), *map(write_along, along)] if along else []
    return "\n".join([write_functions(functions), define(values), *lanes, *(loop(name) for name in loops)])


def define(constants: Mapping[str, object]) -> str:
    """Macros of these names, in capitals; numbers to the last bit, text as it is."""
    return "".join(
        f"#define {name.upper()} {value if isinstance(value, str) else number(value)}\n"
        for name, value in constants.items()
    )


def array(name: str, values: NDArray[np.float64] | NDArray[np.int32]) -> str:
    """A constant array; C has none without elements."""
    kind = "int" if np.issubdtype(values.dtype, np.integer) else "double"
    items = [number(value) for value in values.tolist()] or ["0"]
    return f"static const {kind} {name}[{len(items)}] = {{{', '.join(items)}}};"


def number(value: Any) -> str:
    """A number to the last bit."""
    if isinstance(value, int):
        return str(int(value))
    value = float(value)
    if np.isfinite(value):
        return repr(value)
    return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"


def loop(name: str) -> str:
    """Text of one of the files in ``c``, which go around the generated functions."""
    return (_LOOPS / name).read_text(encoding="utf-8")


def write_functions(functions: Sequence[ca.Function]) -> str:
    """C of these functions, ``static`` and clean under ``-Wall -Wextra``.

    Of what CasADi writes only the bodies are kept: its functions for names, sizes and memory are of no use here, would make half
    of the text, and would collide with those of another controller in the same program.

    Raises:
        CompilationError: part of a function cannot be expressed in C.
    """
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator("stage.c", {"with_header": False, "with_export": False, "indent": 0})
        for function in functions:
            generator.add(function)
        generator.generate(folder + os.sep)
        source = (Path(folder) / "stage.c").read_text()
    if "#error" in source:
        raise CompilationError("part of the model cannot be expressed in C")
    helpers = re.search(r"^#include <math.h>\n.*?(?=^/\* Configuration)", source, re.DOTALL | re.MULTILINE)
    bodies = re.findall(r"^static int casadi_f\d+\(.*?^}\n", source, re.DOTALL | re.MULTILINE)
    names = re.findall(r"^int \w+\(const casadi_real\*\* arg.*?^}\n", source, re.DOTALL | re.MULTILINE)
    if helpers is None or len(names) != len(functions) or len(bodies) < len(names):
        raise CompilationError(
            f"CasADi {ca.CasadiMeta.version()} lays its C out otherwise than the versions known here"
        )
    # Names need no prefix once they are static.
    arithmetic = re.sub(r"^#define casadi_\w+ CASADI_PREFIX\(\w+\)\n", "", helpers[0], flags=re.MULTILINE)
    arithmetic = re.sub(r"^(?=casadi_real casadi_)", "static ", arithmetic, flags=re.MULTILINE)
    return "\n".join(
        [
            arithmetic,
            *(_body(text, called=len(bodies) > len(names)) for text in bodies),
            *(f"static {name}" for name in names),
        ]
    )


def _body(text: str, *, called: bool) -> str:
    """A function of CasADi's that reads and writes through pointers of its own, which are neither null nor overlap.

    As CasADi writes it, each access looks its pointer up and compares it with zero, for any store might have changed it. Where
    functions call each other (``called``) this is left so: they do pass null pointers.
    """
    if called:
        return text.replace("{\n", "{\n(void)arg; (void)res; (void)iw; (void)w; (void)mem;\n", 1)
    text = re.sub(r"\barg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0", r"from\1[\2]", text)
    text = re.sub(r"\bif \(res\[(\d+)\]!=0\) res\[\1\]\[(\d+)\]=", r"to\1[\2]=", text)
    sources, targets = (sorted(set(re.findall(rf"\b{name}(\d+)\[", text)), key=int) for name in ("from", "to"))
    pointers = [f"const casadi_real *restrict from{k} = arg[{k}];" for k in sources]
    pointers += [f"casadi_real *restrict to{k} = res[{k}];" for k in targets]
    start = ["{", *pointers, "(void)arg; (void)res; (void)iw; (void)w; (void)mem;", ""]
    return text.replace("{\n", "\n".join(start), 1)


_LINEAR = {
    ca.OP_ADD: "{} + {}",
    ca.OP_SUB: "{} - {}",
    ca.OP_MUL: "{} * {}",
    ca.OP_DIV: "{} / {}",
    ca.OP_NEG: "-{}",
    ca.OP_TWICE: "2.0 * {}",
    ca.OP_IF_ELSE_ZERO: "({}) ? {} : ({})",
    ca.OP_ASSIGN: "{}",
}


def write_along(function: ca.Function) -> str:
    """C of ``(factors, direction, ...) -> derivative`` for as many directions at a time as there are lanes.

    ``void name(const double *from0, const lanes *from1, ..., lanes *to)``. Lane for lane the operations are those of the function.

    Raises:
        CompilationError: the function is not linear in its directions.
    """
    lines: list[str] = []
    values: dict[int, tuple[str, bool]] = {}
    for k in range(function.n_instructions()):
        operation, to, of = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if operation == ca.OP_CONST:
            values[to[0]] = (number(function.instruction_constant(k)), False)
        elif operation == ca.OP_INPUT:
            values[to[0]] = (f"from{of[0]}[{of[1]}]", of[0] > 0)
        elif operation == ca.OP_OUTPUT:
            name, wide = values[of[0]]
            lines.append(f"to[{to[1]}] = {name if wide else f'{name} + none'};")
        else:
            operands = [values[i] for i in of]
            wide = any(is_wide for _, is_wide in operands)
            lines.append(f"const {'lanes' if wide else 'double'} v{k} = {_linear(function, operation, operands)};")
            values[to[0]] = (f"v{k}", wide)
    arguments = [f"const {'lanes' if i else 'double'} *restrict from{i}" for i in range(function.n_in())]
    unused = " ".join(f"(void)from{i};" for i in range(function.n_in()))
    start = f"static void {function.name()}({', '.join(arguments)}, lanes *restrict to) {{"
    return "\n".join([start, "const lanes none = {0};", f"{unused} (void)none;", *lines, "}\n"])


def _linear(function: ca.Function, operation: int, operands: list[tuple[str, bool]]) -> str:
    """An operation on operands by name, each with whether it has lanes."""
    names = [f"({name})" if name.startswith("-") else name for name, _ in operands]
    wide = [is_wide for _, is_wide in operands]
    bent = {ca.OP_MUL: all(wide), ca.OP_DIV: wide[-1], ca.OP_IF_ELSE_ZERO: wide[0]}
    if operation not in _LINEAR or bent.get(operation, False):
        raise CompilationError(f"{function.name()}: is not linear in its directions")
    if operation == ca.OP_IF_ELSE_ZERO:
        names.append("none" if wide[1] else "0.0")
    return _LINEAR[operation].format(*names)
