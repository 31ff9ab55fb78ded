"""TGOV1 and HYGOV: steady state, limits, the turbine's own response."""

from __future__ import annotations

import numpy as np
import pytest
from component_harness import Bench, simulate
from plants import kobbelv
from pydantic import ValidationError

from pgexcite.core.events import Change
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.trace import Ending
from pgexcite.plugins.governors.hygov import HYGOV
from pgexcite.plugins.governors.tgov1 import TGOV1

KNOWN = {"t_m": 0.8}
GOVERNORS = {
    "tgov1": TGOV1(),
    "tgov1-torque": TGOV1(holds="torque", D_t=0.5, T_1=0.0),
    "hygov": HYGOV(),
    "hygov-torque": HYGOV(holds="torque", D_turb=0.5),
}
every_governor = pytest.mark.parametrize("name", GOVERNORS)


def at_rest(governor):
    return dict(governor.guess(None, KNOWN)) | {"omega": 1.0, "x_f": 0.0}


@every_governor
def test_guess_is_the_steady_state(name):
    values = {k: v for k, v in at_rest(GOVERNORS[name]).items() if name.startswith("hygov") or k != "x_f"}
    point = Bench(GOVERNORS[name])(values)
    assert max(abs(item) for item in point.rhs.values()) < 1e-12
    assert point.out["t_m"] == pytest.approx(0.8, abs=1e-12)


@every_governor
def test_jacobian_matches_finite_differences(name):
    values = at_rest(GOVERNORS[name]) | {"omega": 1.002}
    values = values if name.startswith("hygov") else {k: v for k, v in values.items() if k != "x_f"}
    assert Bench(GOVERNORS[name]).jacobian_error(values) < 1e-6


@every_governor
def test_power_or_torque(name):
    governor = GOVERNORS[name]
    values = {k: v for k, v in at_rest(governor).items() if name.startswith("hygov") or k != "x_f"}
    t_m = Bench(governor)(values | {"omega": 1.01}).out["t_m"]
    damping = getattr(governor, "D_t", 0.0) + getattr(governor, "D_turb", 0.0) * values.get("g", 0.0)
    p_m = 0.8 - damping * 0.01
    assert t_m == pytest.approx(p_m / 1.01 if governor.holds == "power" else p_m)


@pytest.mark.parametrize("name", ["tgov1-torque", "hygov-torque"])
def test_permanent_droop(name):
    """A lasting speed error of R times 10 % moves the gate or valve by 10 %."""
    governor = GOVERNORS[name].model_copy(update={"D_t": 0.0} if name.startswith("tgov1") else {"D_turb": 0.0})
    start = at_rest(governor)
    if name.startswith("tgov1"):
        start.pop("x_f")
    _t, run = simulate(Bench(governor), start, lambda _: {"omega": 1.0 - 0.005}, t_end=200.0, h=1e-2)
    state = "x_v" if name.startswith("tgov1") else "g"
    assert run[state][-1] - start[state] == pytest.approx(0.1, abs=1e-3)


def test_tgov1_valve_is_limited_without_windup():
    governor = TGOV1(holds="torque", V_MAX=0.9, V_MIN=0.3)

    def swings(t):
        return {"omega": 1.0 - 0.02 * (1 <= t < 6) + 0.05 * (10 <= t < 15)}

    start = {k: v for k, v in at_rest(governor).items() if k != "x_f"}
    t, run = simulate(Bench(governor), start, swings, t_end=20.0)
    at = dict(zip(np.round(t, 3), run["x_v"], strict=True))
    assert (at[5.9], at[14.9]) == (0.9, 0.3)
    assert at[6.5] == pytest.approx(0.8 + 0.1 * np.exp(-1), abs=5e-3)  # leaves at once, with T_1
    assert at[15.5] == pytest.approx(0.8 - 0.5 * np.exp(-1), abs=5e-3)


def test_hygov_gate_speed_and_end_stops():
    governor = HYGOV(holds="torque", VELM=0.05, G_MAX=0.9)
    start = at_rest(governor)
    _t, run = simulate(Bench(governor), start, lambda t: {"omega": 1.0 - 0.05 * (t >= 1)}, t_end=20.0)
    assert np.max(np.diff(run["c"])) / 1e-3 == pytest.approx(0.05, rel=1e-6)
    assert run["c"].max() == 0.9
    down = simulate(Bench(governor), start, lambda t: {"omega": 1.0 + 0.08 * (t >= 1)}, t_end=23.0, h=2e-3)[1]
    assert down["c"].min() == 0.0


def test_hygov_water_answers_the_wrong_way_first():
    """Opening the gate lowers the head before the flow has risen: the non-minimum phase of a penstock."""
    governor = HYGOV(holds="torque", T_w=2.0, T_g=0.05)
    start = at_rest(governor)
    t, run = simulate(Bench(governor), start, lambda t: {"omega": 1.0 - 0.01 * (t >= 1)}, t_end=60.0, h=2e-3)
    first = run["t_m"][(t > 1.0) & (t < 2.0)]
    assert first.min() < 0.78
    assert run["t_m"][-1] > 0.9


@pytest.mark.parametrize("T_g", [0.0, 0.5])
def test_hygov_closes_its_gate(T_g):
    """The flow stops with the gate, and what is left is the loss at no load."""
    governor = HYGOV(T_g=T_g, holds="torque")
    close = Change(0.5, {"unit.G2.governor.n_ref": -0.2}, "stop")
    sim = Simulation(kobbelv(governor=governor), Settings(20.0, 0.02, compile="never"), [close])
    assert sim.run().ending is Ending.COMPLETED
    assert sim.get("unit.G2.governor.g") == pytest.approx(0.0, abs=1e-9)  # measured 0 and 2e-13
    assert sim.get("unit.G2.governor.q") == pytest.approx(1e-4, abs=1e-9)  # the leakage
    assert sim.get("unit.G2.t_m") == pytest.approx(governor.A_t * (1e-4 - governor.q_NL), abs=1e-9)


def test_limits_in_the_wrong_order_are_refused():
    with pytest.raises(ValidationError, match=r"V_MIN = 2.0 must be below V_MAX = 1.0"):
        TGOV1(V_MIN=2.0)
    with pytest.raises(ValidationError, match=r"T_2 = 2.1 needs T_3 > 0"):
        TGOV1(T_3=0.0)
