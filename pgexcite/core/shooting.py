"""Single shooting on a model: real-time iterations or converged plans, from wherever the state is taken from."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.condensed import Condensed
from pgexcite.core.controller import Sample
from pgexcite.core.horizons import Horizons
from pgexcite.core.iteration import ShootingOptions
from pgexcite.core.model import State
from pgexcite.core.mpc import ControlProblem, Solution, Status
from pgexcite.core.plans_in_c import plans_in_c
from pgexcite.core.plans_in_python import PlansInPython, a_sample_later, failed
from pgexcite.core.prediction import Predictor
from pgexcite.core.program import QPSolver
from pgexcite.core.settings import Rule
from pgexcite.core.step import Kernel

Array = NDArray[np.float64]


class Plans(Protocol):
    """Makes plans, and remembers the last one and what was prepared."""

    def plan(self, state: State, t: float, p: Array, u_last: Array) -> Solution:
        """The plan from this state on.

        Args:
            state: the model's.
            t: this instant, s.
            p: parameters in force.
            u_last: the commands in force until the plan begins, shape ``(n_u,)``.
        """
        ...

    def lost(self) -> None:
        """There is no state at this sample: nothing can be prepared for the next."""
        ...

    def prepare(self, u: Array) -> None:
        """Linearise around the plan the next sample will start from, at the state expected then under these commands."""
        ...

    def memory(self) -> Mapping[str, Array]:
        """What it remembers; either kind takes up what the other left."""
        ...

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        ...


class Shooting(ABC):
    """Plans by shooting. A backend says where the state comes from (``locate``) and may change the parameters ``p``.

    Args:
        kernel: of the model that predicts; the solver has it for itself.
        problem: the control problem; its paths are those of the model.
        options: how far plans are iterated.
        rule: integration rule of the prediction.
        h: prediction step in the first interval, s.
        grid: the plant's step, s.
        qp: solver of the programs; ``WarmSolver`` where left out.
    """

    def __init__(
        self,
        kernel: Kernel,
        problem: ControlProblem,
        options: ShootingOptions,
        *,
        rule: Rule,
        h: float,
        grid: float,
        qp: QPSolver | None = None,
    ) -> None:
        self.kernel, self.problem, self.options = kernel, problem, options
        self.rule = rule
        self.condensed = Condensed(problem, qp)
        model = kernel.model
        commands = [model.position("u", path) for path in problem.commands]
        outputs = [model.position("y", path) for path in self.condensed.outputs()]
        corrects = options.mode == "rti" and not options.exact
        self.predictor = Predictor(kernel, commands, outputs, problem.N_c, rule, transitions=True if corrects else None)
        self.horizons = Horizons(model, problem, h, grid)
        made_of = (self.predictor, self.condensed, self.horizons, options)
        self.plans: Plans = (plans_in_c(*made_of) if qp is None else None) or PlansInPython(*made_of)
        self.p: Array = np.empty(0)

    @abstractmethod
    def locate(self, sample: Sample) -> State | None:
        """The model's state at this sample; sets ``self.p``. ``None`` where it is not known."""

    # The protocol of a solver.

    def solve(self, sample: Sample, u_last: Array) -> Solution:
        """The plan from this sample on; see ``pgexcite.core.mpc.Solver``."""
        began = time.perf_counter()
        state = self.locate(sample)
        located = time.perf_counter()
        solution = self._from_state(state, sample.t, u_last)
        times = {"locate": 1e3 * (located - began), "feedback": 1e3 * (time.perf_counter() - located)}
        return replace(solution, times_ms=times)

    def prepare(self, u: Array) -> None:
        """Linearise around the plan the next sample will start from, at the state expected then."""
        self.plans.prepare(u)

    def memory(self) -> Mapping[str, Array]:
        """Plan, linearisation and the QP's warm start."""
        return self.plans.memory()

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off.

        Raises:
            ValueError: what was prepared is of another problem.
        """
        G, shape = memory.get("prepared:G"), (self.problem.N_p, len(self.condensed.outputs()), self.condensed.n)
        if G is not None and G.shape != shape:
            raise ValueError(f"what was prepared is of shape {G.shape}, not {shape}")
        self.plans.recall(memory)

    def later(self, state: State, t: float, u: Array, p: Array) -> tuple[State, Array] | None:
        """State and parameters one sample later under these commands; ``None`` where the model cannot be stepped."""
        return a_sample_later(self.predictor, self.horizons, state, t, u, p)

    def plan_in_python(self) -> None:
        """Have plans made in Python, as a reference for those of C."""
        self.plans = PlansInPython(self.predictor, self.condensed, self.horizons, self.options)

    def _from_state(self, state: State | None, t: float, u_last: Array) -> Solution:
        if state is None or not _finite(state, self.p):
            self.plans.lost()
            return failed(self.condensed, Status.STATE_UNKNOWN, u_last)
        solution = self.plans.plan(state, t, self.p, u_last)
        return (
            failed(self.condensed, solution.status, u_last) if solution.status == Status.PREDICTION_FAILED else solution
        )


def _finite(state: State, p: Array) -> bool:
    # A sum of squares is finite only if every term is: cheaper than a look at each.
    return all(math.isfinite(values.dot(values)) for values in (state.x, state.z, state.d, state.u, p))
