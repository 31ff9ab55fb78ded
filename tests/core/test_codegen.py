"""C as it is written: the same for the same model, lane for lane the functions themselves, refused where it would not be."""

from __future__ import annotations

import ctypes
import subprocess

import casadi as ca
import numpy as np
import pytest
from plants import regulated

from pgexcite.core.codegen import CompilationError, define, generate, loop, number, write_along
from pgexcite.core.compiling import compiler
from pgexcite.core.initialise import initialise
from pgexcite.core.step import Kernel


def test_the_source_is_the_same_for_the_same_model():
    sources = set()
    for _ in range(2):
        initial = initialise(regulated())
        kernel = Kernel(initial.model, initial.state, initial.p, "never")
        sources.add(generate([*kernel.stepping(), kernel.functions.land], kernel.constants(), ["step.c", "advance.c"]))
    assert len(sources) == 1


FACTORS, DIRECTION, COMMAND = ca.SX.sym("factors", 3), ca.SX.sym("s", 2), ca.SX.sym("s_c")
ALONG = ca.Function(
    "along",
    [FACTORS, DIRECTION, COMMAND],
    [
        ca.vertcat(
            FACTORS[0] * DIRECTION[0] - DIRECTION[1] / 3.7,
            ca.if_else(FACTORS[1], -2 * DIRECTION[0] + FACTORS[2] * COMMAND, 0),
            DIRECTION[1],
            0.0,
        )
    ],
)
DRIVER = """
static lanes from1[N_BLOCKS][2], from2[N_BLOCKS][1], to[N_BLOCKS][4];
#define AT(of, k, i) (((double *)of[(k) / LANES])[(i) * LANES + (k) % LANES])
void all(const double *factors, const double *directions, double *derivatives) {
    int k, i;
    for (k = 0; k < N_COLUMNS; k++) {
        for (i = 0; i < 2; i++) AT(from1, k, i) = directions[k * 3 + i];
        AT(from2, k, 0) = directions[k * 3 + 2];
    }
    for (k = 0; k < N_BLOCKS; k++) along(factors, from1[k], from2[k], to[k]);
    for (k = 0; k < N_COLUMNS; k++)
        for (i = 0; i < 4; i++) derivatives[k * 4 + i] = AT(to, k, i);
}
"""


@pytest.mark.compiler
@pytest.mark.parametrize(
    "flags", [["-DLANES=1"], ["-DLANES=1", "-U__GNUC__"], ["-DLANES=2"], ["-DLANES=4"], ["-DLANES=8"], []]
)
@pytest.mark.parametrize("columns", [1, 3, 9])
def test_lane_for_lane_it_is_the_function(tmp_path, columns, flags):
    """Vectors wider than the processor's are taken apart by the compiler."""
    source = define({"n_columns": columns}) + loop("lanes.c") + write_along(ALONG) + DRIVER
    (tmp_path / "along.c").write_text(source)
    strict = ["-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Wno-psabi", "-Werror", "-fPIC", "-shared"]
    command = [compiler(), *strict, *flags, "along.c", "-o", "along.so"]
    subprocess.run(command, cwd=tmp_path, check=True)
    rng = np.random.default_rng(columns)
    for switch in (1.0, 0.0):
        factors, directions = np.array([0.3, switch, 1.9]), rng.normal(size=(columns, 3))
        found = np.empty((columns, 4))
        library = ctypes.CDLL(str(tmp_path / "along.so"))
        library.all(*(ctypes.c_void_p(a.ctypes.data) for a in (factors, directions, found)))
        expected = [np.array(ALONG(factors, s[:2], s[2])).ravel() for s in directions]
        assert np.array_equal(found, expected)


@pytest.mark.parametrize(
    "value",
    [
        DIRECTION[0] * DIRECTION[1],
        FACTORS[0] / DIRECTION[0],
        ca.sin(DIRECTION[0]),
        ca.if_else(DIRECTION[0], FACTORS[0], 0),
        ca.if_else(DIRECTION[0], DIRECTION[1], 0),
    ],
)
def test_what_is_not_linear_in_its_directions_is_refused(value):
    with pytest.raises(CompilationError, match="bent: is not linear in its directions"):
        write_along(ca.Function("bent", [FACTORS, DIRECTION], [value]))


@pytest.mark.parametrize(
    ("value", "text"), [(0.1, "0.1"), (3, "3"), (np.inf, "INFINITY"), (-np.inf, "-INFINITY"), (np.nan, "NAN")]
)
def test_a_number_is_written_to_the_last_bit(value, text):
    assert number(value) == text
