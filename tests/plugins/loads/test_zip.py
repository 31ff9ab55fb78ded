from __future__ import annotations

import math
from functools import cache

import pytest
from component_harness import Bench, terminal
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pgexcite.plugins.loads.zip import ConstantCurrent, ConstantImpedance, ConstantPower, ZIPLoad

LOADS = {
    "zip": ZIPLoad(P=50.0, Q=20.0, p_z=0.3, p_i=0.3, p_p=0.4, q_z=0.5, q_i=0.2, q_p=0.3),
    "zip-default": ZIPLoad(P=50.0, Q=20.0),
    "impedance": ConstantImpedance(P=50.0, Q=20.0),
    "current": ConstantCurrent(P=50.0, Q=20.0),
    "power": ConstantPower(P=50.0, Q=-20.0),
    "negative": ConstantPower(P=-50.0, Q=0.0),
}
every_load = pytest.mark.parametrize("name", LOADS)


@cache
def bench(name: str) -> Bench:
    return Bench(LOADS[name], S_n=200.0)


def at(V, v_0=1.0, angle=0.4):
    return {"v_re": V * math.cos(angle), "v_im": V * math.sin(angle), "v_0": v_0}


def scale(shares, V, v_0, V_min):
    """A ZIP curve with its changeover, written out."""
    edge = min(V_min, v_0)
    if edge > V:
        return scale(shares, edge, v_0, V_min) * (V / edge) ** 2
    z, i, p = shares
    return z * (V / v_0) ** 2 + i * V / v_0 + p


@every_load
@settings(deadline=None, max_examples=40)
@given(V=st.floats(0.01, 1.3), v_0=st.floats(0.5, 1.15), angle=st.floats(-3, 3))
def test_power_follows_the_curve(name, V, v_0, angle):
    load, values = LOADS[name], at(V, v_0, angle)
    point = bench(name)(values)
    for_p, for_q = load.shares()
    expected = complex(load.P * scale(for_p, V, v_0, 0.7), load.Q * scale(for_q, V, v_0, 0.7)) / 200.0
    drawn = -complex(values["v_re"], values["v_im"]) * point.current.conjugate()
    assert drawn == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert complex(point.out["p"], point.out["q"]) == pytest.approx(drawn, abs=1e-12)


@every_load
@pytest.mark.parametrize("v_0", [1.03, 0.6])
def test_draws_its_rating_at_the_initial_voltage(name, v_0):
    load = LOADS[name]
    values = at(v_0, v_0)
    point = bench(name)(values)
    assert (point.out["p"], point.out["q"]) == pytest.approx((load.P / 200, load.Q / 200))
    assert point.hold["v_0"] == pytest.approx(v_0)
    assert load.guess(terminal(-0.25, -0.1, v_0), {})["v_0"] == pytest.approx(v_0)


@every_load
@pytest.mark.parametrize("V", [1.0, 0.71, 0.69, 0.3, 1e-5])
def test_jacobian_matches_finite_differences_on_both_sides_of_the_changeover(name, V):
    assert bench(name).jacobian_error(at(V), step=1e-7) < 1e-5


@pytest.mark.parametrize("name", ["zip", "current", "power"])
def test_changeover_is_entered_and_left_without_a_step(name):
    below, above = (bench(name)(at(0.7 + side * 1e-9)) for side in (-1, 1))
    assert below.out["p"] == pytest.approx(above.out["p"], rel=1e-8)
    impedance = [bench(name)(at(V)).out["p"] / V**2 for V in (0.69, 0.4, 0.1)]
    assert impedance == pytest.approx([impedance[0]] * 3)
    assert bench(name)(at(0.8)).out["p"] / 0.8**2 != pytest.approx(impedance[0])


def test_changeover_does_not_touch_a_constant_impedance():
    low, high = (ConstantImpedance(P=50.0, V_min=V_min) for V_min in (0.3, 0.9))
    values = at(0.6)
    assert Bench(low)(values).current == Bench(high)(values).current


@every_load
def test_nothing_is_divided_by_the_voltage_of_a_bolted_fault(name):
    point = bench(name)(at(0.0))
    assert point.current == 0
    assert point.out == {"p": 0.0, "q": 0.0}


def test_demand_may_step_without_recompiling():
    assert bench("power")(at(1.0), P=80.0).out["p"] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"P": 1.0, "p_p": 1.0}, r"p_z \+ p_i \+ p_p must sum to 1, not to 2"),
        ({"P": 1.0, "q_z": 0.9}, r"q_z \+ q_i \+ q_p must sum to 1, not to 0.9"),
        ({"P": 1.0, "V_min": 0.0}, r"greater than 0"),
        ({}, r"Field required"),
    ],
)
def test_impossible_data_are_refused(wrong, text):
    with pytest.raises(ValidationError, match=text):
        ZIPLoad(**wrong)


def test_shares_with_rounding_are_accepted():
    ZIPLoad(P=1.0, p_z=0.1, p_i=0.2, p_p=0.7, q_z=1 / 3, q_i=1 / 3, q_p=1 / 3)
