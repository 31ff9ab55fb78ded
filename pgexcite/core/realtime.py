"""Controllers in real time: a run paced by the wall clock, on the simulated plant.

A period begins by the clock, on a fixed grid. The controllers act, the commands go out, the next sample is prepared, the plant is
stepped; then the process sleeps until the next period. A Python process keeps such a clock well but not always: what was missed
is counted, and what the system was asked for to miss less is reported as granted or refused.
"""

from __future__ import annotations

import ctypes
import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.result import RunResult
from pgexcite.core.simulate import Simulation
from pgexcite.core.timing import PHASES, Grant, Timing

Array = NDArray[np.float64]

_MCL_CURRENT, _MCL_FUTURE = 1, 2
_LOOKS = 100
"""How often in a run the resident memory is looked at."""
_FORGET_EVERY = 200
"""Periods between two times old samples are dropped."""

GarbageCollector = Literal["on", "frozen", "off"]


@dataclass(frozen=True)
class RealtimeOptions:
    """How a run is paced.

    Attributes:
        period: wall-clock time of a period, s; 0 takes the controllers' sample time.
        steps: periods; 0 goes on to the end of the run.
        deadline: time after the beginning of a period by which commands must be out, s; 0 takes the period. It only counts
            misses: that a late plan is not used is the controller's own ``deadline_ms``.
        priority: priority of the scheduler SCHED_FIFO, 1 to 99; 0 leaves the scheduler as it is.
        lock_memory: keep all pages in memory (mlockall).
        core: processor the thread is pinned to; ``None`` leaves it free.
        garbage: Python's cyclic garbage collector: ``"on"`` as usual; ``"frozen"`` collects once and exempts what there is then;
            ``"off"`` does that and stops it.
        keep: simulated seconds kept in the trace; 0 keeps all.
    """

    period: float = 0.0
    steps: int = 0
    deadline: float = 0.0
    priority: int = 0
    lock_memory: bool = False
    core: int | None = None
    garbage: GarbageCollector = "on"
    keep: float = 0.0


