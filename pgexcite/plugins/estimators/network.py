"""What is believed of the equivalent bus beyond a filter's mean and covariance: is it held, and what does a change start from."""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.equivalent import Layout, Terminals
from pgexcite.core.memory import as_arrays
from pgexcite.plugins.estimators.mapped_filter import MappedFilter

Array = NDArray[np.float64]

HELD = 1e-5
"""Standard deviation of what is held, pu: nothing against any measurement."""

LOWEST = 0.01
"""Voltage below which a phasor has no direction worth the name, pu."""


class Jump(NamedTuple):
    """A change of the network.

    Attributes:
        delta, x_s, v_bus: standard deviations, rad, relative, and pu.
        left_x_s, left_v_bus: what is left of ``x_s`` and ``v_bus`` on average.
    """

    delta: float
    x_s: float
    v_bus: float
    left_x_s: float = 1.0
    left_v_bus: float = 1.0


class Network:
    """The network of one unit in one run: ``x_s`` and the voltage ``(b_d, b_q)`` of the equivalent bus, in the filter's state.

    While ``x_s`` is held the filter takes it for known, and its variance is put aside. At rest nothing measured depends on it; left
    in the filter the variance would shrink by noise that is taken for information, and make the filter deaf meanwhile. The voltage
    of the bus can be seen at rest where ``x_s`` is given, and goes on being followed.

    Args:
        kalman: the filter.
        layout: of its state.

    Attributes:
        seen: terminals as last expected, in the order of ``pgexcite.core.equivalent.TERMINALS``.
        held: whether ``x_s`` is held.
    """

    def __init__(self, kalman: MappedFilter, layout: Layout) -> None:
        self._kalman = kalman
        self._x_s, self._bus, self._all = layout.x_s, layout.bus, slice(layout.x_s, layout.size)
        self.held = False
        self.seen: Array = np.zeros(4)
        self._aside, self._turned = 0.0, 0.0
        self._settled, self._settled_P = np.zeros(3), np.zeros((3, 3))

    @property
    def x_s(self) -> float:
        """Reactance, pu."""
        return float(self._kalman.x[self._x_s])

    @property
    def v_bus(self) -> float:
        """Voltage of the equivalent bus, pu."""
        b_d, b_q = self._kalman.x[self._bus].tolist()
        return hypot(b_d, b_q)

    # Holding.

    def covariance(self) -> Array:
        """Covariance of ``(x_s, b_d, b_q)``, with what has been put aside."""
        kalman = self._kalman
        P = kalman.P[self._all, self._all]
        if not self.held:
            return np.array(P)
        v_t, p_e, q_e, _ = self.seen.tolist()
        at, bus = Terminals(max(v_t, LOWEST), p_e, q_e), complex(*kalman.x[self._bus])
        behind = at.behind(self.x_s)
        if abs(behind) < LOWEST:
            return np.array(P)
        # At given terminals the voltage of the bus is on a straight line in x_s.
        slope = at.slope * bus / behind
        along = np.array([1.0, slope.real, slope.imag])
        return np.asarray(P + self._aside * np.outer(along, along))

    def hold(self, sigma_x_s: float | None = None) -> None:
        """Take ``x_s`` for known from here on.

        Args:
            sigma_x_s: its standard deviation, pu, where the filter has none of it yet.
        """
        P, k = self._kalman.P.copy(), self._x_s
        self._aside = float(P[k, k]) if sigma_x_s is None else sigma_x_s**2
        if sigma_x_s is None:
            P -= np.outer(P[:, k], P[k, :]) / P[k, k]
        P[k, :] = P[:, k] = 0.0
        P[k, k] = HELD**2
        self._kalman.P = P
        self.held = True

    def release(self) -> None:
        """Let it go, as uncertain as it was."""
        if self.held:
            self._kalman.P[self._all, self._all] = self.covariance()
            self.held = False

    def keep(self, before: Array, lowest: float, highest: float) -> None:
        """Give ``x_s`` its value in ``before`` again, where it is held, and ``v_bus`` one within its bounds."""
        x, v_bus = self._kalman.x, self.v_bus
        if self.held:
            x[self._x_s] = before[self._x_s]
        if not lowest <= v_bus <= highest:
            x[self._bus] *= min(max(v_bus, lowest), highest) / max(v_bus, 1e-9)

    # Changing.

    def turn(self, angle: float) -> None:
        """The rotor has moved ahead of the bus by this angle, rad, since the last sample."""
        self._turned += angle

    def settle(self) -> None:
        """Keep the network as it is now: a change starts from here."""
        self._settled, self._settled_P = self._kalman.x[self._all].copy(), self.covariance()
        self._turned = 0.0

    def changed(self, jump: Jump) -> tuple[Array, Array]:
        """State and covariance with the network as last settled, turned as the rotor has since, uncertain by a jump."""
        x, P = self._kalman.x.copy(), self._kalman.P.copy()
        turn = np.eye(3)
        cosine, sine = np.cos(self._turned), np.sin(self._turned)
        turn[1:, 1:] = (cosine, sine), (-sine, cosine)
        x[self._all] = [jump.left_x_s, jump.left_v_bus, jump.left_v_bus] * (turn @ self._settled)
        P[self._all, :] = P[:, self._all] = 0.0
        P[self._all, self._all] = turn @ self._settled_P @ turn.T + spread(x[self._all], jump)
        return x, P

    # Snapshots.

    _KEPT = ("held", "seen", "aside", "turned", "settled", "settled_P")

    def memory(self) -> Mapping[str, Array]:
        """All it remembers, as arrays."""
        return as_arrays({name: getattr(self, name if hasattr(self, name) else f"_{name}") for name in self._KEPT})

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        self.held, self.seen = bool(memory["held"] > 0), memory["seen"]
        self._aside, self._turned = float(memory["aside"]), float(memory["turned"])
        self._settled, self._settled_P = memory["settled"], memory["settled_P"]


def directions(bus: Array) -> tuple[Array, Array]:
    """Where ``(b_d, b_q)`` goes as the rotor angle grows, per rad, and, of length one, as the voltage of the bus does."""
    b_d, b_q = bus.tolist()
    return np.array([b_q, -b_d]), bus / max(hypot(b_d, b_q), 1e-9)


def wandered(bus: Array, delta: float, v_bus: float) -> Array:
    """Covariance of ``(b_d, b_q)`` from one of ``delta``, rad, and one of ``v_bus``, pu, given by their deviations."""
    around, outwards = directions(bus)
    pair = np.array([delta * around, v_bus * outwards])
    return np.asarray(pair.T @ pair)


def spread(network: Array, jump: Jump) -> Array:
    """Covariance of ``(x_s, b_d, b_q)`` after a change of this kind, shape ``(3, 3)``."""
    P = np.zeros((3, 3))
    P[0, 0] = (jump.x_s * network[0]) ** 2
    P[1:, 1:] = wandered(network[1:], jump.delta, jump.v_bus)
    return P
