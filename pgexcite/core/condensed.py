"""The quadratic program of a problem condensed to its moves: what every backend builds from a prediction and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.mpc import ControlProblem
from pgexcite.core.program import Program, QPSolver, Rows
from pgexcite.core.qp import WarmSolver

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curvature:
    """What a program owes to the derivatives alone.

    Attributes:
        weighted: twice the weights times the derivatives of the tracked outputs, shape ``(n, N_p * n_tracked)``.
        H: Gauss-Newton Hessian of the tracked cost, shape ``(n, n)``.
    """

    weighted: Array
    H: Array


@dataclass(frozen=True)
class Linearised:
    """A prediction around a plan.

    Attributes:
        y: predicted outputs ``(voltages, speeds, soft-bounded)`` at the end of each sample, shape ``(N_p, n_y)``.
        G: derivatives to the moves, shape ``(N_p, n_y, N_c * n_u)``.
        references: of the voltages, shape ``(N_p, n_voltages)``.
        curvature: by ``Condensed.curvature``, where it is known already.
    """

    y: Array
    G: Array
    references: Array
    curvature: Curvature | None = None


class Direction(NamedTuple):
    """A program's step from a plan.

    Attributes:
        step: of the commands, shape ``(N_c, n_u)``.
        slope: of the cost along it, at the plan.
        cost: after it, to first order of the prediction.
    """

    step: Array
    slope: float
    cost: float


class Condensed:
    """Cost and quadratic programs of one problem.

    Outputs come in the order voltages, speeds, soft-bounded. Soft bounds get a slack each, so that a program always has a solution.

    Args:
        problem: the control problem.
        solver: of programs with ``variables`` variables and ``rows`` rows; ``WarmSolver`` where left out.
    """

    def __init__(self, problem: ControlProblem, solver: QPSolver | None = None) -> None:
        self.problem = problem
        n_u, self._n_soft = len(problem.commands), len(problem.soft)
        self.n = problem.N_c * n_u
        self._n_slack = self._n_soft * problem.N_p
        self._rate = bool(np.isfinite(problem.du_max).any())
        self.variables = self.n + self._n_slack
        self.rows = (self.n if self._rate else 0) + 2 * self._n_slack
        self.solver: QPSolver = solver or WarmSolver(self.variables, self.rows)
        # Moves are differences of consecutive commands: moves = difference @ plan - (last command, 0, ...).
        self._difference = np.eye(self.n) - np.eye(self.n, k=-n_u)
        weights = np.concatenate((problem.Q, problem.P))
        self._weights = np.tile(weights, (problem.N_p, 1))
        self._weights[-1] *= problem.terminal
        self._twice = 2 * self._weights.ravel()
        self._n_tracked = weights.size
        self._referred, self._targets = np.empty(0), np.empty(0)
        self._R = np.tile(problem.R, problem.N_c)
        self._move_hessian = 2 * (self._difference.T * self._R) @ self._difference
        self._lower, self._upper = np.tile(problem.u_min, problem.N_c), np.tile(problem.u_max, problem.N_c)
        self._du_max = np.tile(problem.du_max, problem.N_c)
        self._soft_lower = np.array([bound.lower for bound in problem.soft])
        self._soft_upper = np.array([bound.upper for bound in problem.soft])
        self._soft_weight = np.array([bound.weight for bound in problem.soft])
        self._slack_hessian = np.zeros((self.variables, self.variables))
        slacks = np.arange(self.n, self.variables)
        self._slack_hessian[slacks, slacks] = np.tile(2 * self._soft_weight, problem.N_p)

    def outputs(self) -> tuple[str, ...]:
        """Paths of the outputs a prediction must give."""
        return (*self.problem.voltages, *self.problem.speeds, *(bound.path for bound in self.problem.soft))

    def _moves(self, plan: Array, u_last: Array) -> Array:
        moves: Array = self._difference @ plan.ravel()
        moves[: u_last.size] -= u_last
        return moves

    def _errors(self, y: Array, references: Array) -> Array:
        if references is not self._referred:
            # References that do not change are the same array in every sample.
            self._referred, self._targets = references, np.ones((y.shape[0], self._n_tracked))
            self._targets[:, : references.shape[1]] = references
        return y[:, : self._n_tracked] - self._targets

    def cost(self, y: Array, references: Array, plan: Array, u_last: Array) -> float:
        """Cost of a plan, soft bounds included."""
        errors, moves = self._errors(y, references), self._moves(plan, u_last)
        total = np.vdot(errors * errors, self._weights) + (self._R * moves) @ moves
        if self._n_soft:
            total += np.sum(self._soft_weight * self._excess(y[:, self._n_tracked :]) ** 2)
        return float(total)

    def _excess(self, soft: Array) -> Array:
        return np.maximum(soft - self._soft_upper, 0.0) + np.maximum(self._soft_lower - soft, 0.0)

    def curvature(self, G: Array) -> Curvature:
        """What programs around a prediction with these derivatives share."""
        J = G[:, : self._n_tracked].reshape(-1, self.n)
        weighted = J.T * self._twice
        return Curvature(weighted, weighted @ J + self._move_hessian)

    def quadratic(self, at: Linearised, plan: Array, u_last: Array) -> tuple[Array, Array, float]:
        """The tracked cost around a plan, no soft bounds: Hessian (Gauss-Newton), gradient and value."""
        shared = at.curvature or self.curvature(at.G)
        errors, moves = self._errors(at.y, at.references).ravel(), self._moves(plan, u_last)
        weighted = self._R * moves
        value = 0.5 * float((errors * errors) @ self._twice) + float(weighted @ moves)
        g = shared.weighted @ errors
        weighted *= 2
        g += weighted
        g[: -u_last.size] -= weighted[u_last.size :]
        return shared.H, g, value

    def direction(self, at: Linearised, plan: Array, u_last: Array) -> Direction | None:
        """The program's step from a plan; ``None`` where it was not solved."""
        H, g, value = tracked = self.quadratic(at, plan, u_last)
        lower, upper = self._lower - plan.ravel(), self._upper - plan.ravel()
        rows = self._constraints(at, plan, u_last) if self.rows else None
        if self._n_slack:
            H = self._slack_hessian.copy()
            H[: self.n, : self.n] = tracked[0]
            g = np.concatenate((g, np.zeros(self._n_slack)))
            lower = np.concatenate((lower, np.zeros(self._n_slack)))
            upper = np.concatenate((upper, np.full(self._n_slack, np.inf)))
        solution = self.solver.solve(Program(H, g, lower, upper, rows))
        if not solution.solved:
            return None
        step = solution.x[: self.n]
        slope = float(tracked[1] @ step)
        cost = value + slope + 0.5 * float(step @ (tracked[0] @ step))
        if self._n_soft:
            y, along = at.y, at.G[:, self._n_tracked :] @ step
            sides = np.sign(y[:, self._n_tracked :] - self._soft_upper)
            slope += float(np.sum(2 * self._soft_weight * self._excess(y[:, self._n_tracked :]) * sides * along))
            cost += float(np.sum(self._soft_weight * self._excess(y[:, self._n_tracked :] + along) ** 2))
        return Direction(step.reshape(plan.shape), slope, cost)

    def _constraints(self, at: Linearised, plan: Array, u_last: Array) -> Rows:
        blocks, low, high = [], [], []
        if self._rate:
            moves = self._moves(plan, u_last)
            blocks.append(np.hstack((self._difference, np.zeros((self.n, self._n_slack)))))
            low.append(-self._du_max - moves)
            high.append(self._du_max - moves)
        if self._n_slack:
            G = at.G[:, self._n_tracked :].reshape(-1, self.n)
            y = at.y[:, self._n_tracked :].ravel()
            slack, nothing = np.eye(self._n_slack), np.full(self._n_slack, np.inf)
            upper, lower = (
                np.tile(self._soft_upper, self.problem.N_p) - y,
                np.tile(self._soft_lower, self.problem.N_p) - y,
            )
            blocks += [np.hstack((G, -slack)), np.hstack((G, slack))]
            low += [-nothing, lower]
            high += [upper, nothing]
        return Rows(np.vstack(blocks), np.concatenate(low), np.concatenate(high))

    def clipped(self, plan: Array) -> Array:
        """A plan within the bounds on commands."""
        return np.minimum(np.maximum(plan, self.problem.u_min), self.problem.u_max)

    def reachable(self, plan: Array, u_last: Array) -> Array:
        """The nearest plan that keeps the bounds on moves from ``u_last`` on, and those on commands."""
        if not self._rate:
            return self.clipped(plan)
        kept = np.empty_like(plan)
        before = u_last
        for k, move in enumerate(plan):
            before = self.clipped(np.clip(move, before - self.problem.du_max, before + self.problem.du_max))
            kept[k] = before
        return kept
