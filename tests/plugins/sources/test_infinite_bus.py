from __future__ import annotations

import math

import pytest
from component_harness import Bench, at_terminal, terminal
from hypothesis import given
from hypothesis import strategies as st

from pgexcite.plugins.sources.infinite_bus import InfiniteBus


def at_rest(source, at):
    return {"theta": 0.0, **source.guess(at, {}), **at_terminal(at)}


@given(
    P=st.floats(-2, 2), Q=st.floats(-1, 1), V=st.floats(0.8, 1.2), angle=st.floats(-3, 3),
    Z=st.sampled_from([0j, 0.2j, 0.02 + 0.3j]),
)  # fmt: skip
def test_guess_is_the_steady_state(P, Q, V, angle, Z):
    source, at = InfiniteBus(R=Z.real, X=Z.imag), terminal(P, Q, V, angle)
    point = Bench(source)(at_rest(source, at))
    assert point.alg == pytest.approx((0.0, 0.0), abs=1e-12)
    assert point.rhs == {"theta": 0.0}
    assert point.current == at.i
    assert complex(point.out["p"], point.out["q"]) == pytest.approx(complex(P, Q), abs=1e-12)


def test_impedance_drops_voltage_towards_the_bus():
    source = InfiniteBus(R=0.1, X=0.5)
    values = {"theta": 0.0, "v": 1.0, "angle": 0.0, "i_re": 0.2, "i_im": -0.1}
    v = 1.0 - (0.1 + 0.5j) * (0.2 - 0.1j)
    assert Bench(source)(values | {"v_re": v.real, "v_im": v.imag}).alg == pytest.approx((0.0, 0.0), abs=1e-15)


def test_turns_against_a_reference_that_runs_fast():
    source = InfiniteBus()
    values = at_rest(source, terminal(0.5, 0.1))
    point = Bench(source, f_n=60.0)(values | {"omega_ref": 1.001})
    assert point.rhs["theta"] == pytest.approx(-2 * math.pi * 60 * 0.001)


def test_theta_and_angle_add():
    source = InfiniteBus()
    values = at_rest(source, terminal(0.5, 0.1, 1.0, 0.5))
    moved = values | {"theta": 0.2, "angle": values["angle"] - 0.2}
    assert Bench(source)(moved).alg == pytest.approx((0.0, 0.0), abs=1e-15)


def test_jacobian_matches_finite_differences():
    source = InfiniteBus(R=0.01, X=0.2)
    assert Bench(source).jacobian_error(at_rest(source, terminal(0.5, 0.1, 1.0, 0.5))) < 1e-8
