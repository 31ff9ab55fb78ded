"""Events that wait for a condition: when it comes true, what happens then, and that a snapshot knows of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plants import kobbelv, regulated

from pgexcite.core.config import from_data, load
from pgexcite.core.errors import ConfigError
from pgexcite.core.events import BranchTrip, Fault, HandOver, ParameterStep, When
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.trace import Ending
from pgexcite.plugins.controllers.mpc import MPC
from pgexcite.plugins.transfers.field import FieldTransfer

CONFIG = Path(__file__).parents[2] / "configs" / "smib" / "fault_constant.toml"
H = 0.005
FAULT = Fault(type="fault", t=0.5, bus="HV", R=0.02, duration=0.1)


def simulation(*events, system=None, t_end=2.0, controllers=None, rule="tr_bdf2"):
    changes = [change for event in events for change in event.changes()]
    return Simulation(system or kobbelv(), Settings(t_end, H, rule, "never"), changes, controllers)


def raised(signal="unit.G2.v_t", t=None, value=1.9, **condition):
    """The field voltage is set when the condition comes true."""
    return ParameterStep(
        type="set", t=t, path="unit.G2.exciter.e_fd_ref", value=value, when=When(signal=signal, **condition)
    )


def moved_at(sim):
    trace = sim.trace()
    e_fd = trace["unit.G2.exciter.e_fd_ref"]
    return trace.t[np.flatnonzero(np.diff(e_fd))]


@pytest.mark.parametrize("rule", ["tr_bdf2", "trapezoidal"])
def test_it_comes_true_after_the_first_step_beyond_the_threshold(rule):
    sim = simulation(FAULT, raised(below=0.9), rule=rule)
    sim.run()
    assert moved_at(sim) == pytest.approx([0.505])
    log = [entry.text for entry in sim.trace().log if entry.kind == "event"]
    assert log[1] == "unit.G2.exciter.e_fd_ref set to 1.9, for unit.G2.v_t below 0.9"


def test_a_rising_signal_a_delay_and_a_time_to_stay():
    free = simulation(FAULT)
    free.run()
    trace = free.trace()
    beyond = trace.t[trace["unit.G2.delta"] > 0.9]
    first = beyond[0]
    cases = {"at once": {}, "lasting": {"lasting": 0.05}}
    for lasting in cases.values():
        sim = simulation(FAULT, raised("unit.G2.delta", t=0.1, above=0.9, **lasting))
        sim.run()
        assert moved_at(sim) == pytest.approx([first + 0.1 + lasting.get("lasting", 0.0)])


def test_what_does_not_last_does_not_count():
    sim = simulation(FAULT, raised(below=0.9, lasting=0.2))
    sim.run()
    assert moved_at(sim).size == 0


def test_it_may_be_looked_at_from_a_time_on():
    sim = simulation(raised(above=0.9, lasting=0.1, after=0.7))
    sim.run()
    assert moved_at(sim) == pytest.approx([0.8])


def test_it_comes_true_once():
    again = Fault(type="fault", t=1.2, bus="HV", R=0.02, duration=0.1)
    sim = simulation(FAULT, again, raised(below=0.9))
    sim.run()
    assert len(moved_at(sim)) == 1


def test_a_relay_trips_a_line_and_recloses_it():
    relay = BranchTrip(type="line_trip", name="L1", reclose_after=0.3, t=0.05, when=When(signal="bus.HV.v", below=0.5))
    sim = simulation(FAULT, relay, system=regulated())
    sim.run(until=0.6)
    assert sim.get("line.L1.status") == 0.0
    sim.run(until=0.9)
    assert sim.get("line.L1.status") == 1.0
    texts = [f"{entry.t:.3f} {entry.text}" for entry in sim.trace().log if entry.kind == "event"]
    assert texts == [
        "0.500 three-phase fault at bus HV (R = 0.02, X = 0 pu)",
        "0.555 line L1 trips, for bus.HV.v below 0.5",
        "0.600 fault at bus HV cleared",
        "0.855 line L1 recloses, for bus.HV.v below 0.5",
    ]


def test_control_passes_by_a_condition_and_back_by_another_without_a_bump():
    """A fault's undervoltage calls the predictive controller, and a second of good voltage sends it back."""
    system = regulated(transfer=FieldTransfer(V_RMIN=-3.85, V_RMAX=3.85))
    low = When(signal="unit.G2.v_t", below=0.8)
    called = HandOver(type="hand_over", controller="mpc", to="controller", when=low)
    sent = HandOver(type="hand_over", t=2.0, controller="mpc", to="classical", when=low)
    sim = simulation(FAULT, called, sent, system=system, t_end=4.0, controllers={"mpc": MPC(unit="G2", active=False)})
    assert sim.run().ending is Ending.COMPLETED
    trace = sim.trace()
    notes = {entry.text: entry.t for entry in trace.log if entry.kind == "controller"}
    assert notes["mpc: takes charge"] == pytest.approx(0.55)  # its first sample in the fault
    assert notes["mpc: hands over to the classical controller, as told"] == pytest.approx(2.55)
    around = np.abs(trace.t - 2.55) < 2.5 * H
    assert np.abs(np.diff(trace["unit.G2.e_fd"][around])).max() < 0.05  # measured 0.01
    assert trace["controller.mpc.active"][-1] == 0.0


