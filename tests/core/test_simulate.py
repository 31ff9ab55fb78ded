"""A run: going on, going back, changing things in the middle, the angle reference, and C against the virtual machine."""

from __future__ import annotations

import numpy as np
import pytest
from plants import kobbelv, regulated, two_units

from pgexcite.core.errors import ConfigError
from pgexcite.core.events import Change, Fault
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.controllers.mpc import MPC

FAULT = Fault(type="fault", t=0.2, bus="HV", R=0.02, duration=0.1).changes()
AT_A = Fault(type="fault", t=0.2, bus="A", duration=0.1).changes()
V_REF = "unit.G2.exciter.v_ref"


def simulation(system=None, changes=FAULT, t_end=1.0, h=0.005, rule="tr_bdf2", compile="never", controllers=None):
    return Simulation(system or regulated(), Settings(t_end, h, rule, compile), changes, controllers)


def assert_same(a, b):
    for name in a.columns:
        assert np.array_equal(a[name], b[name], equal_nan=True), name
    assert np.array_equal(a.t, b.t)


# Going on and going back.


def test_a_run_in_parts_is_the_same_run():
    whole, parts = simulation(), simulation()
    whole.run()
    for until in (0.1, 0.2, 0.21, 0.3, 0.3, 0.7, 1.0):
        assert parts.run(until=until).ending.value == "completed"
        assert parts.state.t == pytest.approx(until)
    assert_same(whole.trace(), parts.trace())


def test_restart_goes_back_and_takes_other_events():
    sim = simulation()
    sim.run()
    first = sim.trace()
    sim.set(V_REF, 1.05)
    sim.restart()
    sim.run()
    assert_same(first, sim.trace())
    sim.restart([])
    sim.run()
    assert np.abs(sim.state.x - sim.initial.state.x).max() < 1e-11  # measured 5e-13
    assert sim.trace().log == ()


def test_samples_start_at_zero_and_are_a_step_apart():
    sim = simulation(changes=())
    sim.run()
    trace = sim.trace()
    assert trace.t == pytest.approx(np.arange(201) * 0.005, abs=1e-12)
    assert trace.units[V_REF] == "pu"
    assert trace.units["unit.G2.delta"] == "rad"


def test_progress_is_told_the_time():
    times = []
    simulation(t_end=6.0, changes=()).run(progress=times.append)
    assert times == sorted(times)
    assert times[-1] == pytest.approx(6.0)


def test_the_run_as_a_record():
    sim = simulation()
    sim.run()
    result = sim.result("a title", {"simulation": {"h": 0.005}})
    assert (result.title, result.steps, result.outcome.ending.value) == ("a title", 200, "completed")
    assert result.wall_time > 0
    assert result.config["simulation"] == {"h": 0.005}


# In the middle of a run, from Python.


def test_get_finds_every_kind_of_quantity():
    sim = simulation()
    sim.run(until=0.25)
    trace = sim.trace()
    assert sim.get("unit.G2.machine.H") == 2.9
    assert sim.get(V_REF) == trace[V_REF][-1]
    assert sim.get("unit.G2.machine.delta") == trace["unit.G2.machine.delta"][-1]
    assert sim.get("unit.G2.v_t") == trace["unit.G2.v_t"][-1]
    assert abs(complex(sim.get("bus.HV.v_re"), sim.get("bus.HV.v_im"))) == pytest.approx(trace["bus.HV.v"][-1])
    with pytest.raises(KeyError, match=r"unit\.G2\.v_t"):
        sim.get("unit.G2.vt")


@pytest.mark.parametrize(
    "path", [V_REF, "unit.G2.exciter.K_A", "unit.G2.machine.H", "line.L1.X", "infinite_bus.grid.v"]
)
def test_set_is_the_same_as_an_event(path):
    """A command, a gain, an inertia, a reactance, a source: nothing is compiled again."""
    untouched, by_hand = simulation(), simulation()
    untouched.run()
    value = 1.02 * by_hand.get(path)
    by_hand.run(until=0.15)
    by_hand.set(path, value)
    by_hand.run()
    by_event = simulation(changes=[*FAULT, Change(0.15, {path: value}, "as an event")])
    by_event.run()
    assert_same(by_hand.trace(), by_event.trace())
    assert by_hand.trace().log[0].text == f"{path} set to {value:g}"
    assert np.count_nonzero(np.abs(by_hand.trace().t - 0.15) < 1e-9) == 2
    assert np.abs(by_hand.state.x - untouched.state.x).max() > 1e-4


def test_set_refuses_what_is_not_there_or_cannot_be_set():
    sim = simulation()
    for path in ("unit.G2.exciter.K_a", "unit.G2.machine.delta", "bus.HV.v"):
        with pytest.raises(KeyError):
            sim.set(path, 1.0)
    assert sim.trace().log == ()


