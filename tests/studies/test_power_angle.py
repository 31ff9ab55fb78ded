"""The criterion against the swing equation itself, on random plants."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from pgexcite.studies.power_angle import Curve, EqualArea, lossless


def swings_back(area, clearing):
    """Whether the machine stays below a full turn: brute force, ten seconds (near the angle of no return all is slow)."""

    def slope(t, y):
        curve = area.during if t < clearing else area.after
        return y[1], math.pi * area.f_n / area.H * (area.p_m - curve(y[0]))

    first = solve_ivp(slope, (0, clearing), (area.delta_0, 0.0), rtol=1e-10, atol=1e-12)
    then = solve_ivp(slope, (clearing, clearing + 10), first.y[:, -1], rtol=1e-9, atol=1e-11, max_step=0.05)
    return bool(np.max(then.y[0]) < area.delta_limit + 0.2)


@settings(max_examples=25, deadline=None)
@given(
    delta_0=st.floats(0.2, 0.9),
    r_1=st.floats(0.0, 0.4),
    weaker=st.floats(0.75, 1.0),
    offset=st.floats(0.0, 0.1),
    H=st.floats(1.5, 8.0),
)
def test_the_critical_time_separates_stable_from_lost(delta_0, r_1, weaker, offset, H):
    base = lossless(0.8, delta_0, r_1, weaker, H, 50.0)
    area = EqualArea(0.8, delta_0, base.before, Curve(base.during.peak, offset, 0.1), base.after, H, 50.0)
    if area.delta_crit is None or area.t_crit is None:
        return
    assert swings_back(area, 0.99 * area.t_crit)
    assert not swings_back(area, 1.01 * area.t_crit)
    assert area.delta_max(0.99 * area.t_crit) is not None
    assert area.delta_max(1.01 * area.t_crit) is None


def test_area_under_a_curve_is_its_integral():
    curve = Curve(1.3, 0.2, -0.4)
    assert curve.energy(0.3, 2.1) == pytest.approx(quad(curve, 0.3, 2.1)[0], abs=1e-12)


def test_equilibria_are_where_the_curve_meets_the_turbine():
    curve = Curve(1.3, 0.2, -0.4)
    stable, unstable = curve.equilibria(0.9)
    assert curve(stable) == pytest.approx(0.9)
    assert curve(unstable) == pytest.approx(0.9)
    assert stable < unstable
    assert curve.equilibria(1.6) is None


def test_bolted_fault_follows_the_textbook_s_parabola():
    """With no power during the fault t = sqrt(4 H (delta_c - delta_0) / (omega_0 P_m))."""
    area = lossless(0.9, math.radians(40), 0.0, 1.0, 3.5, 60.0)
    t = math.sqrt(4 * 3.5 * (area.delta_crit - area.delta_0) / (2 * math.pi * 60 * 0.9))
    assert area.t_crit == pytest.approx(t, rel=1e-8)
