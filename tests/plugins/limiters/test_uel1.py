from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from component_harness import Bench
from plants import regulated

from pgexcite.core.events import ParameterStep
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Schedule
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.limiters.uel1 import UEL1

NEAR = {"K_UC": 1.0, "K_UR": 1.25}  # a circle the plant leaves with a tenth less voltage
EMPTY = {"x_i": 0.0, "x_1": 0.0, "x_2": 0.0}


def error(limiter, v, p, q):
    """Distance from the circle, from the phasors themselves."""
    i = np.conj(complex(p, q) / v)
    return abs(limiter.K_UC * v - 1j * i) - limiter.K_UR * v


@pytest.mark.parametrize(("v", "p", "q"), [(1.0, 0.8, -0.6), (0.95, 0.3, -0.9), (1.05, 0.9, 0.4)])
def test_the_circle(v, p, q):
    limiter = UEL1(K_UL=10.0, T_U2=0.0)
    bench = Bench(limiter)
    signal = 10.0 * error(limiter, v, p, q)
    point = bench({"v_t": v, "p_e": p, "q_e": q, "x_i": 0.0, "x_1": signal, "x_2": signal})
    assert max(abs(r) for r in point.rhs.values()) < 1e-12
    assert point.out["v_uel"] == pytest.approx(signal)


def test_on_the_circle_the_signal_is_zero_and_limits_hold():
    limiter = UEL1(T_U2=0.0, K_UC=1.38, K_UR=1.95)
    bench = Bench(limiter)
    # Lowest point of the circle: Q = (K_UC - K_UR) V^2.
    assert bench({"v_t": 1.0, "p_e": 0.0, "q_e": -0.57, **EMPTY}).rhs["x_1"] == pytest.approx(0.0, abs=1e-9)
    for x_2, held in ((50.0, 18.0), (-50.0, -18.0)):
        assert bench({"v_t": 1.0, "p_e": 0.0, "q_e": 0.0, **EMPTY, "x_2": x_2}).out["v_uel"] == held
    capped = UEL1(V_UCMAX=1.0, V_URMAX=0.4, K_UL=1.0)
    assert Bench(capped)({"v_t": 1.0, "p_e": 0.0, "q_e": -2.0, **EMPTY}).rhs["x_1"] == pytest.approx(0.6)


def test_integral_action_is_bounded():
    point = Bench(UEL1(K_UI=2.0))({"v_t": 1.0, "p_e": 0.0, "q_e": -0.67, **EMPTY})
    assert point.rhs["x_i"] == pytest.approx(0.2, abs=1e-9)
    assert (point.lower["x_i"], point.upper["x_i"]) == (0.0, 18.0)
    inside = Bench(UEL1(K_UI=2.0))({"v_t": 1.0, "p_e": 0.0, "q_e": 0.0, **EMPTY, "x_i": 0.01})
    assert inside.rhs["x_i"] == pytest.approx(-0.1)  # empties with 0.1 s


@pytest.mark.parametrize(("p", "q", "x_2"), [(0.8, -0.7, 0.3), (0.0, -0.4, -1.0), (0.0, 0.0, 0.0)])
def test_jacobian_matches_finite_differences(p, q, x_2):
    point = {"v_t": 0.97, "p_e": p, "q_e": q, "x_i": 0.1, "x_1": 0.2, "x_2": x_2}
    assert Bench(UEL1(K_UI=1.0, K_UL=2.0, T_U1=0.02)).jacobian_error(point) < 1e-7


@pytest.mark.parametrize(
    ("exciter", "limiter"),
    [
        (ST1A(uel_position=2), UEL1(**NEAR, K_UL=0.01, K_UI=0.01, V_UIMIN=-1.0, V_UIMAX=1.0)),
        (ST1A(uel_position=3), UEL1(**NEAR, K_UL=2.0, K_UI=2.0)),
        (ST1A(uel_position=1), UEL1(**NEAR, K_UL=0.2, K_UI=0.5, V_UIMIN=0.0, V_UIMAX=0.3)),
    ],
)
def test_it_holds_the_machine_on_its_circle(exciter, limiter):
    """A reference far too low: with the limiter the machine stays at the circle, without it goes beyond."""
    step = ParameterStep(type="set", t=1.0, path="unit.G2.exciter.v_ref", step=-0.2)

    def end(exciter, **slots):
        sim = Simulation(regulated(exciter=exciter, **slots), Settings(30.0, 0.01, "tr_bdf2", "never"), step.changes())
        assert sim.run().ending.value == "completed"
        trace = sim.trace()
        return error(limiter, *(trace[f"unit.G2.{name}"][-1] for name in ("v_t", "p_e", "q_e")))

    assert end(exciter.model_copy(update={"uel_position": 0})) > 0.2
    assert end(exciter, **{"limiter.uel": limiter}) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("radius", "told"), [(1.3, True), (1.95, False)])
def test_a_limiter_that_works_at_the_initial_point_is_in_the_log(radius, told):
    system = regulated(exciter=ST1A(uel_position=1), uel=UEL1(K_UC=1.0, K_UR=radius, K_UL=1.0, V_UIMIN=0.0))
    low = replace(system.devices[0], schedule=Schedule(P=0.5 * 175, Q=-0.5 * 175, V=1.0))
    system = replace(system, devices=(low, *system.devices[1:]))
    trace = Simulation(system, Settings(0.1, 0.01, "tr_bdf2", "never")).trace()
    assert [(entry.t, entry.kind) for entry in trace.log] == [(0.0, "limit")] * told
    signal = trace["unit.G2.v_uel"][0]
    assert (signal > 0) == told
    if told:
        assert trace.log[0].text == f"unit.G2.uel: v_uel = {signal:.4g} pu at the initial point already"
