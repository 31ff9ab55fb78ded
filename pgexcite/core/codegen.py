"""The stepping loop as generated C: the same functions, the same order of operations, compiled once and cached by content.

No compiler means slower, never broken: the caller then keeps to CasADi's virtual machine.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.errors import PgexciteError

Array = NDArray[np.float64]

FLAGS = ("-O1", "-fPIC", "-shared", "-ffp-contract=off", "-w")
"""Without contraction into fused multiply-adds the numbers are those of the virtual machine."""

_DRIVER = r"""
#include <string.h>
#define NX {n_x}
#define NZ {n_z}
#define NW (NX + NZ)
#define ND {n_d}
#define NY {n_y}
#define AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

typedef struct {{
    double w[2][AT_LEAST_1(NW)], start[AT_LEAST_1(NW)], b[AT_LEAST_1(NX)], mass[AT_LEAST_1(NX)], d_next[AT_LEAST_1(ND)], c, norm;
    const double *d, *u, *p;
}} Stage;

static double work[{sz_w}];
static casadi_int iwork[{sz_iw}];
static const double *args[{sz_arg}];
static double *results[{sz_res}];

static void history_at(Stage *s, const double *x, const double *z) {{
    args[0] = x; args[1] = z; args[2] = s->d; args[3] = s->u; args[4] = s->p; args[5] = &s->c;
    results[0] = s->b; results[1] = s->mass;
    history(args, results, iwork, work, 0);
}}

/* Newton from s->w[0]; the solution is left there. Returns 1 when it converged. */
static int solve(Stage *s) {{
    int k;
    for (k = 0; k < {max_iterations}; k++) {{
        double *from = s->w[k & 1], *to = s->w[!(k & 1)];
        args[0] = from; args[1] = s->b; args[2] = &s->c; args[3] = s->d; args[4] = s->u; args[5] = s->p;
        results[0] = to; results[1] = &s->norm;
        newton(args, results, iwork, work, 0);
        if (s->norm < {tolerance2}) {{
            double sum = 0; int i;
            if (to != s->w[0]) memcpy(s->w[0], to, sizeof(double) * NW);
            for (i = 0; i < NW; i++) sum += s->w[0][i];
            return sum - sum == 0;
        }}
        if (!(s->norm < 1e20)) return 0;
    }}
    return 0;
}}

static int one_step(Stage *s, int rule, double h, int startup, double *x, double *z) {{
    int i;
    memcpy(s->start, x, sizeof(double) * NX); memcpy(s->start + NX, z, sizeof(double) * NZ);
    memcpy(s->w[0], s->start, sizeof(double) * NW);
    if (rule == 2 || (rule == 1 && startup > 0)) {{
        s->c = h;
        for (i = 0; i < NX; i++) s->b[i] = s->mass[i] * x[i];
    }} else {{
        s->c = rule == 1 ? h / 2 : {gamma} * h / 2;
        history_at(s, x, z);
    }}
    if (!solve(s)) return 0;
    if (rule == 0) {{
        for (i = 0; i < NX; i++) s->b[i] = s->mass[i] * ({alpha} * s->w[0][i] - {beta} * x[i]);
        for (i = 0; i < NW; i++) s->w[0][i] += {extrapolate} * (s->w[0][i] - s->start[i]);
        if (!solve(s)) return 0;
    }}
    memcpy(x, s->w[0], sizeof(double) * NX); memcpy(z, s->w[0] + NX, sizeof(double) * NZ);
    return 1;
}}

/* Renews the discrete states. 0: nothing that matters to the equations; 1: the algebraic unknowns moved. */
static int renew(Stage *s, double h, double *x, double *z, double *d) {{
    int i, changed = 0;
    double moved = 0;
    args[0] = x; args[1] = z; args[2] = d; args[3] = s->u; args[4] = s->p; args[5] = &h;
    results[0] = s->d_next;
    update(args, results, iwork, work, 0);
    for (i = 0; i < ND; i++) changed |= s->d_next[i] != d[i];
    if (!changed) return 0;
    memcpy(d, s->d_next, sizeof(double) * ND);
    s->c = {frozen};
    for (i = 0; i < NX; i++) s->b[i] = s->mass[i] * x[i];
    memcpy(s->w[0], x, sizeof(double) * NX); memcpy(s->w[0] + NX, z, sizeof(double) * NZ);
    if (!solve(s)) return 1;
    for (i = 0; i < NZ; i++) {{
        double move = s->w[0][NX + i] - z[i];
        if (move < 0) move = -move;
        if (move > moved) moved = move;
    }}
    memcpy(x, s->w[0], sizeof(double) * NX); memcpy(z, s->w[0] + NX, sizeof(double) * NZ);
    return moved > {moved};
}}

