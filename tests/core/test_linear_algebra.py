"""The written-out sparse LU against numpy, and the pairing of equations with unknowns."""

from __future__ import annotations

from itertools import permutations

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from plants import regulated, two_units

from pgexcite.core.errors import AssemblyError
from pgexcite.core.initialise import initialise
from pgexcite.core.linear_algebra import Entry, SymbolicLU, pair_equations
from pgexcite.core.stage import build_stage_functions, write_stage


def symbolic(pattern):
    """An SX matrix with this pattern, and the symbols of its nonzeros in CasADi's order."""
    rows, cols = np.nonzero(pattern)
    sparsity = ca.Sparsity.triplet(*pattern.shape, rows.tolist(), cols.tolist())
    entries = ca.SX.sym("a", sparsity.nnz())
    return ca.SX(sparsity, entries), entries


def matrix_rows(matrix, pairing):
    """A matrix as a system, all of it computed in every iteration and known at no point."""
    unknown_of = {int(row): column for column, row in enumerate(pairing)}
    rows = {k: {} for k in range(matrix.shape[0])}
    for i, j, value in zip(*matrix.sparsity().get_triplet(), matrix.nonzeros(), strict=True):
        rows[unknown_of[i]][j] = Entry(value, True, np.zeros(0))
    return rows


def solved(A, B, pairing):
    """``A^-1 B`` by the written-out factors, and the factors."""
    matrix, entries = symbolic(A != 0)
    lu = SymbolicLU(matrix_rows(matrix, pairing))
    rhs, given_rhs = symbolic(B != 0)
    function = ca.Function("solve", [entries, given_rhs], [lu.solve(rhs, pairing)])
    values = [M.T[(M != 0).T] for M in (A, B)]
    return np.array(function(*values)), lu


@st.composite
def systems(draw):
    """A sparse matrix with a permuted heavy diagonal, and right-hand sides with zeros."""
    n = draw(st.integers(1, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    A = rng.uniform(-1, 1, (n, n)) * (rng.uniform(size=(n, n)) < draw(st.floats(0.0, 0.7)))
    A[np.arange(n), rng.permutation(n)] += rng.choice([-1, 1], n) * rng.uniform(1.0, 3.0, n) * n**0.5
    B = rng.uniform(-1, 1, (n, draw(st.integers(1, 3)))) * (rng.uniform(size=(n, 1)) < 0.8)
    return A, B


@settings(deadline=None, max_examples=150)
@given(systems())
def test_random_sparse_systems(system):
    A, B = system
    assume(np.linalg.cond(A) < 1e4)
    found, lu = solved(A, B, pair_equations([A], A != 0))
    assert np.abs(found - np.linalg.solve(A, B)).max() < 1e-8
    assert A.shape[0] <= lu.entries <= A.size


@settings(deadline=None, max_examples=50)
@given(systems())
def test_the_pairing_maximises_the_product_of_the_pivots(system):
    """Against every other pairing of a small system; rows count relative to their largest entry."""
    A = system[0][:6, :6]
    scaled = np.abs(A)
    assume(np.all(scaled.max(axis=1) > 0))
    scaled = scaled / scaled.max(axis=1, keepdims=True)
    columns = np.arange(A.shape[0])
    best = max(np.prod(scaled[list(rows), columns]) for rows in permutations(columns))
    assume(best > 0)
    assert np.prod(scaled[pair_equations([A], A != 0), columns]) == pytest.approx(best, rel=1e-9)


def test_a_zero_diagonal_is_no_obstacle():
    A = np.array([[0.0, 2.0], [3.0, 0.0]])
    pairing = pair_equations([A], A != 0)
    assert list(pairing) == [1, 0]
    found, _ = solved(A, np.eye(2), pairing)
    assert found == pytest.approx(np.linalg.inv(A))


def test_a_pivot_must_hold_at_every_sample():
    """The largest entry of the first point vanishes at the second: the smaller one is chosen that is there at both."""
    first = np.array([[9.0, 1.0], [1.0, 9.0]])
    second = np.array([[0.0, 1.0], [1.0, 0.0]])
    assert list(pair_equations([first], first != 0)) == [0, 1]
    assert list(pair_equations([first, second], first != 0)) == [1, 0]


def test_an_entry_that_is_there_at_some_points_comes_before_one_that_never_is():
    pattern = np.ones((2, 2), dtype=bool)
    sometimes = [np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [1.0, 0.0]])]
    assert list(pair_equations(sometimes, pattern)) == [1, 0]


@pytest.mark.parametrize("pattern", [[[1, 1], [0, 0]], [[1, 0], [1, 0]], [[1, 1, 0], [1, 1, 0], [1, 1, 0]]])
def test_structural_singularity_is_refused(pattern):
    A = np.array(pattern, dtype=float)
    with pytest.raises(AssemblyError, match="structurally singular"):
        pair_equations([A], A != 0)


def test_a_right_hand_side_of_zeros_costs_nothing():
    matrix, _ = symbolic(np.ones((3, 3), dtype=bool))
    pairing = np.arange(3)
    solution = SymbolicLU(matrix_rows(matrix, pairing)).solve(ca.SX(3, 2), pairing)
    assert solution.shape == (3, 2)
    assert solution.is_zero()


@pytest.mark.parametrize("system", [regulated(), two_units()], ids=["one_unit", "two_units"])
def test_an_update_of_a_real_stage_is_numpys(system):
    """Newton's update by the written-out factors at a disturbed point: steps short and long, a fault on and off."""
    initial = initialise(system)
    model, state = initial.model, initial.state
    stage = write_stage(model)
    functions = build_stage_functions(model, state, initial.p, stage)
    arguments = [stage.w, stage.b, *stage.parameters]
    pivots = ca.Function("pivots", arguments, stage.in_parameters([ca.vertcat(*functions.factors.pivots)]))
    mass = np.array(functions.prepare(0.0, state.d, state.u, initial.p)[1]).ravel()
    faulted = initial.p.copy()
    faulted[next(k for name, k in model.index["p"].items() if name.endswith(".fault_status"))] = 1.0
    rng = np.random.default_rng(1)
    for c in (1e-30, 1e-3, 0.1):
        for p in (initial.p, faulted):
            w = np.concatenate((state.x, state.z)) + 1e-2 * rng.standard_normal(state.x.size + state.z.size)
            point = (w, mass * state.x, c, state.d, state.u, p)
            q = functions.prepare(c, state.d, state.u, p)[0]
            found = w - np.array(functions.newton(w, mass * state.x, q)[0]).ravel()
            r, J = (np.array(item.full()) for item in functions.residual(*point))
            assert np.abs(found - np.linalg.solve(J, r).ravel()).max() < 1e-12  # measured 6e-14
            assert np.abs(np.array(pivots(*point))).min() > 0.1  # measured 0.23
