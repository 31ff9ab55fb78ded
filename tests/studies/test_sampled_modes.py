"""The map over a sample against closed forms, and against the swings of the very loop."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from plants import kobbelv, push, regulated

from pgexcite.core.controller import Action
from pgexcite.core.errors import PgexciteError
from pgexcite.core.events import Change, When
from pgexcite.core.linearise import linearise
from pgexcite.core.measurement import Measurement
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.stage import ALPHA, BETA, GAMMA
from pgexcite.core.trace import Ending
from pgexcite.plugins.controllers.mpc import MPC
from pgexcite.studies.ringdown import mode_near, ringdown_modes
from pgexcite.studies.sampled_modes import CARRIED, sampled_modes

H = 0.005


def simulation(system=None, h=H, t_end=6.0, **controllers):
    return Simulation(system or kobbelv(), Settings(t_end, h, "tr_bdf2", "never"), (), controllers)


def linearised(sim):
    return linearise(sim.model, sim.state, sim.p)


def tr_bdf2(z):
    """What a step of TR-BDF2 makes of ``x' = lambda x``, ``z = lambda h``."""
    half = GAMMA * z / 2
    return (ALPHA * (1 + half) / (1 - half) - BETA) / (1 - half)


def distance(found, expected):
    """Largest distance of one of ``expected`` from the nearest of ``found``."""
    return max(np.abs(np.asarray(found) - value).min() for value in expected)


@pytest.mark.parametrize("system", [kobbelv, regulated])
def test_without_control_it_is_the_rule_of_the_steps(system):
    """To rounding: ``mu = R(lambda h)^n`` for every eigenvalue of the linearised plant."""
    sim = simulation(system())
    exact = linearised(sim).eigenvalues()
    loop = sampled_modes(sim, 0.1)
    assert distance(loop.multipliers, tr_bdf2(exact * H) ** 20) < 1e-7  # measured 9e-10, 3e-9
    swing = exact[np.argmax(exact.imag * (exact.imag < 15))]
    found = [mode.eigenvalue for mode in loop.modes()]
    assert distance(found, [swing]) < 2e-3  # measured 6e-4, 4e-4


def test_the_trapezoidal_rule_has_no_step_of_another_rule_in_it():
    sim = Simulation(kobbelv(), Settings(6.0, H, "trapezoidal", "never"))
    half = linearised(sim).eigenvalues() * H / 2
    assert distance(sampled_modes(sim, 0.1).multipliers, ((1 + half) / (1 - half)) ** 20) < 1e-7  # measured 9e-10


def test_it_tends_to_the_modes_of_continuous_time_with_the_step():
    errors = []
    for h in (0.01, 0.005, 0.0025):
        sim = simulation(h=h)
        swing = next(m for m in linearised(sim).modes() if m.eigenvalue.imag > 1)
        nearest = min(sampled_modes(sim, 0.1).modes(), key=lambda m: abs(m.eigenvalue - swing.eigenvalue))
        errors.append(abs(nearest.eigenvalue - swing.eigenvalue))
        assert list(nearest.participation)[:2] == list(swing.participation)[:2]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.05)


@dataclass(frozen=True)
class _Integral:
    """A sampled integral controller of the terminal voltage, as a controller and as its own session."""

    gain: float
    dt: float = 0.1
    information: str = "measured"
    measurement: Measurement = field(default_factory=Measurement)
    active: bool = True
    disturbance_known: bool = False

    def measures(self):
        return ("unit.G2.v_t",)

    def start(self, surroundings, plant):
        return _Integrating(self.gain, surroundings.u_0["unit.G2.exciter.e_fd_ref"], surroundings.y_0["unit.G2.v_t"])


class _Integrating:
    def __init__(self, gain, u, v_ref):
        self.gain, self.u, self.v_ref = gain, u, v_ref

    def act(self, sample):
        self.u += self.gain * (self.v_ref - sample.measured["unit.G2.v_t"])
        return Action({"unit.G2.exciter.e_fd_ref": float(self.u)})

    def prepare(self):
        pass

    def memory(self):
        return {"u": np.array(self.u), "v_ref": np.array(self.v_ref)}

    def recall(self, memory):
        self.u, self.v_ref = float(memory["u"]), float(memory["v_ref"])


def over_a_sample(sim):
    """``x+ = Phi x + Gamma u`` by TR-BDF2's steps, and ``v_t = C x``."""
    at = linearised(sim)
    command, voltage = at.u_names.index("unit.G2.exciter.e_fd_ref"), at.y_names.index("unit.G2.v_t")
    n = len(at.x_names)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = at.A, at.B[:, command]
    half = np.linalg.inv(np.eye(n + 1) - GAMMA * H / 2 * whole)
    step = half @ (ALPHA * half @ (np.eye(n + 1) + GAMMA * H / 2 * whole) - BETA * np.eye(n + 1))
    over = np.linalg.matrix_power(step, 20)
    assert at.D[voltage, command] == 0
    return over[:n, :n], over[:n, n:], at.C[voltage : voltage + 1]


def test_a_sampled_controller_in_closed_form():
    """``u+ = u - k C x``, ``x+ = Phi x + Gamma u+``."""
    gain = 2.0
    sim = simulation(integral=_Integral(gain))
    Phi, Gamma, C = over_a_sample(sim)
    closed = np.block([[Phi - gain * Gamma @ C, Gamma], [-gain * C, np.ones((1, 1))]])
    loop = sampled_modes(sim, 0.1)
    assert loop.names[-1] == "controller.integral.u.0"
    assert distance(loop.multipliers, np.linalg.eigvals(closed)) < 1e-7  # measured 1.2e-9
    assert loop.defect < 1e-9  # measured 7e-14


