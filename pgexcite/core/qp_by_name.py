"""Quadratic programs by any solver that qpsolvers offers, under the name it has there."""

from __future__ import annotations

from typing import Any

import numpy as np
import qpsolvers
import scipy.sparse as sp
from numpy.typing import NDArray

from pgexcite.core import registry
from pgexcite.core.polish import polished
from pgexcite.core.program import Program, QPSolution, Rows
from pgexcite.core.qp import WIDE

Array = NDArray[np.float64]

_SETTINGS: dict[str, dict[str, Any]] = {
    # Its own limit of 10,000 iterations is no limit to a control loop; without the gap a point 4e-7 off a bound counts as solved.
    "proxqp": {
        "backend": "dense",
        "eps_abs": 1e-10,
        "eps_rel": 0.0,
        "check_duality_gap": True,
        "eps_duality_gap_abs": 1e-8,
        "eps_duality_gap_rel": 0.0,
        "max_iter": 60,
        "compute_timings": False,
    },
    "osqp": {"eps_abs": 1e-9, "eps_rel": 0.0, "max_iter": 20000, "polishing": True},
    "daqp": {"primal_tol": 1e-10, "dual_tol": 1e-12, "iter_limit": 1000},
    "clarabel": {"tol_gap_abs": 1e-10, "tol_gap_rel": 0.0, "tol_feas": 1e-10, "max_iter": 100},
}
"""What is asked of a solver beyond its defaults; of one that is not listed, nothing."""


def solver_names() -> tuple[str, ...]:
    """Names of all solvers that qpsolvers knows, installed or not."""
    ending = "_solve_problem"
    return tuple(sorted(name.removesuffix(ending) for name in dir(qpsolvers.solvers) if name.endswith(ending)))


def objection(name: str) -> str:
    """Why a solver cannot be used, or ``""``."""
    if name in qpsolvers.available_solvers:
        return ""
    if name in solver_names():
        there = ", ".join(sorted(qpsolvers.available_solvers))
        return f"the solver {name!r} is known to qpsolvers but not installed here; install it, or use one of {there}"
    return f"qpsolvers has no solver {name!r}; {registry.nearest(name, solver_names())}"


class NamedSolver:
    """Solves programs by one of qpsolvers' solvers; each is a fresh object, so that nothing is kept from one to the next.

    A program's unknown is a step from a plan that ought to be nearly right, so every search starts at zero.

    Args:
        name: the solver.

    Raises:
        ValueError: there is no such solver, or it is not installed.
    """

    def __init__(self, name: str) -> None:
        if why := objection(name):
            raise ValueError(why)
        self._name, self._settings = name, _SETTINGS.get(name, {})
        self._sparse = name not in qpsolvers.dense_solvers

    def solve(self, program: Program) -> QPSolution:
        """Solve; an unusable input or a solver that gives up gives ``solved = False``, whatever it leaves in ``x``."""
        n = program.g.size
        nothing = QPSolution(np.zeros(n), np.zeros(0), False, 0)
        if not program.usable():
            return nothing
        program = _one_sided(_folded(program))
        H, g, lower, upper, rows = program
        if not (lower <= upper).all():
            return nothing
        lb, ub = lower, upper
        if self._name == "proxqp":  # to it a bound that does not exist is a large number, not an infinity
            lb, ub = np.maximum(lower, -WIDE), np.minimum(upper, WIDE)
        G, h = (None, None) if rows is None else (rows.matrix, rows.upper)
        problem = qpsolvers.Problem((H + H.T) / 2, g, G, h, None, None, lb, ub)
        if self._sparse:
            problem = _sparse(problem)
        try:
            solution = qpsolvers.solve_problem(problem, self._name, initvals=np.zeros(n), **self._settings)
        except (qpsolvers.exceptions.QPError, ValueError):
            return nothing
        if not solution.found or solution.x is None or not np.isfinite(solution.x).all():
            return nothing
        x = solution.x
        if solution.z is not None and solution.z_box is not None:
            multipliers = np.concatenate((solution.z, solution.z_box))
            x, _ = polished(program, x, multipliers)
        return QPSolution(np.clip(x, lower, upper), np.zeros(0), True, 0)


def _folded(program: Program) -> Program:
    """The program with its rows of one variable as bounds of that variable.

    Two parallel rows, one inside the other, have opposite multipliers that ProxQP takes for a certificate of infeasibility, and
    qpsolvers does not pass its tolerance on.
    """
    rows = program.rows
    if rows is None:
        return program
    alone = np.count_nonzero(rows.matrix, axis=1) == 1
    lower, upper = program.lower.copy(), program.upper.copy()
    for row, low, high in zip(*(part[alone] for part in rows), strict=True):
        k = int(np.flatnonzero(row)[0])
        ends = sorted((low / row[k], high / row[k]))
        lower[k], upper[k] = max(lower[k], ends[0]), min(upper[k], ends[1])
    return Program(program.H, program.g, lower, upper, Rows(*(part[~alone] for part in rows)))


def _one_sided(program: Program) -> Program:
    """The program with upper bounds only on its rows; sides that do not exist are left out."""
    rows = program.rows
    if rows is None:
        return program
    above, below = np.isfinite(rows.upper), np.isfinite(rows.lower)
    G = np.vstack((rows.matrix[above], -rows.matrix[below]))
    h = np.concatenate((rows.upper[above], -rows.lower[below]))
    return program._replace(rows=Rows(G, np.full(h.size, -np.inf), h) if h.size else None)


def _sparse(problem: qpsolvers.Problem) -> qpsolvers.Problem:
    """The same program for a solver that takes no dense matrices."""
    G = None if problem.G is None else sp.csc_matrix(problem.G)
    return qpsolvers.Problem(sp.csc_matrix(problem.P), problem.q, G, problem.h, None, None, problem.lb, problem.ub)
