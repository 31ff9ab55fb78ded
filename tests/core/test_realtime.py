"""Paced runs: what is counted, what is granted, and that pacing changes nothing of the run itself."""

from __future__ import annotations

import gc
import json
import os
import time

import numpy as np
import pytest
from plants import kobbelv

from pgexcite.core import realtime
from pgexcite.core.errors import ConfigError
from pgexcite.core.events import Fault
from pgexcite.core.realtime import RealtimeOptions, run_paced, timed
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.summary import summarise
from pgexcite.core.timing import EDGES, histogram, statistics
from pgexcite.plugins.controllers.mpc import MPC

FAULT = Fault(type="fault", t=0.2, bus="HV", R=0.02, duration=0.1)


def plant(t_end=1.0, controllers=None, **options):
    if controllers is None:
        controllers = {"mpc": MPC(**({"unit": "G2"} | options))}
    return Simulation(kobbelv(), Settings(t_end, 0.005, "tr_bdf2", "never"), FAULT.changes(), controllers)


class Clock:
    """A clock that moves only when somebody sleeps."""

    def __init__(self):
        self.now = 100.0

    def read(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock.read)
    monkeypatch.setattr(time, "sleep", clock.sleep)
    return clock


class _Slow:
    """A solver that takes its time in some of its calls."""

    def __init__(self, good, takes):
        self._good, self._takes, self._count = good, takes, 0

    def solve(self, sample, u_last):
        time.sleep(self._takes.get(self._count, 0.0))
        self._count += 1
        return self._good.solve(sample, u_last)

    def prepare(self, u):
        self._good.prepare(u)


def slowed(takes, **options):
    sim = plant(**options)
    session = sim._running["mpc"].session
    session.solver = _Slow(session.solver, takes)
    return sim


def test_a_paced_run_is_the_run(clock):
    paced, plain = plant(), plant()
    plain.run()
    timing = run_paced(paced, RealtimeOptions())
    assert timing.t.size == 20
    assert timing.missed == timing.overruns == timing.skipped == 0
    assert np.array_equal(paced.state.x, plain.state.x)
    assert clock.now == pytest.approx(100.0 + 20 * 0.05)


def test_periods_are_as_long_as_asked(clock):
    timing = run_paced(plant(), RealtimeOptions(period=0.005, steps=7))
    assert timing.t == pytest.approx(0.05 * np.arange(7))
    assert clock.now == pytest.approx(100.0 + 7 * 0.005)
    assert (timing.period, timing.sample, timing.deadline) == pytest.approx((0.005, 0.05, 0.005))


def test_controllers_of_several_sample_times_share_a_grid(clock):
    controllers = {name: MPC(unit="G2", dt=dt) for name, dt in (("slow", 0.1), ("fast", 0.04))}
    sim = plant(controllers=controllers)
    assert sim.sampling * 0.005 == pytest.approx(0.02)
    assert run_paced(sim, RealtimeOptions(steps=10)).t.size == 10
    assert [len(sim.result().controllers[name].solve_ms) for name in ("slow", "fast")] == [2, 5]


def test_late_commands_are_misses(clock):
    """The third of 10 periods of 20 ms takes 12 ms, late for a deadline of 10; the sixth takes 30, and the next starts late."""
    sim = slowed({2: 0.012, 5: 0.030})
    timing = run_paced(sim, RealtimeOptions(period=0.02, steps=10, deadline=0.01))
    assert timing.ms["response"] == pytest.approx([0, 0, 12, 0, 0, 30, 10, 0, 0, 0], abs=1e-9)
    assert timing.ms["wake_up"] == pytest.approx([0, 0, 0, 0, 0, 0, 10, 0, 0, 0], abs=1e-9)
    assert list(np.flatnonzero(timing.ms["response"] > 10 + 1e-6)) == [2, 5]
    assert timing.overruns == 1
    assert timing.skipped == 0


def test_periods_that_went_by_are_skipped_and_missed(clock):
    """One solve of 70 ms: its own period is missed, two more go by, and the next sample is taken late, 10 ms into its own."""
    timing = run_paced(slowed({2: 0.070}), RealtimeOptions(period=0.02, steps=10))
    assert timing.skipped == 2
    assert timing.missed == 3
    assert timing.ms["wake_up"][3] == pytest.approx(10, abs=1e-9)
    assert clock.now == pytest.approx(100.0 + 12 * 0.02)
    assert timing.summary()["miss_rate"] == pytest.approx(3 / 12)


def test_a_plan_later_than_its_deadline_is_not_used(clock):
    sim = slowed({4: 0.004}, deadline_ms=3.0)
    run_paced(sim, RealtimeOptions(period=0.02, steps=10))
    trace = sim.trace()
    assert sim.result().controllers["mpc"].fallbacks == 1
    assert trace["controller.mpc.level"].max() == 1
    assert any("later than its deadline of 3 ms" in entry.text for entry in trace.log)


