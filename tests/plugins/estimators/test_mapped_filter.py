"""filterpy's filter with all sigma points in one call: its own numbers, and bounds that it does not have."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from pgexcite.plugins.estimators.mapped_filter import MappedFilter, SigmaPoints

DT, N = 0.1, 3
Q, R = np.diag([1e-4, 2e-4, 1e-4]), np.diag([1e-2, 4e-2])
UNBOUNDED = np.full(N, np.inf)


def functions():
    """A pendulum of unknown length."""
    x, u = ca.SX.sym("x", N), ca.SX.sym("u")
    after = ca.vertcat(x[0] + DT * x[1], x[1] - DT * ca.sin(x[0]) / x[2] + DT * u, x[2])
    seen = ca.vertcat(x[2] * ca.sin(x[0]), x[1])
    return ca.Function("propagate", [x, u], [after]), ca.Function("sense", [x, u], [seen])


def mapped(lower=-UNBOUNDED, upper=UNBOUNDED, share=None):
    kalman = MappedFilter(*functions(), lower, upper, np.zeros(N) if share is None else share, DT, "never")
    kalman.x, kalman.P, kalman.Q, kalman.R = np.array([0.3, 0.0, 1.0]), np.diag([0.04, 0.04, 0.09]), Q, R
    return kalman


def stock():
    """filterpy's own filter, one Python call for each sigma point."""
    propagate, sense = functions()
    points = MerweScaledSigmaPoints(N, 1.0, 2.0, 0.0, sqrt_method=lambda P: np.linalg.cholesky(P).T)
    kalman = UnscentedKalmanFilter(
        N,
        2,
        DT,
        hx=lambda x: np.array(sense(x, 0.0)).ravel(),
        fx=lambda x, _dt, u: np.array(propagate(x, u)).ravel(),
        points=points,
    )
    kalman.x, kalman.P, kalman.Q, kalman.R = np.array([0.3, 0.0, 1.0]), np.diag([0.04, 0.04, 0.09]), Q, R
    return kalman


def test_it_is_filterpys_filter_where_nothing_is_bounded():
    ours, theirs, rng = mapped(), stock(), np.random.default_rng(1)
    for k in range(50):
        u, z = np.sin(k / 5), rng.normal(size=2)
        ours.propagate(u)
        theirs.predict(u=u)
        assert np.abs(ours.x - theirs.x).max() < 1e-10
        ours.update(z)
        theirs.update(z)
        assert np.abs(ours.x - theirs.x).max() < 1e-10  # measured 9e-14
        assert np.abs(ours.P - theirs.P).max() < 1e-10  # measured 1e-14
        assert np.array_equal(ours.P, ours.P.T)  # filterpy's own is not symmetric


def test_surprise_is_the_mahalanobis_distance_squared():
    ours, theirs, z = mapped(), stock(), np.array([0.4, -0.2])
    ours.propagate(0.0)
    theirs.predict(u=0.0)
    theirs.update(z)
    assert ours.expect().surprise(z) == pytest.approx(theirs.mahalanobis**2, rel=1e-12)


def test_bounds_hold_for_points_and_means_and_leave_a_covariance():
    """A length that is pushed against its bound by every measurement; without the bound it is crossed at once."""
    ours, free = mapped(np.array([-np.inf, -np.inf, 0.9])), mapped()
    crossed = False
    for _ in range(30):
        for kalman in (ours, free):
            kalman.propagate(0.0)
            kalman.update(np.array([-0.1, 0.0]))
        assert ours._propagate.points[:, 2].min() >= 0.9
        assert ours.x[2] >= 0.9
        assert np.linalg.eigvalsh(ours.P).min() > 0
        crossed |= free.x[2] < 0.9
    assert crossed


@pytest.mark.parametrize("n", [3, 9, 12])
def test_points_have_their_mean_and_covariance_and_no_negative_weight(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n))
    x, P = rng.normal(size=n), A @ A.T + np.eye(n)
    points = SigmaPoints(n)
    sigmas = points.sigma_points(x, P)
    assert sigmas == pytest.approx(MerweScaledSigmaPoints.sigma_points(points, x, P), abs=1e-12)
    assert points.Wm @ sigmas == pytest.approx(x, abs=1e-12)
    assert (points.Wc[:, None] * (sigmas - x)).T @ (sigmas - x) == pytest.approx(P, abs=1e-11)
    assert points.Wc.min() >= -1e-15


def test_what_the_model_may_have_wrong_grows_with_what_it_moves():
    still, sure = mapped(share=np.full(N, 0.5)), mapped()
    for kalman in (still, sure):
        kalman.propagate(2.0)
    change = np.diag(still.P - sure.P)
    assert change == pytest.approx((0.5 * (sure.x - [0.3, 0.0, 1.0])) ** 2, abs=1e-15)


def test_a_covariance_that_is_none_is_reported():
    kalman = mapped()
    kalman.P = np.diag([1.0, 1.0, -1.0])
    with pytest.raises(np.linalg.LinAlgError):
        kalman.propagate(0.0)
