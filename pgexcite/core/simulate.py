"""A run: steps, events and controllers in order of time, recorded on both sides of every jump."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.agenda import Agenda, objections, switched
from pgexcite.core.at_work import AtWork, start
from pgexcite.core.controller import Controller, Session
from pgexcite.core.diagnose import (
    collapse,
    diagnose,
    limiters_at_work,
    lost_synchronism,
    smallest_singular_value,
)
from pgexcite.core.errors import ConfigError, SnapshotError
from pgexcite.core.events import Change
from pgexcite.core.history import History
from pgexcite.core.initialise import Initial, initialise
from pgexcite.core.measurement import Instruments
from pgexcite.core.memory import Memory, as_arrays, those_under, under
from pgexcite.core.model import Model, State
from pgexcite.core.registry import nearest
from pgexcite.core.result import RunResult
from pgexcite.core.settings import Settings
from pgexcite.core.step import Kernel
from pgexcite.core.synchronism import RotorAngles, dead_buses
from pgexcite.core.system import System
from pgexcite.core.trace import Ending, Outcome, Trace
from pgexcite.core.undervoltage import Undervoltage

Array = NDArray[np.float64]

_CHUNK = 500
"""Steps taken between two looks at the outcome; a run that ends inside a chunk is cut back to the sample where it ended."""


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
        self.settings, self._system = settings, system
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
            if problems := objections(self.model, changes, self._controllers):
                raise ConfigError(problems)
            self._declared = tuple(changes)
        self._agenda = Agenda(self.model, self._declared, self.settings.h)
        self.state: State = self.initial.state
        self.p: Array = self.initial.p.copy()
        self.outcome: Outcome | None = None
        self.wall_time = 0.0
        self.controlled = (0.0, 0.0)
        settings = self.settings
        self._low = Undervoltage(self.model, settings.collapse_below, settings.collapse_after, settings.h)
        y = self.kernel.outputs(self.state, self.p)
        self._running = {
            name: start(name, controller, self.initial, y, settings, self._agenda.changes)
            for name, controller in self._controllers.items()
        }
        self._history = History(self.model, self._running)
        self._history.add_point(self.state, y)
        for text in limiters_at_work(self.model, y):
            self._history.note(0.0, "limit", f"{text} at the initial point already")

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
            ValueError: the value is not finite, or one that a configuration could not give the parameter either.
        """
        # Configurations make simulations: at the head of this file the import would go round in a circle.
        from pgexcite.core.config.checks import adjustable, refusals, siblings

        targets = adjustable(self._system)
        if not any(path in self.model.index[group] for group in "up") and not switched(path):
            raise KeyError(f"no parameter or set-point {path!r}; {nearest(path, siblings(path, targets))}")
        if not math.isfinite(value):
            raise ValueError(f"{path}: should be a finite number (got {value})")
        if problems := refusals(targets, path, float(value)):
            raise ValueError("; ".join(map(str, problems)))
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
    def controllers(self) -> Mapping[str, Controller]:
        """The controllers as configured, by name."""
        return self._controllers

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
        self._history.forget(before)

    def _ended(self) -> bool:
        return self.outcome is not None and self.outcome.ending is not Ending.COMPLETED

    def _end(self, outcome: Outcome) -> None:
        self.outcome = outcome
        self._history.note(outcome.t, "outcome", outcome.message)

    def _next_stop(self) -> int:
        """The step boundary at which something else than a step happens next."""
        stops, change = [self.state.k + _CHUNK], self._agenda.next()
        stops += [] if change is None else [change]
        stops += [(self.state.k // r.every + 1) * r.every for r in self._running.values()]
        return min(stops)

    def _advance(self, n: int) -> None:
        before = self.state
        segment = self.kernel.advance(before, self.p, self.settings.rule, self.settings.h, n)
        done = segment.x.shape[0]
        t: Array = np.arange(before.k + 1, before.k + 1 + done, dtype=np.float64) * self.settings.h
        self._angles.follow(self.p)
        lost = self._angles.first_beyond(segment.x, segment.y, self.settings.delta_max_deg)
        cuts = [found + 1 for found in (lost and lost[0], self._agenda.first(t, segment.y)) if found is not None]
        keep = min([done, *cuts])
        low = self._low.watch(segment.y[:keep])
        keep = keep if low is None else low[0] + 1
        self._history.add(t[:keep], segment.x[:keep], segment.z[:keep], segment.d[:keep], before.u, segment.y[:keep])
        if segment.rescued:
            text = f"{segment.rescued} steps up to t = {segment.state.t:g} s needed shorter inner steps or pivoting"
            self._history.note(segment.state.t, "solver", text)
        self.state = segment.state
        if keep < done:
            row = keep - 1
            self.state = State(before.k + keep, float(t[row]), segment.x[row], segment.z[row], segment.d[row], before.u)
        self._agenda.watch(t[:keep], segment.y[:keep])
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

    def _apply_due(self) -> None:
        if due := self._agenda.due(self.state.k):
            self._apply(*due)

    def _apply(self, *changes: Change) -> None:
        """Changes of one boundary, in their order; only what they make together needs to have a solution."""
        u, p = self.state.u.copy(), self.p.copy()
        for change in changes:
            self._enter(change, u, p)
        self._jump(u, p)

    def _enter(self, change: Change, u: Array, p: Array) -> None:
        """Write a change into commands and parameters, and into the log."""
        for path, value, added in change.assignments():
            if name := switched(path):
                running = self._running[name]
                running.active, running.ordered = value > 0, True
                continue
            array, group = (u, "u") if path in self.model.index["u"] else (p, "p")
            k = self.model.position(group, path)
            array[k] = array[k] + value if added else value
        moved = "" if abs(self.state.t - change.t) < 1e-9 else f" (asked for at t = {change.t:g} s)"
        self._history.note(self.state.t, "event", change.text + moved)

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
        self._history.add_point(self.state, self.kernel.outputs(self.state, self.p))

    # Controllers.

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

    def _call(self, name: str, running: AtWork, y: Array, u: Array) -> None:
        """Let a controller act; its commands go into ``u``."""
        action, took = running.act(self.state, self.p, y)
        self._history.acted(name, self.state.t, action, running.active, took)
        for path, value in action.commands.items():
            u[self.model.position("u", path)] = value

    # What is left behind.

    def trace(self) -> Trace:
        """All samples so far."""
        return self._history.trace()

    def result(self, title: str = "", config: Mapping[str, Any] | None = None) -> RunResult:
        """The run so far as a record to be written."""
        outcome = self.outcome or Outcome(Ending.COMPLETED, self.state.t, "", "not run to its end")
        system, statistics = self.model.system, self._history.statistics()
        return RunResult(title, config or {}, system, outcome, self.trace(), self.state.k, self.wall_time, statistics)

    # What it remembers.

    def memory(self) -> Memory:
        """All that it goes on from."""
        kept = {"low": self._low.elapsed, **self._agenda.memory(self.state.k)}
        for name, running in self._running.items():
            kept |= under(f"controller:{name}", running.session.memory())
            kept[f"instruments:{name}"] = running.instruments.memory()
            kept |= as_arrays({f"active:{name}": running.active, f"ordered:{name}": running.ordered})
        return Memory(self.state, self.p.copy(), {key: np.array(value) for key, value in kept.items()})

    def recall(self, memory: Memory) -> None:
        """Go on from where ``memory`` was taken, bit for bit; what was recorded and how the run ended stay as they are.

        Raises:
            KeyError: it was taken of other controllers.
        """
        kept = {key: value.copy() for key, value in memory.kept.items()}
        self.state, self.p = memory.state, memory.p.copy()
        for name, running in self._running.items():
            running.instruments.recall(kept[f"instruments:{name}"])
            running.session.recall(those_under(f"controller:{name}", kept))
            running.active, running.ordered = bool(kept[f"active:{name}"]), bool(kept[f"ordered:{name}"])
        self._agenda.recall(kept, self.state.k)
        self._low.elapsed = kept["low"]

    @contextmanager
    def tentatively(self) -> Iterator[None]:
        """What is done inside is undone at its end: nothing is left of it, in what is remembered or in what is recorded."""
        memory, left = self.memory(), (self._history, self.outcome, self.wall_time, self.controlled)
        self._record_anew()
        try:
            yield
        finally:
            self.recall(memory)
            self._history, self.outcome, self.wall_time, self.controlled = left

    def _record_anew(self) -> None:
        self._history = History(self.model, self._running)
        self._record_point()

    def save(self, path: Path) -> None:
        """Write what it remembers; ``resume`` goes on from it bit for bit."""
        memory = self.memory()
        memory.state.save(path, self.model, memory.p, memory.kept)

    def resume(self, path: Path) -> None:
        """Go on from a saved point; events before it are taken as past.

        Raises:
            SnapshotError: the file cannot be read or belongs to another model or to other controllers.
        """
        self.restart()
        memory, own = Memory(*State.load(path, self.model)), self.memory().kept
        advice = "use the configuration and the version it was taken with"
        for name, running in self._running.items():
            if running.session.memory() and not those_under(f"controller:{name}", memory.kept):
                raise SnapshotError(f"{path}: holds nothing of the controller {name!r}")
        for key, value in memory.kept.items():
            # What is empty at the start may be of any size later.
            if key in own and own[key].size and own[key].shape != value.shape:
                raise SnapshotError(f"{path}: {key} is of shape {value.shape}, not {own[key].shape}; {advice}")
        try:
            self.recall(memory)
        except KeyError as missing:
            raise SnapshotError(f"{path}: holds no {missing}; {advice}") from missing
        except ValueError as cause:
            raise SnapshotError(f"{path}: {cause}; {advice}") from cause
        self._record_anew()
