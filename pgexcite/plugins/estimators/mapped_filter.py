"""filterpy's unscented Kalman filter with all sigma points in one compiled call, and with bounds.

filterpy takes one Python call for each sigma point and each measurement, never symmetrises a covariance and knows no bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray

from pgexcite.core.mapped import Mapped
from pgexcite.core.settings import Compile

Array = NDArray[np.float64]


class SigmaPoints(MerweScaledSigmaPoints):  # type: ignore[misc]  # filterpy has no types
    """Sigma points at ``sqrt(s)`` standard deviations, ``s = max(3, n / 3)``.

    With 3 the fourth moments of a Gaussian come out right (S. J. Julier, J. K. Uhlmann, "Unscented filtering and nonlinear
    estimation", Proc. IEEE 92 (2004) 401-422). From ``n / 3`` on no weight of a covariance is negative, so that a covariance of
    points that had to be clipped is one still.
    """

    def __init__(self, n: int) -> None:
        super().__init__(n, 1.0, 2.0, max(3.0, n / 3.0) - n, sqrt_method=_upper_factor)
        self.scale = max(3.0, n / 3.0)

    def sigma_points(self, x: Array, P: Array) -> Array:
        """Points around ``x``, shape ``(2n + 1, n)``.

        Raises:
            numpy.linalg.LinAlgError: ``P`` is not positive definite.
        """
        root: Array = self.sqrt(self.scale * P)
        return np.vstack((x, x + root, x - root))


def _upper_factor(P: Array) -> Array:
    return np.asarray(np.linalg.cholesky(P).T)


@dataclass(frozen=True)
class Expectation:
    """What is expected to be measured, by the sigma points as they are within their bounds.

    Attributes:
        x, P: mean and covariance of the points.
        z: mean of the measurement.
        S: covariance of the innovation.
        C: covariance of state and measurement, shape ``(n, n_z)``.
    """

    x: Array
    P: Array
    z: Array
    S: Array
    C: Array

    @cached_property
    def gain(self) -> Array:
        """Kalman's gain, shape ``(n, n_z)``."""
        return np.asarray(self.C @ self._weight)

    def surprise(self, z: Array) -> float:
        """Normalised innovation squared of a measurement: chi-squared with ``n_z`` degrees of freedom where the model holds."""
        nu = z - self.z
        return float(nu @ self._weight @ nu)

    @cached_property
    def _weight(self) -> Array:
        return np.asarray(np.linalg.inv(self.S))


class MappedFilter(UnscentedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """The filter.

    Args:
        propagate: ``(x, input) -> x`` over a sample.
        sense: ``(x, input) -> z``.
        lower, upper: bounds of ``x``; sigma points and means are kept within.
        share: share of a predicted change of each state that is not to be relied upon.
        dt: sample time, s.
        compile: whether the functions run as generated C.

    Raises:
        numpy.linalg.LinAlgError: from any of its methods, where a covariance is not positive definite.
    """

    def __init__(
        self,
        propagate: ca.Function,
        sense: ca.Function,
        lower: Array,
        upper: Array,
        share: Array,
        dt: float,
        compile: Compile = "auto",
    ) -> None:
        n, n_z = lower.size, sense.numel_out(0)
        super().__init__(n, n_z, dt, hx=None, fx=None, points=SigmaPoints(n))
        self.lower, self.upper, self.share = lower, upper, share
        self._propagate = Mapped(propagate, self._num_sigmas, compile)
        self._sense = Mapped(sense, self._num_sigmas, compile)

    def redraw(self, input: float) -> None:
        """Draw the sigma points of the present state, for a measurement that comes before a prediction."""
        self.sigmas_f = self.points_fn.sigma_points(self.x, self.P)
        self._sense.common[0] = input

    def compute_process_sigmas(self, dt: float, fx: Any = None, **given: Any) -> None:
        """All sigma points through the process in one call."""
        np.clip(self.points_fn.sigma_points(self.x, self.P), self.lower, self.upper, out=self._propagate.points)
        self._propagate.common[0] = self._sense.common[0] = given["input"]
        self.sigmas_f = self._propagate().copy()

    def propagate(self, input: float) -> None:
        """One sample further; ``x`` and ``P`` are then those predicted."""
        self.predict(UT=self._predicted, input=input)

    def _predicted(
        self, sigmas: Array, Wm: Array, Wc: Array, Q: Array, mean: object, residual: object
    ) -> tuple[Array, Array]:
        x = Wm @ sigmas
        error = sigmas - x
        P = error.T @ (Wc[:, None] * error) + Q + np.diag((self.share * (x - self.x)) ** 2)
        return x, _symmetric(P)

    def expect(self, x: Array | None = None, P: Array | None = None) -> Expectation:
        """What would be measured at the filter's own state, or at another."""
        points = self._sense.points
        sigmas = self.sigmas_f if x is None else self.points_fn.sigma_points(x, P)
        np.clip(sigmas, self.lower, self.upper, out=points)
        seen = self._sense()
        x, z = self.Wm @ points, self.Wm @ seen
        dx, dz = points - x, seen - z
        weighted = self.Wc[:, None] * dz
        return Expectation(
            x, _symmetric(dx.T @ (self.Wc[:, None] * dx)), z, _symmetric(dz.T @ weighted) + self.R, dx.T @ weighted
        )

    def correct(self, expected: Expectation, z: Array) -> None:
        """Correct by a measurement."""
        K = expected.gain
        self.x = np.clip(expected.x + K @ (z - expected.z), self.lower, self.upper)
        self.P = _symmetric(expected.P - K @ expected.C.T)

    def update(self, z: Array, R: Any = None, UT: Any = None, hx: Any = None, **given: Any) -> None:
        """Correct by a measurement, all sigma points in one call."""
        self.correct(self.expect(), z)


def _symmetric(P: Array) -> Array:
    return (P + P.T) / 2
