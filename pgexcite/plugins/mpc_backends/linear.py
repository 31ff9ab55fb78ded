"""Linear MPC on a model of the controller's own, with estimated states and disturbances: offset-free without a perfect model.

G. Pannocchia, J. B. Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal 49 (2003) 426-437.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from pgexcite.core import qp_by_name
from pgexcite.core.codegen import loop
from pgexcite.core.condensed import Condensed, Linearised
from pgexcite.core.controller import Plant, Sample, Surroundings
from pgexcite.core.declare import par
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.export import Input, Parts
from pgexcite.core.export.linear import filtering, predictions
from pgexcite.core.export.shared import objections
from pgexcite.core.export.shooting import DELAYED
from pgexcite.core.horizons import Horizons
from pgexcite.core.ladder import PLAUSIBLE
from pgexcite.core.local import LocalModel
from pgexcite.core.memory import as_arrays, those_under, under
from pgexcite.core.mpc import ControlProblem, Solution, Solver, Status
from pgexcite.core.nameplate import own_model
from pgexcite.core.offset_free import Disturbances, Noise, OffsetFreeFilter
from pgexcite.core.prediction import Predictor
from pgexcite.core.rollout import Horizon, Transition

Array = NDArray[np.float64]
Disturbed = Literal["v_t", "p_e", "q_e", "i_fd", "torque"]

_SIGNALS = ("v_t", "omega", "p_e", "q_e", "i_fd")
"""What the filter takes from a unit's terminals; the field voltage is an input of the model."""
_AGREEMENT = 1e-9
"""Difference from Python of a command of its C, pu."""
_ABOUT = """One predictive controller for one plant: a linear model of its own, a Kalman filter on states and disturbances that sees
   the unit's measurements, and one quadratic program a sample, as the backend "linear" of pgexcite has them; and the checks of
   pgexcite.core.ladder."""


