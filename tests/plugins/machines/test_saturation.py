from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pgexcite.plugins.machines.saturation import excess, kundur_excess

points = st.tuples(st.floats(0.01, 0.6), st.floats(1.3, 8.0)).map(lambda pair: (pair[0], pair[0] * pair[1]))
curves = st.sampled_from(["quadratic", "exponential"])


@given(curve=curves, S=points)
def test_goes_through_both_points(curve, S):
    assert float(excess(curve, 1.0, *S)) == pytest.approx(S[0])
    assert float(excess(curve, 1.2, *S)) / 1.2 == pytest.approx(S[1])


@given(curve=curves, S=points, E=st.floats(-0.5, 2.0), more=st.floats(0.0, 1.0))
def test_never_falls_and_never_is_negative(curve, S, E, more):
    below, above = float(excess(curve, E, *S)), float(excess(curve, E + more, *S))
    assert 0 <= below <= above * (1 + 1e-12)


@given(curve=curves, S=points, E=st.floats(-1.0, 2.0))
def test_derivative_is_finite(curve, S, E):
    e = ca.SX.sym("e")
    slope = ca.Function("slope", [e], [ca.jacobian(excess(curve, e, *S), e)])
    assert np.isfinite(float(slope(E)))


def test_quadratic_curve_of_psse():
    # B (E - A)^2 / E with A, B solved by hand from S(1.0) = 0.1, S(1.2) = 0.8: a = sqrt(9.6), A = (a - 1.2) / (a - 1).
    a = np.sqrt(1.2 * 0.8 / 0.1)
    A = (a - 1.2) / (a - 1)
    B = 0.1 / (1 - A) ** 2
    assert float(excess("quadratic", 1.1, 0.1, 0.8)) == pytest.approx(B * (1.1 - A) ** 2)
    assert float(excess("quadratic", A - 0.01, 0.1, 0.8)) == 0


def test_quadratic_curve_that_starts_at_one():
    assert float(excess("quadratic", 1.0, 0.0, 0.3)) == 0
    assert float(excess("quadratic", 1.2, 0.0, 0.3)) == pytest.approx(1.2 * 0.3)


def test_none_is_a_plain_zero():
    assert excess("none", ca.SX.sym("e"), 0.1, 0.8) == 0.0


def test_kundur_two_area_constants_give_the_psse_points():
    # A_sat = .015, B_sat = 9.6, psi_T1 = .9 are published as S(1.0) = .0392, S(1.2) = .2672 on flux.
    psi_I = kundur_excess(1.0, 0.015, 9.6, 0.9)
    assert float(psi_I) == pytest.approx(0.0392, abs=5e-5)  # measured 3e-5
    assert float(kundur_excess(1.2, 0.015, 9.6, 0.9)) == pytest.approx(0.2672, abs=5e-5)  # measured 1e-5
