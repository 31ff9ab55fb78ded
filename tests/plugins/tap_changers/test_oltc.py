from __future__ import annotations

import numpy as np
import pytest
from automaton import Automaton
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from tapped import plant, source

from pgexcite.core.events import ParameterStep
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.tap_changers.oltc import OLTC

H = 0.05
PLACE = "transformer.T1.tap_changer"


def run(tap_changer, events, t_end, **where):
    changes = [change for event in events for change in event.changes()]
    sim = Simulation(plant(tap_changer, **where), Settings(t_end, H, "tr_bdf2", "never"), changes)
    assert sim.run().ending.value == "completed"
    return sim.trace()


def taps(trace):
    """Instants at which the position changes, and the positions taken."""
    position = trace[f"{PLACE}.position"]
    moved = np.flatnonzero(np.diff(position)) + 1
    return trace.t[moved].round(9).tolist(), position[moved].tolist()


def test_first_and_next_delay_to_the_step():
    """A dip at 1 s: the first tap 10 s after it, the others 3 s apart, until the voltage is inside the dead band again."""
    trace = run(OLTC(T_first=10.0, T_next=3.0, V_ref=1.0, half_deadband=0.02), [source(1.0, 0.94)], 30.0)
    instants, positions = taps(trace)
    assert instants == [11.0 + 3.0 * k for k in range(len(instants))]
    assert positions == [-1.0 - k for k in range(len(instants))]
    assert len(instants) == 5
    v = trace["bus.LV.v"]
    assert v[np.searchsorted(trace.t, instants[-1] - H - 1e-6)] < 0.98 < v[-1]
    assert trace["transformer.T1.ratio"][-1] == pytest.approx(0.95)


def test_the_tap_acts_in_the_network():
    """The ratio in the equations is the tap changer's: the same voltages as with that ratio from the start."""
    moved = run(OLTC(T_first=1.0, T_next=1.0, half_deadband=0.01), [source(0.0, 0.94)], 20.0)
    n = moved["transformer.T1.ratio"][-1]
    v_hv, v_lv, angle = moved["bus.HV.v"][-1], moved["bus.LV.v"][-1], moved["bus.HV.angle"] - moved["bus.LV.angle"]
    p = moved["load.L.p"][-1]
    assert p == pytest.approx(v_hv / n * v_lv / 0.1 * np.sin(angle[-1]), rel=1e-9)
    assert moved["transformer.T1.p_to"][-1] == pytest.approx(-p, rel=1e-9)


def test_reset_when_the_voltage_returns():
    """Three dips, each shorter than the delay: no tap; the timer starts anew each time."""
    dips = [source(t, v) for k in range(3) for t, v in ((1.0 + 10 * k, 0.94), (9.0 + 10 * k, 1.02))]
    trace = run(OLTC(T_first=8.5, half_deadband=0.02), dips, 32.0)
    assert taps(trace) == ([], [])
    timer = trace[f"{PLACE}.timer"]
    assert timer.max() == pytest.approx(8.0)
    assert timer[-1] == 0.0


def test_reset_when_the_voltage_crosses_to_the_other_side():
    events = [source(1.0, 0.94), source(7.0, 1.12)]
    instants, positions = taps(run(OLTC(T_first=8.0, T_next=4.0, half_deadband=0.02), events, 24.0))
    assert instants == [15.0, 19.0, 23.0]
    assert positions == [1.0, 2.0, 3.0]


def test_it_stops_at_the_ends_of_its_range():
    trace = run(OLTC(T_first=2.0, T_next=1.0, tap_min=0.97, half_deadband=0.02), [source(1.0, 0.85)], 15.0, tap=1.0)
    assert taps(trace) == ([3.0, 4.0, 5.0], [-1.0, -2.0, -3.0])
    assert trace["transformer.T1.ratio"].min() == pytest.approx(0.97)
    up = run(OLTC(T_first=2.0, T_next=1.0, tap_max=1.02, half_deadband=0.02), [source(1.0, 1.2)], 15.0)
    assert taps(up) == ([3.0, 4.0], [1.0, 2.0])


