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
from collections.abc import Mapping, Sequence
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
    double w[2][AT_LEAST_1(NW)], start[AT_LEAST_1(NW)], b[AT_LEAST_1(NX)];
    double middle[AT_LEAST_1(NW)], b_middle[AT_LEAST_1(NX)], mass[AT_LEAST_1(NX)], d_next[AT_LEAST_1(ND)], c, norm;
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
        memcpy(s->middle, s->w[0], sizeof(double) * NW); memcpy(s->b_middle, s->b, sizeof(double) * NX);
        for (i = 0; i < NX; i++) s->b[i] = s->mass[i] * ({alpha} * s->w[0][i] - {beta} * x[i]);
        for (i = 0; i < NW; i++) s->w[0][i] += {extrapolate} * (s->w[0][i] - s->start[i]);
        if (!solve(s)) return 0;
    }}
    memcpy(x, s->w[0], sizeof(double) * NX); memcpy(z, s->w[0] + NX, sizeof(double) * NZ);
    return 1;
}}

/* Solves the algebraic unknowns again at fixed states. */
static int settle(Stage *s, double *x, double *z) {{
    int i;
    s->c = {frozen};
    for (i = 0; i < NX; i++) s->b[i] = s->mass[i] * x[i];
    memcpy(s->w[0], x, sizeof(double) * NX); memcpy(s->w[0] + NX, z, sizeof(double) * NZ);
    if (!solve(s)) return 0;
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
    memcpy(s->start, z, sizeof(double) * NZ);
    if (!settle(s, x, z)) return 1;
    for (i = 0; i < NZ; i++) {{
        double move = z[i] > s->start[i] ? z[i] - s->start[i] : s->start[i] - z[i];
        if (move > moved) moved = move;
    }}
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


_ROLLOUT = r"""
#define NU {n_u}
#define NP {n_p}
#define NC {n_commands}
#define NK {n_columns}
#define NS {n_selected}
#define TRANSITION {transition}

static double S[NW * NK], S_next[NW * NK], S_b[AT_LEAST_1(NX) * NK], S_c[NC * NK];

static void sense_history(Stage *s, const double *x, const double *z) {{
    args[0] = x; args[1] = z; args[2] = s->d; args[3] = s->u; args[4] = s->p; args[5] = &s->c; args[6] = S; args[7] = S_c;
    results[0] = S_b;
    history_sensitivity(args, results, iwork, work, 0);
}}

static void sense_stage(Stage *s, const double *w, const double *b, double *to) {{
    args[0] = w; args[1] = b; args[2] = &s->c; args[3] = s->d; args[4] = s->u; args[5] = s->p; args[6] = S_b; args[7] = S_c;
    results[0] = to;
    stage_sensitivity(args, results, iwork, work, 0);
}}

static void scale_by_mass(Stage *s, double alpha, const double *A, double beta, const double *B) {{
    int i, k;
    for (k = 0; k < NK; k++)
        for (i = 0; i < NX; i++) S_b[k * NX + i] = s->mass[i] * (alpha * A[k * NW + i] - beta * B[k * NW + i]);
}}

static void sense_step(Stage *s, int rule, int euler) {{
    if (rule == 2 || euler) {{
        scale_by_mass(s, 1, S, 0, S);
        sense_stage(s, s->w[0], s->b, S);
    }} else {{
        sense_history(s, s->start, s->start + NX);
        if (rule == 1) {{
            sense_stage(s, s->w[0], s->b, S);
        }} else {{
            sense_stage(s, s->middle, s->b_middle, S_next);
            scale_by_mass(s, {alpha}, S_next, {beta}, S);
            sense_stage(s, s->w[0], s->b, S);
        }}
    }}
}}

static void sense_settling(Stage *s, const double *x, const double *z) {{
    int i;
    memcpy(s->start, x, sizeof(double) * NX); memcpy(s->start + NX, z, sizeof(double) * NZ);
    s->c = {frozen};
    for (i = 0; i < NX; i++) s->b[i] = s->mass[i] * x[i];
    scale_by_mass(s, 1, S, 0, S);
    sense_stage(s, s->start, s->b, S);
}}

/* Directions of the sensitivities at the start of a piece: the commands of its move; of a sample also, if transitions are wanted,
   each state by itself. */
static void point_at(int move, int fresh_sample) {{
    int i;
    if (TRANSITION && !fresh_sample) return;
    memset(S_c, 0, sizeof S_c);
    if (TRANSITION) {{
        memset(S, 0, sizeof S);
        for (i = 0; i < NX; i++) S[i * NW + i] = 1;
        for (i = 0; i < NC; i++) S_c[(NX + i) * NC + i] = 1;
    }} else {{
        for (i = 0; i < NC; i++) S_c[(move * NC + i) * NC + i] = 1;
    }}
}}

/* Rolls out N pieces of count[j] steps of length h[j] under moves[move[j]], parameters and other commands of row[j]; outputs and
   derivatives after each piece that ends a sample. Returns how many pieces were completed. */
int pgexcite_rollout(int rule, int N, const int *count, const double *h, const int *move, const int *row, const int *end,
                     const int *commands, int startup, double *x, double *z, double *d, const double *p_rows,
                     const double *u_rows, const double *moves, int derivatives, double *y, double *dy, double *dx) {{
    static Stage s;
    static double u[AT_LEAST_1(NU)], u_last[AT_LEAST_1(NU)];
    int j, i, k, sample = 0, fresh = 1;
    memcpy(u_last, u_rows, sizeof(double) * NU);
    s.d = d; s.u = u_last; s.p = p_rows; s.c = 0;
    history_at(&s, x, z);
    memset(S, 0, sizeof S); memset(S_c, 0, sizeof S_c);
    for (j = 0; j < N; j++) {{
        int changed = j > 0 && row[j] != row[j - 1];
        memcpy(u, u_rows + (long)row[j] * NU, sizeof(double) * NU);
        for (i = 0; i < NC; i++) u[commands[i]] = moves[move[j] * NC + i];
        for (i = 0; i < NU; i++) changed |= u[i] != u_last[i];
        s.u = u; s.p = p_rows + (long)row[j] * NP;
        if (changed) {{
            s.c = 0;
            history_at(&s, x, z);
            if (!settle(&s, x, z)) return j;
            startup = {startup_steps};
            memcpy(u_last, u, sizeof(double) * NU);
        }}
        if (derivatives && (fresh || changed)) {{
            point_at(move[j], fresh);
            sense_settling(&s, x, z);
        }}
        for (k = 0; k < count[j]; k++) {{
            int euler = rule == 1 && startup > 0;
            if (!one_step(&s, rule, h[j], startup, x, z)) return j;
            if (derivatives) sense_step(&s, rule, euler);
            if (startup > 0) startup--;
            if (ND > 0 && renew(&s, h[j], x, z, d)) {{
                startup = {startup_steps};
                if (derivatives) sense_settling(&s, x, z);
            }}
        }}
        fresh = end[j];
        if (!end[j]) continue;
        args[0] = x; args[1] = z; args[2] = d; args[3] = u; args[4] = s.p; args[5] = S; args[6] = S_c;
        results[0] = y + sample * NS; results[1] = derivatives ? dy + (long)sample * NS * NK : 0;
        output_sensitivity(args, results, iwork, work, 0);
        if (derivatives && TRANSITION)
            for (k = 0; k < NK; k++) memcpy(dx + ((long)sample * NK + k) * NX, S + k * NW, sizeof(double) * NX);
        sample++;
    }}
    return N;
}}

/* Chains the transitions of N samples into derivatives to the initial states and to n_moves moves; move[j] is in force in sample j.
   Q = NX + n_moves * NC columns; X holds Q * NX numbers, twice. */
void pgexcite_condense(int N, int n_moves, const int *move, const double *dy, const double *dx, double *X, double *G) {{
    int Q = NX + n_moves * NC, j, q, k, i;
    double *next = X + (long)Q * NX;
    memset(X, 0, sizeof(double) * 2 * Q * NX);
    for (i = 0; i < NX; i++) X[i * NX + i] = 1;
    for (j = 0; j < N; j++) {{
        const double *Y = dy + (long)j * NS * NK, *A = dx + (long)j * NK * NX;
        double *swap = X;
        for (q = 0; q < Q; q++) {{
            int own = q - NX - move[j] * NC;
            double *g = G + ((long)j * Q + q) * NS, *to = next + (long)q * NX;
            for (i = 0; i < NS; i++) g[i] = own >= 0 && own < NC ? Y[(NX + own) * NS + i] : 0;
            for (i = 0; i < NX; i++) to[i] = own >= 0 && own < NC ? A[(NX + own) * NX + i] : 0;
            if (q >= NX && q >= NX + (move[j] + 1) * NC) continue;
            for (k = 0; k < NX; k++) {{
                double v = X[(long)q * NX + k];
                if (v == 0) continue;
                for (i = 0; i < NS; i++) g[i] += Y[k * NS + i] * v;
                for (i = 0; i < NX; i++) to[i] += A[k * NX + i] * v;
            }}
        }}
        X = next; next = swap;
    }}
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


def generate(functions: Sequence[ca.Function], constants: Mapping[str, object], *, rollout: bool = False) -> str:
    """C source of these functions and of the stepping loop around them.

    Args:
        functions: ``newton``, ``history``, ``update``, ``outputs``; for a rollout also ``stage_sensitivity``,
            ``history_sensitivity`` and ``output_sensitivity``.
        constants: what the templates need.
        rollout: whether to add the prediction loop.
    """
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator("stage.c", {"with_header": False, "indent": 0})
        for function in functions:
            generator.add(function)
        generator.generate(folder + os.sep)
        source = (Path(folder) / "stage.c").read_text()
    if "#error" in source:
        raise CompilationError("part of the model cannot be expressed in C")
    sizes = {key: max(1, *(getattr(f, key)() for f in functions)) for key in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
    template = _DRIVER + _ROLLOUT if rollout else _DRIVER
    return source + template.format(**constants, **sizes)


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
            done = subprocess.run(
                [cc, *FLAGS, str(unit), "-o", str(built), "-lm"], capture_output=True, text=True, check=False
            )
            if done.returncode != 0:
                raise CompilationError(f"{cc} failed: {done.stderr.strip()[:500]}")
            built.replace(target)
    except OSError as cause:
        raise CompilationError(f"the C code could not be compiled in {target.parent}: {cause}") from cause
    return target


def load(library: Path) -> ctypes.CDLL:
    """Load a copy of a library of one's own: its work arrays are static, and two kernels of one model must not share them."""
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / library.name
        shutil.copyfile(library, own)
        return ctypes.CDLL(str(own))


class CompiledLoop:
    """The stepping loop of a compiled library."""

    def __init__(self, library: Path) -> None:
        self._advance = load(library).pgexcite_advance
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
