import math

import numpy as np
import pytest

from pgexcite.plugins.sinks.capability import Capability

PAPER = Capability(v_t=1.0, X_d=1.24, X_q=0.70, cos_phi=0.86)


def test_the_field_circle_has_the_paper_s_radius_and_passes_through_the_rated_point():
    curve = PAPER.field()
    radius = np.hypot(curve[:, 0], curve[:, 1] + 1 / 1.24)
    np.testing.assert_allclose(radius, 1.5727, atol=1e-4)  # equation (1): 1.5725 with Q rounded to 0.51
    p, q = PAPER.rated
    assert np.min(np.hypot(curve[:, 0] - p, curve[:, 1] - q)) < 0.01


def test_the_largest_reactive_power_is_the_field_s():
    """OD = CA - CO in the paper's figure 1."""
    assert PAPER.field()[0] == pytest.approx([0.0, 1.5727 - 1 / 1.24], abs=1e-4)


def test_a_round_rotor_s_stability_limit_is_level_at_minus_v2_over_xd():
    """With X_d = X_q the theoretical limit is Q = -V^2/X_d; the 0.1 pu kept in hand lifts it to the known parabola."""
    x = 1.8
    curve = Capability(v_t=1.0, X_d=x, X_q=x).under_excitation()
    p, q = curve[1:].T
    e_max = (p + 0.1) * x
    np.testing.assert_allclose(q, np.sqrt(e_max**2 - (p * x) ** 2) / x - 1 / x, atol=2e-3)  # the grid of angles


def test_a_salient_pole_machine_may_take_more_than_a_round_one():
    assert PAPER.under_excitation()[0, 1] < -1 / 1.24


def test_stator_and_turbine_meet_at_the_rated_point():
    top = PAPER.turbine()[1]
    assert top == pytest.approx(PAPER.rated)
    np.testing.assert_allclose(np.hypot(*PAPER.stator().T), 1.0)


def test_a_machine_without_synchronous_reactance_has_no_field_limit():
    curve = Capability(v_t=1.0, X_d=None, X_q=None)
    assert len(curve.field()) == len(curve.under_excitation()) == 0
    assert math.hypot(*curve.rated) == pytest.approx(1.0)