def test_the_sending_end_is_held_with_the_ratio_the_other_way():
    """Regulating the source's side: a low voltage there raises the ratio."""
    trace = run(
        OLTC(regulates="from", T_first=2.0, T_next=1.0, V_ref=1.01, half_deadband=0.02), [source(1.0, 0.96)], 4.0
    )
    assert taps(trace)[1][:2] == [1.0, 2.0]


def test_events_block_it_and_move_its_reference():
    events = [
        source(1.0, 0.94),
        ParameterStep(type="set", t=2.0, path=f"{PLACE}.blocked", value=1.0),
        ParameterStep(type="set", t=8.0, path=f"{PLACE}.blocked", value=0.0),
        ParameterStep(type="set", t=14.5, path=f"{PLACE}.V_ref", value=0.92),
    ]
    instants, positions = taps(run(OLTC(T_first=5.0, T_next=2.0, half_deadband=0.02), events, 30.0))
    assert instants == [
        13.0,
        19.5,
    ]  # 5 s after the release; 5 s after the new reference puts the voltage on the other side
    assert positions == [-1.0, 0.0]


def test_a_configuration_wires_it(tmp_path):
    from pgexcite.core.config import load

    file = tmp_path / "case.toml"
    file.write_text(
        """
        [simulation]
        t_end = 20.0
        h = 0.05
        [system]
        S_base = 100.0
        f_n = 50.0
        [bus.INF]
        [bus.LV]
        [transformer.T1]
        from = "INF"
        to = "LV"
        X = 0.1
        [transformer.T1.tap_changer]
        model = "oltc"
        T_first = 4.0
        [infinite_bus.grid]
        bus = "INF"
        V = 1.0
        [load.L]
        bus = "LV"
        P = 30.0
        [[event]]
        type = "set"
        t = 1.0
        path = "transformer.T1.tap_changer.V_ref"
        value = 1.03
        """
    )
    scenario = load(file)
    assert scenario.resolved["transformer"]["T1"]["tap_changer"]["T_next"] == 10.0
    sim = Simulation(scenario.system, scenario.settings, scenario.changes)
    sim.run()
    assert taps(sim.trace()) == ([5.0, 15.0], [-1.0, -2.0])


def test_compiled_steps_tap_at_the_same_instants():
    tap_changer = OLTC(T_first=10.0, T_next=3.0, half_deadband=0.02)
    sim = Simulation(plant(tap_changer), Settings(30.0, H, "tr_bdf2", "auto"), source(1.0, 0.94).changes())
    sim.run()
    assert taps(sim.trace()) == taps(run(tap_changer, [source(1.0, 0.94)], 30.0))


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.sampled_from([0.95, 0.985, 1.0, 1.015, 1.05]), st.integers(1, 30)), min_size=1, max_size=12)
)
def test_against_the_automaton_written_out(course):
    """Any course of the voltage: positions as a plain loop over states gives them."""
    T_first, T_next, h = 1.0, 0.4, 0.1
    machine = Automaton(
        OLTC(T_first=T_first, T_next=T_next, half_deadband=0.01, tap_min=0.95, tap_max=1.04), h=h, tap=1.0
    )
    position, waited, before, due = 0, 0, 0, T_first
    for v, steps in course:
        for _ in range(steps):
            side = 1 if v > 1.01 else -1 if v < 0.99 else 0
            waited = (waited + 1 if side == before else 1) if side else 0
            if side != before:
                due = T_first
            before = side
            if side and waited >= round(due / h) and -5 <= position + side <= 4:
                position, waited, due = position + side, 0, T_next
            assert machine.step(v_re=v)["position"] == position
    assert machine.out["ratio"] == pytest.approx(1 + 0.01 * position)


def test_a_range_upside_down_is_refused():
    with pytest.raises(ValidationError, match=r"tap_min = 1.3 must be below tap_max = 1.2"):
        OLTC(tap_min=1.3)


def test_the_step_in_which_the_voltage_leaves_the_dead_band_counts_in_full():
    automaton = Automaton(OLTC(V_ref=1.0, half_deadband=0.01, T_first=3.0), v_im=0.0, tap=1.0, h=1.0)
    assert automaton.step(v_re=0.991)["timer"] == 0.0
    assert automaton.step(v_re=0.989)["timer"] == 1.0
    automaton.step()
    assert automaton.step()["position"] == -1.0
