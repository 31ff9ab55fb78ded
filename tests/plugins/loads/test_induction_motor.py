from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from component_harness import Bench
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from pgexcite.core.events import Change, Fault, LoadStep
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


def test_a_dip_against_the_flux_linkages_of_stator_and_rotor():
    """The voltage equations of stator and rotor without the stator's transients, integrated by another solver."""
    depth, back, t_end, h = 0.6, 0.4, 3.0, 0.002
    system = plant()
    system = replace(system, lines={}, buses={"B": Bus()}, devices=tuple(replace(d, bus="B") for d in system.devices))
    dip = [Change(t, {"infinite_bus.grid.v": v}, "dip") for t, v in ((0.1, depth), (0.1 + back, 1.0))]
    sim = Simulation(system, Settings(t_end, h), dip)
    begin = dict(zip(sim.model.x_names, sim.state.x, strict=True))
    t_0 = dict(zip(sim.model.p_names, sim.p, strict=True))[f"{SLOT}.t_0"]
    assert sim.run().ending.value == "completed"
    m, omega_0 = MOTOR, 2 * np.pi * 50
    X_ss, X_rr = m.X_s + m.X_m, m.X_r + m.X_m

    def currents(psi_r, v):
        """Of stator and rotor, from the stator's voltage and psi_r = X_rr i_r + X_m i_s."""
        i_s = (v - 1j * m.X_m / X_rr * psi_r) / (m.R_s + 1j * (X_ss - m.X_m**2 / X_rr))
        return i_s, (psi_r - m.X_m * i_s) / X_rr

    def slope(t, x, v):
        psi_r, omega = complex(x[0], x[1]), x[2]
        i_s, i_r = currents(psi_r, v)
        moving = -omega_0 * (m.R_r * i_r + 1j * (1 - omega) * psi_r)
        t_e = (np.conj(X_ss * i_s + m.X_m * i_r) * i_s).imag
        return [moving.real, moving.imag, (t_e - t_0 * omega**m.m) / (2 * m.H)]

    e = complex(begin[f"{SLOT}.e_re"], begin[f"{SLOT}.e_im"])
    psi_r = e * X_rr / (1j * m.X_m)
    x, trace = [psi_r.real, psi_r.imag, begin[f"{SLOT}.omega_m"]], sim.trace()
    for start, stop, v in ((0.0, 0.1, 1.0), (0.1, 0.1 + back, depth), (0.1 + back, t_end, 1.0)):
        inside = (trace.t > start + h / 2) & (trace.t < stop - h / 2)
        found = solve_ivp(slope, (start, stop), x, args=(v,), rtol=1e-10, atol=1e-12, t_eval=[*trace.t[inside], stop])
        x = found.y[:, -1]
        assert np.abs(found.y[2, :-1] - trace[f"{SLOT}.omega_m"][inside]).max() < 1e-5  # measured 1.5e-6
        p = [(v * np.conj(currents(complex(a, b), v)[0])).real * 0.6 for a, b, _ in found.y[:, :-1].T]
        assert np.abs(p - trace[f"{SLOT}.p"][inside]).max() < 1e-4  # measured 2.8e-5
    assert trace[f"{SLOT}.omega_m"].min() < 0.95  # the dip is deep enough to matter


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
