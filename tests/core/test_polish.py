"""Solutions of quadratic programs made exact: from what a solver leaves at its tolerance, and never worse than that."""

from __future__ import annotations

import numpy as np
import pytest
import qpsolvers

from pgexcite.core.polish import polished
from pgexcite.core.program import Program, Rows
from pgexcite.core.qp_by_name import NamedSolver


def drawn(seed, n=6, m=5):
    """A strictly convex program, some of its bounds missing, and rows."""
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(n, n))
    H, g = root @ root.T * 10 ** draw.uniform(-2, 2) + 0.02 * np.eye(n), 10 * draw.normal(size=n)
    rows = draw.normal(size=(m, n))
    lower, upper = -draw.uniform(0, 1, n), draw.uniform(0, 1, n)
    upper[draw.random(n) < 0.3] = np.inf
    low, high = -draw.uniform(0, 0.5, m), draw.uniform(0, 0.5, m)
    low[draw.random(m) < 0.5] = -np.inf
    return Program(H, g, lower, upper, Rows(rows, low, high))


def conditions(program, x, multipliers):
    """Largest violation of the optimality conditions."""
    H, g, lower, upper, (rows, low, high) = program
    value, floor, ceiling = np.concatenate((rows @ x, x)), np.concatenate((low, lower)), np.concatenate((high, upper))
    slope = H @ x + g + rows.T @ multipliers[: len(low)] + multipliers[len(low) :]
    slack = np.where(multipliers > 0, ceiling - value, np.where(multipliers < 0, value - floor, 0.0))
    crossed = np.maximum(floor - value, value - ceiling)
    return max(np.abs(slope).max(), np.abs(slack).max(), crossed.max())


@pytest.mark.parametrize("seed", range(40))
def test_what_is_off_by_a_tolerance_becomes_exact(seed):
    program = drawn(seed)
    H, g, lower, upper, (rows, low, high) = program
    one_sided = np.isfinite(high), np.isfinite(low)
    G = np.vstack((rows[one_sided[0]], -rows[one_sided[1]]))
    h = np.concatenate((high[one_sided[0]], -low[one_sided[1]]))
    solved = qpsolvers.solve_problem(qpsolvers.Problem(H, g, G, h, lb=lower, ub=upper), "daqp", dual_tol=1e-12)
    sides, at = np.zeros(len(low)), int(one_sided[0].sum())
    sides[one_sided[0]] += solved.z[:at]
    sides[one_sided[1]] -= solved.z[at:]
    exact = np.concatenate((sides, solved.z_box))
    draw = np.random.default_rng(seed)
    rough = solved.x + 1e-7 * draw.normal(size=g.size), exact + 1e-7 * draw.normal(size=exact.size)
    x, multipliers = polished(program, *rough)
    scale = max(1.0, np.abs(g).max())
    assert conditions(program, x, multipliers) < 1e-13 * scale  # measured 7e-16
    assert x == pytest.approx(solved.x, abs=1e-10)


@pytest.mark.parametrize("solver", ["proxqp", "daqp"])
@pytest.mark.parametrize("seed", range(20))
def test_named_solvers_agree_to_rounding(seed, solver):
    program = drawn(seed)
    found, wanted = NamedSolver(solver).solve(program), NamedSolver("daqp").solve(program)
    assert found.solved
    assert found.x == pytest.approx(wanted.x, abs=1e-12)  # measured 1e-15; 3e-10 as ProxQP leaves it


def test_a_wrong_set_of_bounds_is_put_right_or_left_alone():
    program = Program(np.eye(2), np.array([-3.0, 0.5]), -np.ones(2), np.ones(2))
    # The first variable ends at its bound, the second is free; told the opposite of both.
    x, multipliers = polished(program, np.array([0.9, 1.0]), np.array([0.0, 0.5]))
    assert x == pytest.approx([1.0, -0.5])
    assert multipliers == pytest.approx([2.0, 0.0])
    # Dependent constraints have no multipliers of their own: the solver's solution stands.
    x, rows = np.array([0.5, 0.0]), Rows(np.array([[1.0, 0.0], [1.0, 0.0]]), np.full(2, -np.inf), np.full(2, 0.5))
    given = np.array([1.0, 1.0, 0.0, 0.0])
    kept, _ = polished(program._replace(rows=rows), x, given)
    assert kept is x