def test_a_delayed_measurement_in_closed_form():
    """``m+ = C x``, ``u+ = u - k m``, ``x+ = Phi x + Gamma u+``: the delay is a state."""
    gain = 2.0
    sim = simulation(integral=_Integral(gain, measurement=Measurement(delay=1)))
    with pytest.raises(PgexciteError, match="not yet been taken"):
        sampled_modes(sim, 0.1)
    sim.run(until=0.1)
    Phi, Gamma, C = over_a_sample(sim)
    none, one = np.zeros_like(C), np.ones((1, 1))
    closed = np.block([[Phi, Gamma, -gain * Gamma], [none, one, -gain * one], [C, 0 * one, 0 * one]])
    loop = sampled_modes(sim, 0.1)
    assert loop.names[-1] == "controller.integral.instruments.0"
    assert distance(loop.multipliers, np.linalg.eigvals(closed)) < 1e-7  # measured 3e-9


@pytest.mark.parametrize("delayed", [False, True])
@pytest.mark.parametrize(("backend", "options"), [("nmpc", {"tolerance": 1e-9}), ("linear", {"relinearise": "once"})])
def test_predictive_control_swings_as_the_map_says(backend, options, delayed):
    mpc = MPC(unit="G2", backend=backend, options=options, N_p=10, N_c=3, dt=0.1, delayed=delayed)
    sim = simulation(mpc=mpc, t_end=20.0)
    sim.run(until=10.0)
    loop = sampled_modes(sim, 0.1)
    swing = next(m for m in loop.modes() if 1.0 < m.frequency_hz < 2.0)
    push(sim, "unit.G2.machine.delta", 1e-3)
    sim.run()
    trace = sim.trace()
    t = np.arange(11.0, 17.0, 0.02)
    found = mode_near(ringdown_modes(t, np.interp(t, trace.t, trace["unit.G2.delta"])), (1.0, 2.0))
    assert found.eigenvalue == pytest.approx(swing.eigenvalue, abs=5e-4)  # measured 8.6e-5 at most


LOOPS = {
    "integral": _Integral(2.0),
    "integral, delayed": _Integral(2.0, measurement=Measurement(delay=2)),
    "nmpc": MPC(unit="G2", dt=0.1, options={"tolerance": 1e-9}),
    "linear": MPC(unit="G2", dt=0.1, backend="linear"),
    "equivalent": MPC(unit="G2", dt=0.1, backend="equivalent"),
}


@pytest.mark.parametrize("loop", LOOPS)
def test_the_simulation_goes_on_as_if_it_had_not_been_asked(loop):
    """Bit for bit, with a voltage low for some time, an event still waiting, and one due; and nothing is recorded of it."""
    settings = Settings(2.0, H, "tr_bdf2", "never", collapse_below=1.2, collapse_after=1.9)
    waiting = When(signal="unit.G2.v_t", above=0.5, lasting=1.2)
    changes = [
        Change(1.1, {"infinite_bus.grid.v": 0.97}, "lower"),
        Change(0.1, {"infinite_bus.grid.v": 0.99}, "higher again", when=waiting),
    ]
    asked, left = (Simulation(kobbelv(), settings, changes, {"mpc": LOOPS[loop]}) for _ in range(2))
    for sim in (asked, left):
        sim.run(until=1.0)
    before, t, log = asked.memory(), asked.trace().t, asked.trace().log
    outcome, spent = asked.outcome, asked.wall_time
    sampled_modes(asked, 0.1, size=1e-4, carried=(*CARRIED, "solver:observer:x"))
    after = asked.memory()
    assert after.state is before.state
    assert all(np.array_equal(value, after.kept[key], equal_nan=True) for key, value in before.kept.items())
    assert (asked.outcome, asked.wall_time) == (outcome, spent)
    assert np.array_equal(asked.trace().t, t)
    assert asked.trace().log == log
    for sim in (asked, left):
        sim.run()
    assert asked.outcome == left.outcome
    assert asked.outcome.ending is Ending.VOLTAGE_COLLAPSE
    one, other = asked.trace(), left.trace()
    assert one.log == other.log
    assert "higher again" in " ".join(entry.text for entry in one.log)
    assert one.columns.keys() == other.columns.keys()
    for path in one.columns:
        if not path.endswith("_ms"):
            assert np.array_equal(one[path], other[path], equal_nan=True), path


@pytest.mark.parametrize("imperfection", [{"noise": 0.01}, {"noise_omega": 1e-4}, {"loss": 0.1}])
def test_measurements_that_are_chance_have_no_map(imperfection):
    sim = simulation(integral=_Integral(2.0, measurement=Measurement(**imperfection)))
    with pytest.raises(PgexciteError, match=r"controller\.integral\.measurement: its noise and losses"):
        sampled_modes(sim, 0.1)


def test_an_estimate_that_is_not_carried_is_not_left_out_without_a_word():
    sim = simulation(mpc=LOOPS["equivalent"])
    with pytest.raises(PgexciteError, match=r"controller\.mpc: carries an estimate on .* \('solver:observer:x'\)"):
        sampled_modes(sim, 0.1)


def test_what_is_no_sample_of_a_loop_at_rest_is_refused():
    sim = simulation(integral=_Integral(2.0))
    with pytest.raises(PgexciteError, match=r"multiples of the controllers' 0.1 s"):
        sampled_modes(sim, 0.05)
    push(sim, "unit.G2.machine.omega", 1e-3)
    with pytest.raises(PgexciteError, match="not a point of rest"):
        sampled_modes(sim, 0.1)
