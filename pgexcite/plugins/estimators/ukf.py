"""Unscented Kalman filter of a unit and its equivalent infinite bus, from the unit's own terminals."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict
from scipy.stats import chi2

from pgexcite.core.controller import as_arrays
from pgexcite.core.declare import par
from pgexcite.core.equivalent import TERMINALS, Equivalent, Terminals
from pgexcite.core.estimation import Estimate, Observer
from pgexcite.core.settings import Compile
from pgexcite.plugins.estimators.mapped_filter import Expectation, MappedFilter

Array = NDArray[np.float64]

_LONGEST_STEP = 0.025
"""Steps of the process model are no longer than this, s."""
_FASTEST = 0.5
"""Largest deviation of a speed from nominal that makes sense, pu."""
_FORGET = 0.3
"""Weight of a sample in the running mean of the normalised innovations squared."""
_FORGIVE = 0.1
"""Seconds of unexplained measurements that a second of explained ones makes up for."""


_HELD = 1e-5
"""Standard deviation of what is held, pu: nothing against any measurement."""


class UKF(BaseModel):
    """Estimates rotor states, mechanical torque, and what the rest of the grid looks like: ``x_s``, ``v_bus``, its frequency.

        e_fd --> [ machine --- x_s --- v_bus ] --> expected v_t, P, Q, omega --(-)--> innovation --> gain --> all of them
                                                            measured ----------(+)

    What is measured is judged before it is used, by the normalised innovation squared (NIS). Where it is not what was expected, the
    network may have changed. Two changes are tried, both from the network as it was when it was last settled: a moderate one (a
    line tripped, a fault cleared), then a severe one (a fault). A measurement that neither explains is left out.

    At rest one combination of ``delta``, ``x_s`` and ``v_bus`` cannot be seen from the terminals. Both ``x_s`` and ``v_bus`` are
    therefore held while nothing moves, and their uncertainty with them. The mirror image of the network, ``x_s < 0``, explains the
    terminals as well as the true one; sigma points are clipped to ``x_s_min`` and above.

    Measurements that stay unexplained for ``patience``, and a covariance that is none, are a divergence: the estimate is not sound
    until the filter has started anew and explained measurements for ``warm_up``.

    Not modelled: resistance and load between the terminals and the equivalent bus.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    source: ClassVar[str] = "S. J. Julier, J. K. Uhlmann, Proc. IEEE 92 (2004) 401-422; R. Labbe, filterpy"

    noise: float = par(0.01, "pu", "standard deviation of measured voltages and powers", gt=0)
    noise_omega: float = par(1e-4, "pu", "standard deviation of measured speeds", gt=0)
    x_s: float = par(0.3, "pu", "reactance between the terminals and the equivalent bus, at first", gt=0)
    spread: float = par(0.4, "-", "its standard deviation at first, relative", gt=0, lt=1)
    x_s_min: float = par(0.02, "pu", "lowest reactance that makes sense", gt=0)
    x_s_max: float = par(2.0, "pu", "highest reactance that makes sense", gt=0)
    v_bus_min: float = par(0.05, "pu", "lowest voltage of the equivalent bus that makes sense", gt=0)
    v_bus_max: float = par(1.5, "pu", "highest voltage of the equivalent bus that makes sense", gt=0)
    share: float = par(0.03, "-", "share of a state's change in a sample that the model may have wrong", ge=0)
    walk_flux: float = par(5e-3, "pu/sqrt(s)", "random walk of the rotor's fluxes", gt=0)
    walk_omega: float = par(1e-4, "pu/sqrt(s)", "random walk of the speed", gt=0)
    walk_delta: float = par(5e-3, "rad/sqrt(s)", "random walk of the rotor angle", gt=0)
    walk_p_m: float = par(2e-3, "pu/sqrt(s)", "random walk of the mechanical torque", gt=0)
    walk_frequency: float = par(2e-4, "pu/sqrt(s)", "random walk of the equivalent bus's frequency", gt=0)
    walk_x_s: float = par(2e-3, "pu/sqrt(s)", "random walk of x_s while anything moves", gt=0)
    walk_v_bus: float = par(2e-3, "pu/sqrt(s)", "random walk of v_bus while anything moves", gt=0)
    gate: float = par(
        1e-8, "-", "probability with which a measurement that is as expected is taken for unexpected", gt=0
    )
    hold_after: float = par(
        2.0, "s", "time after a change of the network at which x_s and v_bus may be held again", ge=0
    )
    settled_after: float = par(0.5, "s", "time after a change of the network at which it counts as settled", ge=0)
    patience: float = par(0.5, "s", "time for which measurements may stay unexplained", gt=0)
    warm_up: float = par(0.25, "s", "time for which a filter started anew must explain measurements", ge=0)

    def start(self, equivalent: Equivalent, dt: float, compile: Compile = "auto") -> Observer:
        """Begin a run."""
        return _Tracker(self, equivalent, dt, compile)

    @cached_property
    def limit(self) -> float:
        """NIS above which a measurement is unexpected."""
        return float(chi2.isf(self.gate, len(TERMINALS)))

    @cached_property
    def limit_calm(self) -> float:
        """Running mean of NIS up to which the network is what it is believed to be."""
        return _mean_above(1e-2)

    @cached_property
    def limit_mean(self) -> float:
        """Running mean of NIS above which something moves that a single sample does not show."""
        return _mean_above(self.gate)


