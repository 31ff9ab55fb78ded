from __future__ import annotations

import numpy as np
import pytest
from component_harness import Bench, simulate
from pydantic import ValidationError

from pgexcite.plugins.stabilisers.kundur import KundurPSS

_REST = {"x_w": 0.0, "x_1": 0.0, "x_2": 0.0, "omega": 1.0}


def respond(pss, omega, t_end, h=1e-3):
    t, run = simulate(Bench(pss), _REST, lambda t: {"omega": omega(t)}, t_end=t_end, h=h)
    return t, run["v_s"]


def gain(pss, w):
    """Transfer function from speed to ``v_s`` at ``w`` rad/s, from the linear equations."""
    bench = Bench(pss)
    exact, names = bench.jacobian(_REST), list(bench.names)
    x = [names.index(name) for name in bench.states]
    n, at = len(x), names.index("omega")
    mass = np.diag(list(bench(_REST).mass.values()))
    inner = np.linalg.solve(1j * w * mass - exact[:n, x], exact[:n, at])
    return exact[n, x] @ inner + exact[n, at]


def test_is_at_rest_at_nominal_speed_whatever_the_guess():
    pss = KundurPSS()
    assert pss.guess(None, {}) == {}
    point = Bench(pss)(_REST)
    assert set(point.rhs.values()) == {0.0}
    assert point.out["v_s"] == 0


@pytest.mark.parametrize("w", [0.1, 1.0, 6.6, 40.0])
@pytest.mark.parametrize("second", [(0.0, 0.0), (3.0, 5.4), (0.0, 0.05)])
def test_transfer_function(w, second):
    pss = KundurPSS(T_3=second[0], T_4=second[1])
    s = 1j * w
    expected = (
        9.5 * 1.4 * s / (1 + 1.4 * s) * (1 + 0.154 * s) / (1 + 0.033 * s) * (1 + second[0] * s) / (1 + second[1] * s)
    )
    assert gain(pss, w) == pytest.approx(expected, rel=1e-12)


def test_jacobian_matches_finite_differences():
    assert Bench(KundurPSS(T_3=1.0, T_4=2.0)).jacobian_error(_REST | {"omega": 1.001, "x_w": 0.005}) < 1e-8


def test_a_lasting_speed_deviation_is_washed_out():
    _, v_s = respond(KundurPSS(), lambda t: 1.001 if t > 0 else 1.0, t_end=14.0, h=1e-2)
    assert v_s[1:10].max() > 0.03
    assert abs(v_s[-1]) < 1e-6


@pytest.mark.parametrize("sign", [1, -1])
def test_both_limits_are_entered_and_left(sign):
    pss = KundurPSS(V_SMIN=-0.05, V_SMAX=0.08)
    _, v_s = respond(pss, lambda t: 1 + sign * 0.02 * np.sin(2 * np.pi * t), t_end=2.0)
    assert (v_s.min(), v_s.max()) == (-0.05, 0.08)
    inside = (v_s > -0.05) & (v_s < 0.08)
    assert np.count_nonzero(np.diff(inside.astype(int)) != 0) >= 6  # in and out of both, more than once


def test_no_washout_switches_it_off():
    assert abs(gain(KundurPSS(T_W=0.0), 5.0)) == 0


def test_limits_released_tell_the_label():
    point = Bench(KundurPSS(T_3=1.0, T_4=1.0), released=True)(_REST | {"omega": 1.1})
    signal, low, high = point.limits["stabiliser signal"]
    assert signal > high == 0.1
    assert low == -0.1


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"T_3": 1.0}, r"T_3 = 1.0 needs T_4 > 0"),
        ({"V_SMAX": -0.1}, r"greater than or equal to 0"),
        ({"V_SMIN": 0.0, "V_SMAX": 0.0}, r"V_SMIN = 0.0 must be below V_SMAX"),
    ],
)
def test_impossible_data_are_refused(wrong, text):
    with pytest.raises(ValidationError, match=text):
        KundurPSS(**wrong)
