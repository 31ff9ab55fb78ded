"""Modes of a loop that is closed once a sample: eigenvalues of the map from one sampling instant to the next.

The plant moves between two samples, the controllers at them; what both remember at an instant is the state of the whole. Around a
point of rest its map over a sample is linear, and ``mu = exp(lambda T)`` turns its multipliers into modes in continuous time
(K. J. Astrom, B. Wittenmark, "Computer-Controlled Systems", 3rd edition 1997, sections 2.2 and 2.6). The map is differentiated
numerically, so it is of the very controllers that run: quadratic programs without active bounds, filters, predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eig

from pgexcite.core.errors import PgexciteError
from pgexcite.core.linearise import Mode, linearise, modes_of
from pgexcite.core.simulate import Simulation
from pgexcite.core.trace import Ending

Array = NDArray[np.float64]

CARRIED = ("u", "next", "solver:u", "solver:filter:x")
"""What of a predictive controller's memory carries the past on: the commands in force and under way, and the estimate of a filter.

The rest stays as it is at rest. A filter's covariance does not depend on what is measured, and while it does not the innovations
are zero: its gain has no first-order effect. A quadratic program's solution does not depend on the plan it starts from."""
_OBSERVED = "solver:observer:x"
"""The estimate of an equivalent. Its filter is not linear and changes its gains; whoever knows it at rest may have it carried."""
_FORGOTTEN = 1e-6
"""Multipliers below this are gone after a sample; their logarithm says nothing."""


@dataclass(frozen=True)
class SampledLoop:
    """The linearised map over a sample.

    Attributes:
        A: the map, shape ``(n, n)``.
        names: of what it maps: paths of the plant's states, ``controller.<name>.<memory>.<k>`` of the controllers',
            ``controller.<name>.instruments.<k>`` of measurements that are delayed.
        period: length of the sample, s.
        defect: largest change over a sample of what should be at rest.
    """

    A: Array
    names: tuple[str, ...]
    period: float
    defect: float

    @cached_property
    def multipliers(self) -> NDArray[np.complex128]:
        """Eigenvalues of ``A``, largest first, shape ``(n,)``."""
        values = np.linalg.eigvals(self.A).astype(complex)
        return values[np.argsort(-np.abs(values), kind="stable")]

    def modes(self) -> list[Mode]:
        """Modes with damping and participation as of a continuous system, least damped first; without what a sample forgets.

        A frequency above ``1 / (2 period)`` appears below it.
        """
        values, left, right = eig(self.A, left=True, right=True)
        kept = np.abs(values) > _FORGOTTEN
        exponents = np.log(values[kept].astype(complex)) / self.period
        return modes_of(exponents, left[:, kept].conj().T, right[:, kept], self.names)


def sampled_modes(
    simulation: Simulation, period: float, *, carried: Sequence[str] = CARRIED, size: float = 1e-5
) -> SampledLoop:
    """Differentiate the map over a sample around the point where a simulation stands, by central differences.

    The simulation must be at rest, controllers included (run it undisturbed until estimates have settled), with no event due within
    the sample; it is left as it was, to the last bit.

    Args:
        simulation: at a sampling instant, before the controllers act.
        period: the sample, s: a whole multiple of the sample times of all controllers.
        carried: entries of a controller's memory that carry the past on; those a controller does not have are passed over.
        size: by how much each state is moved either way, in its unit. A controller's tolerances must be well below what it answers.

    Raises:
        PgexciteError: the simulation is not at a sampling instant, is not at rest, or does not get over the sample; delayed
            measurements have not yet been taken; measurements are noisy or may be lost, so that there is no one map; an estimate
            of an equivalent is not carried.
    """
    for name, controller in simulation.controllers.items():
        if controller.measurement.random:
            text = "its noise and losses make every sample another map; leave them out"
            raise PgexciteError(f"controller.{name}.measurement: {text}")
    loop = _Loop(simulation, period, carried)
    rest = loop.read()
    defect = float(np.abs(loop(rest) - rest).max(initial=0.0))
    if defect > size:
        raise PgexciteError(f"this is not a point of rest: something moves by {defect:.2g} in a sample of {period:g} s")
    columns = []
    for k in range(rest.size):
        move = np.zeros(rest.size)
        move[k] = size
        columns.append((loop(rest + move) - loop(rest - move)) / (2 * size))
    return SampledLoop(np.array(columns).T.reshape(rest.size, rest.size), loop.names, period, defect)


class _Loop:
    """The map over a sample, from a vector to a vector; each call leaves the simulation where it was."""

    def __init__(self, simulation: Simulation, period: float, carried: Sequence[str]) -> None:
        self._sim, self._period = simulation, period
        self._rest = simulation.memory()
        count, every = round(period / simulation.settings.h), simulation.sampling
        if every and (simulation.state.k % every or count % every):
            text = f"start and length of the sample must be multiples of the controllers' {every * simulation.settings.h:g} s"
            raise PgexciteError(text)
        model = simulation.model
        moving = linearise(model, simulation.state, simulation.p).x_names
        self._moving = np.array([model.position("x", path) for path in moving], dtype=int)
        kept, said = self._rest.kept, dict[str, str]()
        for name in simulation.controllers:
            if f"controller:{name}:{_OBSERVED}" in kept and _OBSERVED not in carried:
                text = "carries an estimate on that is not among what is carried: this would not be its loop"
                raise PgexciteError(f"controller.{name}: {text}; see carried ({_OBSERVED!r})")
            said |= {f"controller:{name}:{key}": f"controller.{name}.{key}" for key in carried}
            # Delayed samples of its measurements carry the past on as well.
            said[f"instruments:{name}"] = f"controller.{name}.instruments"
        self._entries = [key for key in said if key in kept]
        self.names = (*moving, *(f"{said[key]}.{k}" for key in self._entries for k in range(kept[key].size)))

    def read(self) -> Array:
        """What the simulation carries on now."""
        kept = self._sim.memory().kept
        if any(kept[key].shape != self._rest.kept[key].shape for key in self._entries):
            raise PgexciteError("delayed measurements have not yet been taken: run the simulation for a sample or more")
        return np.concatenate((self._sim.state.x[self._moving], *(np.ravel(kept[key]) for key in self._entries)))

    def __call__(self, vector: Array) -> Array:
        """A sample on from ``vector``."""
        start = self._rest.state
        x = start.x.copy()
        x[self._moving] = vector[: self._moving.size]
        settled = self._sim.kernel.settle(start.with_(x=x), self._sim.p)
        if settled is None:
            raise PgexciteError("the network has no solution next to this point")
        # Solving the network again is not a discontinuity that the loop would have met.
        settled = settled.with_(startup=start.startup)
        kept, at = dict(self._rest.kept), self._moving.size
        for key in self._entries:
            kept[key] = vector[at : at + kept[key].size].reshape(kept[key].shape)
            at += kept[key].size
        with self._sim.tentatively():
            self._sim.recall(replace(self._rest, state=settled, kept=kept))
            outcome = self._sim.run(until=start.t + self._period)
            if outcome.ending is not Ending.COMPLETED:
                raise PgexciteError(f"the simulation did not get over the sample: {outcome.message}")
            return self.read()