def run_paced(
    simulation: Simulation, options: RealtimeOptions, progress: Callable[[float], None] | None = None
) -> Timing:
    """Run a simulation by the wall clock.

    An interrupt (SIGINT) ends it at the end of its period; a second one is that of the process.

    Args:
        simulation: at its start or anywhere in its run.
        progress: called with the simulated time once a second.

    Raises:
        ConfigError: no controller, or a period, deadline or number of steps that is not positive.
    """
    every = simulation.sampling
    _check(simulation, options)
    h = simulation.settings.h
    sample = every * h
    period = options.period or sample
    steps = options.steps or max(1, (round(simulation.settings.t_end / h) - simulation.state.k) // every)
    with ExitStack() as stack:
        grants = tuple(stack.enter_context(_asked(options)))
        interrupted = stack.enter_context(_interruptible())
        pace = _Pace(simulation, period, sample, steps, options.keep, progress)
        pace.run(interrupted)
    return Timing(
        period=period,
        sample=sample,
        deadline=options.deadline or period,
        t=pace.t[: pace.done],
        ms={phase: times[: pace.done] for phase, times in pace.ms.items()},
        skipped=pace.skipped,
        memory=tuple(pace.memory),
        grants=grants,
        interrupted=interrupted.is_set(),
    )


def timed(result: RunResult, timing: Timing) -> RunResult:
    """A result with its timing, each phase also as a signal ``realtime.<phase>_ms`` of the trace."""
    trace = result.trace
    position = np.searchsorted(timing.t, trace.t + 1e-9, side="right") - 1
    columns, units = dict(trace.columns), dict(trace.units)
    for phase, times in timing.ms.items():
        path = f"realtime.{phase}_ms"
        columns[path] = np.where(position >= 0, times[np.maximum(position, 0)], np.nan)
        units[path] = "ms"
    return replace(result, trace=replace(trace, columns=columns, units=units), timing=timing)


def _check(simulation: Simulation, options: RealtimeOptions) -> None:
    problems = []
    if not simulation.sampling:
        problems.append(Problem("controller", "a paced run needs a controller", None, "add a [controller.NAME] table"))
    for name in ("period", "steps", "deadline", "keep"):
        value = getattr(options, name)
        if not value >= 0:
            problems.append(Problem(f"realtime.{name}", "must not be negative", value))
    if not 0 <= options.priority <= 99:
        problems.append(Problem("realtime.priority", "must be 1 to 99, or 0 for the usual scheduler", options.priority))
    if problems:
        raise ConfigError(problems)


class _Pace:
    """The loop, and what it has measured so far."""

    def __init__(
        self,
        simulation: Simulation,
        period: float,
        sample: float,
        steps: int,
        keep: float,
        progress: Callable[[float], None] | None,
    ) -> None:
        self._simulation, self._period, self._sample, self._steps = simulation, period, sample, steps
        self._keep, self._progress = keep, progress
        # Written before the loop, so that its pages are there when it runs.
        self.t: Array = np.full(steps, np.nan)
        self.ms: dict[str, Array] = {phase: np.full(steps, np.nan) for phase in PHASES}
        self.memory: list[tuple[int, float]] = []
        self.done = self.skipped = 0

    def run(self, interrupted: threading.Event) -> None:
        simulation, period = self._simulation, self._period
        every, h = simulation.sampling, simulation.settings.h
        look = max(1, self._steps // _LOOKS)
        told = begins = time.perf_counter() + period
        for j in range(self._steps):
            if j % look == 0:
                self._look(j)
            _sleep_until(begins)
            woke = time.perf_counter()
            self.t[j] = simulation.state.t
            outcome = simulation.run(until=(simulation.state.k // every + 1) * every * h)
            finished = time.perf_counter()
            asked, answered = simulation.controlled
            measured = (woke - begins, answered - asked, answered - begins, finished - woke)
            for times, value in zip(self.ms.values(), measured, strict=True):
                times[j] = 1e3 * value
            self.done = j + 1
            if outcome.ending.value != "completed" or interrupted.is_set():
                break
            if self._keep and j % _FORGET_EVERY == 0:
                simulation.forget(simulation.state.t - self._keep)
            if self._progress is not None and finished - told > 1.0:
                self._progress(simulation.state.t)
                told = finished
            begins = self._next(begins)
        self._look(self.done)

    def _next(self, begins: float) -> float:
        """The beginning of the next period; periods that have gone by already are skipped."""
        begins += self._period
        lost = max(0, int((time.perf_counter() - begins) / self._period))
        self.skipped += lost
        return begins + lost * self._period

    def _look(self, j: int) -> None:
        found = resident_memory()
        if found is not None:
            self.memory.append((j, found))


def _sleep_until(instant: float) -> None:
    left = instant - time.perf_counter()
    if left > 0:
        time.sleep(left)


def resident_memory() -> float | None:
    """Resident memory of this process, MiB; ``None`` where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """An event that the first interrupt sets. Only the main thread may say what an interrupt does."""
    interrupted, before = threading.Event(), signal.getsignal(signal.SIGINT)
    # What was installed from elsewhere than Python could not be put back.
    if before is None or threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    def first(_: int, __: object) -> None:
        interrupted.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, first)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _asked(options: RealtimeOptions) -> Iterator[list[Grant]]:
    """Ask for the options wanted; all of them are undone at the end."""
    grants: list[Grant] = []
    with ExitStack() as stack:
        if options.garbage != "on":
            grants.append(stack.enter_context(_garbage(options.garbage)))
        if options.core is not None:
            grants.append(stack.enter_context(_pinned(options.core)))
        if options.lock_memory:
            grants.append(stack.enter_context(_locked()))
        if options.priority:
            grants.append(stack.enter_context(_fifo(options.priority)))
        yield grants


@contextmanager
def _garbage(choice: GarbageCollector) -> Iterator[Grant]:
    enabled = gc.isenabled()
    gc.collect()
    gc.freeze()
    if choice == "off":
        gc.disable()
    try:
        yield Grant("garbage", True, choice)
    finally:
        gc.unfreeze()
        if enabled:
            gc.enable()


@contextmanager
def _pinned(core: int) -> Iterator[Grant]:
    if not hasattr(os, "sched_setaffinity"):
        yield Grant("core", False, "this system does not pin threads to processors")
        return
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {core})
    except (OSError, ValueError, OverflowError) as cause:
        yield Grant("core", False, f"{core}: {cause} (there are {sorted(before)})")
        return
    try:
        yield Grant("core", True, str(core))
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def _fifo(priority: int) -> Iterator[Grant]:
    if not hasattr(os, "sched_setscheduler"):
        yield Grant("priority", False, "this system has no SCHED_FIFO")
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as cause:
        yield Grant("priority", False, f"{cause.strerror}: it takes CAP_SYS_NICE or a limit on rtprio (ulimit -r)")
        return
    try:
        yield Grant("priority", True, f"SCHED_FIFO {priority}")
    finally:
        os.sched_setscheduler(0, policy, parameters)


@contextmanager
def _locked() -> Iterator[Grant]:
    try:
        library = ctypes.CDLL(None, use_errno=True)
        lock, unlock = library.mlockall, library.munlockall
    except (OSError, TypeError, AttributeError):
        yield Grant("lock_memory", False, "this system has no mlockall")
        return
    if lock(_MCL_CURRENT | _MCL_FUTURE) != 0:
        reason = os.strerror(ctypes.get_errno())
        yield Grant("lock_memory", False, f"{reason}: it takes CAP_IPC_LOCK or a limit on memlock (ulimit -l)")
        return
    try:
        yield Grant("lock_memory", True, "all pages, present and future")
    finally:
        unlock()
