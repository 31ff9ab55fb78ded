"""Nonlinear MPC on what can be known at the unit: an estimated machine on an estimated equivalent infinite bus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pgexcite.core.codegen import loop
from pgexcite.core.controller import Plant, Sample, Surroundings
from pgexcite.core.declare import par
from pgexcite.core.equivalent import TERMINALS, Equivalent
from pgexcite.core.errors import ConfigError, Problem, RegistryError
from pgexcite.core.estimation import Estimate, Estimator, Observer, Writable
from pgexcite.core.export import Input, Parts
from pgexcite.core.export.shooting import DELAYED, exported_planning, refuse, tolerance
from pgexcite.core.iteration import ShootingOptions
from pgexcite.core.memory import as_arrays, those_under, under
from pgexcite.core.model import State
from pgexcite.core.mpc import ControlProblem, Solution, Solver
from pgexcite.core.plans_in_c import LOOPS
from pgexcite.core.registry import find
from pgexcite.core.shooting import Shooting

Array = NDArray[np.float64]

_TEXT = Path(__file__).with_suffix(".c").read_text(encoding="utf-8")
_ABOUT = """One predictive controller for one unit, from the unit's own terminals: plans as pgexcite.core.shooting makes them, on an
   equivalent that an estimator keeps track of, and the checks of pgexcite.core.ladder. On standby it goes on estimating."""


class EquivalentMPC(BaseModel):
    """NMPC that sees the unit's terminals only.

        v_t, P, Q, omega, E_fd --> [ estimator ] --> rotor states, P_m, x_s, v_bus --> [ NMPC on this equivalent ] --> E_fd

    The prediction is that of ``nmpc``, of another network: the rest of the grid is an infinite bus behind ``x_s``. Nothing to come
    is known but changes of ``V_ref``. Angles are against the equivalent bus, and so is the speed in the cost.

    The estimate is of the instant the measurements were taken at. Over the ``known_delay`` of the controller it is carried on to
    the present, under the commands sent since.

    Not modelled: other units, loads, the reaction of the turbine, the exciter's ceiling (bound the command instead).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    information: ClassVar[Literal["measured"]] = "measured"

    estimator: str = Field("ukf", description="registered name of the estimator")
    estimation: Mapping[str, Any] = Field(default_factory=dict, description="parameters of the estimator")
    model: Mapping[str, float] = Field(
        default_factory=dict, description="parameters of its own machine that are not the nameplate's, by path"
    )
    iterations: int = par(3, "-", "QPs solved for one plan at the most", ge=1)
    tolerance: float = par(1e-3, "pu", "largest change of a command at which a plan has converged", gt=0)
    step: float = par(0.0125, "s", "longest prediction step in the first interval", gt=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._estimator()
        return self

    def _estimator(self) -> Estimator:
        try:
            estimator: Estimator = find("estimator", self.estimator).model_validate(dict(self.estimation))
        except RegistryError as cause:
            raise ValueError(str(cause)) from cause
        return estimator

    def start(self, problem: ControlProblem, surroundings: Surroundings, plant: Plant | None) -> Solver:
        """Begin a run; a plant is not looked at.

        Raises:
            ConfigError: the problem is not one of a single unit's field voltage and its own terminals.
            InitialisationError: the equivalent has no steady state at the initial point.
        """
        return _Equivalent(self, self._estimator(), problem, surroundings)


class _Equivalent(Shooting):
    """Shooting from the estimate, on the estimate."""

    def __init__(
        self, options: EquivalentMPC, estimator: Estimator, problem: ControlProblem, surroundings: Surroundings
    ) -> None:
        unit = problem.commands[0].rpartition(".")[0].rpartition(".")[0]
        self._equivalent = Equivalent(surroundings, unit, estimator.x_s, options.model, "options.model")
        self._observer: Observer = estimator.start(self._equivalent, problem.dt, surroundings.compile)
        self._paths = [f"{unit}.{name}" for name in TERMINALS]
        self._field = f"{unit}.e_fd"
        shooting = ShootingOptions(mode="converged", max_iterations=options.iterations, tolerance=options.tolerance)
        h = problem.dt / np.ceil(problem.dt / options.step - 1e-9)
        own = _translated(problem, self._equivalent)
        super().__init__(self._equivalent.kernel, own, shooting, rule="tr_bdf2", h=h, grid=surroundings.h)
        self._offset = self._equivalent.offset
        self._bounds = float(problem.u_min[0]), float(problem.u_max[0])
        self._before = self._seen = np.array([surroundings.y_0[self._field]])
        # Commands, and whether in charge, in each sample since the last measurements.
        self._sent, self._in_charge = np.tile(self._seen, (problem.late + 1, 1)), np.zeros(problem.late + 1)
        self._told: Mapping[str, float] = {}

    # The protocol of a solver: commands of the plant outside, of the equivalent inside.

    def solve(self, sample: Sample, u_last: Array) -> Solution:
        """The plan from this sample on; see ``pgexcite.core.mpc.Solver``."""
        solution = super().solve(sample, u_last + self._offset)
        if self.problem.delayed:
            self._sent[-1] = u_last
        return replace(solution, u=solution.u - self._offset, diagnostics=self._told)

    def prepare(self, u: Array) -> None:
        """Keep what was sent: it is in force until the next sample, but where there is computing delay."""
        if not self.problem.delayed:
            self._sent[-1] = u

    def memory(self) -> Mapping[str, Array]:
        """Plan, estimate, and the field voltages seen and sent last."""
        own = as_arrays(
            {"before": self._before, "seen": self._seen, "sent": self._sent.copy(), "in_charge": self._in_charge}
        )
        return {**super().memory(), **own, **under("observer", self._observer.memory())}

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        super().recall(memory)
        self._before, self._seen = memory["before"], memory["seen"]
        self._sent, self._in_charge = memory["sent"].copy(), memory["in_charge"]
        self._observer.recall(those_under("observer", memory))

    # Where the equivalent is.

    def locate(self, sample: Sample) -> State | None:
        """The equivalent's state now, by the estimator; ``None`` where that has diverged."""
        terminals = np.array([sample.measured[path] for path in self._paths])
        field = np.array([sample.measured[self._field]])
        whole = bool(np.isfinite(terminals).all() and np.isfinite(field).all())
        estimate = self._observer.observe(terminals if whole else None, self._since_last(field if whole else None))
        since = self._sent[1:]
        self._sent = np.vstack((since, self._sent[-1]))
        self._in_charge = np.append(self._in_charge[1:], float(sample.active))
        self._told = estimate.diagnostics
        return self._carried(self._settled(sample.t, estimate), since) if estimate.sound else None

    def _since_last(self, field: Array | None) -> float:
        """The equivalent's field voltage since the last sample, of which ``field`` was measured at the end."""
        first, before, self._before = self._before, self._seen, self._seen
        self._seen = self._sent[0] if field is None else field
        # In charge it was constant. A regulator moved it: the mean of the parabola through the last three.
        mean = self._seen if self._in_charge[0] > 0 else (5 * self._seen + 8 * before - first) / 12
        return float(mean[0]) + self._offset

    def _settled(self, t: float, estimate: Estimate) -> State | None:
        start = self._equivalent.initial.state
        x, u, self.p = self._equivalent.point(estimate.value, float(self._seen[0]) + self._offset)
        return self.kernel.settle(State(0, t, x, start.z, start.d, u), self.p)

    def _carried(self, state: State | None, commands: Array) -> State | None:
        """A state carried on under these commands of the plant, a sample each."""
        for command in commands:
            # Nothing in an equivalent is known to change at any time: the clock does not matter.
            later = None if state is None else self.later(state, state.t, command + self._offset, self.p)
            state = later[0] if later else None
        return state

    # As C.

    def parts(self, where: str, measured: Sequence[str]) -> Parts:
        """Its C; see ``pgexcite.core.export``."""
        refuse(where, self)
        if not isinstance(self._observer, Writable):
            raise ConfigError([Problem(f"{where}.options.estimator", "this estimator offers no C")])
        estimator, predictions = self._observer.written(), exported_planning(self)
        seen = [*self._paths, self._field]
        told = "measured at this instant, pu of the unit's base; NaN where lost"
        return Parts(
            about=_ABOUT + DELAYED * self.problem.delayed,
            inputs=(
                Input("t", "s, on the clock of the references"),
                Input("active", "whether the controller is in charge", kind="int"),
                Input.of("measured", told, seen),
                Input("u_last", "command in force until the plan begins; on standby the field voltage", 1),
            ),
            record=lambda sample, u_last: [
                sample.t,
                int(sample.active),
                np.array([sample.measured[path] for path in seen]),
                u_last,
            ],
            condensed=self.condensed,
            functions=(*predictions.functions, *estimator.functions),
            along=predictions.along,
            loops=LOOPS,
            constants={**predictions.constants, **estimator.constants, **self._constants(len(seen))},
            arrays={**predictions.arrays, **estimator.arrays, **self._arrays()},
            templates=(*(loop(file) for file in ("horizon.c", "shooting.c")), estimator.text, _TEXT),
            tolerance=tolerance(self),
            told=estimator.told,
        )

    def _constants(self, n_measured: int) -> dict[str, object]:
        rotor, layout = self._equivalent.rotor, self._equivalent.layout
        lower, upper = self._bounds
        own: dict[str, object] = {"n_measured": n_measured, "n_rotor": len(rotor), "at_omega": rotor[layout.omega]}
        numbers = {"offset": self._offset, "field_0": float(self._seen[0]), "plant_lower": lower, "plant_upper": upper}
        return own | numbers | {f"at_{name}": k for name, k in self._equivalent.positions().items()}

    def _arrays(self) -> dict[str, Any]:
        initial = self._equivalent.initial
        state = initial.state
        start = {"X_0": state.x, "Z_0": state.z, "D_0": state.d, "U_START": state.u, "P_0": initial.p}
        u_0 = state.u[[self._equivalent.positions()["e_fd"]]]
        return start | {"U_0": u_0, "ROTOR": np.array(self._equivalent.rotor, dtype=np.int32)}


def _translated(problem: ControlProblem, equivalent: Equivalent) -> ControlProblem:
    """The problem in the equivalent's paths and commands.

    Raises:
        ConfigError: it commands or tracks what the equivalent does not have.
    """
    unit, outputs = equivalent.unit, equivalent.initial.model.index["y"]
    problems = []
    if len(problem.commands) > 1 or problem.commands[0].rpartition(".")[2] not in ("e_fd_cmd", "e_fd_ref"):
        text = "the equivalent backend commands the field voltage of one unit"
        problems.append(Problem("controller.command", text, ", ".join(problem.commands), 'command = "e_fd"'))
    for path in (*problem.voltages, *(bound.path for bound in problem.soft)):
        if path not in outputs or not path.startswith(f"{unit}."):
            text = f"the equivalent knows the unit's own outputs only ({unit}.v_t, .i_fd, .delta, ...)"
            problems.append(Problem("controller", text, path))
    if problem.known:
        text = "the equivalent is the grid as seen from the terminals: an event in it cannot be known in advance"
        problems.append(Problem("controller.disturbance_known", text, True, "leave it out; V_ref_known can be given"))
    if problems:
        raise ConfigError(problems)
    return replace(
        problem,
        commands=(equivalent.command,),
        u_min=problem.u_min + equivalent.offset,
        u_max=problem.u_max + equivalent.offset,
        known=(),
        fixed={},
    )
