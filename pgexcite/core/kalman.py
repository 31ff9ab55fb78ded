"""A Kalman filter step by step: what is predicted and what is measured come from outside, lost measurements are left out.

B. D. O. Anderson, J. B. Moore, Optimal Filtering, Prentice-Hall 1979, chapter 3; the update in Joseph's form, which keeps the
covariance symmetric and positive.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Gaussian:
    """A mean, shape ``(n,)``, and its covariance, shape ``(n, n)``."""

    x: Array
    P: Array

    def predicted(self, x: Array, A: Array, Q: Array) -> Gaussian:
        """One step on: the mean goes to ``x``, its errors go through ``A``, and noise of covariance ``Q`` comes in."""
        P = A @ self.P @ A.T + Q
        return Gaussian(x, (P + P.T) / 2)

    def corrected(self, innovation: Array, C: Array, R: Array) -> Gaussian:
        """After a measurement; what was not measured has a NaN for its innovation.

        Args:
            innovation: measured minus predicted, shape ``(n_y,)``.
            C: derivatives of what is measured to the mean, shape ``(n_y, n)``.
            R: variances of the measurements, shape ``(n_y,)``.
        """
        there = np.isfinite(innovation)
        if not there.any():
            return self
        C, R = C[there], R[there]
        gain = np.linalg.solve((C @ self.P @ C.T) + np.diag(R), C @ self.P).T
        rest = np.eye(self.x.size) - gain @ C
        return Gaussian(self.x + gain @ innovation[there], rest @ self.P @ rest.T + (gain * R) @ gain.T)


def unidentified(A: Array, B_d: Array, C: Array, C_d: Array) -> NDArray[np.intp]:
    """Constant disturbances that the measurements cannot tell from each other or from a state: positions, empty where all can be.

    With ``x+ = A x + B_d d`` and ``y = C x + C_d d`` the disturbances are identified when ``[A - I, B_d; C, C_d]`` has as many
    independent columns more than ``[A - I; C]`` as there are disturbances (G. Pannocchia, J. B. Rawlings, "Disturbance models for
    offset-free model-predictive control", AIChE Journal 49 (2003) 426-437, where the states are observable).
    """
    states = np.vstack((A - np.eye(A.shape[0]), C))
    disturbances = np.vstack((B_d, C_d))
    own = disturbances - states @ np.linalg.lstsq(states, disturbances, rcond=None)[0]
    scale = np.linalg.norm(disturbances, axis=0)
    _, size, directions = np.linalg.svd(own / np.where(scale > 0, scale, 1.0), full_matrices=False)
    involved = np.abs(directions[size < _INDEPENDENT]) > _INVOLVED
    return np.flatnonzero(involved.any(axis=0))


_INDEPENDENT = 1e-4
"""Effect a combination of disturbances of size 1 must have of its own to be identified."""
_INVOLVED = 0.1
"""Part of such a combination from which a disturbance is named."""
