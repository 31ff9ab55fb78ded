"""The matrix pencil finds the modes a signal was made of, and those of a simulated swing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import kobbelv, push

from pgexcite.core.errors import PgexciteError
from pgexcite.core.linearise import linearise
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.studies.ringdown import mode_near, ringdown_modes

T = np.arange(400) * 0.025


@settings(deadline=None, max_examples=30)
@given(
    st.floats(-1.0, 0.2),
    st.floats(2.0, 5.0),
    st.floats(-1.5, -0.1),
    st.floats(6.0, 9.0),
    st.floats(0.1, 1.0),
    st.floats(-3, 3),
)
def test_two_modes_are_found_exactly(sigma, omega, sigma2, omega2, size, phase):
    y = np.exp(sigma * T) * np.cos(omega * T + phase) + size * np.exp(sigma2 * T) * np.cos(omega2 * T)
    found = ringdown_modes(T, y, floor=1e-9)
    for value in (sigma + 1j * omega, sigma2 + 1j * omega2):
        assert min(abs(mode.eigenvalue - value) for mode in found) < 1e-9  # measured 1e-13


def test_noise_moves_them_little():
    rng = np.random.default_rng(0)
    y = np.exp(-0.3 * T) * np.cos(3.4 * T) + 0.01 * rng.standard_normal(T.size)
    mode = mode_near(ringdown_modes(T, y, order=6), (0.4, 0.7))
    assert mode is not None
    assert abs(mode.eigenvalue - (-0.3 + 3.4j)) < 0.005  # measured 8e-4


def test_a_small_swing_has_the_linearised_mode():
    sim = Simulation(kobbelv(), Settings(6.0, 0.005, "tr_bdf2", "never"))
    expected = next(m for m in linearise(sim.model, sim.state, sim.p).modes() if m.eigenvalue.imag > 1)
    push(sim, "unit.G2.machine.delta", 1e-4)
    sim.run()
    trace = sim.trace()
    t = np.arange(0.5, 5.5, 0.02)
    mode = mode_near(ringdown_modes(t, np.interp(t, trace.t, trace["unit.G2.delta"])), (1.0, 2.0))
    assert mode.eigenvalue == pytest.approx(expected.eigenvalue, abs=2e-3)  # measured 6e-4
    assert mode.damping == pytest.approx(expected.damping, abs=5e-4)


def test_too_few_or_uneven_samples_are_refused():
    with pytest.raises(PgexciteError, match="too few"):
        ringdown_modes(T[:20], T[:20])
    with pytest.raises(PgexciteError, match="equally spaced"):
        ringdown_modes(T**2, T)
