"""What instruments do to a signal: noise, delay and lost samples, reproducible from any sample on."""

from __future__ import annotations

import numpy as np
import pytest

from pgexcite.core.measurement import Instruments, Measurement

PATHS = ("unit.G2.v_t", "unit.G2.omega", "unit.G2.exciter.v_ref")
SETPOINTS = np.array([False, False, True])
TRUE = np.array([1.0, 1.0, 1.02])


def true(k):
    """The signals at sample ``k``: two that rest and a set-point that ramps."""
    return TRUE + np.array([0.0, 0.0, 1e-3 * k])


def readings(settings, n=2000, paths=PATHS):
    instruments = Instruments(Measurement(**settings), paths, SETPOINTS)
    return np.array([list(instruments.read(k, true(k)).values()) for k in range(n)])


def test_without_settings_signals_come_as_they_are():
    assert np.array_equal(readings({}, 3)[2], TRUE + np.array([0, 0, 2e-3]))


def test_noise_has_the_deviation_asked_for_and_leaves_set_points_alone():
    seen = readings({"noise": 0.01, "noise_omega": 1e-4})
    assert seen[:, 0].std() == pytest.approx(0.01, rel=0.05)
    assert seen[:, 1].std() == pytest.approx(1e-4, rel=0.05)
    assert abs(seen[:, 0].mean() - 1.0) < 1e-3
    assert np.array_equal(seen[:, 2], 1.02 + 1e-3 * np.arange(2000))


def test_samples_are_lost_as_often_as_asked_and_whole():
    lost = np.isnan(readings({"loss": 0.1}))
    assert lost[:, 0].mean() == pytest.approx(0.1, abs=0.02)
    assert (lost.all(axis=1) == lost.any(axis=1)).all()


def test_a_delay_is_whole_samples():
    seen = readings({"delay": 3}, 10)
    assert np.allclose(seen[:, 2], 1.02 + 1e-3 * np.maximum(np.arange(10) - 3, 0))


def test_seeds_and_signals_draw_different_numbers_and_the_same_again():
    a, b = readings({"noise": 0.01}, 50), readings({"noise": 0.01, "seed": 2}, 50)
    other = readings({"noise": 0.01}, 50, ("unit.G1.v_t", "unit.G1.omega", "unit.G1.exciter.v_ref"))
    assert np.array_equal(a, readings({"noise": 0.01}, 50))
    assert not np.allclose(a[:, 0], b[:, 0])
    assert not np.allclose(a[:, 0], other[:, 0])


def test_a_resumed_run_reads_the_same():
    settings = {"noise": 0.01, "delay": 2, "loss": 0.2}
    whole = readings(settings, 20)
    first = Instruments(Measurement(**settings), PATHS, SETPOINTS)
    for k in range(11):
        first.read(k, true(k))
    second = Instruments(Measurement(**settings), PATHS, SETPOINTS)
    second.recall(first.memory())
    rest = [list(second.read(k, true(k)).values()) for k in range(11, 20)]
    assert np.array_equal(np.array(rest), whole[11:], equal_nan=True)
