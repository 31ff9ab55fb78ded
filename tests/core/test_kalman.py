"""The Kalman filter: against the Riccati equation and a batch estimate, with lost measurements, and what it can tell apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from pgexcite.core.kalman import Gaussian, unidentified

A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.7]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
Q, R = np.diag([1e-3, 2e-3, 5e-3]), np.array([1e-2, 4e-2])


def test_covariance_settles_on_the_riccati_equation():
    at = Gaussian(np.zeros(3), np.eye(3))
    for _ in range(400):
        at = at.predicted(A @ at.x, A, Q)
        predicted = at.P
        at = at.corrected(np.zeros(2), C, R)
    expected = solve_discrete_are(A.T, C.T, Q, np.diag(R))
    assert np.abs(predicted - expected).max() < 1e-12  # measured 4e-17


def test_estimate_is_the_least_squares_estimate():
    """The last of a few states, from all measurements at once."""
    rng = np.random.default_rng(1)
    n, steps, P_0 = 3, 4, np.diag([0.5, 0.3, 0.2])
    ys = rng.normal(size=(steps, 2))
    ys[2, 1] = np.nan
    at = Gaussian(np.array([0.1, -0.2, 0.3]), P_0)
    rows, values, weights = [np.eye(n, n * steps)], [at.x], [1 / np.diag(P_0)]
    for k in range(steps):
        if k:
            at = at.predicted(A @ at.x, A, Q)
            link = np.zeros((n, n * steps))
            link[:, n * (k - 1) : n * k], link[:, n * k : n * (k + 1)] = -A, np.eye(n)
            rows.append(link)
            values.append(np.zeros(n))
            weights.append(1 / np.diag(Q))
        at = at.corrected(ys[k] - C @ at.x, C, R)
        there = np.isfinite(ys[k])
        seen = np.zeros((2, n * steps))
        seen[:, n * k : n * (k + 1)] = C
        rows.append(seen[there])
        values.append(ys[k][there])
        weights.append(1 / R[there])
    root = np.sqrt(np.concatenate(weights))
    batch = np.linalg.lstsq(np.vstack(rows) * root[:, None], np.concatenate(values) * root, rcond=None)[0]
    assert np.abs(at.x - batch[-n:]).max() < 1e-12


def test_without_any_measurement_nothing_is_corrected():
    at = Gaussian(np.ones(3), np.eye(3))
    assert at.corrected(np.full(2, np.nan), C, R) is at


def test_covariance_stays_symmetric_and_positive_when_measurements_are_very_sharp():
    at = Gaussian(np.zeros(3), 1e3 * np.eye(3))
    for _ in range(200):
        at = at.predicted(A @ at.x, A, 1e-10 * Q).corrected(np.zeros(2), C, np.array([1e-14, 1e-2]))
    assert np.array_equal(at.P, at.P.T) or np.abs(at.P - at.P.T).max() < 1e-18
    assert np.linalg.eigvalsh(at.P).min() > -1e-18


@pytest.mark.parametrize(
    ("B_d", "C_d", "expected"),
    [
        (np.zeros((3, 2)), np.eye(2), []),  # one disturbance on each output
        (np.array([[0.0], [0.0], [1.0]]), np.zeros((2, 1)), []),  # one on a state
        (np.zeros((3, 3)), np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]), [0, 1, 2]),  # more than there are outputs
        (np.zeros((3, 1)), np.zeros((2, 1)), [0]),  # one without effect
    ],
)
def test_disturbances_that_cannot_be_told_apart(B_d, C_d, expected):
    assert list(unidentified(A, B_d, C, C_d)) == expected


def test_an_integrator_hides_a_disturbance_on_its_own_output():
    A = np.array([[1.0]])
    assert list(unidentified(A, np.zeros((1, 1)), np.array([[1.0]]), np.array([[1.0]]))) == [0]
