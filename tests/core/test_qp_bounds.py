"""Programs with bounds only: the active set that is tried first, and ProxQP where it is not found."""

from __future__ import annotations

import numpy as np
import pytest

from pgexcite.core import qp
from pgexcite.core.program import Program
from pgexcite.core.qp import WarmSolver, exchange


def programs(n, count, rng):
    """Programs of very different scales; a few variables are held where they are."""
    for _ in range(count):
        J = rng.standard_normal((2 * n, n)) * np.exp(rng.uniform(-3, 3, (2 * n, 1)))
        lower, upper = -rng.exponential(1.0, n), rng.exponential(1.0, n)
        held = rng.random(n) < 0.05
        lower[held] = upper[held] = 0.0
        yield Program(J.T @ J + 0.02 * np.eye(n), rng.standard_normal(n) * np.exp(rng.uniform(0, 5)), lower, upper)


def is_optimal(program, found):
    H, g, lower, upper, _ = program
    x, y = found.x, found.multipliers
    scale = max(1.0, np.abs(g).max())
    return (
        np.abs(H @ x + g + y).max() < 1e-9 * scale  # measured 2e-13
        and (x >= lower).all()
        and (x <= upper).all()
        and (x[y > 0] == upper[y > 0]).all()
        and (x[y < 0] == lower[y < 0]).all()
    )


@pytest.mark.parametrize("n", [1, 2, 5, 20, 40])
@pytest.mark.parametrize("start", ["cold", "anywhere"])
def test_an_active_set_is_found_from_wherever_it_starts(n, start):
    rng, found = np.random.default_rng(n), 0
    for program in programs(n, 200, rng):
        guess = np.zeros(n) if start == "cold" else rng.integers(-1, 2, n).astype(float)
        solution = exchange(program, guess)
        if solution is not None:
            found += 1
            assert is_optimal(program, solution)
            assert np.array_equal(exchange(program, solution.multipliers).x, solution.x)
    assert found > 190  # measured 197 to 200


@pytest.mark.parametrize("n", [1, 5, 20])
def test_it_is_the_minimiser_of_proxqp(n, monkeypatch):
    rng = np.random.default_rng(n)
    for program in programs(n, 50, rng):
        ours = WarmSolver(n, 0).solve(program)
        with monkeypatch.context() as without:
            without.setattr(qp, "exchange", lambda *_: None)
            theirs = WarmSolver(n, 0).solve(program)
        assert ours.solved
        assert theirs.solved
        assert np.abs(ours.x - theirs.x).max() < 1e-7  # measured 4e-10


def test_a_bound_that_does_not_exist_is_never_active():
    upper = np.array([np.inf, 1.0])
    found = WarmSolver(2, 0).solve(Program(np.eye(2), np.array([-5.0, -5.0]), np.full(2, -np.inf), upper))
    assert found.x == pytest.approx([5.0, 1.0], abs=1e-12)


@pytest.mark.parametrize("H", [-np.eye(2), np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]])])
def test_what_is_not_strictly_convex_is_left_to_proxqp(H):
    assert exchange(Program(H, np.ones(2), -np.ones(2), np.ones(2)), np.zeros(2)) is None


def test_an_old_solution_is_where_the_next_one_starts():
    program = next(programs(20, 1, np.random.default_rng(7)))
    solver, other = WarmSolver(20, 0), WarmSolver(20, 0)
    first = solver.solve(program)
    assert first.iterations > 1
    assert solver.solve(program).iterations == 1
    other.recall(solver.memory())
    assert np.array_equal(other.solve(program).x, first.x)