@pytest.mark.parametrize("pause", [0.3, 0.53, 0.58, 0.7])
def test_a_resumed_run_goes_on_the_same(pause, tmp_path):
    """Before the condition holds, while it lasts, between its coming true and its change, and after it."""
    events = (FAULT, raised(t=0.1, below=0.9, lasting=0.05))
    whole = simulation(*events)
    whole.run(until=pause)
    whole.save(tmp_path / "at.npz")
    whole.run()
    resumed = simulation(*events)
    resumed.resume(tmp_path / "at.npz")
    resumed.run()
    assert np.array_equal(resumed.state.x, whole.state.x)
    assert moved_at(whole) == pytest.approx([0.655])  # first seen at 0.505


def test_a_resumed_run_may_wait_for_other_conditions(tmp_path):
    """What came true stays so under its own condition; one that is new has never held."""
    one, other = raised(below=0.9), raised(value=1.8, above=0.9, after=0.65, lasting=0.05)
    before = simulation(FAULT, one)
    before.run(until=0.58)
    before.save(tmp_path / "at.npz")
    resumed = simulation(FAULT, other, one)
    resumed.resume(tmp_path / "at.npz")
    whole = simulation(FAULT, one, other)
    for run in (resumed, whole):
        run.run()
    assert moved_at(whole).size == 2
    assert moved_at(resumed) == pytest.approx(moved_at(whole)[-1:])


def test_a_restart_forgets_what_came_true():
    sim = simulation(FAULT, raised(below=0.9))
    sim.run()
    x = sim.state.x.copy()
    sim.restart()
    sim.run()
    assert np.array_equal(sim.state.x, x)
    sim.restart(FAULT.changes())
    sim.run()
    assert moved_at(sim).size == 0


def test_chunks_and_pauses_do_not_matter():
    paused = simulation(FAULT, raised(below=0.9, lasting=0.05))
    for until in (0.51, 0.52, 0.545, 2.0):
        paused.run(until=until)
    assert moved_at(paused) == pytest.approx([0.555])


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ({"type": "set", "path": "unit.G2.exciter.e_fd_ref", "value": 1.9}, r"event\.0\.t: is required"),
        (
            {"type": "set", "path": "unit.G2.exciter.e_fd_ref", "value": 1.9, "when": {"signal": "bus.HV.v"}},
            r"event\.0\.when: exactly one of below and above",
        ),
        (
            {
                "type": "set",
                "path": "unit.G2.exciter.e_fd_ref",
                "value": 1.9,
                "when": {"signal": "bus.HV.v", "under": 0.9},
            },
            r"event\.0\.when\.under: unknown key",
        ),
    ],
)
def test_what_is_wrong_with_a_condition_is_said(event, message):
    data = dict(load(CONFIG).resolved) | {"event": [event]}
    with pytest.raises(ConfigError, match=message):
        from_data(data)


def test_a_signal_that_does_not_exist_is_named():
    with pytest.raises(ConfigError, match=r"unit\.G2\.vt: no such output.*nearest: unit\.G2\.v_t"):
        simulation(raised("unit.G2.vt", below=0.9))
