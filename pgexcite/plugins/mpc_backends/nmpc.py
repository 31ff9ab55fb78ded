"""Nonlinear MPC on the perfect model: Gauss-Newton on the plant's own step, condensed to the moves, one QP each.

Single shooting (the rollout eliminates the states) and the real-time iteration: M. Diehl, H. J. Ferreau, N. Haverbeke, "Efficient
numerical methods for nonlinear MPC and moving horizon estimation" (2009), sections 4 and 5, with the exact sensitivities of the
discrete-time plant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from pgexcite.core.controller import Plant, Sample, Surroundings
from pgexcite.core.declare import par
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.export import Parts, nmpc_parts
from pgexcite.core.iteration import ShootingOptions
from pgexcite.core.model import State
from pgexcite.core.mpc import ControlProblem, Solver
from pgexcite.core.registry import nearest
from pgexcite.core.shooting import Shooting
from pgexcite.core.step import Kernel


class NMPC(BaseModel):
    """Perfect-model NMPC: the prediction is the plant's own step, from the plant's own state.

    With ``mode = "rti"`` a sample solves one quadratic program, prepared before the sample around the plan it expects; where the
    state or the network is not what was expected (a fault), ``jump_iterations`` are made instead, with a line search but for the
    last, whose step is taken on trust as that of a prepared program is. ``"converged"`` iterates every plan to ``tolerance``. Taps
    and limiters inside the horizon make minima that no descent leaves: ``candidates`` constant plans are tried first, and the best
    is where the iteration starts.

    ``mismatch`` makes the model wrong where that is wanted: it predicts with other values of the parameters named, by the same
    equations. The state it starts from remains the plant's own.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    information: ClassVar[Literal["perfect"]] = "perfect"

    mode: Literal["rti", "converged"] = par("rti", "-", "real-time iteration, or every plan converged")
    max_iterations: int = par(20, "-", "QPs solved for one plan at the most, when converging", ge=1)
    jump_iterations: int = par(2, "-", "QPs solved for one plan where the state is not what was expected", ge=1)
    jump: float = par(1e-3, "pu", "difference of a state from what was expected that counts as a jump", gt=0)
    jump_tolerance: float = par(
        1e-3, "pu", "change of a command at which a plan made after a jump is near enough", gt=0
    )
    tolerance: float = par(1e-6, "pu", "largest change of a command at which a plan has converged", gt=0)
    candidates: int = par(0, "-", "constant plans between the bounds tried before iterating; 0 tries none", ge=0)
    mismatch: Mapping[str, float] = Field(
        default_factory=dict, description="parameters the model is wrong about: path -> value it predicts with"
    )
    step: float = par(0.0, "s", "prediction step in the first interval; 0 takes the simulation's", ge=0)

    def start(self, problem: ControlProblem, surroundings: Surroundings, plant: Plant | None) -> Solver:
        """Begin a run.

        Raises:
            ConfigError: the prediction step does not divide the sample time, or grows past what timers of the model stand; or a
                parameter of ``mismatch`` does not exist.
        """
        assert plant is not None, "a perfect-information backend is always handed the plant"
        h = self.step or surroundings.h
        count = round(problem.dt / h)
        if count < 1 or abs(count * h - problem.dt) > 1e-9:
            raise ConfigError([Problem("options.step", f"must divide the sample time {problem.dt:g} s", self.step)])
        _check_growth(problem, plant, count)
        options = ShootingOptions(
            mode=self.mode,
            max_iterations=self.max_iterations,
            jump_iterations=self.jump_iterations,
            jump=self.jump,
            jump_tolerance=self.jump_tolerance,
            tolerance=self.tolerance,
            exact=True,
            candidates=self.candidates,
        )
        return _Perfect(plant.kernel, problem, options, surroundings, h, self._wrong(plant))

    def _wrong(self, plant: Plant) -> dict[int, float]:
        """Positions of the parameters the model is wrong about, and its values of them."""
        known = plant.model.index["p"]
        unknown = [path for path in self.mismatch if path not in known]
        if unknown:
            raise ConfigError(
                [
                    Problem(f"options.mismatch.{path}", "there is no such parameter", hint=nearest(path, list(known)))
                    for path in unknown
                ]
            )
        return {known[path]: value for path, value in self.mismatch.items()}


def _check_growth(problem: ControlProblem, plant: Plant, count: int) -> None:
    """Refuse intervals whose steps are longer than a timer of the model stands."""
    longest = float(problem.intervals().max()) / count
    slow = {
        device.component_path(slot): component.longest_step
        for device in plant.model.system.devices
        for slot, component in device.components.items()
        if component.longest_step < longest
    }
    if slow:
        path, limit = min(slow.items(), key=lambda item: item[1])
        found = f"in the last interval steps are {longest:.3g} s long, and timers of {path} stand {limit:g} s"
        raise ConfigError([Problem("growth", found, problem.growth, hint="a smaller growth, N_p or options.step")])


class _Perfect(Shooting):
    """Shooting from the plant's own state."""

    def __init__(
        self,
        kernel: Kernel,
        problem: ControlProblem,
        options: ShootingOptions,
        surroundings: Surroundings,
        h: float,
        wrong: Mapping[int, float],
    ) -> None:
        self._wrong = wrong
        super().__init__(kernel, problem, options, rule=surroundings.rule, h=h, grid=surroundings.h)

    def locate(self, sample: Sample) -> State | None:
        assert sample.state is not None
        assert sample.p is not None
        self.p = sample.p
        if self._wrong:
            self.p = sample.p.copy()
            self.p[list(self._wrong)] = list(self._wrong.values())
        return sample.state

    def parts(self, where: str, measured: Sequence[str]) -> Parts:
        """Its C; see ``pgexcite.core.export``."""
        if self._wrong:
            raise ConfigError(
                [Problem(f"{where}.options.mismatch", "a model that is wrong on purpose is not exported")]
            )
        return nmpc_parts(self, where)
