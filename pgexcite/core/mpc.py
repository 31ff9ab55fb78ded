"""Model predictive control: the problem every backend solves, its solution, and the protocol between them.

The cost is equation (2) of the paper "Model Predictive Control for Field Excitation of Synchronous Generators":

    J = sum_{j=1..N_p} (Q |V_ref - V_j|^2 + P |omega_ref - omega_j|^2) + sum_{j=1..N_c} R |u_j - u_{j-1}|^2
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.controller import Plant, Sample, Surroundings
from pgexcite.core.events import Change

Array = NDArray[np.float64]


class Status(Enum):
    """How a solve ended; the value is a sentence for a person."""

    CONVERGED = "the plan satisfies its optimality conditions"
    ITERATED = "the allowed iterations were used; the plan is feasible and better than the one it started from"
    PREDICTION_FAILED = "the model could not be stepped over the horizon; shorten the horizon or the prediction step"
    STATE_UNKNOWN = "the state is not known: no usable measurement, or the estimator has diverged"
    SOLVER_FAILED = "the solver's arithmetic failed;"
    QP_FAILED = "the quadratic program was not solved; check weights and bounds for infinities and contradictions"

    @property
    def usable(self) -> bool:
        """Whether the plan may reach the plant."""
        return self in (Status.CONVERGED, Status.ITERATED)


@dataclass(frozen=True)
class SoftBound:
    """A bound on an output that may be crossed at a price: ``weight * excess^2`` in each sample.

    Attributes:
        path: the output.
        lower, upper: bounds in the output's unit; infinite where there is none.
        weight: price of a unit of excess, squared.
    """

    path: str
    lower: float
    upper: float
    weight: float


@dataclass(frozen=True)
class ControlProblem:
    """An excitation control problem over a receding horizon.

    Attributes:
        dt: sample time, s.
        N_p: prediction horizon, samples.
        blocks: length of each move in samples; the last is held to the end. ``N_c`` moves of one sample are ``(1,) * N_c``.
        commands: set-point paths, ``n_u`` of them.
        voltages: paths of the outputs held at ``V_ref``.
        speeds: paths of the speeds held at 1 pu.
        Q, P, R: weights on voltage errors, speed errors and moves, shapes ``(len(voltages),)``, ``(len(speeds),)``, ``(n_u,)``.
        u_min, u_max: bounds on the commands, shape ``(n_u,)``.
        du_max: bound on a move, shape ``(n_u,)``; infinite where there is none.
        V_ref: voltage references, pu, shape ``(len(voltages),)``.
        terminal: factor on ``Q`` and ``P`` at the last sample.
        soft: soft bounds on outputs.
        growth: ratio of consecutive prediction intervals; 1 is uniform. The first is ``dt``.
        previews: known changes to come of ``V_ref``, as ``(t, V_ref)`` in order of time.
        steps: changes of ``V_ref`` that are not known before they happen, as ``(t, V_ref)`` in order of time.
        known: known disturbances to come.
        delayed: whether a plan takes one sample to compute: it is made for the sample after the one it is made in.
        late: samples between the instant measurements are taken at and the one they are told at.
        fixed: set-points that hold while the controller is in charge (the field transfer's ``manual``).
    """

    dt: float
    N_p: int
    blocks: tuple[int, ...]
    commands: tuple[str, ...]
    voltages: tuple[str, ...]
    speeds: tuple[str, ...]
    Q: Array
    P: Array
    R: Array
    u_min: Array
    u_max: Array
    du_max: Array
    V_ref: Array
    terminal: float = 1.0
    soft: tuple[SoftBound, ...] = ()
    growth: float = 1.0
    previews: tuple[tuple[float, Array], ...] = ()
    steps: tuple[tuple[float, Array], ...] = ()
    known: tuple[Change, ...] = ()
    delayed: bool = False
    late: int = 0
    fixed: Mapping[str, float] = field(default_factory=dict)

    @property
    def N_c(self) -> int:
        """Number of moves."""
        return len(self.blocks)

    def moves_per_sample(self) -> NDArray[np.int32]:
        """Which of the moves is in force in each of the ``N_p`` samples, shape ``(N_p,)``."""
        listed = np.repeat(np.arange(self.N_c), self.blocks)[: self.N_p]
        return np.concatenate((listed, np.full(self.N_p - listed.size, self.N_c - 1))).astype(np.int32)

    def intervals(self) -> Array:
        """Length of each prediction interval, s, shape ``(N_p,)``."""
        return self.dt * np.power(self.growth, np.arange(self.N_p, dtype=np.float64))

    def shifted(self, plan: Array) -> Array:
        """A plan one sample later: each move is what was in force one sample after its own beginning, shape ``(N_c, n_u)``."""
        return plan[self._following]

    @cached_property
    def _following(self) -> NDArray[np.int32]:
        """The move in force one sample after the beginning of each, shape ``(N_c,)``."""
        starts = np.concatenate(([0], np.cumsum(self.blocks)[:-1]))
        return self.moves_per_sample()[np.minimum(starts + 1, self.N_p - 1)]

    def references(self, t: float) -> Array:
        """``V_ref`` at the end of each interval of a horizon that begins at ``t``, shape ``(N_p, len(voltages))``."""
        if not (self.previews or self.steps):
            return self._constant_references
        now = t - self.dt if self.delayed else t
        ends = t + np.cumsum(self.intervals())
        return np.array([self._reference(end, now) for end in ends]).reshape(self.N_p, -1)

    @cached_property
    def _constant_references(self) -> Array:
        constant = np.tile(self.V_ref, (self.N_p, 1))
        constant.setflags(write=False)
        return constant

    def reference_at(self, t: float) -> Array:
        """``V_ref`` in force at ``t``."""
        return self._reference(t, t)

    def _reference(self, t: float, now: float) -> Array:
        """``V_ref`` at ``t`` as far as it is known ``now``: the latest change of either kind holds."""
        value, since = self.V_ref, -np.inf
        for changes, until in ((self.previews, t), (self.steps, now)):
            for instant, following in changes:
                if since <= instant <= until + 1e-9:
                    value, since = following, instant
        return value

    def stage_cost(self, t: float, voltages: Array, speeds: Array, move: Array) -> float:
        """Cost of the sample that ends at ``t``: ``voltages`` and ``speeds`` at its end, ``move`` at its beginning."""
        error = self.reference_at(t) - voltages
        return float(np.sum(self.Q * error**2) + np.sum(self.P * (1.0 - speeds) ** 2) + np.sum(self.R * move**2))


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
        diagnostics: further numbers worth recording (an estimator's states and covariances), by name.
        message: what else there is to say of a plan that failed.
    """

    status: Status
    u: Array
    cost: float
    iterations: int
    step: float
    times_ms: Mapping[str, float] = field(default_factory=dict)
    diagnostics: Mapping[str, float] = field(default_factory=dict)
    message: str = ""


class Solver(Protocol):
    """A backend at work on one problem in one run."""

    def solve(self, sample: Sample, u_last: Array) -> Solution:
        """The plan from this sample on (from the next one, where the problem is ``delayed``).

        Args:
            sample: what is known at this instant.
            u_last: the commands in force until the plan begins, shape ``(n_u,)``.
        """
        ...

    def prepare(self, u: Array) -> None:
        """Work that can be done before the next sample is known; ``u`` is what was sent."""
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

    def start(self, problem: ControlProblem, surroundings: Surroundings, plant: Plant | None) -> Solver:
        """Begin a run."""
        ...
