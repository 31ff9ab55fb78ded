"""A run: steps, events and controllers in order of time, recorded on both sides of every jump."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.controller import Controller, Plant, Sample, Session, Surroundings
from pgexcite.core.diagnose import (
    collapse,
    diagnose,
    limiters_at_work,
    lost_synchronism,
    smallest_singular_value,
)
from pgexcite.core.errors import ConfigError, Problem, SnapshotError
from pgexcite.core.events import Change, boundary
from pgexcite.core.initialise import Initial, initialise
from pgexcite.core.measurement import Instruments
from pgexcite.core.model import Model, State
from pgexcite.core.result import ControllerStatistics, RunResult
from pgexcite.core.settings import Settings
from pgexcite.core.step import Kernel
from pgexcite.core.synchronism import RotorAngles, dead_buses
from pgexcite.core.system import System
from pgexcite.core.trace import Ending, LogEntry, Outcome, Trace
from pgexcite.core.triggers import Triggers
from pgexcite.core.undervoltage import Undervoltage

Array = NDArray[np.float64]

_CHUNK = 500
"""Steps taken between two looks at the outcome; a run that ends inside a chunk is cut back to the sample where it ended."""


@dataclass
class _Recording:
    """Blocks of consecutive samples; inside a block commands and parameters do not change."""

    t: list[Array] = field(default_factory=list)
    x: list[Array] = field(default_factory=list)
    z: list[Array] = field(default_factory=list)
    d: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    y: list[Array] = field(default_factory=list)
    log: list[LogEntry] = field(default_factory=list)

    def add(self, t: Array, x: Array, z: Array, d: Array, u: Array, y: Array) -> None:
        self.t.append(t)
        self.x.append(x)
        self.z.append(z)
        self.d.append(d)
        self.u.append(np.broadcast_to(u, (t.size, u.size)))
        self.y.append(y)


@dataclass
class _Running:
    """A controller at work, and how it has done."""

    controller: Controller
    session: Session
    instruments: Instruments
    every: int
    columns: NDArray[np.int_]
    active: bool
    ordered: bool = False
    t: list[float] = field(default_factory=list)
    diagnostics: list[Mapping[str, float]] = field(default_factory=list)
    solve_ms: list[float] = field(default_factory=list)
    fallbacks: int = 0
    cost: float = 0.0


class Simulation:
    """A system on its way through time.

    Args:
        system: what is simulated.
        settings: step, rule, length.
        changes: events, in any order.
        controllers: by name.

    Attributes:
        state, p: the present point and parameters.
        outcome: how the run ended so far; ``None`` before it began.
        wall_time: s spent in ``run``.
        controlled: when the controllers last began to work and when their commands were out, s of ``time.perf_counter``.

    Raises:
        PowerFlowError, InitialisationError, AssemblyError: there is no steady state to start from.
        ConfigError: an event or a controller refers to something that is not there.
    """

    def __init__(
        self,
        system: System,
        settings: Settings,
        changes: Sequence[Change] = (),
        controllers: Mapping[str, Controller] | None = None,
    ) -> None:
        self.settings = settings
        self.initial: Initial = initialise(system)
        self.model: Model = self.initial.model
        self.kernel = Kernel(self.model, self.initial.state, self.initial.p, settings.compile)
        self._controllers = dict(controllers or {})
        self._healthy = smallest_singular_value(self.kernel, self.initial.state, self.initial.p)
        self._angles = RotorAngles(self.model)
        self.restart(changes)

    def restart(self, changes: Sequence[Change] | None = None) -> None:
        """Go back to the initial point, with other events where they are given; nothing is compiled again."""
        if changes is not None:
            self._check_changes(changes)
            self._declared = tuple(changes)
        self._changes = _in_order(change for change in self._declared if change.when is None)
        waiting = [change for change in self._declared if change.when is not None]
        self._triggers = Triggers(self.model, waiting, self.settings.h)
        self.state: State = self.initial.state
        self.p: Array = self.initial.p.copy()
        self.outcome: Outcome | None = None
        self.wall_time = 0.0
        self.controlled = (0.0, 0.0)
        self._pending = list(self._changes)
        settings = self.settings
        self._low = Undervoltage(self.model, settings.collapse_below, settings.collapse_after, settings.h)
        self._recording = _Recording()
        self._running = {name: self._start(name, controller) for name, controller in self._controllers.items()}
        self._record_point()
        at_work = limiters_at_work(self.model, self.kernel.outputs(self.state, self.p))
        self._recording.log += [LogEntry(0.0, "limit", f"{text} at the initial point already") for text in at_work]

    # Parameters and commands, at any time.

    def get(self, path: str) -> float:
        """Present value of a parameter, command, state, algebraic unknown or output.

        Raises:
            KeyError: no such path; the message names the nearest.
        """
        index = self.model.index
        for group, values in (
            ("p", self.p),
            ("u", self.state.u),
            ("x", self.state.x),
            ("z", self.state.z),
            ("d", self.state.d),
        ):
            if path in index[group]:
                return float(values[index[group][path]])
        state = self.state
        y = self.kernel.outputs(state, self.p)
        return float(y[self.model.position("y", path)])

    def set(self, path: str, value: float) -> None:
        """Change a parameter or command now; the algebraic unknowns are solved again and both sides are recorded.

        Raises:
            KeyError: no such parameter or command.
        """
        self._apply(Change(self.state.t, {path: value}, f"{path} set to {value:g}"))

    # Running.

    def run(self, until: float | None = None, progress: Callable[[float], None] | None = None) -> Outcome:
        """Go on to ``until`` (s; the end of the run where left out).

        Args:
            progress: called with the simulated time now and then.
        """
        h = self.settings.h
        k_end = round((self.settings.t_end if until is None else until) / h)
        began = time.perf_counter()
        while not self._ended() and self.state.k < k_end:
            self._apply_due()
            if self._ended():
                break
            self._control()
            if self._ended():
                break
            self._advance(min(k_end, self._next_stop()) - self.state.k)
            if progress is not None:
                progress(self.state.t)
        self.wall_time += time.perf_counter() - began
        if not self._ended():
            self.outcome = Outcome(Ending.COMPLETED, self.state.t, "", f"completed at t = {self.state.t:g} s")
        assert self.outcome is not None
        return self.outcome

    @property
    def sessions(self) -> Mapping[str, Session]:
        """The controllers at work, by name."""
        return {name: running.session for name, running in self._running.items()}

    @property
    def instruments(self) -> Mapping[str, Instruments]:
        """What the controllers measure with, by name."""
        return {name: running.instruments for name, running in self._running.items()}

    @property
    def sampling(self) -> int:
        """Steps between two instants at which a controller may be due; 0 without controllers."""
        return math.gcd(*(r.every for r in self._running.values()))

    def forget(self, before: float) -> None:
        """Drop recorded samples older than ``before`` (s), so that a run without end fits in memory; log and statistics stay."""
        r = self._recording
        gone = sum(block[-1] < before for block in r.t[:-1])
        for blocks in (r.t, r.x, r.z, r.d, r.u, r.y):
            del blocks[:gone]
        for running in self._running.values():
            old = sum(t < before for t in running.t[:-1])
            del running.t[:old], running.diagnostics[:old]

    def _ended(self) -> bool:
        return self.outcome is not None and self.outcome.ending is not Ending.COMPLETED

    def _end(self, outcome: Outcome) -> None:
        self.outcome = outcome
        self._recording.log.append(LogEntry(outcome.t, "outcome", outcome.message))

    def _next_stop(self) -> int:
        """The step boundary at which something else than a step happens next."""
        stops = [self.state.k + _CHUNK]
        stops += [self._boundary(change) for change in self._pending[:1]]
        stops += [(self.state.k // r.every + 1) * r.every for r in self._running.values()]
        return min(stops)

    def _boundary(self, change: Change) -> int:
        return boundary(change.t, self.settings.h)

    def _advance(self, n: int) -> None:
        before = self.state
        segment = self.kernel.advance(before, self.p, self.settings.rule, self.settings.h, n)
        done = segment.x.shape[0]
        t: Array = np.arange(before.k + 1, before.k + 1 + done, dtype=np.float64) * self.settings.h
        self._angles.follow(self.p)
        lost = self._angles.first_beyond(segment.x, segment.y, self.settings.delta_max_deg)
        cuts = [found + 1 for found in (lost and lost[0], self._triggers.first(t, segment.y)) if found is not None]
        keep = min([done, *cuts])
        low = self._low.watch(segment.y[:keep])
        keep = keep if low is None else low[0] + 1
        self._recording.add(t[:keep], segment.x[:keep], segment.z[:keep], segment.d[:keep], before.u, segment.y[:keep])
        if segment.rescued:
            text = f"{segment.rescued} steps up to t = {segment.state.t:g} s needed shorter inner steps or pivoting"
            self._recording.log.append(LogEntry(segment.state.t, "solver", text))
        self.state = segment.state
        if keep < done:
            row = keep - 1
            self.state = State(before.k + keep, float(t[row]), segment.x[row], segment.z[row], segment.d[row], before.u)
        if fired := self._triggers.take(t[:keep], segment.y[:keep]):
            self._changes, self._pending = _in_order([*self._changes, *fired]), _in_order([*self._pending, *fired])
        if lost is not None and lost[0] == keep - 1:
            _, unit, angle = lost
            text = f"its rotor angle against {self._angles.reference(unit)} reached {angle:.1f} degrees"
            self._end(lost_synchronism(self.model, self.state, unit, text))
        elif low is not None:
            _, bus, voltage = low
            text = f"at t = {self.state.t:.4f} s: {voltage:.3f} pu"
            text += f", below {self.settings.collapse_below:g} pu for {self.settings.collapse_after:g} s"
            self._end(collapse(self.model, self.state, bus, text))
        elif segment.failed and keep == done:
            self._end(diagnose(self.kernel, self.state, self.p, self.settings.rule, self.settings.h, self._healthy))

    # Events.

    def _check_changes(self, changes: Sequence[Change]) -> None:
        problems = []
        for change in changes:
            if change.when is not None and change.when.signal not in self.model.index["y"]:
                near = _nearest(self.model, change.when.signal)
                problems.append(Problem(change.when.signal, f"no such output ({change.text} waits for it)", hint=near))
            for path in (*change.values, *(change.increments or {})):
                known = path in self.model.index["u"] or path in self.model.index["p"]
                if not known and _switched(path) not in self._controllers:
                    near = _nearest(self.model, path)
                    when = f"event at t = {change.t:g} s" if change.when is None else f"event when {change.when}"
                    problems.append(Problem(path, f"no such parameter or set-point ({when})", hint=near))
        if problems:
            raise ConfigError(problems)

    def _apply_due(self) -> None:
        due = []
        while self._pending and self._boundary(self._pending[0]) <= self.state.k:
            due.append(self._pending.pop(0))
        if due:
            self._apply(*due)

    def _apply(self, *changes: Change) -> None:
        """Changes of one boundary, in their order; only what they make together needs to have a solution."""
        u, p = self.state.u.copy(), self.p.copy()
        for change in changes:
            self._enter(change, u, p)
        self._jump(u, p)

    def _enter(self, change: Change, u: Array, p: Array) -> None:
        """Write a change into commands and parameters, and into the log."""
        for values, add in ((change.values, False), (change.increments or {}, True)):
            for path, value in values.items():
                if _switched(path):
                    running = self._running[_switched(path)]
                    running.active, running.ordered = value > 0, True
                    continue
                array, group = (u, "u") if path in self.model.index["u"] else (p, "p")
                k = self.model.position(group, path)
                array[k] = array[k] + value if add else value
        moved = "" if abs(self.state.t - change.t) < 1e-9 else f" (asked for at t = {change.t:g} s)"
        self._recording.log.append(LogEntry(self.state.t, "event", change.text + moved))

    def _jump(self, u: Array, p: Array) -> None:
        """New commands and parameters: the algebraic unknowns are solved again at fixed states."""
        # A controller's commands leave the parameters alone, and with them the branches in service.
        was_dead, dead = ((), ()) if p is self.p else (dead_buses(self.model, self.p), dead_buses(self.model, p))
        self.p = p
        self.state = self.state.with_(u=u)
        # From no voltage the search would find the low-voltage solution of a load that is connected again.
        revived = self._with_voltages([bus for bus in was_dead if bus not in dead], self.initial.state.z)
        settled = self.kernel.settle(revived, p)
        if settled is None and dead:
            # From the voltage before the cut the search for a constant power or current may run away to infinity.
            settled = self.kernel.settle(self._with_voltages(dead, np.zeros_like(self.state.z)), p)
        if settled is None:
            self._end(diagnose(self.kernel, self.state, p, self.settings.rule, self.settings.h, self._healthy))
            return
        self.state = settled
        self._record_point()

    def _with_voltages(self, buses: Sequence[str], z: Array) -> State:
        """The present point with the voltages of these buses taken from ``z``."""
        rows = [self.model.position("z", f"bus.{bus}.{part}") for bus in buses for part in ("v_re", "v_im")]
        moved = self.state.z.copy()
        moved[rows] = z[rows]
        return self.state.with_(z=moved)

    def _record_point(self) -> None:
        s = self.state
        y = self.kernel.outputs(s, self.p)
        self._recording.add(np.array([s.t]), s.x[None], s.z[None], s.d[None], s.u, y[None])

    # Controllers.

    def _start(self, name: str, controller: Controller) -> _Running:
        every = round(controller.dt / self.settings.h)
        if every < 1 or abs(every * self.settings.h - controller.dt) > 1e-9:
            text = f"its sample time must be a whole multiple of the step {self.settings.h:g} s"
            raise ConfigError([Problem(f"controller.{name}.dt", text, controller.dt)])
        s = self.initial.state
        y = self.kernel.outputs(s, self.initial.p)
        index = self.model.index
        missing = [path for path in controller.measures() if path not in index["y"] and path not in index["u"]]
        if missing:
            raise ConfigError(
                [
                    Problem(
                        f"controller.{name}", f"measures {path}, which does not exist", hint=_nearest(self.model, path)
                    )
                    for path in missing
                ]
            )
        names, perfect = tuple(controller.measures()), controller.information == "perfect"
        outputs = dict(zip(self.model.y_names, y, strict=True))
        surroundings = Surroundings(
            h=self.settings.h,
            rule=self.settings.rule,
            u_0=dict(zip(self.model.u_names, s.u, strict=True)),
            y_0=outputs if perfect else {path: outputs[path] for path in names if path in outputs},
            system=self.model.system,
            changes=tuple(self._changes) if controller.disturbance_known else (),
            compile=self.settings.compile,
        )
        plant = None
        if perfect:
            plant = Plant(
                self.model, Kernel(self.model, s, self.initial.p, self.settings.compile), self.initial.p.copy()
            )
        # Outputs and commands in one row: a controller may read back the set-points it moves.
        setpoints = np.array([path in index["u"] for path in names], dtype=bool)
        n_y = len(self.model.y_names)
        columns = np.array(
            [n_y + index["u"][path] if path in index["u"] else index["y"][path] for path in names], dtype=int
        )
        session = controller.start(surroundings, plant)
        instruments = Instruments(controller.measurement, names, setpoints)
        return _Running(controller, session, instruments, every, columns, controller.active)

    def _control(self) -> None:
        due = {name: r for name, r in self._running.items() if self.state.k % r.every == 0}
        if not due:
            return
        u = self.state.u.copy()
        y = self.kernel.outputs(self.state, self.p)
        began = time.perf_counter()
        for name, running in due.items():
            self._call(name, running, y, u)
        self.controlled = (began, time.perf_counter())
        if not np.array_equal(u, self.state.u):
            self._jump(u, self.p)
        for running in due.values():
            running.session.prepare()

    def _call(self, name: str, running: _Running, y: Array, u: Array) -> None:
        """Let a controller act; its commands go into ``u``."""
        s = self.state
        perfect = running.controller.information == "perfect"
        measured = running.instruments.read(s.k // running.every, np.concatenate((y, s.u))[running.columns])
        state, p = (s, self.p.copy()) if perfect else (None, None)
        sample = Sample(s.t, measured, running.active, state, p, ordered=running.ordered)
        running.ordered = False
        began = time.perf_counter()
        action = running.session.act(sample)
        running.solve_ms.append(1e3 * (time.perf_counter() - began))
        running.t.append(s.t)
        if action.release is not None:
            running.active = not action.release
        running.diagnostics.append({**action.diagnostics, "active": float(running.active)})
        running.cost += action.stage_cost
        running.fallbacks += action.fallback
        self._recording.log += [LogEntry(s.t, "controller", f"{name}: {note}") for note in action.notes]
        for path, value in action.commands.items():
            u[self.model.position("u", path)] = value

    # What is left behind.

    def trace(self) -> Trace:
        """All samples so far."""
        r, m = self._recording, self.model
        t = np.concatenate(r.t)
        columns: dict[str, Array] = {}
        for names, blocks in ((m.y_names, r.y), (m.x_names, r.x), (m.d_names, r.d), (m.u_names, r.u)):
            if names:
                columns |= dict(zip(names, np.ascontiguousarray(np.concatenate(blocks).T), strict=True))
        units = {path: m.units.get(path, "") for path in columns}
        for name, running in self._running.items():
            for key in {key: None for row in running.diagnostics for key in row}:
                path = f"controller.{name}.{key}"
                columns[path] = _held(t, running.t, [row.get(key, np.nan) for row in running.diagnostics])
                units[path] = "ms" if key.endswith("_ms") else ""
        return Trace(t, columns, units, tuple(sorted(r.log, key=lambda entry: entry.t)))

    def result(self, title: str = "", config: Mapping[str, Any] | None = None) -> RunResult:
        """The run so far as a record to be written."""
        outcome = self.outcome or Outcome(Ending.COMPLETED, self.state.t, "", "not run to its end")
        controllers = {
            name: ControllerStatistics(len(r.solve_ms), tuple(r.solve_ms), r.fallbacks, r.cost)
            for name, r in self._running.items()
        }
        system = self.model.system
        return RunResult(title, config or {}, system, outcome, self.trace(), self.state.k, self.wall_time, controllers)

    # Snapshots.

    def save(self, path: Path) -> None:
        """Write the present point, parameters and the controllers' memories; ``resume`` goes on from it bit for bit."""
        memory = {
            f"controller:{name}:{key}": value
            for name, r in self._running.items()
            for key, value in r.session.memory().items()
        }
        for name, r in self._running.items():
            memory[f"instruments:{name}"] = r.instruments.memory()
            memory[f"active:{name}"] = np.array(float(r.active))
        memory["low"] = self._low.elapsed
        memory |= {f"trigger:{key}": value for key, value in self._triggers.memory().items()}
        here = sum(self._boundary(change) == self.state.k for change in self._changes)
        memory["applied_here"] = np.array(
            here - sum(self._boundary(change) == self.state.k for change in self._pending)
        )
        self.state.save(path, self.model, self.p, memory)

    def resume(self, path: Path) -> None:
        """Go on from a saved point; events before it are taken as past.

        Raises:
            SnapshotError: the file cannot be read or belongs to another model.
        """
        self.restart()
        self.state, self.p, memory = State.load(path, self.model)
        for name, running in self._running.items():
            start = f"controller:{name}:"
            own = {key[len(start) :]: value for key, value in memory.items() if key.startswith(start)}
            if not own and running.session.memory():
                raise SnapshotError(f"{path}: holds nothing of the controller {name!r}")
            running.session.recall(own)
            running.instruments.recall(memory[f"instruments:{name}"])
            running.active = bool(memory[f"active:{name}"] > 0)
        start = "trigger:"
        self._triggers.recall({k.removeprefix(start): v for k, v in memory.items() if k.startswith(start)})
        self._changes = _in_order([*self._changes, *self._triggers.past()])
        here = [change for change in self._changes if self._boundary(change) == self.state.k]
        later = [change for change in self._changes if self._boundary(change) > self.state.k]
        self._pending = here[int(memory["applied_here"]) :] + later
        self._low.elapsed = memory["low"].copy()
        self._recording = _Recording()
        self._record_point()


def _in_order(changes: Iterable[Change]) -> list[Change]:
    return sorted(changes, key=lambda change: change.t)


def _switched(path: str) -> str:
    """The controller that a path ``controller.NAME.active`` switches, or ``""``."""
    head, _, name = path.removesuffix(".active").partition(".")
    return name if head == "controller" and path.endswith(".active") else ""


def _held(t: Array, instants: list[float], values: list[float]) -> Array:
    """Samples of a quantity that is constant between instants, NaN before the first."""
    position = np.searchsorted(np.array(instants), t + 1e-9, side="right") - 1
    return np.where(position >= 0, np.array(values, dtype=float)[np.maximum(position, 0)], np.nan)


def _nearest(model: Model, path: str) -> str:
    from difflib import get_close_matches

    near = get_close_matches(path, (*model.u_names, *model.p_names, *model.y_names), n=3)
    return f"nearest: {', '.join(near)}" if near else ""
