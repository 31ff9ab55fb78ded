"""Plans by shooting in Python: real-time iterations or converged plans, on predictions in C or in the virtual machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.condensed import Condensed, Curvature, Direction, Linearised
from pgexcite.core.horizons import Horizons
from pgexcite.core.iteration import DECREASE, SAME_STATE, SHORTEST, ShootingOptions
from pgexcite.core.memory import those_under, under
from pgexcite.core.model import State
from pgexcite.core.mpc import Solution, Status
from pgexcite.core.prediction import Predictor
from pgexcite.core.qp import WarmSolver
from pgexcite.core.rollout import Horizon, Rollout

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Prepared:
    """A linearisation made before its sample: around ``plan``, from the state expected then."""

    plan: Array
    x: Array
    d: Array
    u: Array
    p: Array
    y: Array
    G: Array
    G_x: Array

    def arrays(self) -> dict[str, Array]:
        """All of it, by name."""
        return {item.name: getattr(self, item.name) for item in fields(self)}


class PlansInPython:
    """Makes plans of one problem; see ``pgexcite.core.shooting.Plans``.

    Args:
        predictor, condensed, horizons, options: of the plans.
    """

    def __init__(
        self, predictor: Predictor, condensed: Condensed, horizons: Horizons, options: ShootingOptions
    ) -> None:
        self.predictor, self.condensed, self.horizons, self.options = predictor, condensed, horizons, options
        self.kernel, self.problem = predictor.kernel, condensed.problem
        self._plan: Array | None = None
        self._prepared: _Prepared | None = None
        self._curvature: Curvature | None = None
        self._from: tuple[State, float, Array] | None = None
        predictor.make_ready()
        owned = {*self.problem.commands, *self.problem.fixed}
        self._others = np.array([path not in owned for path in self.kernel.model.u_names], dtype=bool)

    def plan(self, state: State, t: float, p: Array, u_last: Array) -> Solution:
        """The plan from this state on."""
        self._from = None
        if self.problem.delayed:
            later = a_sample_later(self.predictor, self.horizons, state, t, u_last, p)
            if later is None:
                return failed(self.condensed, Status.PREDICTION_FAILED, u_last)
            state, p = later
            t += self.problem.dt
        self._from = (state, t, p)
        ready = self._expected(state, p)
        solution = self._feedback(ready, state, t, u_last) if ready else self._iterate(state, t, p, u_last)
        if solution.status.usable:
            self._plan = solution.u
        return solution

    def lost(self) -> None:
        """There is no state at this sample."""
        self._from = None

    def prepare(self, u: Array) -> None:
        """Linearise around the plan the next sample will start from, at the state expected then."""
        self._ready(None)
        if self.options.mode != "rti" or self._from is None or self._plan is None or not np.isfinite(u).all():
            return
        state, t, p = self._from
        later = a_sample_later(self.predictor, self.horizons, state, t, u, p)
        if later is None:
            return
        expected, p = later
        plan = self.condensed.reachable(self.problem.shifted(self._plan), u)
        horizon = self.horizons.at(t + self.problem.dt, expected.u, p)
        rollout = self.predictor.roll(expected, plan, horizon, derivatives=True)
        if rollout is not None and rollout.dy is not None:
            G_x = np.zeros((*rollout.y.shape, 0)) if rollout.dx is None else rollout.dx
            self._ready(_Prepared(plan, expected.x, expected.d, expected.u, p, rollout.y, rollout.dy, G_x))

    def _ready(self, prepared: _Prepared | None) -> None:
        self._prepared = prepared
        self._curvature = self.condensed.curvature(prepared.G) if prepared else None

    def memory(self) -> Mapping[str, Array]:
        """Plan, linearisation and the QP's warm start."""
        kept: dict[str, Array] = {}
        if self._plan is not None:
            kept["plan"] = self._plan
        if self._prepared is not None:
            kept |= under("prepared", self._prepared.arrays())
        if isinstance(solver := self.condensed.solver, WarmSolver):
            kept["multipliers"] = solver.memory()
        return kept

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        self._from = None
        self._plan = memory.get("plan")
        prepared = those_under("prepared", memory)
        self._ready(_Prepared(**prepared) if prepared else None)
        if isinstance(solver := self.condensed.solver, WarmSolver):
            multipliers = memory.get("multipliers")
            solver.recall(np.zeros_like(solver.memory()) if multipliers is None else multipliers)

    # Planning.

    def _expected(self, state: State, p: Array) -> _Prepared | None:
        """The linearisation prepared for this sample, unless state, network or the commands of others are not as expected."""
        ready = self._prepared
        if ready is None or not _same(ready.p, p) or not _same(state.d, ready.d):
            return None
        if not _same(state.u[self._others], ready.u[self._others]):
            return None
        reach = self.options.jump if ready.G_x.shape[2] else SAME_STATE
        return ready if np.abs(state.x - ready.x).max(initial=0.0) <= reach else None

    def _feedback(self, ready: _Prepared, state: State, t: float, u_last: Array) -> Solution:
        """One QP around what was prepared, corrected for the state."""
        y = ready.y + ready.G_x @ (state.x - ready.x) if ready.G_x.shape[2] else ready.y
        at = Linearised(y, ready.G, self.problem.references(t), self._curvature)
        found = self.condensed.direction(at, ready.plan, u_last)
        if found is None:
            return Solution(Status.QP_FAILED, ready.plan, np.inf, 1, np.inf)
        return self._taken(ready.plan, found, 1)

    def _taken(self, plan: Array, found: Direction, iterations: int) -> Solution:
        """The plan after a step that is taken on trust; its cost is to first order."""
        largest = float(np.abs(found.step).max())
        return Solution(Status.ITERATED, self.condensed.clipped(plan + found.step), found.cost, iterations, largest)

    def _first(self, plans: list[Array], state: State, horizon: Horizon) -> tuple[Array, Rollout | None]:
        """The first of these plans that the model can be stepped through."""
        for plan in plans:
            rollout = self.predictor.roll(state, plan, horizon, derivatives=True)
            if rollout is not None:
                return plan, rollout
        return (plans[0] if plans else np.empty(0)), None

    def _levels(self, count: int, u_last: Array) -> list[Array]:
        """All commands at one of ``count`` levels from their upper bounds to their lower ones, as fast as they may move."""
        problem = self.problem
        if not np.isfinite([problem.u_min, problem.u_max]).all():
            return []
        levels = np.linspace(problem.u_max, problem.u_min, count)
        return [self.condensed.reachable(np.tile(level, (problem.N_c, 1)), u_last) for level in levels]

    def _cheapest_first(
        self, plans: list[Array], state: State, horizon: Horizon, u_last: Array, t: float
    ) -> list[Array]:
        """Plans in order of their true costs; those the model cannot be stepped through come last."""
        references = self.problem.references(t)

        def cost(plan: Array) -> float:
            rollout = self.predictor.roll(state, plan, horizon, derivatives=False)
            return np.inf if rollout is None else self.condensed.cost(rollout.y, references, plan, u_last)

        return sorted(plans, key=cost)

    def _iterate(self, state: State, t: float, p: Array, u_last: Array) -> Solution:
        """Gauss-Newton with a line search on the true cost."""
        options, references = self.options, self.problem.references(t)
        converge = options.mode == "converged" or self._plan is None
        count = options.max_iterations if converge else options.jump_iterations
        near = options.tolerance if converge else max(options.jump_tolerance, options.tolerance)
        horizon = self.horizons.at(t, state.u, p)
        plan, rollout = self._start(state, t, horizon, u_last)
        if rollout is None:
            return failed(self.condensed, Status.PREDICTION_FAILED, u_last)
        cost = self.condensed.cost(rollout.y, references, plan, u_last)
        status, step, iteration = Status.ITERATED, np.inf, 0
        while iteration < count:
            iteration += 1
            assert rollout.dy is not None
            at = Linearised(rollout.y, rollout.dy, references)
            found = self.condensed.direction(at, plan, u_last)
            if found is None:
                status = Status.QP_FAILED if iteration == 1 else status
                break
            direction = found.step
            step = float(np.abs(direction).max())
            if step <= options.tolerance:
                status = Status.CONVERGED
                break
            if step <= near or (not converge and iteration == count):
                return self._taken(plan, found, iteration)
            more = iteration < count
            better = self._search(
                state, horizon, plan, direction, u_last, references, (cost, found.slope), derivatives=more
            )
            if better is None:
                # No decrease can be had along a descent direction: converged to the rounding of the cost.
                status = Status.CONVERGED if step <= np.sqrt(options.tolerance) else status
                break
            plan, rollout, cost = better
        return Solution(status, plan, cost, iteration, step)

    def _start(self, state: State, t: float, horizon: Horizon, u_last: Array) -> tuple[Array, Rollout | None]:
        """Where the iteration begins, and the prediction there; ``None`` where nothing can be predicted."""
        # A plan made on standby was never in force: it may begin further from the command in force than a move may go.
        wanted = [np.tile(u_last, (self.problem.N_c, 1))]
        if self._plan is not None:
            wanted.insert(0, self.problem.shifted(self._plan))
        starts = [self.condensed.reachable(plan, u_last) for plan in wanted]
        if self.options.candidates:
            starts += self._levels(self.options.candidates, u_last)
            starts = self._cheapest_first(starts, state, horizon, u_last, t)
        plan, rollout = self._first(starts, state, horizon)
        return (plan, rollout) if rollout is not None else self._first(self._levels(2, u_last), state, horizon)

    def _search(
        self,
        state: State,
        horizon: Horizon,
        plan: Array,
        direction: Array,
        u_last: Array,
        references: Array,
        descent: tuple[float, float],
        *,
        derivatives: bool,
    ) -> tuple[Array, Rollout, float] | None:
        """Backtracking on the true cost; ``descent`` is its value and slope. ``None`` where no decrease is found."""
        cost, slope = descent
        scale = 1.0
        while scale >= SHORTEST:
            trial = self.condensed.clipped(plan + scale * direction)
            rolled = self.predictor.roll(state, trial, horizon, derivatives=derivatives)
            if rolled is not None:
                trial_cost = self.condensed.cost(rolled.y, references, trial, u_last)
                if trial_cost <= cost + DECREASE * scale * min(slope, 0.0):
                    return trial, rolled, trial_cost
            scale /= 2
        return None


