"""The controller at work: plan, old plan, classical controller - and back. Nothing else ever reaches the plant.

    level 0   the plan of this sample: found, in time, finite, within its bounds
    level 1   the next move of the last good plan, for ``max_reuse`` samples at the most
    level 2   the classical controller, bumplessly; where there is none, the last command is held
    up        after ``recover_after`` good plans in a row control is taken back from level 2

Every step down and up is in the log; the summary counts the samples in which a plan could not be used.

A measurement counts as lost where a value is not finite or beyond anything a machine does, and where all of them stay the same to
the last bit although the command has moved: the transmitter hangs.

What it cannot see: a plan within its bounds, of finite cost, that is nevertheless wrong. Two seconds of random field voltages can
cost a machine its synchronism.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.controller import Action, Sample
from pgexcite.core.memory import as_arrays, those_under, under
from pgexcite.core.mpc import ControlProblem, Solution, Solver, Status
from pgexcite.core.trace import reference_of

Array = NDArray[np.float64]

_MOVE_SLACK = 1e-6
"""By how much a move may exceed its bound: the tolerance of the quadratic program."""

PLAUSIBLE = 1e3
"""Largest measured value that is believed, pu."""
MOVED = 1e-6
"""A command that moved by more than this moves what is measured."""

_KEPT: Mapping[Callable[[Array], Any], tuple[str, ...]] = {
    np.asarray: ("u", "move", "next", "plan", "seen", "home"),
    int: ("reused", "stale", "good"),
    bool: ("in_charge", "stepped_down", "returning"),
}
"""What a ladder remembers, by type."""


@dataclass(frozen=True)
class Actuator:
    """Where commands go.

    Attributes:
        setpoints: paths of the set-points commanded, in the problem's order.
        feedback: paths of the measured signals that say what is really in force; empty where the commands always are.
        engaged: set-points that put the controller in charge; their opposites (0 for 1) hand back. Empty where there is nobody to
            hand back to.
        returns: whether the set-points go back, after control is handed back, to where they were when it was taken.
    """

    setpoints: tuple[str, ...]
    feedback: tuple[str, ...] = ()
    engaged: Mapping[str, float] = field(default_factory=dict)
    returns: bool = False

    @property
    def has_classical(self) -> bool:
        """Whether a classical controller stands behind this one."""
        return bool(self.engaged) or self.returns


@dataclass(frozen=True)
class LadderOptions:
    """When to step down and up; see ``pgexcite.plugins.controllers.mpc.MPC``."""

    max_reuse: int
    max_age: int
    recover_after: int
    deadline_ms: float
    return_rate: float
    perfect: bool


class Ladder:
    """A controller in one run (the ``Session`` of ``pgexcite.core.controller``).

    Attributes:
        level: of the last sample.
    """

    def __init__(
        self, problem: ControlProblem, solver: Solver, actuator: Actuator, options: LadderOptions, u_0: Array
    ) -> None:
        self.problem, self.solver, self.actuator, self.options = problem, solver, actuator, options
        self.u_0 = self._home = u_0
        self._u, self._move = u_0, np.zeros_like(u_0)
        self._next = u_0
        self._plan = np.tile(u_0, (problem.N_c, 1))
        self._reused = 0
        self._stale = 0
        self._seen: Array = np.empty(0)
        self._good = 0
        self._in_charge = False
        self._stepped_down = False
        self._returning = False
        self.level = 2

    # The protocol of a session.

    def act(self, sample: Sample) -> Action:
        """One sample: plan, judge the plan, command."""
        notes: list[str] = []
        sample = _believed(sample)
        passed = self._passed(sample)
        self._take_bearings(sample)
        began = time.perf_counter()
        in_force = self._next if self.problem.delayed else self._u
        solution = self._solve(sample, in_force)
        elapsed = 1e3 * (time.perf_counter() - began)
        why = self._objection(sample, solution, in_force, elapsed)
        self._good = 0 if why else self._good + 1
        if not why:
            self._plan, self._reused = solution.u, 0
        elif not self._in_charge:
            # A plan from standby was never in force: until there is a good one, what is in force is the plan.
            self._plan = np.tile(in_force, (self.problem.N_c, 1))
        if sample.ordered:
            self._stepped_down = False
        self.level = self._level(why, active=sample.active)
        diagnostics = {
            "level": float(self.level),
            "predicted_cost": solution.cost,
            "iterations": float(solution.iterations),
            "converged": float(solution.status is Status.CONVERGED),
            "solve_ms": elapsed,
            **{f"{phase}_ms": value for phase, value in solution.times_ms.items()},
            **solution.diagnostics,
            **self._aims(sample.t),
        }
        action = self._active(why, notes) if sample.active else self._standby(why, notes)
        return Action(action.commands, diagnostics, passed, bool(why) and sample.active, action.release, tuple(notes))

    def _aims(self, t: float) -> dict[str, float]:
        """References in force of the units' terminal voltages, pu: what a run is judged by while this controller is in charge."""
        references = zip(self.problem.voltages, self.problem.reference_at(t), strict=True)
        of_units = ((path.removeprefix("unit.").removesuffix(".v_t"), path, value) for path, value in references)
        return {reference_of(unit): float(value) for unit, path, value in of_units if path == f"unit.{unit}.v_t"}

    def _solve(self, sample: Sample, in_force: Array) -> Solution:
        """A solution, whatever happens: arithmetic that fails inside a solver is a failed plan, not the end of the run."""
        try:
            return self.solver.solve(sample, in_force)
        except (ArithmeticError, np.linalg.LinAlgError, RuntimeError) as error:
            plan = np.tile(in_force, (self.problem.N_c, 1))
            return Solution(Status.SOLVER_FAILED, plan, np.inf, 0, np.inf, message=f"{type(error).__name__}: {error}")

    def prepare(self) -> None:
        """Let the solver prepare the next sample."""
        self.solver.prepare(self._next if self.problem.delayed else self._u)

    def memory(self) -> Mapping[str, Array]:
        """All that is kept between samples."""
        own = as_arrays({name: getattr(self, f"_{name}") for names in _KEPT.values() for name in names})
        return own | under("solver", self.solver.memory())

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        for kind, names in _KEPT.items():
            for name in names:
                setattr(self, f"_{name}", kind(memory[name]))
        self.solver.recall(those_under("solver", memory))

    # Before the plan.

    def _passed(self, sample: Sample) -> float:
        """Cost of the sample that ends now; nothing where its measurement was lost."""
        if sample.t <= 0:
            return 0.0
        voltages = np.array([sample.measured[path] for path in self.problem.voltages])
        speeds = np.array([sample.measured[path] for path in self.problem.speeds])
        cost = self.problem.stage_cost(sample.t, voltages, speeds, self._move)
        return cost if np.isfinite(cost) else 0.0

    def _take_bearings(self, sample: Sample) -> None:
        """How old the measurement is and, until in charge, what is in force."""
        values = np.array(list(sample.measured.values()))
        lost = not np.isfinite(values).all()
        # On standby the command stays where it is: a measurement once found to hang hangs until it moves.
        moved = self._stale > 0 or bool(np.abs(self._move).max() > MOVED)
        hangs = moved and np.array_equal(values, self._seen)
        self._seen = values
        self._stale = self._stale + 1 if lost or hangs else 0
        if not (sample.active and self._in_charge) and self.actuator.feedback and not lost:
            in_force = np.array([sample.measured[path] for path in self.actuator.feedback])
            self._u = self._next = np.clip(in_force, self.problem.u_min, self.problem.u_max)

    # After it.

    def _objection(self, sample: Sample, solution: Solution, in_force: Array, elapsed_ms: float) -> str:
        """Why this plan may not be used; ``""`` where it may."""
        options = self.options
        if not options.perfect and self._stale > options.max_age:
            return f"the measurement is {self._stale} samples old"
        if not solution.status.usable:
            return f"{solution.status.value} {solution.message}".strip()
        if not np.isfinite(solution.u).all():
            return "the plan is not finite"
        if not np.isfinite(solution.cost):
            return "the plan's predicted cost is not finite"
        slack = 1e-9
        if (solution.u < self.problem.u_min - slack).any() or (solution.u > self.problem.u_max + slack).any():
            return "the plan leaves its bounds"
        if (np.abs(solution.u[0] - in_force) > self.problem.du_max + _MOVE_SLACK).any():
            return "the plan's first move is larger than a move may be"
        if options.deadline_ms and elapsed_ms > options.deadline_ms:
            return f"the plan came after {elapsed_ms:.3g} ms, later than its deadline of {options.deadline_ms:g} ms"
        return ""

    def _level(self, why: str, *, active: bool) -> int:
        if not active:
            return 2
        if not why:
            return 0
        return 1 if self._reused < self.options.max_reuse else 2

    def _active(self, why: str, notes: list[str]) -> Action:
        """In charge: this plan, or the old one, or down to the classical controller."""
        if not self._in_charge:
            self._in_charge, self._stepped_down, self._returning = True, False, False
            self._home = self._u
            notes.append("takes charge")
        if why:
            if self._reused == 0:
                notes.append(f"the last plan is followed: {why}")
            self._reused += 1
            if self._reused > self.options.max_reuse:
                return self._step_down(why, notes)
            self._plan = self.problem.shifted(self._plan)
        elif self._reused:
            self._reused = 0
        u = self._command(self._plan[0])
        self._move, self._u = u - self._u, u
        return Action(self._addressed(u) | dict(self.actuator.engaged))

    def _addressed(self, u: Array) -> dict[str, float]:
        return dict(zip(self.actuator.setpoints, (float(value) for value in u), strict=True))

    def _command(self, first: Array) -> Array:
        """What is sent now; with computing delay the plan's first move waits one sample."""
        first = np.clip(first, self.problem.u_min, self.problem.u_max)
        now, self._next = self._next, first
        return now if self.problem.delayed else first

    def _step_down(self, why: str, notes: list[str]) -> Action:
        if not self.actuator.has_classical:
            if self._reused == self.options.max_reuse + 1:
                notes.append(f"the last command is held, for there is no classical controller: {why}")
            self._move = np.zeros_like(self._u)
            return Action(self._addressed(self._u))
        notes.append(f"hands over to the classical controller: {why}")
        self._in_charge, self._stepped_down, self._returning = False, True, self.actuator.returns
        self._move = np.zeros_like(self._u)
        return Action(dict.fromkeys(self.actuator.engaged, 0.0), release=True)

    def _standby(self, why: str, notes: list[str]) -> Action:
        """Not in charge: keep track; come back after a fault of one's own, once plans are good again."""
        commands: dict[str, float] = {}
        self._move = np.zeros_like(self._u)
        if self._in_charge:
            self._in_charge, self._returning = False, self.actuator.returns
            notes.append("hands over to the classical controller, as told")
            commands = dict.fromkeys(self.actuator.engaged, 0.0)
        if self._stepped_down and not why and self._good >= self.options.recover_after:
            notes.append(f"plans have been good for {self._good} samples: control is taken back")
            self._reused = 0
            return Action(commands, release=False)
        if self._returning:
            self._u = self._next = self._returned()
            self._returning = not np.array_equal(self._u, self._home)
            commands |= self._addressed(self._u)
        return Action(commands)

    def _returned(self) -> Array:
        """The set-point on its way back to where it was before this controller moved it."""
        reach = self.options.return_rate * self.problem.dt
        return self._u + np.clip(self._home - self._u, -reach, reach)


def _believed(sample: Sample) -> Sample:
    """A sample with NaN in place of what no instrument of a machine would show."""
    measured = {path: value if abs(value) <= PLAUSIBLE else np.nan for path, value in sample.measured.items()}
    return replace(sample, measured=measured)
