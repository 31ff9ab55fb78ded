"""States and constant disturbances of a linear model from what is measured: a Kalman filter on both.

Disturbances of outputs and of torques make a predictive controller offset-free (U. Maeder, F. Borrelli, M. Morari, "Linear
offset-free Model Predictive Control", Automatica 45 (2009) 2214-2222). Which of them can be told apart is decided at rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.kalman import Gaussian, unidentified
from pgexcite.core.rollout import Transition

Array = NDArray[np.float64]


LARGEST = 2.0
"""Disturbance beyond which the filter has diverged, pu: the arc fault at the transformer of the scenarios makes one of 0.95."""


@dataclass(frozen=True)
class Noise:
    """What the filter assumes: standard deviations, of the measurements and of what comes in during a sample.

    Attributes:
        measured: of each measurement, shape ``(n_m,)``.
        state: of each state, shape ``(n_x,)``; zero where a state has no dynamics of its own.
        command: of each command.
        torque: of each torque, pu.
        drift: change of the disturbance of an output.
        drift_torque: change of the disturbance of a torque, pu.
    """

    measured: Array
    state: Array
    command: float
    torque: float
    drift: float
    drift_torque: float


@dataclass(frozen=True)
class Disturbances:
    """Where constant disturbances act.

    Attributes:
        names: of the disturbances of outputs, then of torques.
        outputs: on the outputs, shape ``(n_y, n_d)``.
        torques: effect of each torque (1 pu over a sample) on the states, shape ``(n_x, n_t)``; all of them bring noise.
        estimated: whether the torques have constant disturbances too.
    """

    names: tuple[str, ...]
    outputs: Array
    torques: Array
    estimated: bool

    @property
    def pushing(self) -> Array:
        """Effect on the states of the torques whose disturbance is estimated."""
        return self.torques if self.estimated else self.torques[:, :0]


class OffsetFreeFilter:
    """The filter: of states, disturbances of outputs, disturbances of torques, in this order.

    Args:
        disturbances: where they act.
        noise: what is assumed.
        rows: positions among the outputs of what is measured, shape ``(n_m,)``.
        x: states at first, shape ``(n_x,)``.

    Attributes:
        at: what it believes.
        surprise: largest innovation of the last measurement.
        start: what it believes at first.
        walk: variances of what comes in during a sample, of states and disturbances.
    """

    def __init__(self, disturbances: Disturbances, noise: Noise, rows: NDArray[np.intp], x: Array) -> None:
        self.disturbances, self.noise, self.rows = disturbances, noise, rows
        self._n, self._n_d, self._n_t = x.size, disturbances.outputs.shape[1], disturbances.pushing.shape[1]
        drift = np.concatenate((np.full(self._n_d, noise.drift), np.full(self._n_t, noise.drift_torque)))
        self.walk = np.concatenate((noise.state, drift)) ** 2
        self.start = Gaussian(np.concatenate((x, np.zeros(drift.size))), np.diag(100.0 * self.walk))
        self.at, self.surprise = self.start, 0.0

    @property
    def x(self) -> Array:
        """The states, shape ``(n_x,)``."""
        return self.at.x[: self._n]

    @property
    def push(self) -> Array:
        """What the disturbances of torques move the states by in a sample, shape ``(n_x,)``."""
        pushed: Array = self.disturbances.pushing @ self.at.x[self._n + self._n_d :]
        return pushed

    @property
    def estimates(self) -> dict[str, float]:
        """The disturbances by name."""
        return dict(zip(self.disturbances.names, map(float, self.at.x[self._n :]), strict=True))

    @property
    def sound(self) -> bool:
        """Whether the estimate is finite, and no disturbance is larger than any that an undamaged plant could explain."""
        finite = bool(np.isfinite(self.at.x).all() and np.isfinite(self.at.P).all())
        return finite and bool(np.abs(self.at.x[self._n :]).max(initial=0.0) <= LARGEST)

    def disturbed(self, y: Array) -> Array:
        """Outputs of the model with the disturbances on them, shape ``(..., n_y)``."""
        total: Array = y + self.disturbances.outputs @ self.at.x[self._n : self._n + self._n_d]
        return total

    def predict(self, step: Transition) -> None:
        """A sample has passed: the states went from the present estimate to ``step.x``."""
        n, noise, pushing = self._n, self.noise, self.disturbances.pushing
        A, into = np.eye(self.at.x.size), np.diag(self.walk)
        A[:n, :n], A[:n, n + self._n_d :] = step.A, pushing
        random = np.hstack((step.B * noise.command, self.disturbances.torques * noise.torque))
        into[:n, :n] += random @ random.T
        self.at = self.at.predicted(np.concatenate((step.x, self.at.x[n:])), A, into)

    def correct(self, measured: Array, y: Array, C: Array) -> None:
        """Take in a measurement, NaN where a signal was lost.

        Args:
            measured: shape ``(n_m,)``.
            y: outputs the model predicts without disturbances, shape ``(n_y,)``.
            C: their derivatives to the states, shape ``(n_y, n_x)``.
        """
        innovation = measured - self.disturbed(y)[self.rows]
        seen = np.hstack((C, self.disturbances.outputs, np.zeros((C.shape[0], self._n_t))))[self.rows]
        self.at = self.at.corrected(innovation, seen, self.noise.measured**2)
        there = innovation[np.isfinite(innovation)]
        self.surprise = float(np.abs(there).max()) if there.size else np.nan

    def confused(self, step: Transition) -> Sequence[str]:
        """Names of the disturbances that the measurements cannot tell apart at rest, with this transition of a sample."""
        moving = self.noise.state > 0
        pushing, outputs = self.disturbances.pushing[moving], self.disturbances.outputs[self.rows]
        B_d = np.hstack((np.zeros((pushing.shape[0], self._n_d)), pushing))
        C_d = np.hstack((outputs, np.zeros((outputs.shape[0], self._n_t))))
        found = unidentified(step.A[np.ix_(moving, moving)], B_d, step.C[np.ix_(self.rows, moving)], C_d)
        return [self.disturbances.names[k] for k in found]

    def memory(self) -> Mapping[str, Array]:
        """The estimate."""
        return {"x": self.at.x, "P": self.at.P, "surprise": np.array(self.surprise)}

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off; from the start where it is empty."""
        self.at = Gaussian(memory["x"], memory["P"]) if memory else self.start
        self.surprise = float(memory["surprise"]) if memory else 0.0