def a_sample_later(
    predictor: Predictor, horizons: Horizons, state: State, t: float, u: Array, p: Array
) -> tuple[State, Array] | None:
    """State and parameters one sample later under these commands, with all that is known to happen by then."""
    kernel = predictor.kernel
    horizon = horizons.first(t, state.u, p)
    row = -1
    for count, h, k in zip(horizon.counts, horizon.lengths, horizon.rows, strict=True):
        if k != row:
            wanted = horizon.u[k].copy()
            wanted[predictor.commands] = u
            if row >= 0 or not np.array_equal(wanted, state.u):
                settled = kernel.settle(state.with_(u=wanted), horizon.p[k])
                if settled is None:
                    return None
                state = settled
            row = int(k)
        segment = kernel.advance(state, horizon.p[k], predictor.rule, horizons.on_grid(h), int(count))
        if segment.failed:
            return None
        state = segment.state
    wanted, after = horizons.between(t, t + horizons.problem.dt, horizon.u[0], p)
    wanted[predictor.commands] = u
    if np.array_equal(after, horizon.p[row]) and np.array_equal(wanted, state.u):
        return state, after
    settled = kernel.settle(state.with_(u=wanted), after)
    return None if settled is None else (settled, after)


def failed(condensed: Condensed, status: Status, u_last: Array) -> Solution:
    """No plan; its moves hold what is in force."""
    hold = condensed.clipped(np.tile(u_last, (condensed.problem.N_c, 1)))
    return Solution(status, hold, np.inf, 0, np.inf)


def _same(a: Array, b: Array) -> bool:
    """Whether two arrays are the same to the bit."""
    return a.tobytes() == b.tobytes()
