"""Programs by name: the optimum whatever the solver, and no stalled or invented solutions."""

from __future__ import annotations

import numpy as np
import pytest
import qpsolvers

from pgexcite.core.program import Program, Rows
from pgexcite.core.qp import WarmSolver
from pgexcite.core.qp_by_name import NamedSolver, objection, solver_names

INSTALLED = sorted(qpsolvers.available_solvers)


def test_there_are_several_to_compare():
    assert {"proxqp", "daqp"} <= set(INSTALLED)


def programs(n, m, rng):
    A = rng.normal(size=(n, n))
    H, g = A @ A.T + 1e-2 * np.eye(n), 10 * rng.normal(size=n)
    lower, upper = -rng.random(n), rng.random(n)
    upper[-1] = np.inf
    if not m:
        return Program(H, g, lower, upper)
    below, above = -np.full(m, 0.5), np.full(m, 0.5)
    below[0], above[-1] = -np.inf, np.inf
    return Program(H, g, lower, upper, Rows(rng.normal(size=(m, n)), below, above))


@pytest.mark.parametrize("name", INSTALLED)
@pytest.mark.parametrize(("n", "m"), [(1, 0), (5, 3), (12, 12)])
def test_every_solver_finds_the_optimum(name, n, m):
    rng = np.random.default_rng(n)
    for _ in range(10):
        program = programs(n, m, rng)
        expected, found = WarmSolver(n, m).solve(program), NamedSolver(name).solve(program)
        assert expected.solved
        assert found.solved
        assert np.abs(found.x - expected.x).max() < 1e-6  # measured 5e-8
        assert (found.x >= program.lower).all()
        assert (found.x <= program.upper).all()


@pytest.mark.parametrize("name", INSTALLED)
def test_contradictory_rows_are_not_solved(name):
    rows = np.array([[1.0, 1.0], [1.0, 1.0]])
    contradictory = Rows(rows, np.array([1.0, -2.0]), np.array([1.5, -1.0]))
    program = Program(np.eye(2), np.zeros(2), -np.ones(2), np.ones(2), contradictory)
    assert not NamedSolver(name).solve(program).solved


@pytest.mark.parametrize("name", INSTALLED)
@pytest.mark.parametrize(
    "broken", [{"H": np.array([[np.nan]])}, {"g": np.array([np.inf])}, {"lower": np.ones(1), "upper": np.zeros(1)}]
)
def test_what_would_stall_a_solver_is_refused(name, broken):
    data = {"H": np.eye(1), "g": np.ones(1), "lower": -np.ones(1), "upper": np.ones(1)} | broken
    assert not NamedSolver(name).solve(Program(**data)).solved


def test_names_are_judged():
    assert not objection("proxqp")
    assert "did you mean 'clarabel'" in objection("clarabell")
    missing = next(name for name in solver_names() if name not in INSTALLED)
    assert "not installed here" in objection(missing)
    with pytest.raises(ValueError, match="qpsolvers has no solver"):
        NamedSolver("simplex")
