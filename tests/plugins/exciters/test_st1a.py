from __future__ import annotations

import numpy as np
import pytest
from component_harness import Bench, simulate
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pgexcite.plugins.exciters.st1a import ST1A

_KNOWN = {"e_fd": 2.0, "v_t": 1.0, "i_fd": 2.0, "t_m": 0.8}
_SEEN = {"v_t": 1.0, "i_fd": 2.0}
_BARE = {"T_R": 0.0, "K_A": 100.0, "T_F": 0.0}
"""Every block is a plain gain: K_A times the error."""


def at_rest(exciter, known=_KNOWN):
    return dict(exciter.guess(None, known)) | {"v_t": known["v_t"], "i_fd": known["i_fd"]}


def respond(exciter, inputs, t_end=0.5, h=1e-3):
    return simulate(Bench(exciter), at_rest(exciter), inputs, t_end=t_end, h=h)


def settled(exciter, **inputs):
    """Field voltage after the algebraic rows have settled at constant inputs."""
    _, run = simulate(Bench(exciter), at_rest(exciter), lambda _: inputs, t_end=0.0)
    return run["e_fd"][-1]


@settings(deadline=None, max_examples=30)
@given(
    e_fd=st.floats(-3, 6), v_t=st.floats(0.8, 1.2), i_fd=st.floats(0, 6), T_A=st.sampled_from([0.0, 0.02]),
    T_B=st.sampled_from([0.0, 10.0]), K_F=st.sampled_from([0.0, 0.03]), K_LR=st.sampled_from([0.0, 4.54]),
)  # fmt: skip
def test_guess_is_the_steady_state(e_fd, v_t, i_fd, T_A, T_B, K_F, K_LR):
    exciter = ST1A(T_A=T_A, T_B=T_B, T_C=T_B / 10, K_F=K_F, T_F=1.0, K_LR=K_LR)
    known = {"e_fd": e_fd, "v_t": v_t, "i_fd": i_fd}
    point = Bench(exciter, released=True)(at_rest(exciter, known))
    assert max(abs(item) for item in point.rhs.values()) < 1e-11
    assert point.out["e_fd"] == pytest.approx(e_fd, abs=1e-12)
    assert set(point.limits) == {"voltage error", "field voltage"}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"T_R": 0.0, "T_A": 0.0, "T_B": 0.0, "T_F": 0.0},
        {
            "T_A": 0.05,
            "T_B": 10.0,
            "T_C": 1.0,
            "T_B1": 0.1,
            "T_C1": 0.3,
            "K_F": 0.03,
            "T_F": 1.0,
            "K_C": 0.04,
            "K_LR": 4.54,
            "I_LR": 1.0,
        },
        {"uel_position": 1, "oel_position": 1},
        {"uel_position": 2, "oel_position": 2, "pss_position": 2},
        {"uel_position": 3, "oel_position": 3},
    ],
)
def test_jacobian_matches_finite_differences(changes):
    exciter = ST1A(**changes)
    off = {"v_m": 0.99, "x_b": 0.02, "x_b1": 0.015, "v_s": 0.01, "v_uel": -2.0, "v_oel": 9.0, "x_f": 1.9}
    assert Bench(exciter).jacobian_error(at_rest(exciter) | off) < 1e-6


def test_without_time_constants_it_is_a_gain():
    exciter = ST1A(**_BARE)
    assert settled(exciter, v_t=0.99) == pytest.approx(2.0 + 100 * 0.01)
    assert settled(exciter, v_s=-0.01) == pytest.approx(2.0 - 100 * 0.01)


def test_transducer_lag():
    exciter = ST1A(**_BARE | {"T_R": 0.02})
    t, run = respond(exciter, lambda _: {"v_t": 0.99}, t_end=0.1, h=1e-4)
    assert run["e_fd"] == pytest.approx(2 + 1 - np.exp(-t / 0.02), abs=3e-3)  # measured 9e-4, Euler's