@pytest.mark.parametrize(
    ("path", "value", "error", "expected"),
    [
        ("unit.G2.exciter.vref", 1.0, KeyError, "did you mean 'unit.G2.exciter.v_ref'"),
        (V_REF, np.nan, ValueError, "should be a finite number"),
        ("unit.G2.machine.H", 0.0, ValueError, r"unit.G2.machine.H: should be greater than 0 \(got 0.0\)"),
        ("line.L1.X", np.inf, ValueError, "should be a finite number"),
    ],
)
def test_set_refuses_what_a_configuration_could_not_say(path, value, error, expected):
    sim = simulation()
    with pytest.raises(error, match=expected):
        sim.set(path, value)
    assert sim.trace().log == ()


def test_a_time_constant_of_zero_in_the_middle_of_a_run():
    """Mass becomes zero without a new model; the transducer's state then is its input."""
    sim = simulation(changes=())
    sim.run(until=0.1)
    sim.set("unit.G2.exciter.T_R", 0.0)
    for change in FAULT:
        sim.set(next(iter(change.values)), next(iter(change.values.values())))
    sim.run(until=0.3)
    trace = sim.trace()
    after = trace.t > 0.1
    assert np.abs(trace["unit.G2.exciter.v_m"] - trace["unit.G2.v_t"])[after].max() < 1e-9  # measured below 1e-15


def test_a_loop_closed_from_outside():
    """Anyone may be the controller: read, decide, set, go on."""
    sim = simulation(kobbelv(), ())
    for k in range(200):
        sim.run(until=0.005 * (k + 1))
        sim.set("unit.G2.exciter.e_fd_ref", 1.9246 + 20.0 * (1.02 - sim.get("unit.G2.v_t")))
    assert sim.get("unit.G2.v_t") > 1.01


# The angle reference.


@pytest.mark.parametrize(
    ("grid", "references"), [(True, ("G1", "G2", "centre_of_inertia")), (False, ("G2", "centre_of_inertia"))]
)
def test_the_reference_changes_no_relative_angle_and_no_voltage(grid, references):
    def relative(reference):
        sim = simulation(two_units(reference, grid=grid), AT_A, t_end=2.0)
        assert sim.run().ending.value == "completed"
        trace = sim.trace()
        frame = trace["infinite_bus.grid.theta"] if grid else trace["unit.G1.delta"]
        angles = [trace[f"unit.{name}.delta"] - frame for name in ("G1", "G2")]
        angles.append(trace["bus.L.angle"] - frame)
        return np.array([*angles, trace["bus.L.v"], trace["unit.G1.omega"], trace["unit.G2.p_e"]])

    expected = relative("infinite_bus" if grid else "G1")
    for reference in references:
        assert np.abs(relative(reference) - expected).max() < 1e-10, reference  # measured 1.4e-13


def test_the_reference_itself_stands_still():
    sim = simulation(two_units("G2"), AT_A)
    sim.run()
    assert np.ptp(sim.trace()["unit.G2.delta"]) < 1e-12  # measured 2e-15
    sim = simulation(two_units("centre_of_inertia", grid=False), AT_A)
    sim.run()
    trace = sim.trace()
    centre = 650.0 * trace["unit.G1.delta"] + 2.9 * 175 * trace["unit.G2.delta"]
    assert np.ptp(centre) < 1e-9  # measured 2e-11


# C and the virtual machine.


@pytest.mark.parametrize("rule", ["trapezoidal", "tr_bdf2", "backward_euler"])
@pytest.mark.parametrize(
    ("system", "changes"),
    [
        pytest.param(regulated(), FAULT, id="one_unit"),
        pytest.param(two_units(grid=False), AT_A, id="two_units"),
    ],
)
def test_compiled_and_interpreted_runs_agree(rule, system, changes):
    traces = []
    for compile in ("never", "always"):
        sim = simulation(system, changes, rule=rule, compile=compile)
        assert sim.kernel.compiled is (compile == "always")
        sim.run()
        traces.append(sim.trace())
    for name in traces[0].columns:
        assert np.abs(traces[0][name] - traces[1][name]).max() < 1e-9, name  # measured 0: the same bits


# Controllers.


@pytest.mark.parametrize("dt", [0.0125, 0.004, 0.001])
def test_a_sample_time_that_is_no_multiple_of_the_step(dt):
    with pytest.raises(ConfigError, match=r"controller\.mpc\.dt.*whole multiple of the step 0\.005 s"):
        simulation(kobbelv(), (), controllers={"mpc": MPC(unit="G2", dt=dt)})


# Snapshots.


def test_resume_takes_up_other_events(tmp_path):
    """A point of one run is the start of another: what lies before it is past, what lies behind it is to come."""
    first = simulation()
    first.run(until=0.5)
    first.save(tmp_path / "point.npz")
    step = Change(0.7, {V_REF: 1.05}, "step")
    other = simulation(changes=[step])
    other.resume(tmp_path / "point.npz")
    other.run()
    straight = simulation(changes=[*FAULT, step])
    straight.run()
    assert np.array_equal(other.state.x, straight.state.x)
    assert [entry.text for entry in other.trace().log] == ["step"]
