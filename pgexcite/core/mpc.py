"""Model predictive control: the problem every backend solves, its solution, and the protocol between them.

The cost is equation (2) of the paper "Model Predictive Control for Field Excitation of Synchronous Generators":

    J = sum_{j=1..N_p} (Q |V_ref - V_j|^2 + P |omega_ref - omega_j|^2) + sum_{j=1..N_c} R |u_j - u_{j-1}|^2
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.controller import Plant, Sample, Surroundings

Array = NDArray[np.float64]


class Status(Enum):
    """How a solve ended; the value is a sentence for a person."""

    CONVERGED = "the plan satisfies its optimality conditions"
    ITERATED = "the allowed iterations were used; the plan is feasible and better than the one it started from"
    PREDICTION_FAILED = "the model could not be stepped over the horizon; shorten the horizon or the prediction step"
    QP_FAILED = "the quadratic program was not solved; check weights and bounds for infinities and contradictions"

    @property
    def usable(self) -> bool:
        """Whether the plan may reach the plant."""
        return self in (Status.CONVERGED, Status.ITERATED)


@dataclass(frozen=True)
class Problem:
    """An excitation control problem over a receding horizon.

    Attributes:
        dt: sample time, s.
        N_p: prediction horizon, samples.
        N_c: control horizon, moves; the command is held after the last.
        commands: set-point paths, ``n_u`` of them.
        voltages: paths of the outputs held at ``V_ref``.
        speeds: paths of the speeds held at 1 pu.
        Q, P, R: weights on voltage error, speed error and move.
        u_min, u_max: bounds on the commands, shape ``(n_u,)``.
        du_max: bound on a move, shape ``(n_u,)``; infinite where there is none.
        V_ref: voltage references, pu, shape ``(len(voltages),)``.
    """

    dt: float
    N_p: int
    N_c: int
    commands: tuple[str, ...]
    voltages: tuple[str, ...]
    speeds: tuple[str, ...]
    Q: float
    P: float
    R: float
    u_min: Array
    u_max: Array
    du_max: Array
    V_ref: Array

    def moves_per_sample(self) -> NDArray[np.intp]:
        """Which of the ``N_c`` moves is in force in each of the ``N_p`` samples, shape ``(N_p,)``."""
        return np.minimum(np.arange(self.N_p), self.N_c - 1)

    def stage_cost(self, voltages: Array, speeds: Array, move: Array) -> float:
        """Cost of one sample: ``voltages`` and ``speeds`` at its end, ``move`` at its beginning."""
        return float(
            self.Q * np.sum((self.V_ref - voltages) ** 2)
            + self.P * np.sum((1.0 - speeds) ** 2)
            + self.R * np.sum(move**2)
        )


@dataclass(frozen=True)
class Solution:
    """A plan, and how it was found.

    Attributes:
        status: whether it may be used.
        u: moves as absolute commands, shape ``(N_c, n_u)``.
        cost: predicted cost of the plan.
        iterations: QPs solved.
        step: largest change of a command in the last iteration; how far from converged it may still be.
        times_ms: phase -> wall time, ms.
    """

    status: Status
    u: Array
    cost: float
    iterations: int
    step: float
    times_ms: Mapping[str, float] = field(default_factory=dict)


class Solver(Protocol):
    """A backend at work on one problem in one run."""

    def solve(self, sample: Sample, u_last: Array) -> Solution:
        """The plan from this sample on; ``u_last`` are the commands in force, shape ``(n_u,)``."""
        ...

    def memory(self) -> Mapping[str, Array]:
        """What it remembers between samples."""
        ...

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        ...


class Backend(Protocol):
    """A way to solve the problem, as configured; registered under ``pgexcite.mpc_backends``."""

    @property
    def information(self) -> Literal["perfect", "measured"]:
        """Whether it needs the plant's state and model."""
        ...

    def start(self, problem: Problem, surroundings: Surroundings, plant: Plant | None) -> Solver:
        """Begin a run."""
        ...