/* Takes up to n steps and records each; returns how many were taken. */
int pgexcite_advance(int rule, double h, int n, int *startup, double *x, double *z, double *d, const double *u, const double *p,
                     double *rows_x, double *rows_z, double *rows_d, double *rows_y) {{
    static Stage s;
    int k;
    s.d = d; s.u = u; s.p = p; s.c = 0;
    history_at(&s, x, z);
    for (k = 0; k < n; k++) {{
        if (!one_step(&s, rule, h, *startup, x, z)) return k;
        if (*startup > 0) --*startup;
        if (ND > 0 && renew(&s, h, x, z, d)) *startup = {startup_steps};
        memcpy(rows_x + (long)k * NX, x, sizeof(double) * NX);
        memcpy(rows_z + (long)k * NZ, z, sizeof(double) * NZ);
        memcpy(rows_d + (long)k * ND, d, sizeof(double) * ND);
        args[0] = x; args[1] = z; args[2] = d; args[3] = u; args[4] = p;
        results[0] = rows_y + (long)k * NY;
        outputs(args, results, iwork, work, 0);
    }}
    return k;
}}
"""


class CompilationError(PgexciteError):
    """C code was asked for and could not be had."""


def compiler() -> str | None:
    """The C compiler: ``$CC``, ``cc`` or ``gcc``, whichever is there first; ``None`` without one."""
    for name in (os.environ.get("CC"), "cc", "gcc", "clang"):
        if name and shutil.which(name):
            return shutil.which(name)
    return None


def cache_directory() -> Path:
    """Where compiled libraries are kept: ``$PGEXCITE_CACHE``, else the user's cache directory."""
    chosen = os.environ.get("PGEXCITE_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "pgexcite"


def generate(functions: Sequence[ca.Function], constants: dict[str, object]) -> str:
    """C source of these functions and of the stepping loop around them."""
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator("stage.c", {"with_header": False, "indent": 0})
        for function in functions:
            generator.add(function)
        generator.generate(folder + os.sep)
        source = (Path(folder) / "stage.c").read_text()
    if "#error" in source:
        raise CompilationError("part of the model cannot be expressed in C")
    sizes = {key: max(1, *(getattr(f, key)() for f in functions)) for key in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
    return source + _DRIVER.format(**constants, **sizes)


def build(source: str, *, only_cached: bool = False) -> Path | None:
    """Compile a source, or take the library compiled from the same source before.

    Args:
        only_cached: do not compile; ``None`` where there is no library yet.

    Raises:
        CompilationError: no compiler, or it failed.
    """
    cc = compiler()
    key = hashlib.sha256("\0".join((source, *FLAGS, cc or "")).encode()).hexdigest()[:24]
    target = cache_directory() / f"{key}.so"
    if target.exists():
        return target
    if only_cached:
        return None
    if cc is None:
        raise CompilationError('no C compiler was found: install one, set CC, or use compile = "auto"')
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            unit = Path(folder) / "stage.c"
            unit.write_text(source)
            built = Path(folder) / target.name
            done = subprocess.run([cc, *FLAGS, str(unit), "-o", str(built), "-lm"], capture_output=True, text=True, check=False)
            if done.returncode != 0:
                raise CompilationError(f"{cc} failed: {done.stderr.strip()[:500]}")
            built.replace(target)
    except OSError as cause:
        raise CompilationError(f"the C code could not be compiled in {target.parent}: {cause}") from cause
    return target


class CompiledLoop:
    """The stepping loop of a compiled library.

    The library keeps its work arrays in static memory, so each loop loads a copy of its own: two kernels of one model never share
    them.
    """

    def __init__(self, library: Path) -> None:
        with tempfile.TemporaryDirectory() as folder:
            own = Path(folder) / library.name
            shutil.copyfile(library, own)
            self._library = ctypes.CDLL(str(own))
        self._advance = self._library.pgexcite_advance
        self._advance.restype = ctypes.c_int
        pointer = ctypes.c_void_p
        self._advance.argtypes = [ctypes.c_int, ctypes.c_double, ctypes.c_int, pointer, *([pointer] * 9)]

    def advance(self, rule: int, h: float, n: int, startup: int, arrays: Sequence[Array]) -> tuple[int, int]:
        """Take up to ``n`` steps; returns how many were taken and the startup steps left.

        Args:
            arrays: ``x, z, d, u, p`` (renewed in place) and the rows of ``x, z, d, y`` to record into, contiguous float64.
        """
        left = ctypes.c_int(startup)
        done = self._advance(rule, h, n, ctypes.addressof(left), *(array.ctypes.data for array in arrays))
        return int(done), int(left.value)