def test_the_summary_and_the_trace_hold_the_figures(clock):
    sim = slowed({2: 0.012})
    timing = run_paced(sim, RealtimeOptions(period=0.02, steps=10))
    result = timed(sim.result(), timing)
    found = json.loads(json.dumps(summarise(result), allow_nan=False))["realtime"]
    assert found["steps"] == 10
    assert set(found) >= {"wake_up_ms", "solve_ms", "response_ms", "work_ms", "memory_mib", "options", "miss_rate"}
    assert found["solve_ms"]["max"] == pytest.approx(12)
    assert sum(found["solve_ms"]["histogram"]["counts"]) == 10
    trace = result.trace
    third = (trace.t > 0.101) & (trace.t < 0.149)
    assert trace["realtime.solve_ms"][third] == pytest.approx(12.0)
    assert trace.units["realtime.solve_ms"] == "ms"


def test_old_samples_are_dropped_and_the_statistics_stay(clock):
    sim, whole = plant(30.0), plant(30.0)
    run_paced(sim, RealtimeOptions(period=0.005, keep=1.0))
    whole.run()
    kept, all_of_it = sim.trace(), whole.trace()
    assert sim.result().controllers["mpc"].samples == 600
    # Old samples go every 200 periods of 50 ms, the last time at t = 20.05 s: from there back one second is kept, by whole blocks.
    assert 18.9 < kept.t[0] < 19.1
    same = all_of_it.t >= kept.t[0]
    assert np.array_equal(kept["unit.G2.v_t"], all_of_it["unit.G2.v_t"][same][-kept.t.size :])


def test_a_run_that_ends_early_stops_the_clock(clock):
    sim = plant(3.0, N_p=1, Q=0.0, P=0.0, R=1.0)
    sim.restart([*Fault(type="fault", t=0.2, bus="HV", duration=0.4).changes()])
    timing = run_paced(sim, RealtimeOptions())
    assert sim.outcome.ending.value == "lost_synchronism"
    assert timing.t.size < 60


def test_nothing_to_pace_is_a_config_error():
    with pytest.raises(ConfigError, match="needs a controller"):
        run_paced(plant(controllers={}), RealtimeOptions())
    with pytest.raises(ConfigError, match=r"realtime\.period: must not be negative"):
        run_paced(plant(), RealtimeOptions(period=-1.0))
    with pytest.raises(ConfigError, match=r"realtime\.priority"):
        run_paced(plant(), RealtimeOptions(priority=100))


def grants(clock, **options):
    timing = run_paced(plant(), RealtimeOptions(steps=1, **options))
    return {grant.option: grant for grant in timing.grants}


def test_nothing_is_asked_for_unless_told(clock):
    assert grants(clock) == {}


def test_options_that_are_refused_are_reported_and_the_run_goes_on(clock, monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    class Library:
        def mlockall(self, flags):
            return -1

        def munlockall(self):
            raise AssertionError("nothing was locked")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(realtime.ctypes, "CDLL", lambda *_, **__: Library())
    found = grants(clock, priority=50, lock_memory=True, core=4096)
    assert not any(grant.granted for grant in found.values())
    assert set(found) == {"priority", "lock_memory", "core"}
    assert "ulimit -r" in found["priority"].detail
    assert "ulimit -l" in found["lock_memory"].detail
    assert found["core"].detail.startswith("4096: ")


def test_options_of_a_system_without_them_are_refused(clock, monkeypatch):
    monkeypatch.delattr(os, "sched_setscheduler")
    monkeypatch.delattr(os, "sched_setaffinity")
    monkeypatch.setattr(realtime.ctypes, "CDLL", lambda *_, **__: object())
    found = grants(clock, priority=50, lock_memory=True, core=0)
    assert not any(grant.granted for grant in found.values())


def test_the_garbage_collector_and_the_core_are_put_back(clock):
    before = os.sched_getaffinity(0)
    core = min(before)
    seen = []
    sim = plant()
    options = RealtimeOptions(steps=1, garbage="off", core=core)
    session = sim._running["mpc"].session
    prepare = session.prepare
    session.prepare = lambda: (seen.append((gc.isenabled(), os.sched_getaffinity(0))), prepare())
    timing = run_paced(sim, options)
    assert seen == [(False, {core})]
    assert all(grant.granted for grant in timing.grants)
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0
    assert os.sched_getaffinity(0) == before


def test_memory_is_looked_at(clock):
    timing = run_paced(plant(), RealtimeOptions(steps=5))
    assert [j for j, _ in timing.memory] == [0, 1, 2, 3, 4, 5]
    assert all(10 < mib < 1e5 for _, mib in timing.memory)


def test_histograms_count_everything():
    times = np.array([1e-5, 0.1, 0.11, 0.9, 1e6])
    edges, counts = histogram(times)
    assert counts.sum() == 5
    assert edges[0] == EDGES[0]
    assert edges[-1] == EDGES[-1]
    edges, counts = histogram(np.array([0.9, 1.05]))
    assert edges == pytest.approx(10.0 ** np.array([-0.1, 0.0, 0.1]))
    assert list(counts) == [1, 1]
    assert statistics(np.empty(0)) is None
