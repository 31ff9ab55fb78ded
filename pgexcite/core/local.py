"""Linear predictions around one point of a model, in discrete time and as exact as its sensitivities.

Whatever the horizon, every piece of it starts from the same point: one linear time-invariant model, except for what is known to
change on the way. Around a point that is not at rest the model is affine; its drift is that of the equations there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.model import State
from pgexcite.core.prediction import Predictor
from pgexcite.core.rollout import Horizon, Transition
from pgexcite.core.step import Kernel

Array = NDArray[np.float64]


class LocalModel:
    """A model linearised at a point, which can be moved.

    Args:
        kernel: of the model.
        commands: positions in ``u`` of the commands.
        predictor: of that kernel, with these commands and ``transitions=True``.
        point: where it is linearised at first; its commands are those the linearisation is around.
    """

    def __init__(self, kernel: Kernel, commands: Sequence[int], predictor: Predictor, point: State) -> None:
        self._kernel, self._commands, self._predictor = kernel, np.array(commands, dtype=int), predictor
        self._found: dict[tuple[int, float, bytes, bytes], Transition | None] = {}
        self.point = point

    def move(self, point: State) -> None:
        """Linearise at another point from now on; its ``z`` is where the search for the algebraic unknowns starts."""
        self.point, self._found = point, {}

    def transition(self, count: int, h: float, u: Array, p: Array) -> Transition | None:
        """``count`` steps of ``h`` seconds from the point, with these other commands and parameters; ``None`` if there are none."""
        key = (count, h, u.tobytes(), p.tobytes())
        if key not in self._found:
            wanted = u.copy()
            wanted[self._commands] = self.point.u[self._commands]
            start = self._kernel.settle(self.point.with_(u=wanted), p)
            self._found[key] = None if start is None else self._predictor.transition(start, p, count, h)
        return self._found[key]

    def sample(self, horizon: Horizon, x: Array, u: Array, push: Array | float = 0.0) -> Transition | None:
        """The first sample of a horizon, from ``x`` under commands ``u``; ``push`` moves the states at its end."""
        du = u - self.point.u[self._commands]
        step = self._piece(horizon, 0)
        if step is None:
            return None
        x, A, B = step.x + step.A @ (x - self.point.x) + step.B @ du, step.A, step.B
        for k in range(1, int(np.flatnonzero(horizon.ends)[0]) + 1):
            step = self._piece(horizon, k)
            if step is None:
                return None
            x = step.x + step.A @ (x - self.point.x) + step.B @ du
            A, B = step.A @ A, step.A @ B + step.B
        x = x + push
        return Transition(x, step.y + step.C @ (x - step.x) + step.D @ du, A, B, step.C, step.D)

    def predict(self, horizon: Horizon, x: Array, plan: Array, push: Array) -> tuple[Array, Array] | None:
        """Outputs at the end of each sample and their derivatives to the plan, shapes ``(N, n_y)`` and ``(N, n_y, plan.size)``.

        Args:
            horizon: the pieces.
            x: states at its beginning.
            plan: commands, shape ``(n_moves, n_u)``.
            push: moves the states by this much in each sample of the first interval's length, shape ``(n_x,)``.
        """
        n_u, ys, slopes = plan.shape[1], [], []
        S = np.zeros((x.size, plan.size))
        lengths = horizon.counts * horizon.lengths
        dt = float(lengths[: int(np.flatnonzero(horizon.ends)[0]) + 1].sum())
        for k, (move, ends) in enumerate(zip(horizon.moves, horizon.ends, strict=True)):
            step = self._piece(horizon, k)
            if step is None:
                return None
            own, du = slice(move * n_u, (move + 1) * n_u), plan[move] - self.point.u[self._commands]
            x = step.x + step.A @ (x - self.point.x) + step.B @ du + (lengths[k] / dt) * push
            S = step.A @ S
            S[:, own] += step.B
            if ends:
                slope = step.C @ S
                slope[:, own] += step.D
                ys.append(step.y + step.C @ (x - step.x) + step.D @ du)
                slopes.append(slope)
        return np.array(ys), np.array(slopes)

    def outputs(self, x: Array, commands: Array, u: Array, p: Array) -> tuple[Array, Array] | None:
        """Outputs and their derivatives to the states at ``x`` under ``commands``, with other commands and parameters in force."""
        wanted = u.copy()
        wanted[self._commands] = self.point.u[self._commands]
        start = self._kernel.settle(self.point.with_(u=wanted), p)
        if start is None:
            return None
        y, C, D = self._predictor.outputs(start, p)
        return y + C @ (x - start.x) + D @ (commands - wanted[self._commands]), C

    def _piece(self, horizon: Horizon, k: int) -> Transition | None:
        row = horizon.rows[k]
        # A horizon's lengths are differences of times: without rounding no two of them were the same.
        h = round(float(horizon.lengths[k]), 12)
        return self.transition(int(horizon.counts[k]), h, horizon.u[row], horizon.p[row])
