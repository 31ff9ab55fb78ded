"""Nonlinear MPC on the perfect model: Gauss-Newton on the plant's own step, condensed to the moves, ProxQP for each subproblem.

Single shooting (the states are eliminated by the rollout), as in M. Diehl, H. J. Ferreau and N. Haverbeke, "Efficient numerical
methods for nonlinear MPC and moving horizon estimation" (2009), section 4, with the exact sensitivities of the discrete-time plant.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from pgexcite.core.controller import Plant, Sample, Surroundings
from pgexcite.core.declare import par
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.mpc import Problem as ControlProblem
from pgexcite.core.mpc import Solution, Solver, Status
from pgexcite.core.prediction import Predictor, Rollout
from pgexcite.core.qp import QuadraticProgram

Array = NDArray[np.float64]

_SHORTEST = 1.0 / 256.0
"""Shortest fraction of a Gauss-Newton step the line search tries."""
_DECREASE = 1e-4
"""Armijo's constant: the share of the predicted decrease that must be had."""


class NMPC(BaseModel):
    """Perfect-model NMPC: the prediction is the plant's own step, from the plant's own state.

    Not modelled: disturbances to come. The network is predicted as it stands at the sample.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    information: ClassVar[Literal["perfect"]] = "perfect"

    max_iterations: int = par(20, "-", "QPs solved for one plan at the most", ge=1)
    tolerance: float = par(1e-6, "pu", "largest change of a command at which a plan has converged", gt=0)
    step: float = par(0.0, "s", "prediction step; 0 takes the simulation's", ge=0)

    def start(self, problem: ControlProblem, surroundings: Surroundings, plant: Plant | None) -> Solver:
        """Begin a run.

        Raises:
            ConfigError: the prediction step does not divide the sample time.
        """
        assert plant is not None, "a perfect-information backend is always handed the plant"
        return _Solver(self, problem, surroundings, plant)


class _Solver:
    def __init__(self, config: NMPC, problem: ControlProblem, surroundings: Surroundings, plant: Plant) -> None:
        self._config, self._problem = config, problem
        h = config.step or surroundings.h
        count = round(problem.dt / h)
        if count < 1 or abs(count * h - problem.dt) > 1e-9:
            raise ConfigError([Problem("options.step", f"must divide the sample time {problem.dt:g} s", config.step)])
        self._counts, self._lengths = [count] * problem.N_p, [h] * problem.N_p
        model = plant.model
        commands = [model.position("u", path) for path in problem.commands]
        outputs = [model.position("y", path) for path in (*problem.voltages, *problem.speeds)]
        self._predictor = Predictor(plant.kernel, commands, outputs, problem.N_c, surroundings.rule)
        self._in_force = problem.moves_per_sample()
        n = problem.N_c * len(commands)
        bounded = bool(np.isfinite(problem.du_max).any())
        self._qp = QuadraticProgram(n, n if bounded else 0)
        # Moves are differences of consecutive commands: moves = difference @ plan - first, with the last command in ``first``.
        self._difference = np.eye(n) - np.eye(n, k=-len(commands))
        self._bounded = bounded
        self._plan: Array | None = None

    def memory(self) -> Mapping[str, Array]:
        return {} if self._plan is None else {"plan": self._plan}

    def recall(self, memory: Mapping[str, Array]) -> None:
        self._plan = memory.get("plan")

    def solve(self, sample: Sample, u_last: Array) -> Solution:
        """The plan from this sample on: converged, or as far as ``max_iterations`` go."""
        began = time.perf_counter()
        problem = self._problem
        plan = np.clip(self._shifted(u_last), problem.u_min, problem.u_max)
        status, cost, step, iteration = Status.ITERATED, np.inf, np.inf, 0
        rollout = self._roll(sample, plan)
        if rollout is None:
            plan = np.clip(np.tile(u_last, (problem.N_c, 1)), problem.u_min, problem.u_max)
            rollout = self._roll(sample, plan)
        if rollout is None:
            return Solution(
                Status.PREDICTION_FAILED, plan, np.inf, 0, np.inf, {"total": 1e3 * (time.perf_counter() - began)}
            )
        cost = self._cost(rollout, plan, u_last)
        while iteration < self._config.max_iterations:
            iteration += 1
            H, g = self._quadratic(rollout, plan, u_last)
            direction = self._direction(H, g, plan, u_last)
            if direction is None:
                status = Status.QP_FAILED if iteration == 1 else status
                break
            step = float(np.abs(direction).max())
            if step <= self._config.tolerance:
                status = Status.CONVERGED
                break
            found = self._search(sample, plan, u_last, direction, cost, float(g @ direction.ravel()))
            if found is None:
                # No decrease can be had along a descent direction: converged to the rounding of the cost.
                status = Status.CONVERGED if step <= np.sqrt(self._config.tolerance) else status
                break
            plan, rollout, cost = found
        if status.usable:
            self._plan = plan
        return Solution(status, plan, cost, iteration, step, {"total": 1e3 * (time.perf_counter() - began)})

    def _shifted(self, u_last: Array) -> Array:
        if self._plan is None:
            return np.tile(u_last, (self._problem.N_c, 1))
        if self._problem.N_c == 1:
            return self._plan
        return np.vstack((self._plan[1:], self._plan[-1:]))

    def _roll(self, sample: Sample, plan: Array) -> Rollout | None:
        assert sample.state is not None
        assert sample.p is not None
        return self._predictor.roll(
            sample.state, sample.p, plan, self._counts, self._lengths, self._in_force, derivatives=True
        )

    def _errors(self, rollout: Rollout) -> tuple[Array, Array]:
        """Output errors of shape ``(N_p, n_outputs)`` and their weights, ``(n_outputs,)``."""
        problem = self._problem
        references = np.concatenate((problem.V_ref, np.ones(len(problem.speeds))))
        weights = np.concatenate((np.full(len(problem.voltages), problem.Q), np.full(len(problem.speeds), problem.P)))
        return rollout.y - references, weights

    def _moves(self, plan: Array, u_last: Array) -> Array:
        return np.diff(plan, axis=0, prepend=u_last[None]).ravel()

    def _cost(self, rollout: Rollout, plan: Array, u_last: Array) -> float:
        errors, weights = self._errors(rollout)
        return float(np.sum(errors * errors * weights) + self._problem.R * np.sum(self._moves(plan, u_last) ** 2))

    def _quadratic(self, rollout: Rollout, plan: Array, u_last: Array) -> tuple[Array, Array]:
        """Gauss-Newton Hessian and gradient in the plan."""
        assert rollout.dy is not None
        errors, weights = self._errors(rollout)
        J = rollout.dy.reshape(-1, plan.size)
        weighted = J.T * np.tile(weights, errors.shape[0])
        R, D = self._problem.R, self._difference
        H = 2 * (weighted @ J + R * D.T @ D)
        g = 2 * (weighted @ errors.ravel() + R * D.T @ self._moves(plan, u_last))
        return H, g

    def _direction(self, H: Array, g: Array, plan: Array, u_last: Array) -> Array | None:
        """The QP's step, shape ``(N_c, n_u)``; ``None`` where it was not solved."""
        problem = self._problem
        lower, upper = (np.tile(bound, problem.N_c) - plan.ravel() for bound in (problem.u_min, problem.u_max))
        if self._bounded:
            limit, moves = np.tile(problem.du_max, problem.N_c), self._moves(plan, u_last)
            solution = self._qp.solve(H, g, lower, upper, self._difference, -limit - moves, limit - moves)
        else:
            solution = self._qp.solve(H, g, lower, upper)
        return solution.x.reshape(plan.shape) if solution.solved else None

    def _search(
        self, sample: Sample, plan: Array, u_last: Array, direction: Array, cost: float, slope: float
    ) -> tuple[Array, Rollout, float] | None:
        """Backtracking on the true cost; ``None`` where no decrease is found."""
        scale = 1.0
        while scale >= _SHORTEST:
            trial = np.clip(plan + scale * direction, self._problem.u_min, self._problem.u_max)
            rollout = self._roll(sample, trial)
            if rollout is not None:
                trial_cost = self._cost(rollout, trial, u_last)
                if trial_cost <= cost + _DECREASE * scale * min(slope, 0.0):
                    return trial, rollout, trial_cost
            scale /= 2
        return None
