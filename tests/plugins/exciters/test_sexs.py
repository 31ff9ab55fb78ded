from __future__ import annotations

import numpy as np
import pytest
from component_harness import Bench, simulate
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from pgexcite.plugins.exciters.sexs import SEXS

_KNOWN = {"e_fd": 1.9, "v_t": 1.02, "i_fd": 1.9, "t_m": 0.8}
_DATA = {"T_A": 2.0, "T_B": 5.0, "K": 20.0, "E_MIN": -0.5, "E_MAX": 4.0}


def at_rest(exciter):
    return dict(exciter.guess(None, _KNOWN)) | {"v_t": 1.02, "i_fd": 1.9}


@given(
    e_fd=st.floats(-5, 5), v_t=st.floats(0.5, 1.2), T_R=st.sampled_from([0.0, 0.02]), T_E=st.sampled_from([0.0, 0.5])
)  # fmt: skip
def test_guess_is_the_steady_state(e_fd, v_t, T_R, T_E):
    exciter = SEXS(T_R=T_R, T_E=T_E)
    values = dict(exciter.guess(None, {"e_fd": e_fd, "v_t": v_t})) | {"v_t": v_t, "i_fd": 1.0}
    point = Bench(exciter)(values)
    assert max(abs(item) for item in point.rhs.values()) < 1e-12
    assert point.out["e_fd"] == e_fd


@pytest.mark.parametrize("T_E", [0.0, 0.3])
def test_jacobian_matches_finite_differences(T_E):
    exciter = SEXS(T_E=T_E, T_R=0.01)
    assert Bench(exciter).jacobian_error(at_rest(exciter) | {"x_b": 0.2}) < 1e-7


@pytest.mark.parametrize("port", ["v_s", "v_uel", "v_oel", "v_ref"])
def test_every_signal_is_summed(port):
    exciter = SEXS(T_A=0.0, T_B=0.0, T_E=0.0, E_MAX=50.0, K=20.0)
    bench, values = Bench(exciter), at_rest(SEXS(T_A=0, T_B=0, K=20.0))
    _, run = simulate(bench, values, lambda t: {port: values.get(port, 0.0) + 0.01 * (t > 0)}, t_end=2e-3)
    assert run["e_fd"][-1] - run["e_fd"][0] == pytest.approx(0.2)


@pytest.mark.parametrize("T_E", [0.0, 0.05])
def test_both_ceilings_are_entered_and_left_without_windup(T_E):
    """A voltage dip drives the exciter to its ceiling, a swell to its floor; it leaves either as soon as the error turns."""
    exciter = SEXS(**(_DATA | {"T_A": 0.0, "T_B": 0.0}), T_E=T_E)

    def dips(t):
        return {"v_t": 1.02 - 0.5 * (0.1 <= t < 0.3) + 0.4 * (0.5 <= t < 0.7)}

    t, run = simulate(Bench(exciter), at_rest(exciter), dips, t_end=1.0)
    e_fd = run["e_fd"]
    assert e_fd.max() == 4.0
    assert e_fd.min() == -0.5
    at = dict(zip(np.round(t, 3), e_fd, strict=True))
    assert (at[0.25], at[0.65]) == (4.0, -0.5)
    # Left at once: the distance to the rest value shrinks with T_E from the first sample after the dip.
    for end, limit in ((0.3, 4.0), (0.7, -0.5)):
        expected = 1.9 + (limit - 1.9) * np.exp(-0.05 / T_E) if T_E else 1.9
        assert at[round(end + 0.05, 3)] == pytest.approx(expected, abs=0.02)  # Euler's error at 1 ms, measured 9e-3


def test_step_response_of_the_lead_lag():
    exciter = SEXS(**_DATA, T_E=0.0)
    start = at_rest(exciter)
    t, run = simulate(Bench(exciter), start, lambda _: {"v_ref": start["v_ref"] + 0.05}, t_end=2.0)
    expected = 1.9 + 20 * 0.05 * (1 - (1 - 2.0 / 5.0) * np.exp(-t / 5.0))
    assert run["e_fd"] == pytest.approx(expected, abs=1e-3)  # measured 2e-5


def test_a_lead_without_a_lag_is_refused():
    with pytest.raises(ValidationError, match=r"T_A = 1.0 needs T_B > 0"):
        SEXS(T_A=1.0, T_B=0.0)
