from __future__ import annotations

import numpy as np
import pytest
from component_harness import Bench
from pydantic import ValidationError

from pgexcite.core.events import Fault, LoadStep
from pgexcite.core.initialise import initialise
from pgexcite.core.linearise import linearise
from pgexcite.core.network import Bus, Line
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.loads.induction_motor import InductionMotor
from pgexcite.plugins.sources.infinite_bus import InfiniteBus

MOTOR = InductionMotor(P=40.0, Q=10.0, S_m=60.0)
SLOT = "load.M"


def plant(motor=MOTOR, X=0.1):
    return System(
        S_base=100.0,
        f_n=50.0,
        buses={"INF": Bus(), "B": Bus()},
        lines={"L1": Line(**{"from": "INF", "to": "B"}, X=X)},
        devices=(
            Device("infinite_bus.grid", "INF", 100.0, {"": InfiniteBus()}, Schedule(V=1.0, angle=0.0)),
            Device(SLOT, "B", 100.0, {"": motor}, Schedule(P=-motor.P, Q=-motor.Q)),
        ),
    )


def equivalent_circuit(motor, v, slip):
    """Power into the motor, pu of its base, from Kundur's figure 7.7."""
    rotor = motor.R_r / slip + 1j * motor.X_r
    z = motor.R_s + 1j * motor.X_s + 1j * motor.X_m * rotor / (1j * motor.X_m + rotor)
    return v * np.conj(v / z)


def test_steady_state_is_the_equivalent_circuit():
    initial = initialise(plant())
    assert initial.residual < 1e-10
    value = dict(zip(initial.model.x_names, initial.state.x, strict=True))
    constant = dict(zip(initial.model.p_names, initial.p, strict=True))
    s = equivalent_circuit(MOTOR, initial.flow.v["B"], 1 - value[f"{SLOT}.omega_m"])
    assert s.real * 60.0 == pytest.approx(40.0, rel=1e-9)
    v = abs(initial.flow.v["B"])
    assert (s.imag * 0.6 - constant[f"{SLOT}.b_0"] * v**2 + 0.1) * 100 == pytest.approx(10.0, rel=1e-9)
    assert constant[f"{SLOT}.t_0"] > 0


def test_jacobian_matches_finite_differences():
    point = {
        "v_re": 0.97,
        "v_im": -0.1,
        "omega_m": 0.97,
        "e_re": 0.85,
        "e_im": -0.25,
        "t_0": 0.6,
        "p_0": 40.0,
        "v_0": 1.0,
        "b_0": 0.2,
    }
    assert Bench(MOTOR).jacobian_error(point) < 1e-7


def test_it_is_stable_beyond_its_pull_out_it_stalls():
    initial = initialise(plant())
    assert linearise(initial.model, initial.state, initial.p).eigenvalues().real.max() < 0

    def after_fault(duration):
        fault = Fault(type="fault", t=0.1, bus="B", duration=duration)
        sim = Simulation(plant(X=0.3), Settings(5.0, 0.005), fault.changes())
        assert sim.run().ending.value == "completed"
        return sim.trace()[f"{SLOT}.p"], sim.get(f"{SLOT}.omega_m")

    assert after_fault(0.1)[1] == pytest.approx(0.985, abs=0.01)
    p, speed = after_fault(1.5)
    assert speed < 0.6  # stalled, and drawing a short circuit's current
    assert np.isfinite(p).all()


def test_load_steps_move_torque_and_capacitor():
    step = LoadStep(type="load_step", t=0.1, load="M", dP=8.0, dQ=-5.0)
    sim = Simulation(plant(X=0.001), Settings(8.0, 0.005), step.changes())
    sim.run()
    trace = sim.trace()
    motor = sim.model.position("x", f"{SLOT}.omega_m")
    slip = 1 - sim.state.x[motor]
    v = trace["bus.B.v"][-1]
    s = equivalent_circuit(MOTOR, v, slip)
    assert trace[f"{SLOT}.p"][-1] == pytest.approx(0.6 * s.real, rel=1e-6)
    assert trace[f"{SLOT}.p"][-1] == pytest.approx(0.48, rel=0.02)  # torque times a speed that hardly changed
    at_step = np.searchsorted(trace.t, 0.1)
    q = trace[f"{SLOT}.q"]
    assert q[at_step + 1] - q[at_step] == pytest.approx(-0.05, abs=1e-3)


def test_no_load_speed_follows_the_frame():
    """The slip counts from the network's frame: with the reference 1 % fast the same slip means 1 % more speed."""
    point = {
        "v_re": 1.0,
        "v_im": 0.0,
        "omega_m": 0.98,
        "e_re": 0.9,
        "e_im": -0.2,
        "t_0": 0.5,
        "p_0": 40.0,
        "v_0": 1.0,
        "b_0": 0.2,
    }
    bench = Bench(MOTOR)
    same = bench(point | {"omega_ref": 1.01, "omega_m": 0.99}).rhs
    assert bench(point).rhs["e_re"] == pytest.approx(same["e_re"])


def test_a_motor_smaller_than_its_power_is_refused():
    with pytest.raises(ValidationError, match=r"S_m = 30.0 MVA is too small"):
        InductionMotor(P=40.0, S_m=30.0)
