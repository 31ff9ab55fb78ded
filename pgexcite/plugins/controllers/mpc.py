"""Model predictive excitation control: primary (u = E_fd) or secondary (u = V_ref), over a backend of choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import itemgetter
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from pgexcite.core.config.validate import Collector
from pgexcite.core.controller import Plant, Session, Surroundings
from pgexcite.core.declare import par
from pgexcite.core.errors import ConfigError, Problem, RegistryError
from pgexcite.core.events import Change
from pgexcite.core.ladder import Actuator, Ladder, LadderOptions
from pgexcite.core.measurement import Measurement
from pgexcite.core.mpc import Backend, ControlProblem, SoftBound
from pgexcite.core.registry import find
from pgexcite.plugins.controllers.per_signal import NotNegative, Number, Positive, each


class Soft(BaseModel):
    """A soft bound on an output: of each unit controlled, or anywhere."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    signal: str = Field(description="output of each unit (v_t, i_fd, delta, ...), or a whole path (bus.HV.v)")
    lower: float = par(-1e6, "pu or rad", "lower bound")
    upper: float = par(1e6, "pu or rad", "upper bound")
    weight: float = par(1e3, "-", "price of a unit of excess, squared, in each sample", gt=0)


class MPC(BaseModel):
    """Receding-horizon control of excitation with the cost of equation (2) (see ``pgexcite.core.mpc``), of one unit or of several.

    Weights and bounds are one number for all signals, or a list with one for each: ``Q`` and ``V_ref`` in the order of
    ``voltages``, ``P``, ``R`` and the bounds in the order of the units.

    Commands go to a unit's field transfer where it has one (``command = "e_fd"``: the exciter stands by, and control passes both
    ways without a bump), else straight to a constant-field exciter, or to a regulator's set-point (``command = "v_ref"``).

    A plan that fails, is late, leaves its bounds or is not finite never reaches the plant: see ``pgexcite.core.ladder``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    source: ClassVar[str] = '"Model Predictive Control for Field Excitation of Synchronous Generators", section 3'

    unit: str | tuple[str, ...] = Field(description="unit whose excitation is controlled, or several")
    voltages: tuple[str, ...] = Field(
        (), description="paths of the voltages held at V_ref; the units' terminals where left out"
    )
    command: Literal["e_fd", "v_ref"] = Field(
        "e_fd", description="what it commands: the field voltage or the regulator's set-point"
    )
    backend: str = Field("nmpc", description="registered name of the MPC backend")
    options: Mapping[str, Any] = Field(default_factory=dict, description="parameters of the backend")
    dt: float = par(0.05, "s", "sample time", gt=0)
    N_p: int = par(5, "-", "prediction horizon, samples", ge=1)
    N_c: int = par(1, "-", "control horizon, moves of one sample; the command is held after the last", ge=1)
    blocks: tuple[int, ...] = Field((), description="lengths of the moves in samples, instead of N_c (move blocking)")
    growth: float = par(1.0, "-", "ratio of consecutive prediction intervals", ge=1)
    Q: NotNegative = par(300.0, "-", "weight on the voltage error")
    P: NotNegative = par(5.0, "-", "weight on the speed error")
    R: NotNegative = par(0.01, "-", "weight on the move")
    terminal: float = par(1.0, "-", "factor on Q and P at the last sample", gt=0)
    u_min: Number = par(-3.2, "pu", "lower bound of the command")
    u_max: Number = par(3.2, "pu", "upper bound of the command")
    du_max: Positive = par(1e6, "pu", "largest move in one sample")
    soft: tuple[Soft, ...] = Field((), description="soft bounds on outputs of the unit")
    V_ref: NotNegative = par(0.0, "pu", "voltage reference; 0 takes each voltage's initial value")
    V_ref_known: tuple[tuple[float, NotNegative], ...] = Field(
        (), description="changes of V_ref known in advance, as [t, V_ref]"
    )
    V_ref_steps: tuple[tuple[float, NotNegative], ...] = Field(
        (), description="changes of V_ref that are not known before they happen, as [t, V_ref]"
    )
    disturbance_known: bool = Field(False, description="whether the events of the run are known in advance")
    delayed: bool = Field(False, description="whether a plan takes one sample to compute, and is made for the next")
    known_delay: int = par(
        0,
        "-",
        "samples by which it takes its measurements to be late; it predicts over them what it has commanded",
        ge=0,
    )
    active: bool = Field(True, description="whether it is in charge from the start, or on standby")
    measurement: Measurement = Field(Measurement(), description="what its instruments do")
    max_reuse: int = par(3, "-", "samples an old plan is followed when no new one is found", ge=0)
    max_age: int = par(3, "-", "samples without a measurement after which it is stale", ge=0)
    recover_after: int = par(
        10, "-", "good plans in a row after which control is taken back from the classical controller", ge=1
    )
    deadline_ms: float = par(0.0, "ms", "time a plan may take; 0 sets no deadline", ge=0)
    v_ref_rate: float = par(0.01, "pu/s", "rate at which a set-point returns after control is handed back", gt=0)

    @field_validator("backend")
    @classmethod
    def _known_backend(cls, name: str) -> str:
        try:
            find("mpc_backend", name)
        except RegistryError as cause:
            raise ValueError(str(cause)) from cause
        return name

    @field_validator("unit")
    @classmethod
    def _any_unit(cls, unit: str | tuple[str, ...]) -> str | tuple[str, ...]:
        if not unit:
            raise ValueError("should name the unit whose excitation is controlled, or several")
        return unit

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name, n in self._lengths().items():
            try:
                each(getattr(self, name), n)
            except ValueError as cause:
                raise ValueError(f"{name} = {cause}") from cause
        low, high = (each(bound, len(self.units)) for bound in (self.u_min, self.u_max))
        if not (low < high).all():
            raise ValueError(f"u_min = {self.u_min} must be below u_max = {self.u_max}")
        for name in ("V_ref_known", "V_ref_steps"):
            for t, value in getattr(self, name):
                try:
                    each(value, len(self.tracked))
                except ValueError as cause:
                    raise ValueError(f"{name} at t = {t:g}: {cause}") from cause
        if self.blocks and (min(self.blocks) < 1 or sum(self.blocks) > self.N_p):
            raise ValueError(
                f"blocks = {list(self.blocks)} must be positive and add up to N_p = {self.N_p} at the most"
            )
        if not self.blocks and self.N_c > self.N_p:
            raise ValueError(f"N_c = {self.N_c} must not exceed N_p = {self.N_p}")
        if self.information == "perfect" and self.known_delay:
            raise ValueError(
                f"known_delay = {self.known_delay}, but the state that backend {self.backend!r} is told is never late"
            )
        return self

    def _lengths(self) -> dict[str, int]:
        """How many numbers a list has, by field: one for each voltage tracked or for each unit."""
        of_units = dict.fromkeys(("P", "R", "u_min", "u_max", "du_max"), len(self.units))
        return dict.fromkeys(("Q", "V_ref"), len(self.tracked)) | of_units

    def _backend(self) -> Backend:
        collect = Collector()
        backend: Backend | None = collect.validate(find("mpc_backend", self.backend), dict(self.options), "options")
        if backend is None:
            raise ValueError("; ".join(map(str, collect.problems)))
        return backend

    @property
    def information(self) -> Literal["perfect", "measured"]:
        """That of the backend."""
        return self._backend().information

    @property
    def units(self) -> tuple[str, ...]:
        """Paths of the units controlled."""
        names = (self.unit,) if isinstance(self.unit, str) else self.unit
        return tuple(f"unit.{name}" for name in names)

    @property
    def tracked(self) -> tuple[str, ...]:
        """Paths of the voltages held at their references."""
        return self.voltages or tuple(f"{unit}.v_t" for unit in self.units)

    def measures(self) -> Sequence[str]:
        """The units' own terminals, what is tracked or bounded, and the set-points it moves."""
        signals = ("v_t", "omega", "p_e", "q_e", "e_fd", "i_fd")
        own = [f"{unit}.{name}" for unit in self.units for name in signals]
        bounded = [path for bound in self.soft for path in self._bounded(bound)]
        moved = [f"{unit}.exciter.v_ref" for unit in self.units] if self.command == "v_ref" else []
        return list(dict.fromkeys([*own, *bounded, *self.tracked, *moved]))

    def _bounded(self, bound: Soft) -> list[str]:
        """Paths of the outputs a soft bound is on."""
        return [bound.signal] if "." in bound.signal else [f"{unit}.{bound.signal}" for unit in self.units]

    def actuator(self, setpoints: Mapping[str, float]) -> Actuator:
        """Where its commands go.

        Raises:
            ConfigError: a unit has no such set-point.
        """
        transferred = [f"{unit}.transfer.e_fd_cmd" in setpoints for unit in self.units]
        if self.command == "e_fd" and all(transferred):
            engaged = {f"{unit}.transfer.manual": 1.0 for unit in self.units}
            commanded = tuple(f"{unit}.transfer.e_fd_cmd" for unit in self.units)
            return Actuator(commanded, tuple(f"{unit}.e_fd" for unit in self.units), engaged)
        name = "e_fd_ref" if self.command == "e_fd" else "v_ref"
        paths = tuple(f"{unit}.exciter.{name}" for unit in self.units)
        hint = (
            'command = "e_fd" goes with the exciter "constant_field" or a transfer, command = "v_ref" with a regulator'
        )
        missing = [path for path in paths if path not in setpoints]
        if missing:
            raise ConfigError(
                [
                    Problem("controller.command", f"commands {path}, which does not exist", self.command, hint)
                    for path in missing
                ]
            )
        return Actuator(paths, paths, returns=True) if self.command == "v_ref" else Actuator(paths)

    def start(self, surroundings: Surroundings, plant: Plant | None) -> Session:
        """Begin a run.

        Raises:
            ConfigError: the unit has no such set-point, its initial value is outside the bounds, or a soft bound is on an output
                that does not exist.
        """
        actuator = self.actuator(surroundings.u_0)
        u_0 = np.array([surroundings.u_0[path] for path in actuator.setpoints])
        problem = self._problem(actuator, surroundings)
        problems = [
            Problem(path, f"its initial value is outside u_min = {low:g} .. u_max = {high:g}", round(float(value), 5))
            for path, value, low, high in zip(actuator.setpoints, u_0, problem.u_min, problem.u_max, strict=True)
            if not low <= value <= high
        ]
        if problems:
            raise ConfigError(problems)
        solver = self._backend().start(problem, surroundings, plant)
        options = LadderOptions(
            max_reuse=self.max_reuse,
            max_age=self.max_age,
            recover_after=self.recover_after,
            deadline_ms=self.deadline_ms,
            return_rate=self.v_ref_rate,
            perfect=self.information == "perfect",
        )
        return Ladder(problem, solver, actuator, options, u_0)

    def _problem(self, actuator: Actuator, surroundings: Surroundings) -> ControlProblem:
        of = {name: each(getattr(self, name), n) for name, n in self._lengths().items()}
        n_v = len(self.tracked)
        at_first = np.array([surroundings.y_0[path] for path in self.tracked])
        known: tuple[Change, ...] = ()
        if self.disturbance_known:
            known = tuple(
                c for c in surroundings.changes if not any(path.startswith("controller.") for path in c.values)
            )
        return ControlProblem(
            dt=self.dt,
            N_p=self.N_p,
            blocks=self.blocks or (1,) * self.N_c,
            commands=actuator.setpoints,
            voltages=self.tracked,
            speeds=tuple(f"{unit}.omega" for unit in self.units),
            Q=of["Q"],
            P=of["P"],
            R=of["R"],
            u_min=of["u_min"],
            u_max=of["u_max"],
            du_max=np.where(of["du_max"] < 1e6, of["du_max"], np.inf),
            V_ref=np.where(of["V_ref"] > 0, of["V_ref"], at_first),
            terminal=self.terminal,
            soft=tuple(SoftBound(path, s.lower, s.upper, s.weight) for s in self.soft for path in self._bounded(s)),
            growth=self.growth,
            previews=tuple((t, each(value, n_v)) for t, value in sorted(self.V_ref_known, key=itemgetter(0))),
            steps=tuple((t, each(value, n_v)) for t, value in sorted(self.V_ref_steps, key=itemgetter(0))),
            known=known,
            delayed=self.delayed,
            late=self.known_delay,
            fixed=actuator.engaged,
        )