class Linear(BaseModel):
    """Linear MPC with a Kalman filter, on the grid's nameplate data and the unit's own measurements.

        measured --> [ Kalman filter: states, disturbances d ] --> y = linear model + d --> [ QP ] --> plan
                               ^ command in force                       ^ linearised at the initial point or at the estimate

    The model is the grid as configured, with ``model`` for what is different in it; it is assembled, initialised and linearised
    like the plant, but never sees it. Commands and measurements count from the initial point, the plant's from the plant's and the
    model's from the model's: a model that needs another field voltage for the same terminals starts without an error.

    Disturbances are constant over the horizon. Those of outputs are added to them, ``"torque"`` is one of the turbine's and moves
    the speed. Left out, they are chosen so that whatever can differ at rest has one: voltages, reactive power, torque, and the
    field current unless the field voltage is what is commanded (at rest the two are equal, whatever the machine). Their drift
    against ``sigma`` says how fast they follow: with the defaults almost at once; with noisy instruments give ``sigma`` and
    ``sigma_omega`` as they are, and a ``drift`` well below ``sigma`` for a quiet field voltage.

    With ``relinearise = "once"`` the model is that of the initial point, with ``"scheduled"`` it is made anew at the estimated
    state every ``every`` samples, with ``"every"`` in each. In the middle of a swing a linear model carries the motion of that
    instant on over the horizon; one that is renewed once a second follows the operating point and not every swing.

    Not modelled: a limit inside the model (a ceiling, a non-windup limit) is as it stands at the point of linearisation; discrete
    states stay as at the initial point.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    information: ClassVar[Literal["measured"]] = "measured"
    source: ClassVar[str] = "G. Pannocchia, J. B. Rawlings, AIChE Journal 49 (2003) 426-437"

    model: Mapping[str, float] = Field(
        default_factory=dict, description="parameters of its own model that are not the nameplate's, by path"
    )
    relinearise: Literal["once", "scheduled", "every"] = par("scheduled", "-", "when the model is linearised")
    every: int = par(20, "-", "samples between two linearisations that are scheduled", ge=1)
    disturbances: tuple[Disturbed, ...] | None = Field(
        None, description="what constant disturbances are estimated for; chosen by the command where left out"
    )
    solver: str = Field("proxqp", description="name of the QP solver, as qpsolvers has it")
    sigma: float = par(1e-3, "pu", "deviation of measured voltages, currents and powers that the filter assumes", gt=0)
    sigma_omega: float = par(1e-5, "pu", "deviation of measured speeds that the filter assumes", gt=0)
    sigma_state: float = par(1e-4, "pu", "noise of each state in a sample", gt=0)
    sigma_field: float = par(1e-2, "pu", "noise of the command in a sample", ge=0)
    sigma_torque: float = par(0.1, "pu", "noise of the torque in a sample: what is not known of the network", ge=0)
    drift: float = par(1e-2, "pu", "change of a disturbance of an output in a sample", gt=0)
    drift_torque: float = par(1e-2, "pu", "change of a disturbance of a torque in a sample", gt=0)

    @field_validator("solver")
    @classmethod
    def _known_solver(cls, name: str) -> str:
        if why := qp_by_name.objection(name):
            raise ValueError(why)
        return name

    def start(self, problem: ControlProblem, surroundings: Surroundings, plant: Plant | None) -> Solver:
        """Begin a run; a plant is not looked at.

        Raises:
            ConfigError: an override of the model is not valid, or the measurements cannot tell the disturbances apart.
            InitialisationError: the model has no steady state at the operating point as configured.
        """
        return _Linear(self, problem, surroundings)


class _Linear:
    """The backend in one run.

    Attributes:
        filter: what it believes.
    """

    _plan: Array | None
    _since: float | None  # when the sample before this one was
    _u: Array  # the plant's commands in each sample since that one's measurements, a row each
    _in_charge: Array  # whether it was in charge in each of them
    _age: int  # samples since the model was linearised

    def __init__(self, options: Linear, problem: ControlProblem, surroundings: Surroundings) -> None:
        self.options, self.problem = options, problem
        initial, kernel = own_model(surroundings, options.model, "options.model")
        self._initial, self._kernel, self._rule = initial, kernel, surroundings.rule
        model = initial.model
        self.condensed = Condensed(problem, qp_by_name.NamedSolver(options.solver))
        units = [path.rpartition(".")[0] for path in problem.speeds]
        at_terminals = [f"{unit}.{signal}" for unit in units for signal in _SIGNALS]
        self._measured = list(dict.fromkeys([*at_terminals, *problem.voltages]))
        self._outputs = outputs = list(dict.fromkeys([*self._measured, *self.condensed.outputs()]))
        self._predicted = [outputs.index(path) for path in self.condensed.outputs()]
        self._commands = [model.position("u", path) for path in problem.commands]
        self._horizons = Horizons(model, problem, surroundings.h, surroundings.h)
        self._u_0, self._p_0 = initial.state.u, initial.p
        u, p = self._horizons.until(0.0, self._u_0, self._p_0)
        self._point_0 = kernel.settle(initial.state.with_(u=u), p) or initial.state
        positions = [model.position("y", path) for path in outputs]
        predictor = Predictor(kernel, self._commands, positions, problem.N_c, surroundings.rule, transitions=True)
        predictor.make_ready()
        self._local = LocalModel(kernel, self._commands, predictor, self._point_0)
        self._y_0, self._C_0, _ = predictor.outputs(self._point_0, p)
        # The plant minus the model at the initial point; nobody tells what is not measured.
        self._u_bias = np.array([surroundings.u_0[path] for path in problem.commands]) - u[self._commands]
        told = [surroundings.y_0[path] if path in self._measured else np.nan for path in outputs]
        self._y_bias = np.where(np.isfinite(told), told - self._y_0, 0.0)
        speeds = [model.position("x", f"{unit}.machine.omega") for unit in units]
        moving = (kernel.mass > 0) & ~model.inert
        self.filter = self._make_filter(outputs, units, speeds, kernel.mass[speeds], moving)
        if confused := self.filter.confused(self._first()):
            text = f"the measurements cannot tell {', '.join(confused)} apart at rest; leave one of them out"
            raise ConfigError([Problem("options.disturbances", text, list(self._disturbances()))])
        self.recall({})

    def _make_filter(
        self,
        outputs: Sequence[str],
        units: Sequence[str],
        speeds: Sequence[int],
        mass: Array,
        moving: NDArray[np.bool_],
    ) -> OffsetFreeFilter:
        """The filter; ``speeds`` are the positions of the units' speeds among the states, ``mass`` their coefficients."""
        options, chosen = self.options, self._disturbances()
        disturbed = [
            path
            for path in self._measured
            if path.rpartition(".")[2] in chosen or (path in self.problem.voltages and "v_t" in chosen)
        ]
        where = np.array([path == name for path in outputs for name in disturbed], dtype=float)
        # Half of the speed gained over a sample is there on the average: (I + A) / 2 gives the angle its share.
        gained = (np.eye(moving.size) + self._first().A)[:, speeds] / 2 * (self.problem.dt / mass)
        disturbances = Disturbances(
            names=(*disturbed, *(f"{unit}.torque" for unit in units if "torque" in chosen)),
            outputs=where.reshape(len(outputs), len(disturbed)),
            torques=gained,
            estimated="torque" in chosen,
        )
        slow = np.array([path.endswith(".omega") for path in self._measured])
        noise = Noise(
            measured=np.where(slow, options.sigma_omega, options.sigma),
            state=np.where(moving, options.sigma_state, 0.0),
            command=options.sigma_field,
            torque=options.sigma_torque,
            drift=options.drift,
            drift_torque=options.drift_torque,
        )
        rows = np.array([outputs.index(path) for path in self._measured])
        return OffsetFreeFilter(disturbances, noise, rows, self._point_0.x)

    def _disturbances(self) -> tuple[Disturbed, ...]:
        if self.options.disturbances is not None:
            return self.options.disturbances
        drives_field = all(path.rpartition(".")[2].startswith("e_fd") for path in self.problem.commands)
        return ("v_t", "q_e", "torque") if drives_field else ("v_t", "q_e", "i_fd", "torque")

    def _first(self) -> Transition:
        """A sample from the initial point."""
        step = self._local.sample(self._horizon(0.0), self._point_0.x, self._point_0.u[self._commands])
        if step is None:
            raise ConfigError([Problem("options.model", "this model cannot be stepped at its own operating point")])
        return step

    def _horizon(self, t: float) -> Horizon:
        return self._horizons.at(t, *self._horizons.until(t, self._u_0, self._p_0))

    # The protocol of a solver.

    def solve(self, sample: Sample, u_last: Array) -> Solution:
        """The plan from this sample on; see ``pgexcite.core.mpc.Solver``."""
        began = time.perf_counter()
        known = self._observe(sample, u_last)
        located = time.perf_counter()
        if known:
            self._linearise(u_last)
            solution = self._planned(sample.t, u_last)
        else:
            solution = self._failed(Status.STATE_UNKNOWN, u_last)
        self._since = sample.t
        self._u = np.vstack((self._u[1:], u_last))
        self._in_charge = np.append(self._in_charge[1:], float(sample.active))
        times = {"locate": 1e3 * (located - began), "feedback": 1e3 * (time.perf_counter() - located)}
        return replace(solution, times_ms=times, diagnostics=self._diagnostics())

    def prepare(self, u: Array) -> None:
        """Keep what was sent: it is in force until the next sample."""
        if not self.problem.delayed:
            self._u[-1] = u

    def memory(self) -> Mapping[str, Array]:
        """Estimate, plan, and the point of linearisation."""
        point = {name: getattr(self._local.point, name) for name in ("x", "z", "u")}
        maybe = {"plan": self._plan, "since": self._since}
        own = {"u": self._u.copy(), "in_charge": self._in_charge, "age": self._age}
        kept = own | {key: value for key, value in maybe.items() if value is not None}
        return as_arrays(kept) | under("filter", self.filter.memory()) | under("point", point)

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off; from the initial point where it is empty."""
        self.filter.recall(those_under("filter", memory))
        self._local.move(self._point_0.with_(**those_under("point", memory)))
        self._plan, self._since = memory.get("plan"), float(memory["since"]) if "since" in memory else None
        rows = self.problem.late + 1
        self._u = memory.get("u", np.tile(self._point_0.u[self._commands] + self._u_bias, (rows, 1))).copy()
        self._in_charge = memory.get("in_charge", np.zeros(rows))
        self._age = int(memory.get("age", 0))

    def parts(self, where: str, measured: Sequence[str]) -> Parts:
        """Its C; see ``pgexcite.core.export``.

        Raises:
            ConfigError: something in the configuration cannot be exported.
        """
        problems = objections(where, self.condensed)
        if self._kernel.functions.newton is None:
            problems.append(Problem(f"{where}.backend", "the model is too large to be written out as C"))
        if problems:
            raise ConfigError(problems)
        local = predictions(self._kernel, self._initial, self._horizons, self._outputs, self._rule)
        of_filter, numbers = filtering(self.filter)
        every = {"once": 0, "scheduled": self.options.every, "every": 1}[self.options.relinearise]
        point = self._point_0
        own: dict[str, NDArray[np.float64] | NDArray[np.int32]] = {
            "SEEN_AT": np.array([list(measured).index(path) for path in self._measured], dtype=np.int32),
            "PREDICTED": np.array(self._predicted, dtype=np.int32),
            **{f"POINT_{name.upper()}": getattr(point, name) for name in ("x", "z", "d")},
            "POINT_U": point.u[self._commands],
            "U_BIAS": self._u_bias,
            "Y_BIAS": self._y_bias,
            "Y_0": self._y_0,
            "TO_Y_0": self._C_0.T,
        }
        core = ("horizon.c", "local.c", "kalman.c", "offset_free.c")
        return Parts(
            about=_ABOUT + DELAYED * self.problem.delayed,
            inputs=(
                Input("t", "s, on the clock of the references"),
                Input("active", "whether the controller is in charge", kind="int"),
                Input.of("measured", "what is measured, NaN where it was lost", measured),
                Input("u_last", "commands in force until the plan begins", len(self._commands)),
            ),
            record=_recorded,
            condensed=self.condensed,
            functions=local.functions,
            along=local.along,
            loops=("step.c", "rollout.c"),
            constants={**local.constants, **of_filter, "relinearise_every": every, "dt": self.problem.dt},
            arrays={**local.arrays, **numbers, **own},
            templates=(*(loop(file) for file in core), (Path(__file__).parent / "linear.c").read_text()),
            tolerance=_AGREEMENT,
            told=[name for name in self._diagnostics() if name != "age"],
        )

    # Where the model is.

    def _observe(self, sample: Sample, u_last: Array) -> bool:
        """Predict to the instant of what was measured and correct by it; whether the state is known there."""
        y, C, t = self._y_0, self._C_0, self._taken_at(sample.t)
        if self._since is not None:
            # On standby the command moves between two samples, and is measured as late as all else: both ends are known.
            u = self._u[0] if self._in_charge[0] > 0 else (self._u[-1] + u_last) / 2
            began = self._taken_at(self._since)
            step = self._local.sample(self._horizon(began), self.filter.x, u - self._u_bias, self.filter.push)
            if step is None:
                return False
            self.filter.predict(step)
            y, C = step.y, step.C
            if self._horizons.changes_at(t):
                # Measured after what is known to have changed at this instant; without it the change would count twice.
                after = self._horizons.until(t, self._u_0, self._p_0)
                y, C = self._local.outputs(step.x, u - self._u_bias, *after) or (y, C)
        measured = np.array([sample.measured[path] for path in self._measured])
        # An instrument is broken: not believed, and not taken for a lost measurement. (From the ladder it comes as one.)
        if np.nanmax(np.abs(measured), initial=0.0) > PLAUSIBLE:
            return False
        self.filter.correct(measured, y + self._y_bias, C)
        if not self.filter.sound:
            self.recall({})
            return False
        return True

    def _taken_at(self, t: float) -> float:
        """When the measurements told at ``t`` were taken, s."""
        return t - self.problem.late * self.problem.dt

    def _linearise(self, u_last: Array) -> None:
        """Move the point of linearisation to the estimate, where it is time."""
        self._age += 1
        mode = self.options.relinearise
        if mode == "every" or (mode == "scheduled" and self._age >= self.options.every):
            self._age = 0
            self._move(u_last - self._u_bias)

    def _move(self, commands: Array) -> None:
        u = self._local.point.u.copy()
        u[self._commands] = commands
        self._local.move(self._local.point.with_(x=self.filter.x, u=u))

    # Planning.

    def _failed(self, status: Status, u_last: Array) -> Solution:
        hold = self.condensed.clipped(np.tile(u_last, (self.problem.N_c, 1)))
        return Solution(status, hold, np.inf, 0, np.inf)

    def _planned(self, t: float, u_last: Array) -> Solution:
        at = self._prediction(t, u_last)
        if at is None:
            # The model cannot be stepped from the estimate: the initial point still serves.
            self._local.move(self._point_0)
            at = self._prediction(t, u_last)
        elif not at.G.any():
            # A limit of the model is met, where commands have no effect: around the initial commands they have.
            self._move(self._point_0.u[self._commands])
            at = self._prediction(t, u_last) or at
        if at is None:
            return self._failed(Status.PREDICTION_FAILED, u_last)
        plan = self._guess(u_last)
        found = self.condensed.direction(at, plan, u_last)
        if found is None:
            return self._failed(Status.QP_FAILED, u_last)
        self._plan = self.condensed.clipped(plan + found.step)
        return Solution(Status.CONVERGED, self._plan, found.cost, 1, float(np.abs(found.step).max()))

    def _guess(self, u_last: Array) -> Array:
        """The plan that predictions are made around: the last one, a sample on."""
        held = np.tile(u_last, (self.problem.N_c, 1))
        return self.condensed.clipped(held if self._plan is None else self.problem.shifted(self._plan))

    def _prediction(self, t: float, u_last: Array) -> Linearised | None:
        x, push = self.filter.x, self.filter.push
        t = self._taken_at(t)
        for u in (*self._u[1:], *([u_last] if self.problem.delayed else ())):
            step = self._local.sample(self._horizon(t), x, u - self._u_bias, push)
            if step is None:
                return None
            x, t = step.x, t + self.problem.dt
        predicted = self._local.predict(self._horizon(t), x, self._guess(u_last) - self._u_bias, push)
        if predicted is None:
            return None
        y, G = self.filter.disturbed(predicted[0] + self._y_bias), predicted[1]
        return Linearised(y[:, self._predicted], G[:, self._predicted], self.problem.references(t))

    def _diagnostics(self) -> dict[str, float]:
        """What the filter believes, for the trace."""
        several, believed = len(self.problem.speeds) > 1, {}
        for path, value in self.filter.estimates.items():
            believed[f"disturbance.{path if several else path.rpartition('.')[2]}"] = value
        return believed | {"innovation": self.filter.surprise, "age": float(self._age)}


def _recorded(sample: Sample, u_last: Array) -> Sequence[Array | float]:
    """The inputs of its C."""
    return [sample.t, int(sample.active), np.array(list(sample.measured.values())), u_last]
