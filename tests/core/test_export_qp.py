"""The quadratic programs of an exported controller: solved exactly, soft rows included, or refused."""

from __future__ import annotations

import ctypes
import subprocess

import numpy as np
import pytest
from exported import STRICT, compiler
from scipy.optimize import nnls

from pgexcite.core import codegen
from pgexcite.core.qp import limits

SOURCE = """
{text}
int solve_qp(const double *H, const double *g, const double *l, const double *u, const double *A, const double *a, const double *b,
             const double *give, double *x);
int solve_qp(const double *H, const double *g, const double *l, const double *u, const double *A, const double *a, const double *b,
             const double *give, double *x) {{
    Program program;
    program.H = H; program.g = g; program.lower = l; program.upper = u;
    program.rows = A; program.row_lower = a; program.row_upper = b; program.give = give;
    return qp_solve(&program, x);
}}
"""


def library(folder, n, m):
    """Solver of programs of ``n`` variables and ``m`` rows: arrays in, whether it was solved and the minimiser out."""
    name = f"qp_{n}_{m}"
    constants = codegen.define({"n_v": n, "n_rows": m, **limits()})
    text = constants + codegen.loop("dense.c") + codegen.loop("qp.c")
    (folder / f"{name}.c").write_text(SOURCE.format(text=text))
    command = [compiler(), *STRICT, "-fPIC", "-shared", f"{name}.c", "-o", f"{name}.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    function = ctypes.CDLL(str(folder / f"{name}.so")).solve_qp

    def solve(*arrays):
        held = [np.ascontiguousarray(a, dtype=float) for a in (*arrays, np.zeros(n))]
        done = function(*(a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in held))
        return bool(done), held[-1]

    return solve


def kkt_error(H, g, lower, upper, rows, low, high, give, x):
    """Largest violation of the optimality conditions, by a nonnegative least-squares fit of the multipliers at active bounds.

    A soft row that is crossed costs: its multiplier is known. One that is not is free.
    """
    soft = give > 0
    hard = np.vstack((np.eye(x.size), rows[~soft]))
    value, floor, ceiling = hard @ x, np.concatenate((lower, low[~soft])), np.concatenate((upper, high[~soft]))
    outside = max(np.max(floor - value, initial=0.0), np.max(value - ceiling, initial=0.0))
    at_floor, at_ceiling = value - floor < 1e-10, ceiling - value < 1e-10
    normals = np.vstack((hard[at_floor], -hard[at_ceiling])).T
    crossed = np.maximum(rows[soft] @ x - high[soft], 0.0) - np.maximum(low[soft] - rows[soft] @ x, 0.0)
    prices = crossed / give[soft]
    gradient = H @ x + g + rows[soft].T @ prices
    left = nnls(normals, gradient)[1] if normals.shape[1] else np.linalg.norm(gradient)
    return max(outside, left / max(1.0, np.abs(g).max(), np.abs(prices).max(initial=0.0)))


SIZES = [
    (1, 1, 0, 0),
    (1, 1, 1, 0),
    (5, 1, 0, 0),
    (20, 1, 0, 0),
    (5, 1, 1, 0),
    (20, 1, 1, 0),
    (12, 3, 1, 0),
    (1, 1, 0, 5),
    (5, 1, 1, 10),
]
SIZES += [(3, 1, 0, 20), (20, 1, 1, 20)]


@pytest.mark.compiler
@pytest.mark.parametrize(("n", "n_u", "rate", "soft"), SIZES)
def test_programs_are_solved_exactly(n, n_u, rate, soft, tmp_path):
    rates = rate * n
    solve, rng = library(tmp_path, n, rates + soft), np.random.default_rng(n)
    differences = np.eye(n) - np.eye(n, k=-n_u)
    worst, active, crossed = 0.0, 0, 0
    for _ in range(300):
        J = rng.standard_normal((2 * n, n)) * np.exp(rng.uniform(-3, 3, (2 * n, 1)))
        H = J.T @ J + 0.02 * differences.T @ differences
        g = rng.standard_normal(n) * np.exp(rng.uniform(0, 5))
        lower, upper = -rng.exponential(1.0, n), rng.exponential(1.0, n)
        pinned = rng.random(n) < 0.05
        lower[pinned] = upper[pinned] = 0.0
        rows = np.vstack((differences[:rates], rng.standard_normal((soft, n))))
        low, high = -rng.exponential(0.5, rates + soft), rng.exponential(0.5, rates + soft)
        # At the plan a program starts from a soft bound may be crossed already, or have one side only.
        moved = np.concatenate((np.zeros(rates), rng.uniform(-1, 1, soft)))
        low, high = low + moved, high + moved
        low[rates:][rng.random(soft) < 0.3] = -np.inf
        give = np.concatenate((np.zeros(rates), np.exp(rng.uniform(-8, 3, soft))))
        solved, x = solve(H, g, lower, upper, rows, low, high, give)
        assert solved
        worst = max(worst, kkt_error(H, g, lower, upper, rows, low, high, give, x))
        active += int((np.abs(x - np.clip(x, lower + 1e-12, upper - 1e-12)) > 0).sum())
        crossed += int((rows[rates:] @ x > high[rates:] + 1e-9).sum())
    assert worst < 1e-9  # measured 2e-12, 6e-11 with soft rows
    assert active > 50
    assert crossed > 50 or not soft


@pytest.mark.compiler
def test_a_program_without_a_solution_is_refused(tmp_path):
    solve = library(tmp_path, 2, 2)

    def attempt(**changes):
        values = {"H": np.eye(2), "g": np.ones(2), "l": -np.ones(2), "u": np.ones(2)}
        rows = {"A": np.array([[1.0, 0.0], [-1.0, 1.0]]), "a": -np.ones(2), "b": np.ones(2), "give": np.zeros(2)}
        return solve(*(values | rows | changes).values())[0]

    assert attempt()
    assert not attempt(l=np.array([2.0, -1.0]), u=np.array([1.0, 1.0]))
    # The bounds leave the second move no more than 2; a soft row gives way.
    beyond = {"a": np.array([-1.0, 3.0]), "b": np.array([1.0, 4.0])}
    assert not attempt(**beyond)
    assert attempt(**beyond, give=np.array([0.0, 1.0]))
    assert not attempt(H=-np.eye(2))
    assert not attempt(g=np.array([np.nan, 0.0]))
    assert not attempt(H=np.full((2, 2), np.nan))