def test_transient_gain_reduction_by_both_lead_lags():
    exciter = ST1A(**_BARE, T_C=1.0, T_B=10.0, T_C1=0.2, T_B1=0.1)
    t, run = respond(exciter, lambda _: {"v_t": 0.99}, t_end=2.0)
    # Partial fractions of (1 + s)(1 + .2 s) / ((1 + 10 s)(1 + .1 s)) / s.
    slow, fast = -(1 - 1 / 10) * (1 - 0.2 / 10) / (1 - 0.1 / 10), (1 - 1 / 0.1) * (1 - 0.2 / 0.1) / (1 - 10 / 0.1) * -1
    assert 1 + slow + fast == pytest.approx(0.2)
    assert run["e_fd"] == pytest.approx(2 + 1 + slow * np.exp(-t / 10) + fast * np.exp(-t / 0.1), abs=1e-3)


@pytest.mark.parametrize(("dip", "reached"), [(0.5, 2.0 + 100 * (0.1 - 0.02)), (-0.5, 2.0 + 100 * (-0.2 - 0.02))])
def test_input_limits_are_entered_and_left(dip, reached):
    wide = {"V_RMIN": -100.0, "V_RMAX": 100.0}
    exciter = ST1A(**_BARE, **wide, V_IMIN=-0.2, V_IMAX=0.1)
    _, run = respond(exciter, lambda t: {"v_t": 1.0 - dip * (0.1 <= t < 0.2)}, t_end=0.3)
    assert run["e_fd"][150] == pytest.approx(reached)
    assert run["e_fd"][-1] == pytest.approx(2.0)


@pytest.mark.parametrize("T_A", [0.0, 0.02])
def test_regulator_limits_are_entered_and_left_without_windup(T_A):
    exciter = ST1A(**_BARE, T_A=T_A, V_AMIN=-1.0, V_AMAX=5.0)
    _, run = respond(exciter, lambda t: {"v_t": 1.0 - 0.3 * (0.1 <= t < 0.3) + 0.3 * (0.5 <= t < 0.7)}, t_end=0.9)
    v_a = run["v_a"]
    assert (v_a[290], v_a[690]) == (5.0, -1.0)
    assert (v_a.max(), v_a.min()) == (5.0, -1.0)
    for end, limit in ((300, 5.0), (700, -1.0)):
        expected = 2 + (limit - 2) * np.exp(-1.0) if T_A else 2.0
        assert v_a[end + 20] == pytest.approx(
            expected, abs=0.1
        )  # one T_A after the error is gone; measured 0.03, Euler's
    assert v_a[-1] == pytest.approx(2.0, abs=1e-3)


def test_rectifier_ceiling_follows_terminal_voltage_and_field_current():
    exciter = ST1A(**_BARE, V_RMAX=6.4, V_RMIN=-5.0, K_C=0.1)
    assert settled(exciter, v_t=0.5, i_fd=3.0) == pytest.approx(0.5 * 6.4 - 0.1 * 3.0)
    assert settled(exciter, v_t=1.2, i_fd=3.0) == pytest.approx(1.2 * -5.0)
    assert settled(exciter, v_t=0.0, i_fd=3.0) == pytest.approx(-0.3)  # no supply: the commutation drop remains


def test_rectifier_ceiling_winds_up_behind_the_regulator():
    exciter = ST1A(**_BARE, T_A=0.5)
    _, run = respond(exciter, lambda t: {"v_t": 1.0 - 0.5 * (0.1 <= t < 0.3)}, t_end=0.4)
    assert run["v_a"][300] > 6.4 > run["e_fd"][299]
    assert run["e_fd"][299] == pytest.approx(3.2)
    # Still at the ceiling after the dip: it winds up, as in the standard.
    assert run["e_fd"][320] == pytest.approx(6.4)


def test_field_current_limiter_is_entered_and_left():
    exciter = ST1A(**_BARE, K_LR=4.0, I_LR=2.5)
    _, run = respond(exciter, lambda t: {"i_fd": 3.0 if 0.1 <= t < 0.2 else 2.4}, t_end=0.3)
    assert run["e_fd"][[50, 150, 250]] == pytest.approx([2.0, 2.0 - 4.0 * 0.5, 2.0])


