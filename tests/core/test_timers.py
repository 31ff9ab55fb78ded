"""Timers against exact switching times, where a threshold is crossed within a step."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
from automaton import Automaton
from plants import voltage_problem
from tapped import plant, source

from pgexcite.core.controller import Plant, Surroundings
from pgexcite.core.errors import ConfigError
from pgexcite.core.prediction import Predictor
from pgexcite.core.rollout import Horizon
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.step import Kernel
from pgexcite.plugins.limiters.oel import OEL
from pgexcite.plugins.limiters.scl import SCL
from pgexcite.plugins.loads.exponential import AdditiveRecovery
from pgexcite.plugins.mpc_backends.nmpc import NMPC
from pgexcite.plugins.tap_changers.oltc import OLTC

TAP = "transformer.T1.tap_changer"
RULES = ["tr_bdf2", "trapezoidal"]
EDGES = [0.95, 0.9512]
"""Voltages, pu, that the sagging voltage below passes 8.1 and 4.5 s after the dip."""


def sagging(h, edge, *, rule="tr_bdf2", compiled="never", T_first=100.0, T_next=10.0):
    """A dip at 1 s, and a load that recovers: the voltage slides from 0.9532 to 0.9469 pu and out of the dead band at ``edge``."""
    automaton = OLTC(V_ref=edge + 0.05, half_deadband=0.05, T_first=T_first, T_next=T_next)
    system = plant(automaton, V=1.05, P=100.0, load=AdditiveRecovery(P=100.0, T_p=10.0, T_q=10.0))
    return Simulation(system, Settings(30.0, h, rule, compiled), source(1.0, 0.97).changes())


def left_dead_band(sim):
    trace = sim.trace()
    return trace.t[-1] - trace[f"{TAP}.timer"][-1]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("edge", EDGES)
def test_a_timer_starts_where_the_voltage_leaves_the_dead_band(rule, edge):
    """To the second order in the step, against one 64 times as short; a timer that counts whole steps is up to a step off."""
    sim = sagging(1 / 64, edge, rule=rule)
    sim.run()
    exact = left_dead_band(sim)
    for h in (1.0, 0.5, 0.25):
        sim = sagging(h, edge, rule=rule)
        sim.run()
        assert abs(left_dead_band(sim) - exact) < 0.12 * h**2  # measured 0.095 h^2, and 0.01 h^2 by TR-BDF2


@pytest.mark.parametrize("h", [1.0, 0.4, 0.25])
def test_a_tap_is_made_at_the_first_end_of_a_step_not_before_it_is_due(h):
    reference = sagging(1 / 64, EDGES[0])
    reference.run()
    exact = left_dead_band(reference) + 5.0
    sim = sagging(h, EDGES[0], T_first=5.0)
    sim.run()
    trace = sim.trace()
    tapped = trace.t[np.argmax(trace[f"{TAP}.position"] != 0)]
    assert tapped == pytest.approx(np.ceil(exact / h) * h)


@pytest.mark.compiler
def test_compiled_steps_and_predictions_count_the_same():
    in_vm, in_c = (sagging(0.25, EDGES[0], compiled=how, T_first=5.0, T_next=1.7) for how in ("never", "always"))
    in_vm.run(until=2.0)
    start, model = in_vm.state, in_vm.model
    rolled = []
    for how in ("never", "always"):
        kernel = Kernel(model, in_vm.initial.state, in_vm.initial.p, how)
        outputs = [model.position("y", name) for name in ("transformer.T1.ratio", "bus.LV.v")]
        predictor = Predictor(kernel, [model.position("u", "infinite_bus.grid.v")], outputs, 1, "tr_bdf2")
        horizon = Horizon.plain(1, 0.25, [0] * 112, start, in_vm.p)
        rolled.append(predictor.roll(start, np.array([[0.97]]), horizon, derivatives=False).y)
    in_vm.run()
    in_c.run()
    a, b = in_vm.trace(), in_c.trace()
    assert in_c.kernel.compiled
    assert a[f"{TAP}.position"][-1] == -1.0
    assert np.abs(a[f"{TAP}.timer"] - b[f"{TAP}.timer"]).max() < 1e-9  # measured 0
    assert np.array_equal(rolled[0], rolled[1])
    assert np.array_equal(rolled[0][:, 0], a["transformer.T1.ratio"][-112:])


@pytest.mark.parametrize("h", [0.5, 3.0, 4.0, 7.0])
def test_taps_keep_their_pace_on_steps_that_do_not_divide_the_delays(h):
    """The k-th tap is made at the first end of a step not before T_first + (k - 1) T_next."""
    automaton = Automaton(OLTC(T_first=30.0, T_next=10.0, step=0.001, tap_min=0.5), v_im=0.0, tap=1.0, h=h)
    instants, position = [], 0.0
    for k in range(1, 1 + round(200 / h)):
        now = automaton.step(v_re=0.9)["position"]
        if now != position:
            instants.append(k * h)
        position = now
    due = 30.0 + 10.0 * np.arange(len(instants))
    assert len(instants) >= 16
    assert instants == pytest.approx(np.ceil(due / h - 1e-9) * h)


def test_lateness_does_not_pile_up_where_the_step_is_longer_than_the_delay():
    """A tap a step, and no haste afterwards: with short steps again the next tap waits no less than what is left of its delay."""
    automaton = Automaton(OLTC(T_first=4.0, T_next=3.0, tap_min=0.5), v_im=0.0, tap=1.0, h=8.0)
    positions = [automaton.step(v_re=0.9)["position"] for _ in range(5)]
    assert positions == [-1.0, -2.0, -3.0, -4.0, -5.0]
    assert automaton.d["timer"] == 3.0


def test_a_prediction_whose_steps_outgrow_a_delay_is_refused():
    """Twelve intervals growing by 1.4 from 2 s, in 20 steps each: 4.05 s at the end."""
    command = "infinite_bus.grid.v"
    problem = voltage_problem(command, dt=2.0, N_p=12, growth=1.4, voltages=("bus.LV.v",), speeds=(), P=np.empty(0))
    for delay, refused in ((4.1, False), (4.0, True)):
        sim = sagging(0.1, EDGES[0], T_next=delay)
        told = pytest.raises(ConfigError, match=r"growth: .* 4\.05 s long, and timers of transformer\.T1\.tap_changer")
        with told if refused else nullcontext():
            NMPC().start(
                problem,
                Surroundings(0.1, "tr_bdf2", {command: 1.0}, {}, sim.model.system),
                Plant(sim.model, sim.kernel, sim.p),
            )


def slid(limiter, name, course, h, t_end, **given):
    """The limiter's discrete states after steps of ``h`` along a smooth course of one signal."""
    machine = Automaton(limiter, h=h, **{name: course(0.0)}, **given)
    return [dict(machine.slide(**{name: course(k * h)})) for k in range(1, 1 + round(t_end / h))]


