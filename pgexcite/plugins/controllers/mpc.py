"""Model predictive excitation control: primary (u = E_fd) or secondary (u = V_ref), over a backend of choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from pgexcite.core.controller import Action, Plant, Sample, Session, Surroundings, as_arrays
from pgexcite.core.declare import par
from pgexcite.core.errors import ConfigError, Problem, RegistryError
from pgexcite.core.mpc import Backend, Solver, Status
from pgexcite.core.mpc import Problem as ControlProblem
from pgexcite.core.registry import find

Array = NDArray[np.float64]

_SETPOINT = {"e_fd": "e_fd_ref", "v_ref": "v_ref"}


class MPC(BaseModel):
    """Receding-horizon control of one unit's excitation with the cost of equation (2) (see ``pgexcite.core.mpc``).

    Each sample a plan of ``N_c`` moves is found and its first move is sent. A plan that fails or is not finite never reaches the
    plant: the last plan's next move is used instead, for ``max_reuse`` samples at the most, then the last command is held; the log
    and the summary say so.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    source: ClassVar[str] = '"Model Predictive Control for Field Excitation of Synchronous Generators", section 3'

    unit: str = Field(description="unit whose excitation is controlled")
    command: Literal["e_fd", "v_ref"] = Field(
        "e_fd", description="what it commands: the field voltage or the regulator's set-point"
    )
    backend: str = Field("nmpc", description="registered name of the MPC backend")
    options: Mapping[str, Any] = Field(default_factory=dict, description="parameters of the backend")
    dt: float = par(0.05, "s", "sample time", gt=0)
    N_p: int = par(5, "-", "prediction horizon, samples", ge=1)
    N_c: int = par(1, "-", "control horizon, moves; the command is held after the last", ge=1)
    Q: float = par(300.0, "-", "weight on the voltage error", ge=0)
    P: float = par(5.0, "-", "weight on the speed error", ge=0)
    R: float = par(0.01, "-", "weight on the move", ge=0)
    u_min: float = par(-3.2, "pu", "lower bound of the command")
    u_max: float = par(3.2, "pu", "upper bound of the command")
    du_max: float = par(1e6, "pu", "largest move in one sample", gt=0)
    V_ref: float = par(0.0, "pu", "voltage reference; 0 takes the initial terminal voltage", ge=0)
    max_reuse: int = par(3, "-", "samples an old plan is followed when no new one is found", ge=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.u_min >= self.u_max:
            raise ValueError(f"u_min = {self.u_min} must be below u_max = {self.u_max}")
        if self.N_c > self.N_p:
            raise ValueError(f"N_c = {self.N_c} must not exceed N_p = {self.N_p}")
        try:
            self._backend()
        except RegistryError as cause:
            raise ValueError(str(cause)) from cause
        return self

    def _backend(self) -> Backend:
        backend: Backend = find("mpc_backend", self.backend).model_validate(dict(self.options))
        return backend

    @property
    def information(self) -> Literal["perfect", "measured"]:
        """That of the backend."""
        return self._backend().information

    @property
    def setpoint(self) -> str:
        """Path of the set-point it commands."""
        return f"unit.{self.unit}.exciter.{_SETPOINT[self.command]}"

    def measures(self) -> Sequence[str]:
        """Terminal voltage and speed of its unit."""
        return (f"unit.{self.unit}.v_t", f"unit.{self.unit}.omega")

    def start(self, surroundings: Surroundings, plant: Plant | None) -> Session:
        """Begin a run.

        Raises:
            ConfigError: the unit has no such set-point, or its initial value is outside the bounds.
        """
        voltage, speed = self.measures()
        u_0 = surroundings.u_0.get(self.setpoint)
        if u_0 is None:
            text = f"commands {self.setpoint}, which does not exist"
            hint = 'command = "e_fd" goes with the exciter "constant_field", command = "v_ref" with a regulator'
            raise ConfigError([Problem("controller.command", text, self.command, hint)])
        if not self.u_min <= u_0 <= self.u_max:
            text = f"the initial value of {self.setpoint} is outside u_min = {self.u_min:g} .. u_max = {self.u_max:g}"
            raise ConfigError(
                [Problem("controller", text, round(u_0, 5), "widen the bounds or move the operating point")]
            )
        problem = ControlProblem(
            dt=self.dt,
            N_p=self.N_p,
            N_c=self.N_c,
            commands=(self.setpoint,),
            voltages=(voltage,),
            speeds=(speed,),
            Q=self.Q,
            P=self.P,
            R=self.R,
            u_min=np.array([self.u_min]),
            u_max=np.array([self.u_max]),
            du_max=np.array([self.du_max]),
            V_ref=np.array([self.V_ref or surroundings.y_0[voltage]]),
        )
        return _Session(self, problem, self._backend().start(problem, surroundings, plant), np.array([u_0]))


class _Session:
    """The controller at work: the plan in force and the command last sent."""

    def __init__(self, config: MPC, problem: ControlProblem, solver: Solver, u_0: Array) -> None:
        self._config, self._problem, self._solver = config, problem, solver
        self._u, self._move = u_0, np.zeros_like(u_0)
        self._plan = np.tile(u_0, (problem.N_c, 1))
        self._age = 0

    def act(self, sample: Sample) -> Action:
        problem = self._problem
        voltages = np.array([sample.measured[path] for path in problem.voltages])
        speeds = np.array([sample.measured[path] for path in problem.speeds])
        passed = problem.stage_cost(voltages, speeds, self._move) if sample.t > 0 else 0.0
        solution = self._solver.solve(sample, self._u)
        notes: list[str] = []
        usable = solution.status.usable and self._admissible(solution.u)
        if usable:
            self._plan, self._age = solution.u, 0
        else:
            self._age += 1
            reused = self._age <= self._config.max_reuse
            why = solution.status.value if not solution.status.usable else "the plan leaves its bounds or is not finite"
            notes.append(f"{'the last plan is followed' if reused else 'the last command is held'}: {why}")
            if not reused:
                self._plan = np.tile(self._u, (problem.N_c, 1))
        u = self._plan[min(self._age, problem.N_c - 1)]
        self._move, self._u = u - self._u, u
        diagnostics = {
            "predicted_cost": solution.cost,
            "iterations": float(solution.iterations),
            "converged": float(solution.status is Status.CONVERGED),
            "solve_ms": solution.times_ms.get("total", np.nan),
        }
        commands = dict(zip(problem.commands, (float(value) for value in u), strict=True))
        return Action(commands, diagnostics, passed, not usable, notes)

    def _admissible(self, u: Array) -> bool:
        slack = 1e-9
        inside = (u >= self._problem.u_min - slack) & (u <= self._problem.u_max + slack)
        return bool(np.isfinite(u).all() and inside.all())

    def memory(self) -> Mapping[str, Array]:
        own = as_arrays({"u": self._u, "move": self._move, "plan": self._plan, "age": self._age})
        return own | {f"solver:{key}": value for key, value in self._solver.memory().items()}

    def recall(self, memory: Mapping[str, Array]) -> None:
        self._u, self._move, self._plan = memory["u"], memory["move"], memory["plan"]
        self._age = int(memory["age"])
        start = "solver:"
        self._solver.recall({key.removeprefix(start): value for key, value in memory.items() if key.startswith(start)})