def _mean_above(probability: float) -> float:
    """What the running mean of NIS exceeds with this probability where the model holds."""
    # The weighted sum has the mean and the variance of this chi-squared variable, scaled.
    scale = _FORGET / (2 - _FORGET)
    return float(chi2.isf(probability, len(TERMINALS) / scale)) * scale


class _Tracker:
    """The filter in one run."""

    # Standard deviations of (delta, x_s relative, v_bus) of the changes a network may go through.
    _MODERATE = (0.1, 0.3, 0.05)
    _SEVERE = (1.0, 0.1, 0.6)

    def __init__(self, options: UKF, equivalent: Equivalent, dt: float, compile: Compile) -> None:
        self.options, self._dt = options, dt
        self.layout = layout = equivalent.layout
        self._equivalent = equivalent
        self._network = np.arange(layout.size)[layout.x_s :]
        self._omega_0 = 2 * np.pi * equivalent.f_n
        lower, upper = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
        lower[layout.x_s], upper[layout.x_s] = options.x_s_min, options.x_s_max
        lower[layout.bus], upper[layout.bus] = -options.v_bus_max, options.v_bus_max
        lower[layout.omega_bus], upper[layout.omega_bus] = -_FASTEST, _FASTEST
        share = np.zeros(layout.size)
        share[: len(layout.rotor)] = options.share
        steps = int(np.ceil(dt / _LONGEST_STEP - 1e-9))
        self._filter = MappedFilter(*equivalent.functions(dt, steps), lower, upper, share, dt, compile)
        noise = np.array([options.noise_omega if name == "omega" else options.noise for name in TERMINALS])
        self._filter.R = np.diag(noise**2)
        self._walk = np.square(
            self._spread(options.walk_flux, options.walk_omega, options.walk_p_m, options.walk_frequency)
        )
        P = np.square(self._spread(options.noise, options.noise_omega, options.noise, options.noise_omega / 10))
        around, _ = _directions(equivalent.start[layout.bus])
        P = np.diag(P)
        P[layout.bus, layout.bus] = options.noise**2 * np.outer(around, around)
        at = equivalent.terminals
        self._seen = np.array([at.v, at.p, at.q, 1.0])
        self._begin(
            equivalent.start, P, parked=((options.spread * equivalent.start[layout.x_s]) ** 2, options.noise**2)
        )
        self._started, self._anew = 0.0, 0.0

    def _spread(self, flux: float, speed: float, torque: float, frequency: float) -> Array:
        """A standard deviation for each entry; none for the network."""
        layout = self.layout
        sigma = np.full(layout.size, flux)
        sigma[layout.omega], sigma[layout.p_m], sigma[layout.omega_bus] = speed, torque, frequency
        sigma[self._network] = 0.0
        return sigma

    def _begin(self, x: Array, P: Array, parked: tuple[float, float] | None) -> None:
        """Start, or start anew, with the network held where the variances of ``x_s`` and ``v_bus`` are given."""
        self._held, self._parked = parked is not None, np.array(parked or (0.0, 0.0))
        if self._held:
            P = P + self._floor(x)
        self._filter.begin(x, P)
        self._settle()
        self._since, self._moving = np.inf, 0.0
        self._unexplained, self._mean = 0.0, float(len(TERMINALS))

    # What cannot be seen at rest.

    def _fixed(self, x: Array) -> Array:
        """The two directions ``x_s`` and ``v_bus``, shape ``(size, 2)``."""
        directions = np.zeros((self.layout.size, 2))
        directions[self.layout.x_s, 0] = 1.0
        directions[self.layout.bus, 1] = _directions(x[self.layout.bus])[1]
        return directions

    def _floor(self, x: Array) -> Array:
        """Next to no variance in what is held: enough for a factor of the covariance."""
        fixed = self._fixed(x)
        return _HELD**2 * fixed @ fixed.T

    def _hold(self) -> None:
        """Take ``x_s`` and ``v_bus`` for known from here on, and put their uncertainty aside."""
        P = self._filter.P
        fixed = self._fixed(self._filter.x)
        own = fixed.T @ P @ fixed
        given_x_s = own[1, 1] - own[0, 1] ** 2 / own[0, 0]
        self._parked = np.array([own[0, 0], max(given_x_s, 0.0) + self.options.noise**2 / 100])
        self._filter.P = P - P @ fixed @ np.linalg.solve(own, fixed.T @ P) + self._floor(self._filter.x)
        self._held = True

    def _release(self) -> None:
        """Let them go, as uncertain as they were."""
        if self._held:
            at = np.ix_(self._network, self._network)
            self._filter.P[at] = self._network_P()
            self._held = False

    def _network_P(self) -> Array:
        """Covariance of the network, shape ``(3, 3)``, with what has been put aside."""
        P = self._filter.P[np.ix_(self._network, self._network)]
        if self._held:
            v_t, p_e, q_e, _ = self._seen
            x_s, b_d, b_q = self._filter.x[self._network]
            at = Terminals(v_t, p_e, q_e)
            # At given terminals the voltage of the bus is on a straight line in x_s.
            slope = at.slope * complex(b_d, b_q) / at.behind(x_s)
            along = np.array([1.0, slope.real, slope.imag])
            outwards = np.concatenate(([0.0], _directions(np.array([b_d, b_q]))[1]))
            P = P + self._parked[0] * np.outer(along, along) + self._parked[1] * np.outer(outwards, outwards)
        return P

    def _settle(self) -> None:
        """Keep the network as it is now: what a change starts from."""
        self._settled, self._settled_P = self._filter.x[self._network], self._network_P()
        self._turned = 0.0

    # One sample.

    def observe(self, terminals: Array | None, e_fd: float) -> Estimate:
        """One sample further; see ``pgexcite.core.estimation.Observer``."""
        kalman = self._filter
        changed, surprise, innovation = 0, np.nan, np.full(len(TERMINALS), np.nan)
        try:
            if self._started:
                self._propagate(e_fd)
            self._started = 1.0
            if terminals is not None:
                expected, changed = self._judged(terminals)
                innovation, surprise, self._seen = terminals - expected.z, expected.surprise(terminals), expected.z
                if changed >= 0:
                    self._correct(expected, terminals)
            sane = bool(np.isfinite(kalman.x).all() and np.isfinite(kalman.P).all() and (np.diag(kalman.P) > 0).all())
        except np.linalg.LinAlgError:
            sane = False
        if not sane or self._unexplained > self.options.patience:
            self._restart()
        return self._estimate(changed, surprise, innovation)

    def _propagate(self, e_fd: float) -> None:
        kalman, layout, options = self._filter, self.layout, self.options
        before = kalman.x
        around, outwards = _directions(before[layout.bus])
        walk = np.diag(self._walk)
        walk[layout.bus, layout.bus] = options.walk_delta**2 * np.outer(around, around)
        if not self._held:
            walk[layout.x_s, layout.x_s] = options.walk_x_s**2
            walk[layout.bus, layout.bus] += options.walk_v_bus**2 * np.outer(outwards, outwards)
        kalman.Q = walk * self._dt
        kalman.propagate(e_fd)
        self._keep(before)
        mean = (before + kalman.x) / 2
        self._turned += self._omega_0 * self._dt * (mean[layout.omega] - mean[layout.omega_bus] - 1)
        self._since += self._dt
        self._moving -= self._dt

    def _keep(self, before: Array) -> None:
        """Keep ``x_s`` and ``v_bus`` as they were, where they are held, and ``v_bus`` within its bounds."""
        x, layout = self._filter.x, self.layout
        v_bus = np.hypot(*x[layout.bus])
        wanted = np.clip(v_bus, self.options.v_bus_min, self.options.v_bus_max)
        if self._held:
            x[layout.x_s], wanted = before[layout.x_s], np.hypot(*before[layout.bus])
        x[layout.bus] *= wanted / max(v_bus, 1e-9)

    def _judged(self, z: Array) -> tuple[Expectation, int]:
        """What is expected, and the change of the network that takes: 0 none, 1 moderate, 2 severe; -1 where none explains it."""
        options = self.options
        expected = self._filter.expect()
        surprise = expected.surprise(z)
        self._mean += _FORGET * (min(surprise, options.limit) - self._mean)
        if surprise <= options.limit and self._mean <= options.limit_mean:
            self._anew = max(self._anew - self._dt, 0.0)
            self._unexplained = max(self._unexplained - _FORGIVE * self._dt, 0.0)
            return expected, 0
        self._unexplained += self._dt
        self._anew = options.warm_up if self._anew > 0 else 0.0
        for k, jump in enumerate((self._MODERATE, self._SEVERE)):
            x, P = self._changed(jump)
            other = self._filter.expect(x, P)
            if other.surprise(z) <= options.limit:
                self._filter.x, self._filter.P, self._held = x, P, False
                self._since, self._moving, self._mean = 0.0, options.hold_after, float(len(TERMINALS))
                return other, k + 1
        return expected, -1

    def _changed(self, jump: tuple[float, float, float]) -> tuple[Array, Array]:
        """The present state with the network of the last settled instant, turned as the rotor has, and uncertain by a jump."""
        layout, options = self.layout, self.options
        x, P = self._filter.x.copy(), self._filter.P.copy()
        turn = np.eye(3)
        cosine, sine = np.cos(self._turned), np.sin(self._turned)
        turn[1:, 1:] = (cosine, sine), (-sine, cosine)
        x[self._network] = turn @ self._settled
        P[self._network, :] = P[:, self._network] = 0.0
        P[np.ix_(self._network, self._network)] = turn @ self._settled_P @ turn.T + self._jump(x, jump)
        fluxes = [k for k in range(len(layout.rotor)) if k != layout.omega]
        P[fluxes, fluxes] += options.noise**2
        P[layout.omega, layout.omega] += 4 * options.noise_omega**2
        return x, P

    def _jump(self, x: Array, jump: tuple[float, float, float]) -> Array:
        """Covariance of a change of the network, shape ``(3, 3)``."""
        delta, x_s, v_bus = jump
        around, outwards = _directions(x[self.layout.bus])
        P = np.zeros((3, 3))
        P[0, 0] = (x_s * x[self.layout.x_s]) ** 2
        P[1:, 1:] = delta**2 * np.outer(around, around) + v_bus**2 * np.outer(outwards, outwards)
        return P

    def _correct(self, expected: Expectation, z: Array) -> None:
        kalman, layout, options = self._filter, self.layout, self.options
        before = kalman.x
        kalman.correct(expected, z)
        self._keep(before)
        if abs(kalman.x[layout.omega] - kalman.x[layout.omega_bus] - 1) > 4 * options.noise_omega:
            self._moving = max(self._moving, options.settled_after)
            self._release()
        elif self._moving <= 0 and not self._held:
            self._hold()
        if self._since >= options.settled_after and self._mean <= options.limit_calm:
            self._settle()

    def _restart(self) -> None:
        """Start anew from the initial point, of which next to nothing is taken for certain."""
        options, layout = self.options, self.layout
        x = self._equivalent.start.copy()
        P = np.diag(np.square(self._spread(0.2, 10 * options.noise_omega, 0.1, options.noise_omega)))
        P[layout.x_s :, layout.x_s :] = self._jump(x, (1.0, options.spread, 0.6))
        self._begin(x, P, parked=None)
        self._moving, self._anew = options.hold_after, options.warm_up

    # What is told of it.

    def _estimate(self, changed: int, surprise: float, innovation: Array) -> Estimate:
        layout, x = self.layout, self._filter.x
        variance = np.diag(self._filter.P).copy()
        b_d, b_q = x[layout.bus]
        v_bus = float(np.hypot(b_d, b_q))
        around, outwards = _directions(x[layout.bus])
        network = self._network_P()
        P_bus = network[1:, 1:]
        variance[self._network] = np.diag(network)
        told = {name: x[k] for k, name in enumerate((*layout.rotor, "p_m", "omega_bus", "x_s"))}
        told |= {f"sigma_{name}": np.sqrt(variance[k]) for k, name in enumerate(list(told))}
        told |= {"v_bus": v_bus, "sigma_v_bus": np.sqrt(outwards @ P_bus @ outwards)}
        told |= {"delta": np.arctan2(b_d, b_q), "sigma_delta": np.sqrt(around @ P_bus @ around) / v_bus}
        told["covariance_x_s_v_bus"] = network[0, 1:] @ outwards
        told |= {f"innovation_{name}": value for name, value in zip(TERMINALS, innovation, strict=True)}
        told |= {"nis": surprise, "network_change": changed, "network_held": self._held}
        return Estimate(self._anew <= 0, x.copy(), {name: float(value) for name, value in told.items()})

    # Snapshots.

    _NUMBERS = ("started", "held", "since", "moving", "unexplained", "anew", "mean", "turned")
    _ARRAYS = ("settled", "settled_P", "parked", "seen")

    def memory(self) -> Mapping[str, Array]:
        """State, covariance, the settled network and the clocks."""
        kept = {name: getattr(self, f"_{name}") for name in (*self._NUMBERS, *self._ARRAYS)}
        return as_arrays(kept | {"x": self._filter.x, "P": self._filter.P})

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        self._filter.x, self._filter.P = memory["x"].copy(), memory["P"].copy()
        for name in self._ARRAYS:
            setattr(self, f"_{name}", memory[name])
        for name in self._NUMBERS:
            setattr(self, f"_{name}", float(memory[name]))
        self._held = bool(self._held)


def _directions(bus: Array) -> tuple[Array, Array]:
    """Where ``(b_d, b_q)`` goes as the rotor angle grows, per rad, and, of length one, as the voltage of the bus does."""
    return np.array([bus[1], -bus[0]]), bus / max(np.hypot(bus[0], bus[1]), 1e-9)
