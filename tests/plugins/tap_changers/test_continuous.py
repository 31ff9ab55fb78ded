from __future__ import annotations

import numpy as np
import pytest
from tapped import plant, source

from pgexcite.core.errors import InitialisationError
from pgexcite.core.initialise import initialise
from pgexcite.core.powerflow import solve
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.tap_changers.continuous import ContinuousTapChanger


def run(tap_changer, events, t_end):
    changes = [change for event in events for change in event.changes()]
    sim = Simulation(plant(tap_changer), Settings(t_end, 0.05, "tr_bdf2", "never"), changes)
    assert sim.run().ending.value == "completed"
    return sim


def at_rest(**parameters):
    """A tap changer whose reference is the voltage the run starts from."""
    V = abs(solve(plant(ContinuousTapChanger())).v["LV"])
    return ContinuousTapChanger(V_ref=V, half_deadband=0.0, **parameters)


def test_the_ratio_is_the_integral_of_the_error():
    tap_changer = at_rest(T_c=5.0)
    trace = run(tap_changer, [source(1.0, 0.95)], 40.0).trace()
    ratio, v = trace["transformer.T1.ratio"], trace["bus.LV.v"]
    area = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1] - 2 * tap_changer.V_ref) / 2 * np.diff(trace.t))])
    assert ratio - 1.0 == pytest.approx(area / 5.0, abs=1e-5)  # measured 2.8e-7
    assert v[-1] == pytest.approx(tap_changer.V_ref, abs=1e-3)


def test_both_ends_of_the_range_are_reached_and_left_without_windup():
    events = [source(1.0, 0.8), source(20.0, 1.25), source(40.0, 0.95)]
    trace = run(at_rest(T_c=1.0, tap_min=0.95, tap_max=1.05), events, 42.0).trace()
    ratio = trace["transformer.T1.ratio"]
    assert ratio[np.searchsorted(trace.t, 19.0)] == pytest.approx(0.95, abs=1e-12)
    assert ratio[np.searchsorted(trace.t, 39.0)] == pytest.approx(1.05, abs=1e-12)
    assert ratio[np.searchsorted(trace.t, 40.2)] < 1.05


def test_a_dead_band_leaves_small_errors_alone_and_blocking_stops_it():
    banded = ContinuousTapChanger(half_deadband=0.03)
    assert np.ptp(run(banded, [source(1.0, 1.0)], 10.0).trace()["transformer.T1.ratio"]) == 0.0
    blocked = at_rest(blocked=1.0)
    assert np.ptp(run(blocked, [source(1.0, 0.9)], 10.0).trace()["transformer.T1.ratio"]) == 0.0


def test_a_start_outside_the_dead_band_is_refused():
    with pytest.raises(InitialisationError, match=r"transformer\.T1: no steady state"):
        initialise(plant(ContinuousTapChanger(V_ref=0.9)))
