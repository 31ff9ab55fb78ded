"""The warm-started quadratic programs: against another solver, and where ProxQP's own defaults go wrong."""

from __future__ import annotations

import numpy as np
import pytest
import qpsolvers

from pgexcite.core.program import Program, Rows
from pgexcite.core.qp import WarmSolver
from pgexcite.core.qp_by_name import NamedSolver

H = np.array([[8.717771058826e-02, 1.953443127785], [1.953443127785, 379.8883179443]])
G = np.array([-0.221793460823, -25.817593903047])


@pytest.mark.parametrize("solver", [WarmSolver(2, 2), NamedSolver("proxqp"), NamedSolver("daqp")])
def test_a_move_bound_beside_a_command_bound_is_no_contradiction(solver):
    """Parallel rows, one inside the other: with its default tolerance ProxQP calls this infeasible after four iterations."""
    lower, upper = np.array([-0.611732817719, -0.534319313605]), np.array([0.008267182281, 0.965680686395])
    rows = Rows(np.eye(2), np.array([-0.01, -1.0]), np.array([0.01, 1.0]))
    found = solver.solve(Program(H, G, lower, upper, rows))
    assert found.solved
    first = upper[0]
    assert found.x == pytest.approx([first, -(G[1] + H[1, 0] * first) / H[1, 1]], abs=1e-9)


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_random_programs_agree_with_an_active_set_solver(seed, named):
    draw = np.random.default_rng(seed)
    n = int(draw.integers(1, 8))
    root = draw.normal(size=(n, n))
    hessian, gradient = root @ root.T * 10 ** draw.uniform(-2, 2) + 0.02 * np.eye(n), 10 * draw.normal(size=n)
    rows = np.eye(n) - np.eye(n, k=-1)
    lower, upper = -draw.uniform(0, 1, n), draw.uniform(0, 1, n)
    reach = draw.uniform(0.01, 1, n)
    solver = NamedSolver("proxqp") if named else WarmSolver(n, n)
    for _ in range(2):  # cold, then warm
        found = solver.solve(Program(hessian, gradient, lower, upper, Rows(rows, -reach, reach)))
        wanted = qpsolvers.solve_qp(
            hessian, gradient, np.vstack((rows, -rows)), np.tile(reach, 2), lb=lower, ub=upper, solver="daqp"
        )
        assert found.solved
        assert found.x == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize(
    "seed", [273, *range(20)]
)  # 273: infeasible to a tolerance of 1e-12, when it starts from the one before
def test_multipliers_of_an_unlike_program_do_not_lead_astray(seed):
    draw = np.random.default_rng(seed)
    n = int(draw.integers(1, 9))
    solver, rows = WarmSolver(n, n), np.eye(n) - np.eye(n, k=-1)
    for _ in range(8):
        root = draw.normal(size=(n, n))
        hessian = root @ root.T * 10 ** draw.uniform(-3, 2) + 0.02 * np.eye(n)
        gradient = 10 ** draw.uniform(-1, 2) * draw.normal(size=n)
        lower = -draw.uniform(0, 3, n) * (draw.random(n) < 0.8)
        upper, reach = draw.uniform(0, 3, n) * (draw.random(n) < 0.8), draw.uniform(0.01, 1, n)
        assert solver.solve(Program(hessian, gradient, lower, upper, Rows(rows, -reach, reach))).solved


def test_a_contradiction_is_not_solved():
    solver, box = WarmSolver(2, 1), Program(np.eye(2), np.zeros(2), np.full(2, -1.0), np.ones(2))
    found = solver.solve(box._replace(rows=Rows(np.ones((1, 2)), np.array([3.0]), np.array([4.0]))))
    assert not found.solved
    assert solver.solve(box._replace(rows=Rows(np.ones((1, 2)), np.array([1.0]), np.array([4.0])))).solved


def test_the_optimality_conditions_hold():
    rng = np.random.default_rng(1)
    for n, m in ((1, 0), (5, 0), (8, 8), (20, 20)):
        for _ in range(20):
            A = rng.normal(size=(n, n))
            H, g = A @ A.T + 1e-3 * np.eye(n), 10 * rng.normal(size=n)
            lower, upper = -rng.random(n), rng.random(n)
            rows, reach = rng.normal(size=(m, n)), np.full(m, 0.5)
            program = Program(H, g, lower, upper, Rows(rows, -reach, reach) if m else None)
            solution = WarmSolver(n, m).solve(program)
            assert solution.solved
            x, y = solution.x, solution.multipliers
            C = np.vstack((rows, np.eye(n)))
            low, high = np.concatenate((-reach, lower)), np.concatenate((reach, upper))
            value = C @ x
            assert np.abs(H @ x + g + C.T @ y).max() < 1e-8  # stationarity
            assert np.all(value <= high + 1e-9)
            assert np.all(value >= low - 1e-9)
            slack = np.where(y > 0, high - value, value - low)
            assert np.abs(y * slack).max() < 1e-7  # complementarity


@pytest.mark.parametrize(
    "broken",
    [
        {"H": np.array([[np.nan]])},
        {"g": np.array([np.inf])},
        {"lower": np.array([1.0]), "upper": np.array([0.0])},
        {"lower": np.array([np.nan])},
    ],
)
def test_it_refuses_what_would_stall_the_solver(broken):
    data = {"H": np.eye(1), "g": np.ones(1), "lower": -np.ones(1), "upper": np.ones(1)} | broken
    assert not WarmSolver(1, 0).solve(Program(**data)).solved


def test_contradictory_rows_end_quickly_and_unsolved():
    rows = np.array([[1.0, 1.0], [1.0, 1.0]])
    contradictory = Rows(rows, np.array([1.0, -2.0]), np.array([1.5, -1.0]))
    solution = WarmSolver(2, 2).solve(Program(np.eye(2), np.zeros(2), -np.ones(2), np.ones(2), contradictory))
    assert not solution.solved
    assert solution.iterations <= 60 * 60
