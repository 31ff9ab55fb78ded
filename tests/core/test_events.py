"""Events: what they change, when, and that both sides of the jump are in the trace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import kobbelv, regulated, two_units
from pydantic import TypeAdapter, ValidationError

from pgexcite.core.errors import ConfigError
from pgexcite.core.events import BranchClose, BranchTrip, Change, Event, Fault, LoadStep, ParameterStep
from pgexcite.core.network import Bus, Line
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.loads.zip import ConstantCurrent, ConstantPower


def run(system, *events, t_end=0.6, h=0.005, rule="tr_bdf2"):
    sim = Simulation(
        system, Settings(t_end, h, rule, "never"), [change for event in events for change in event.changes()]
    )
    assert sim.run().ending.value == "completed"
    return sim, sim.trace()


def sides(trace, t):
    """Rows before and after the event at ``t``."""
    rows = np.flatnonzero(np.abs(trace.t - t) < 1e-9)
    assert rows.size == 2
    return rows


def fault(bus="HV", t=0.2, duration=0.1, **impedance):
    return Fault(type="fault", t=t, bus=bus, duration=duration, **impedance)


@pytest.mark.parametrize("rule", ["trapezoidal", "tr_bdf2", "backward_euler"])
def test_both_sides_of_a_jump_are_recorded(rule):
    _, trace = run(regulated(), fault(R=0.02), rule=rule)
    states = [name for name in trace.columns if name.startswith("unit.G2.machine.")]
    for t in (0.2, 0.3):
        before, after = sides(trace, t)
        for name in states:
            assert trace[name][before] == trace[name][after], name
        assert abs(trace["bus.HV.v"][after] - trace["bus.HV.v"][before]) > 0.1
    assert np.all(np.diff(np.delete(trace.t, [sides(trace, t)[1] for t in (0.2, 0.3)])) > 0)


@pytest.mark.parametrize("bus", ["A", "B", "L"])
def test_a_bolted_fault_puts_exactly_zero_volts(bus):
    sim, trace = run(two_units(), fault(bus))
    on = (trace.t >= 0.2) & (trace.t <= 0.3)
    on[[sides(trace, 0.2)[0], sides(trace, 0.3)[1]]] = False
    assert np.all(trace[f"bus.{bus}.v"][on] <= 1e-10)  # the floor under the root of a magnitude
    sim.restart()
    sim.run(until=0.25)
    assert sim.get(f"bus.{bus}.v_re") == sim.get(f"bus.{bus}.v_im") == 0.0


@pytest.mark.parametrize(("R", "X"), [(0.02, 0.0), (0.0, 0.05), (0.01, 0.03)])
def test_a_fault_through_an_impedance_obeys_ohm(R, X):
    sim, _ = run(kobbelv(), fault(R=R, X=X))
    sim.restart()
    sim.run(until=0.25)
    v = complex(sim.get("bus.HV.v_re"), sim.get("bus.HV.v_im"))
    behind = {"T1": "G2", "L1": "INF"}
    there = {k: complex(sim.get(f"bus.{bus}.v_re"), sim.get(f"bus.{bus}.v_im")) for k, bus in behind.items()}
    into = (there["T1"] - v) / 0.12j + (there["L1"] - v) / 0.15j
    assert v == pytest.approx(into * complex(R, X), abs=1e-12)  # measured below 1e-15


def test_after_a_fault_the_network_is_as_before():
    sim, trace = run(kobbelv(), fault(duration=0.005), t_end=0.3)
    assert np.array_equal(sim.p[~np.isnan(sim.p)], sim.initial.p[~np.isnan(sim.initial.p)])
    assert trace["bus.HV.v"][-1] == pytest.approx(trace["bus.HV.v"][0], abs=0.01)


def test_a_line_trips_and_recloses():
    _, trace = run(two_units(), BranchTrip(type="line_trip", t=0.2, name="L3", reclose_after=0.1))
    out = (trace.t >= 0.2) & (trace.t <= 0.3)
    out[[sides(trace, 0.2)[0], sides(trace, 0.3)[1]]] = False
    for signal in ("p_from", "q_from", "p_to", "q_to"):
        flow = trace[f"line.L3.{signal}"]
        assert np.all(flow[out] == 0.0)
        assert np.all(flow[~out] != 0.0)
    assert np.allclose(trace["line.L3.p_from"][~out], trace["line.L4.p_from"][~out], rtol=0, atol=1e-12)
    assert [entry.text for entry in trace.log] == ["line L3 trips", "line L3 recloses"]


def test_tripping_and_closing_separately_is_the_same():
    together, _ = run(two_units(), BranchTrip(type="line_trip", t=0.2, name="L3", reclose_after=0.1))
    apart, _ = run(
        two_units(), BranchTrip(type="line_trip", t=0.2, name="L3"), BranchClose(type="line_close", t=0.3, name="L3")
    )
    assert np.array_equal(together.state.x, apart.state.x)


def test_a_transformer_trips():
    _, trace = run(kobbelv(), BranchTrip(type="transformer_trip", t=0.2, name="T1", reclose_after=0.05))
    before, after = sides(trace, 0.2)
    assert trace["unit.G2.p_e"][before] == pytest.approx(0.86)
    assert abs(trace["unit.G2.p_e"][after]) < 1e-10


@pytest.mark.parametrize(
    ("load", "exponent"), [(None, 2), (ConstantCurrent(P=150.0, Q=30.0), 1), (ConstantPower(P=150.0, Q=30.0), 0)]
)
def test_a_load_steps_at_its_initial_voltage(load, exponent):
    sim, trace = run(two_units(load=load), LoadStep(type="load_step", t=0.2, load="L", dP=-20.0, dQ=6.0))
    v = trace["bus.L.v"] / sim.get("load.L.v_0")
    stepped = np.arange(trace.t.size) >= sides(trace, 0.2)[1]
    for signal, start, change in (("p", 1.5, -0.2), ("q", 0.3, 0.06)):
        expected = (start + change * stepped) * v**exponent
        assert trace[f"load.L.{signal}"] == pytest.approx(expected, abs=1e-12)  # measured below 1e-15


def test_a_set_point_steps_by_and_a_parameter_is_set_to():
    sim, trace = run(
        regulated(),
        ParameterStep(type="setpoint", t=0.2, path="unit.G2.exciter.v_ref", step=0.02),
        ParameterStep(type="set", t=0.3, path="unit.G2.exciter.K_A", value=100.0),
        ParameterStep(type="parameter", t=0.3, path="unit.G2.exciter.K_A", step=-50.0),
    )
    v_ref = trace["unit.G2.exciter.v_ref"]
    assert v_ref[-1] == v_ref[0] + 0.02
    assert sim.get("unit.G2.exciter.K_A") == 50.0
    error = v_ref - trace["unit.G2.exciter.v_m"] + trace["unit.G2.v_s"]
    assert trace["unit.G2.exciter.v_a"][-1] == pytest.approx(50.0 * error[-1], abs=1e-9)
    assert trace["unit.G2.exciter.v_a"][0] == pytest.approx(200.0 * error[0], abs=1e-9)
    assert np.flatnonzero(np.abs(trace.t - 0.3) < 1e-9).size == 2  # before and after the two changes


def test_an_event_between_boundaries_waits_for_the_next():
    _, trace = run(kobbelv(), fault(t=0.2012, R=0.02))
    assert sides(trace, 0.205).size == 2
    assert sides(trace, 0.305).size == 2  # 0.3012, too
    assert trace.log[0].text.endswith("(asked for at t = 0.2012 s)")


@pytest.mark.parametrize("h", [0.001, 0.003, 0.005, 0.01, 1 / 120, 1 / 240])
def test_an_event_on_a_boundary_is_not_late(h):
    """Whatever the rounding of ``k h``."""
    boundaries = [round(t / h) * h for t in (0.1, 0.15, 0.2, 0.25)]
    changes = [Change(t, {"unit.G2.governor.p_m": 0.86}, "nothing changes") for t in boundaries]
    sim = Simulation(kobbelv(), Settings(0.3, h, compile="never"), changes)
    sim.run()
    assert [entry.t for entry in sim.trace().log] == pytest.approx(boundaries, abs=1e-12)
    assert not any("asked for" in entry.text for entry in sim.trace().log)


def test_an_event_at_the_start():
    _, trace = run(kobbelv(), fault(t=0.0, R=0.02))
    assert sides(trace, 0.0).size == 2
    assert trace["bus.HV.v"][1] < 0.6 * trace["bus.HV.v"][0]


def test_events_at_one_instant_apply_in_the_order_given():
    path = "unit.G2.exciter.e_fd_ref"
    changes = [
        Change(0.2, {path: 2.0}, "first"),
        Change(0.1, {path: 1.0}, "earlier"),
        Change(0.2, {}, "second", {path: 0.5}),
    ]
    sim = Simulation(kobbelv(), Settings(0.3, 0.005, compile="never"), changes)
    sim.run()
    assert sim.get(path) == 2.5
    assert [entry.text for entry in sim.trace().log] == ["earlier", "first", "second"]


@pytest.mark.parametrize("closes_first", [False, True])
def test_events_at_one_instant_need_a_solution_together_only(closes_first):
    """The only line to a load is swapped for another: in between there would be no voltage for it."""
    system = two_units(load=ConstantPower(P=150.0, Q=30.0))
    ends = {"from": "L", "to": "X"}
    extra = {"LX": Line(**ends, X=0.1), "LY": Line(**ends, X=0.1, status=0.0)}
    devices = tuple(replace(d, bus="X") if d.path == "load.L" else d for d in system.devices)
    system = replace(system, buses={**system.buses, "X": Bus()}, lines=system.lines | extra, devices=devices)
    swap = [BranchTrip(type="line_trip", t=0.2, name="LX"), BranchClose(type="line_close", t=0.2, name="LY")]
    _, trace = run(system, *(swap[::-1] if closes_first else swap))
    before, after = sides(trace, 0.2)
    assert trace["bus.X.v"][after] == pytest.approx(trace["bus.X.v"][before], abs=1e-9)  # the lines are alike
    assert len(trace.log) == 2


def test_events_that_refer_to_nothing_are_all_reported():
    changes = [
        Change(0.1, {"unit.G2.exciter.K_a": 1.0}, "misspelt"),
        Change(0.2, {"bus.HW.fault_status": 1.0}, "no such bus"),
        Change(0.3, {}, "no such load", {"load.L.P": 1.0}),
    ]
    with pytest.raises(ConfigError) as caught:
        Simulation(regulated(), Settings(1.0, compile="never"), changes)
    assert len(caught.value.problems) == 3
    message = str(caught.value)
    assert "unit.G2.exciter.K_A" in message
    assert "event at t = 0.2 s" in message


ADAPTER = TypeAdapter(Event)


@pytest.mark.parametrize(
    "bad",
    [
        {"type": "fault", "t": -1.0, "bus": "HV"},
        {"type": "fault", "t": 1.0, "bus": "HV", "R": -0.1},
        {"type": "fault", "t": 1.0, "bus": "HV", "duration": 0.0},
        {"type": "fault", "t": 1.0, "bus": "HV", "R": float("nan")},
        {"type": "line_trip", "t": 1.0, "name": "L1", "reclose_after": -1.0},
        {"type": "earthquake", "t": 1.0},
        {"type": "fault", "t": 1.0, "bus": "HV", "line": "L1"},
    ],
)
def test_malformed_events_are_refused(bad):
    with pytest.raises(ValidationError):
        ADAPTER.validate_python(bad)


@pytest.mark.parametrize("event", [{}, {"value": 1.0, "step": 1.0}])
def test_a_step_needs_a_value_or_a_step(event):
    problems = ParameterStep(type="set", t=0.0, path="x", **event).problems("event.0")
    assert [problem.path for problem in problems] == ["event.0"]
