"""DC1A, EXDC2 and AC1A: exciters with a rotating machine."""

from __future__ import annotations

import math

import numpy as np
import pytest
from component_harness import Bench, simulate
from pydantic import ValidationError

from pgexcite.plugins.exciters.ac1a import AC1A
from pgexcite.plugins.exciters.dc1a import DC1A
from pgexcite.plugins.exciters.exdc2 import EXDC2
from pgexcite.plugins.exciters.rotating import exponential_excess, quadratic_excess, rectifier

KNOWN = {"e_fd": 1.9, "v_t": 1.02, "i_fd": 1.9, "t_m": 0.8}
CURVE = {"E_1": 2.3, "SE_1": 0.1, "E_2": 3.1, "SE_2": 0.33}
EXCITERS = {
    "dc1a": DC1A(),
    "dc1a-lead-lag": DC1A(T_C=0.3, T_B=1.0, T_R=0.0),
    "exdc2": EXDC2(),
    "exdc2-saturated": EXDC2(**CURVE, supply="fixed", by_speed=False),
    "ac1a": AC1A(T_R=0.01, E_1=4.0, SE_1=0.4, E_2=5.0, SE_2=0.5),
    "ac1a-no-load": AC1A(K_C=0.0, K_D=0.0),
}
every_exciter = pytest.mark.parametrize("name", EXCITERS)


def at_rest(exciter):
    return dict(exciter.guess(None, KNOWN)) | {"v_t": 1.02, "i_fd": 1.9, "omega": 1.0}


@every_exciter
def test_guess_is_the_steady_state(name):
    point = Bench(EXCITERS[name])(at_rest(EXCITERS[name]))
    assert max(abs(item) for item in point.rhs.values()) < 1e-12
    assert point.out["e_fd"] == pytest.approx(1.9, abs=1e-12)


@every_exciter
def test_jacobian_matches_finite_differences(name):
    exciter = EXCITERS[name]
    assert Bench(exciter).jacobian_error(at_rest(exciter) | {"x_b": 0.07, "v_e": 2.9}) < 1e-6


@every_exciter
@pytest.mark.parametrize("port", ["v_s", "v_uel", "v_oel", "v_scl", "v_ref"])
def test_every_signal_is_summed_at_the_input(name, port):
    exciter = EXCITERS[name]
    bench, values = Bench(exciter), at_rest(exciter)
    raised = bench(values | {port: values.get(port, 0.0) + 0.01})
    state = "x_b"
    assert raised.rhs[state] == pytest.approx(0.01, abs=1e-12)


def test_saturation_goes_through_its_points_and_can_be_off():
    for E, S in ((2.3, 0.1), (3.1, 0.33)):
        assert quadratic_excess(E, 2.3, 0.1, 3.1, 0.33) == pytest.approx(S * E)
    assert float(quadratic_excess(0.5, 2.3, 0.1, 3.1, 0.33)) == 0.0
    for off in ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 1.0), (2.0, 0.0, 3.0, 0.3)):
        assert float(quadratic_excess(2.0, *off)) == 0.0
    assert exponential_excess(-2.0, 0.1, 0.5) == pytest.approx(-0.2 * math.e)


def test_rectifier_in_its_three_modes():
    """IEEE Std 421.5, annex D; continuous where the modes meet."""
    assert float(rectifier(-0.1)) == 1.0
    assert float(rectifier(0.3)) == pytest.approx(1 - 0.577 * 0.3)
    assert float(rectifier(0.6)) == pytest.approx(math.sqrt(0.75 - 0.36))
    assert float(rectifier(0.9)) == pytest.approx(0.1732)
    assert float(rectifier(1.2)) == 0.0
    for edge in (0.433, 0.75, 1.0):
        assert float(rectifier(edge - 1e-9)) == pytest.approx(float(rectifier(edge + 1e-9)), abs=2e-3)


@pytest.mark.parametrize("dip", [(-0.6, 5.0), (0.6, -3.0)])
def test_regulator_limits_do_not_wind_up(dip):
    """A dip drives the regulator to its limit; it leaves it within its own time constant after the voltage is back."""
    change, limit = dip
    exciter = DC1A(K_A=200.0, K_F=0.0, T_F=0.0, T_R=0.0)
    t, run = simulate(Bench(exciter), at_rest(exciter), lambda t: {"v_t": 1.02 + change * (0.1 <= t < 0.5)}, t_end=0.8)
    at = dict(zip(np.round(t, 3), run["v_r"], strict=True))
    assert at[0.45] == limit
    assert abs(at[0.62] - limit) > 0.5 * abs(limit - at[0.05])


def test_exdc2_limits_follow_the_terminal_voltage_or_not():
    values = at_rest(EXDC2()) | {"v_t": 0.5}
    assert Bench(EXDC2())(values).upper["v_r"] == pytest.approx(2.6)
    assert Bench(EXDC2())(values).lower["v_r"] == pytest.approx(-2.08)
    assert Bench(EXDC2(supply="fixed"))(values).upper["v_r"] == pytest.approx(5.2)


def test_exdc2_field_voltage_is_proportional_to_speed_where_asked():
    values = at_rest(EXDC2()) | {"omega": 1.02}
    assert Bench(EXDC2())(values).out["e_fd"] == pytest.approx(1.02 * 1.9)
    assert Bench(EXDC2(by_speed=False))(values).out["e_fd"] == pytest.approx(1.9)


def test_rate_feedback_acts_on_the_field_voltage():
    exciter = DC1A(K_F=0.125, T_F=1.8, T_R=0.0)
    values = at_rest(exciter)
    moved = Bench(exciter)(values | {"v_e": values["v_e"] + 0.18})
    assert moved.rhs["x_b"] == pytest.approx(-0.125 / 1.8 * 0.18)


def test_alternator_does_not_reverse():
    exciter = AC1A(K_D=0.0, T_A=0.0, K_A=50.0, K_F=0.0)
    _, run = simulate(Bench(exciter), at_rest(exciter), lambda t: {"v_t": 1.02 + 0.3 * (t > 0.1)}, t_end=4.0, h=2e-3)
    assert run["v_e"].min() == 0.0
    assert run["e_fd"].min() == 0.0


def test_wrong_data_are_refused():
    with pytest.raises(ValidationError, match=r"the saturation curve must rise"):
        EXDC2(E_1=3.0, SE_1=0.1, E_2=2.0, SE_2=0.3)
    with pytest.raises(ValidationError, match=r"K_F = 0.1 needs T_F > 0"):
        DC1A(K_F=0.1, T_F=0.0)
    with pytest.raises(ValidationError, match=r"V_AMIN = 20.0 must be below V_AMAX"):
        AC1A(V_AMIN=20.0)