@pytest.mark.parametrize("h", [0.5, 0.2, 0.03])
def test_a_fixed_time_counts_what_lies_above_pick_up(h):
    """A ramp that passes pick-up at 1.23 s, and one that goes back at half the speed: exact, for both are straight lines."""
    limiter = OEL(I_LIM=1.0, K_PU=1.0, T_LIM=50.0, K_COOL=0.0)
    up = slid(limiter, "i_m", lambda t: 1 + 0.1 * (t - 1.23), h, 6.0)
    assert up[-1]["timer"] == pytest.approx(round(6.0 / h) * h - 1.23, abs=1e-12)
    down = slid(limiter, "i_m", lambda t: 1 + 0.05 * (2.34 - t), h, 6.0)
    assert down[-1]["timer"] == pytest.approx(2.34, abs=1e-12)
    cooling = slid(limiter.model_copy(update={"K_COOL": 0.4}), "i_m", lambda t: 1 + 0.05 * (2.34 - t), h, 6.0)
    assert cooling[-1]["timer"] == pytest.approx(2.34 - 0.4 * (round(6.0 / h) * h - 2.34), abs=1e-12)


def test_an_inverse_time_is_the_integral_of_the_overload():
    """Second order in the step, along a swinging current that passes pick-up three times, against fine quadrature."""
    limiter = OEL(I_LIM=1.0, K_PU=1.05, T_LIM=1e3, timing="inverse", K_INV=0.5, C=2.0, K_COOL=0.1)

    def current(t):
        return 1.1 + 0.4 * np.sin(t)

    t = np.linspace(0.0, 9.0, 900_001)
    speed = np.where(current(t) > 1.05, 0.5 * ((current(t) / 1.05) ** 2 - 1), -0.1)
    # It never cools down to zero after the first overload, so that the integral is all there is to it.
    exact = np.trapezoid(speed, t)
    errors = [abs(slid(limiter, "i_m", current, h, 9.0)[-1]["timer"] - exact) for h in (0.2, 0.1, 0.05)]
    assert errors[0] < 0.01  # measured 0.0052, 0.0013, 0.00032
    assert errors[2] < errors[0] / 8


@pytest.mark.parametrize("h", [0.5, 0.2])
def test_a_release_counts_what_lies_below_it(h):
    """The stator current falls to its release at 2.1 s (at 1 pu voltage it is the active power)."""
    limiter = SCL(I_LIM=1.0, K_RESET=0.98, T_RESET=20.0)
    machine = Automaton(limiter, h=h, v_t=1.0, q_e=0.0, p_e=0.98 + 0.21)
    machine.d["active"] = 1.0
    for k in range(1, 1 + round(6.0 / h)):
        machine.slide(p_e=0.98 + 0.1 * (2.1 - k * h))
    assert machine.d["below"] == pytest.approx(6.0 - 2.1, abs=1e-9)  # a root of 1e-12 keeps the current differentiable
    assert machine.slide(p_e=0.9)["below"] == pytest.approx(6.0 - 2.1 + h, abs=1e-9)
    assert machine.slide(p_e=0.99)["below"] == 0.0
