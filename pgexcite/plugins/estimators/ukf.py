"""Unscented Kalman filter of a unit and its equivalent infinite bus, from the unit's own terminals."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from math import sqrt
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict
from scipy.stats import chi2

from pgexcite.core.declare import par
from pgexcite.core.equivalent import TERMINALS, Equivalent
from pgexcite.core.estimation import Estimate, Observer, Written
from pgexcite.core.memory import as_arrays, those_under, under
from pgexcite.core.settings import Compile
from pgexcite.plugins.estimators.mapped_filter import Expectation, MappedFilter
from pgexcite.plugins.estimators.network import HELD, LOWEST, Jump, Network, directions, spread, wandered

Array = NDArray[np.float64]

_LONGEST_STEP = 0.025
"""Steps of the process model are no longer than this, s."""
_FASTEST = 0.5
"""Largest deviation of a speed from nominal that makes sense, pu."""
_FORGET = 0.3
"""Weight of a sample in the running mean of the normalised innovations squared."""
_FORGIVE = 0.1
"""Seconds of unexplained measurements that a second of explained ones makes up for."""
_BY_CHANGE = 0.5
"""Share of a sample that counts as unexplained where a change of the network had to be assumed. A model that is wrong about its
machine needs one after the other in a large swing, and its estimates are of use all the same."""

_SWING = 4.0
"""Deviation of the speed that counts as a swing, in standard deviations of its measurement."""
_MODERATE = Jump(0.1, 0.3, 0.05)
"""A line trips, a fault is cleared."""
_SEVERE = Jump(3.0, 0.3, 0.3, left_x_s=0.5, left_v_bus=0.2)
"""A fault: little voltage is left, behind less than the whole reactance. Else a bus out of phase would explain it as well."""
_ANY = Jump(1.0, 0.0, 0.6)
"""What may have become of the initial point, but for ``x_s``."""
_JUMPS = (_MODERATE, _SEVERE)
"""In the order in which they are tried."""
_STEADY = 0.3
"""Share of its random walk that the torque keeps right after a change: a swing is faster than a turbine."""
_RESTLESS = 20.0
"""Factor on the random walk of the bus's frequency while measurements are not quite as expected: without an infinite bus it moves
whenever load or generation does."""
_JOLT_FLUX = 3e-3
"""What a change of the network adds to the deviation of the fluxes, which do not jump, pu."""
_JOLT_OMEGA = 2.0
"""The same of the speed, in standard deviations of its measurement."""
_LATE = 3**-0.5
"""Share of the last sample for which a change had been there already, root mean square: any share is as likely."""
_LATE_FLUX = 0.05
"""What a pu of power that was there for the whole sample does to the fluxes, pu: ``X'_d - X''_d`` is some 0.1, and a subtransient
time constant lets half of it come."""

_P_E = TERMINALS.index("p_e")

_TOLD = (
    "x_s",
    "sigma_x_s",
    "v_bus",
    "sigma_v_bus",
    "delta",
    "sigma_delta",
    "nis",
    "network_change",
    "network_held",
)
"""What an exported filter tells."""
_TEXTS = ("mapped_filter.c", "network.c", "ukf.c")
"""What it is written as, in C."""


class UKF(BaseModel):
    """Estimates rotor states, mechanical torque, and what the rest of the grid looks like: ``x_s``, ``v_bus``, its frequency.

        e_fd --> [ machine --- x_s --- v_bus ] --> expected v_t, P, Q, omega --(-)--> innovation --> gain --> all of them
                                                            measured ----------(+)

    What is measured is judged before it is used, by the normalised innovation squared (NIS). Where it is not what was expected, the
    network may have changed. Two changes are tried, both from the network as it was when it was last settled: a moderate one (a
    line tripped, a fault cleared), then a severe one (a fault: most of the voltage is gone). What neither explains is left out.

    At rest one combination of ``delta``, ``x_s`` and ``v_bus`` cannot be seen from the terminals. ``x_s`` is therefore held while
    nothing moves, and its uncertainty with it; given ``x_s``, ``v_bus`` can be seen and is followed. The mirror image of the
    network, ``x_s < 0``, explains the terminals as well as the true one; sigma points are clipped to ``x_s_min`` and above.

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
    share: float = par(0.01, "-", "share of a state's change in a sample that the model may have wrong", ge=0)
    walk_flux: float = par(5e-3, "pu/sqrt(s)", "random walk of the rotor's fluxes", gt=0)
    walk_omega: float = par(3e-5, "pu/sqrt(s)", "random walk of the speed", gt=0)
    walk_delta: float = par(5e-3, "rad/sqrt(s)", "random walk of the rotor angle", gt=0)
    walk_p_m: float = par(5e-3, "pu/sqrt(s)", "random walk of the mechanical torque", gt=0)
    walk_frequency: float = par(5e-5, "pu/sqrt(s)", "random walk of the equivalent bus's frequency", gt=0)
    walk_x_s: float = par(2e-3, "pu/sqrt(s)", "random walk of x_s while anything moves", gt=0)
    walk_v_bus: float = par(5e-4, "pu/sqrt(s)", "random walk of v_bus", gt=0)
    gate: float = par(
        1e-8, "-", "probability with which a measurement that is as expected is taken for unexpected", gt=0
    )
    hold_after: float = par(2.0, "s", "time after a change of the network at which x_s may be held again", ge=0)
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
    """The filter in one run: predict, judge what is measured, correct, or start anew."""

    def __init__(self, options: UKF, equivalent: Equivalent, dt: float, compile: Compile) -> None:
        self.options, self._dt = options, dt
        self.layout = layout = equivalent.layout
        self._start, self._omega_0 = equivalent.start, 2 * np.pi * equivalent.f_n
        self._omega, self._bus, self._fluxes = layout.omega, layout.bus, np.arange(len(layout.rotor)) != layout.omega
        # Variances that a change of the network adds to the rotor's states: always, and for each squared pu of power it made.
        self._jolt = np.where(self._fluxes, _JOLT_FLUX, _JOLT_OMEGA * options.noise_omega) ** 2
        self._late = (_LATE * np.where(self._fluxes, _LATE_FLUX, dt / equivalent.inertia)) ** 2
        lower, upper = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
        lower[layout.x_s], upper[layout.x_s] = options.x_s_min, options.x_s_max
        lower[layout.bus], upper[layout.bus] = -options.v_bus_max, options.v_bus_max
        lower[layout.omega_bus], upper[layout.omega_bus] = -_FASTEST, _FASTEST
        share = np.zeros(layout.size)
        share[: len(layout.rotor)] = options.share
        steps = int(np.ceil(dt / _LONGEST_STEP - 1e-9))
        self._functions = equivalent.functions(dt, steps)
        self._kalman = MappedFilter(*self._functions, lower, upper, share, dt, compile)
        self._kalman.R = np.diag(
            np.square([options.noise_omega if name == "omega" else options.noise for name in TERMINALS])
        )
        self._walk = np.diag(
            self._variances(options.walk_flux, options.walk_omega, options.walk_p_m, options.walk_frequency)
        )
        self._network = Network(self._kalman, layout)
        at = equivalent.terminals
        self._network.seen = np.array([at.v, at.p, at.q, 1.0])
        self._names = (*layout.rotor, "p_m", "omega_bus", "x_s")
        self._since, self._moving, self._mean = np.inf, 0.0, float(len(TERMINALS))
        self._unexplained, self._anew, self._started = 0.0, 0.0, 0.0
        P = np.diag(self._variances(options.noise, options.noise_omega, options.noise, options.noise_omega / 10))
        P[self._bus, self._bus] = (options.noise / 10) ** 2 * np.eye(2)
        self._kalman.x, self._kalman.P = self._start.copy(), P
        self._network.hold(options.spread * self._network.x_s)
        self._network.settle()

    def _variances(self, flux: float, speed: float, torque: float, frequency: float) -> Array:
        """Squares of a standard deviation for each entry; zero for the network."""
        layout = self.layout
        sigma = np.zeros(layout.size)
        sigma[: len(layout.rotor)], sigma[layout.omega] = flux, speed
        sigma[layout.p_m], sigma[layout.omega_bus] = torque, frequency
        return sigma**2

    # One sample.

    def observe(self, terminals: Array | None, e_fd: float) -> Estimate:
        """One sample further; see ``pgexcite.core.estimation.Observer``."""
        kalman = self._kalman
        changed, surprise, innovation = 0, np.nan, np.full(len(TERMINALS), np.nan)
        try:
            if self._started:
                self._propagate(e_fd)
            else:
                kalman.redraw(e_fd)
            self._started = 1.0
            if terminals is not None:
                expected, surprise, changed = self._judged(terminals)
                innovation, self._network.seen = terminals - expected.z, expected.z
                if changed >= 0:
                    self._correct(expected, terminals)
            sane = bool(np.isfinite(kalman.x.sum() + kalman.P.sum()) and kalman.P.diagonal().min() > 0)
        except np.linalg.LinAlgError:
            sane = False
        if not sane or self._unexplained > self.options.patience:
            self._restart()
        return self._estimate(changed, surprise, innovation)

    def _propagate(self, e_fd: float) -> None:
        kalman, options = self._kalman, self.options
        before = kalman.x
        walk = self._walk.copy()
        if self._since < options.hold_after:
            walk[self.layout.p_m, self.layout.p_m] *= _STEADY**2
        if self._mean > options.limit_calm:
            walk[self.layout.omega_bus, self.layout.omega_bus] *= _RESTLESS**2
        walk[self._bus, self._bus] = wandered(before[self._bus], options.walk_delta, options.walk_v_bus)
        if not self._network.held:
            walk[self.layout.x_s, self.layout.x_s] = options.walk_x_s**2
        kalman.Q = walk * self._dt
        kalman.propagate(e_fd)
        self._network.keep(before, options.v_bus_min, options.v_bus_max)
        self._network.turn(self._omega_0 * self._dt * (self._slip(before) + self._slip(kalman.x)) / 2)
        self._since += self._dt
        self._moving -= self._dt

    def _slip(self, x: Array) -> float:
        """Speed of the rotor against the bus, pu."""
        return float(x[self._omega] - x[self.layout.omega_bus] - 1)

    def _judged(self, z: Array) -> tuple[Expectation, float, int]:
        """What is expected, how surprising ``z`` is, and the change of the network that takes.

        Returns:
            The change is 0 for none, 1 for a moderate one, 2 for a severe one, -1 where none explains it.
        """
        options = self.options
        expected = self._kalman.expect()
        surprise = expected.surprise(z)
        self._mean += _FORGET * (min(surprise, options.limit) - self._mean)
        if surprise <= options.limit and self._mean <= options.limit_mean:
            self._anew = max(self._anew - self._dt, 0.0)
            self._unexplained = max(self._unexplained - _FORGIVE * self._dt, 0.0)
            return expected, surprise, 0
        self._unexplained += _BY_CHANGE * self._dt
        self._anew = options.warm_up if self._anew > 0 else 0.0
        for k, jump in enumerate(_JUMPS):
            x, P = self._network.changed(jump)
            P[: self._fluxes.size, : self._fluxes.size] += np.diag(
                self._jolt + self._late * (z[_P_E] - expected.z[_P_E]) ** 2
            )
            other = self._kalman.expect(x, P)
            left = other.surprise(z)
            if left <= options.limit:
                self._kalman.x, self._kalman.P, self._network.held = x, P, False
                self._since, self._moving, self._mean = 0.0, options.hold_after, float(len(TERMINALS))
                return other, left, k + 1
        self._unexplained += (1 - _BY_CHANGE) * self._dt
        return expected, surprise, -1

    def _correct(self, expected: Expectation, z: Array) -> None:
        kalman, network, options = self._kalman, self._network, self.options
        before = kalman.x
        kalman.correct(expected, z)
        network.keep(before, options.v_bus_min, options.v_bus_max)
        if abs(self._slip(kalman.x)) > _SWING * options.noise_omega:
            self._moving = max(self._moving, options.settled_after)
            network.release()
        elif self._moving <= 0 and not network.held:
            network.hold()
        if self._since >= options.settled_after and self._mean <= options.limit_calm:
            network.settle()

    def _restart(self) -> None:
        """Start anew from the initial point, of which next to nothing is taken for certain."""
        options = self.options
        self._kalman.x, self._kalman.P, self._network.held = self._start.copy(), self._uncertain(), False
        self._network.settle()
        self._since, self._moving, self._mean = np.inf, options.hold_after, float(len(TERMINALS))
        self._unexplained, self._anew = 0.0, options.warm_up

    def _uncertain(self) -> Array:
        """Covariance of the initial point where next to nothing of it is certain."""
        options, layout = self.options, self.layout
        P = np.diag(self._variances(0.2, 10 * options.noise_omega, 0.1, options.noise_omega))
        P[layout.x_s :, layout.x_s :] = spread(self._start[layout.x_s :], _ANY._replace(x_s=options.spread))
        return P

    # What is told of it.

    def _estimate(self, changed: int, surprise: float, innovation: Array) -> Estimate:
        x, P = self._kalman.x, self._network.covariance()
        variances = self._kalman.P.diagonal().copy()
        variances[-3:] = P.diagonal()
        sigma = np.sqrt(np.maximum(variances, 0.0))
        around, outwards = directions(x[self._bus])
        v_bus = self._network.v_bus
        told = dict(zip(self._names, x.tolist(), strict=False))
        told |= {f"sigma_{name}": value for name, value in zip(self._names, sigma.tolist(), strict=False)}
        told["v_bus"], told["sigma_v_bus"] = v_bus, sqrt(max(float(outwards @ P[1:, 1:] @ outwards), 0.0))
        told["delta"] = float(np.arctan2(*x[self._bus]))
        told["sigma_delta"] = sqrt(max(float(around @ P[1:, 1:] @ around), 0.0)) / v_bus**2
        told["covariance_x_s_v_bus"] = float(P[0, 1:] @ outwards)
        told |= {f"innovation_{name}": value for name, value in zip(TERMINALS, innovation.tolist(), strict=True)}
        told |= {"nis": surprise, "network_change": float(changed), "network_held": float(self._network.held)}
        return Estimate(self._anew <= 0, x.copy(), told)

    # Snapshots.

    _CLOCKS = ("started", "since", "moving", "unexplained", "anew", "mean")

    def memory(self) -> Mapping[str, Array]:
        """State, covariance, the network and the clocks."""
        own = {name: getattr(self, f"_{name}") for name in self._CLOCKS} | {"x": self._kalman.x, "P": self._kalman.P}
        return as_arrays(own) | under("network", self._network.memory())

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        self._kalman.x, self._kalman.P = memory["x"].copy(), memory["P"].copy()
        for name in self._CLOCKS:
            setattr(self, f"_{name}", float(memory[name]))
        self._network.recall(those_under("network", memory))

    # As C.

    def written(self) -> Written:
        """See ``pgexcite.core.estimation.Writable``; the text is in ``_TEXTS``."""
        options, layout, kalman, first = self.options, self.layout, self._kalman, self.memory()
        constants = {
            "n": layout.size,
            "m": len(TERMINALS),
            "rotor": len(layout.rotor),
            "omega": layout.omega,
            "p_m": layout.p_m,
            "omega_bus": layout.omega_bus,
            "x_s": layout.x_s,
            "bus": layout.bus.start,
            "p_e": _P_E,
            "dt": self._dt,
            "omega_0": self._omega_0,
            "scale": kalman.points_fn.scale,
            "weight": kalman.Wm[1],
            "weight_0": kalman.Wm[0],
            "weight_0_P": kalman.Wc[0],
            "limit": options.limit,
            "limit_calm": options.limit_calm,
            "limit_mean": options.limit_mean,
            "forget": _FORGET,
            "forgive": _FORGIVE,
            "by_change": _BY_CHANGE,
            "swing": _SWING * options.noise_omega,
            "held": HELD,
            "lowest": LOWEST,
            "steady": _STEADY**2,
            "restless": _RESTLESS**2,
            "start_aside": float(first["network:aside"]),
            "n_told": len(_TOLD),
            "n_jumps": len(_JUMPS),
            "jump_size": len(Jump._fields),
        }
        constants |= {f"jump_{name}": k for k, name in enumerate(Jump._fields)}
        constants |= {f"told_{name}": k for k, name in enumerate(_TOLD)}
        bounds, walks = ("v_bus_min", "v_bus_max"), ("walk_delta", "walk_v_bus", "walk_x_s")
        clocks = ("hold_after", "settled_after", "patience", "warm_up")
        constants |= {name: getattr(options, name) for name in (*bounds, *walks, *clocks)}
        arrays = {
            "lower": kalman.lower,
            "upper": kalman.upper,
            "share": kalman.share,
            "R": kalman.R.diagonal(),
            "walk": self._walk.diagonal(),
            "jolt": self._jolt,
            "late": self._late,
            "jumps": np.array(_JUMPS),
            "restart_P": self._uncertain(),
            "start": self._start,
            "start_P": first["P"],
            "start_seen": first["network:seen"],
            "start_settled_P": first["network:settled_P"],
        }
        return Written(
            self._functions,
            {f"ukf_{name}": value for name, value in constants.items()},
            {f"UKF_{name.upper()}": np.array(values, dtype=float).ravel() for name, values in arrays.items()},
            "\n".join(Path(__file__).with_name(name).read_text(encoding="utf-8") for name in _TEXTS),
            _TOLD,
        )