def test_field_current_limiter_active_at_rest_raises_the_reference():
    exciter = ST1A(**_BARE, K_LR=4.0, I_LR=1.5)
    assert at_rest(exciter)["v_ref"] == pytest.approx(1.0 + (2.0 + 4.0 * 0.5) / 100)


def test_rate_feedback():
    exciter = ST1A(**_BARE | {"T_F": 1.0}, T_A=0.02, K_F=0.03)
    t, run = respond(exciter, lambda _: {"v_t": 0.99}, t_end=1.5, h=5e-4)
    # e_fd / error = K_A (1 + s T_F) / ((1 + s T_A)(1 + s T_F) + s K_A K_F): initially K_A / (1 + K_A K_F / T_F) after T_A.
    poles = np.roots([0.02 * 1.0, 0.02 + 1.0 + 100 * 0.03, 1.0])
    residues = [100 * (1 + s) / (2 * 0.02 * s + 4.02) / s for s in poles]
    expected = 2 + 0.01 * (100 + sum(r * np.exp(s * t) for r, s in zip(residues, poles, strict=True)))
    assert run["e_fd"] == pytest.approx(expected, abs=1e-2)  # measured 5e-3, Euler's


@pytest.mark.parametrize("position", [1, 2, 3])
def test_underexcitation_limiter(position):
    exciter = ST1A(**_BARE, uel_position=position)
    inactive = {1: 0.0, 2: -1000.0, 3: -1000.0}[position]
    active, expected = {1: (0.01, 3.0), 2: (0.03, 3.0), 3: (3.0, 3.0)}[position]
    _, run = respond(exciter, lambda t: {"v_uel": active if 0.1 <= t < 0.2 else inactive}, t_end=0.3)
    assert run["e_fd"][[50, 150, 250]] == pytest.approx([2.0, expected, 2.0])


@pytest.mark.parametrize("position", [1, 2, 3])
def test_overexcitation_limiter(position):
    exciter = ST1A(**_BARE, oel_position=position)
    inactive = {1: 0.0, 2: 1000.0, 3: 1000.0}[position]
    active, expected = {1: (-0.01, 1.0), 2: (0.01, 1.0), 3: (1.0, 1.0)}[position]
    _, run = respond(exciter, lambda t: {"v_oel": active if 0.1 <= t < 0.2 else inactive}, t_end=0.3)
    assert run["e_fd"][[50, 150, 250]] == pytest.approx([2.0, expected, 2.0])


def test_overexcitation_gate_has_the_last_word():
    exciter = ST1A(**_BARE, uel_position=3, oel_position=3)
    assert settled(exciter, v_uel=4.0, v_oel=1.0) == 1.0


@pytest.mark.parametrize("position", [2, 3])
def test_gates_nothing_drives_never_act(position):
    exciter = ST1A(**_BARE, uel_position=position, oel_position=position)
    assert settled(exciter) == pytest.approx(2.0)


def test_stabiliser_at_the_output_bypasses_the_gain():
    assert settled(ST1A(**_BARE, pss_position=2), v_s=0.5) == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"V_RMIN": 7.0}, r"V_RMIN = 7.0 must be below V_RMAX = 6.4"),
        ({"V_AMIN": 3.0, "V_AMAX": 2.0}, r"V_AMIN = 3.0 must be below V_AMAX"),
        ({"T_C": 1.0}, r"T_C = 1.0 needs T_B > 0"),
        ({"K_F": 0.1, "T_F": 0.0}, r"K_F = 0.1 needs T_F > 0"),
        ({"uel_position": 4}, r"Input should be 0, 1, 2 or 3"),
        ({"K_A": 0.0}, r"greater than 0"),
        ({"K_a": 200.0}, r"Extra inputs"),
    ],
)
def test_impossible_data_are_refused(wrong, text):
    with pytest.raises(ValidationError, match=text):
        ST1A(**wrong)
