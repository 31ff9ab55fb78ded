"""What is believed of the equivalent bus beyond a filter's mean and covariance: is it held, and what does a change start from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.controller import as_arrays
from pgexcite.core.equivalent import Layout, Terminals
from pgexcite.plugins.estimators.mapped_filter import MappedFilter

Array = NDArray[np.float64]

_HELD = 1e-5
"""Standard deviation of what is held, pu: nothing against any measurement."""

Jump = tuple[float, float, float]
"""Standard deviations of a change of the network: of ``delta``, rad, of ``x_s``, relative, and of ``v_bus``, pu."""


class Network:
    """The network of one unit in one run: ``x_s`` and the voltage ``(b_d, b_q)`` of the equivalent bus, in the filter's state.

    While it is held the filter takes ``x_s`` and ``v_bus`` for known, and their variances are put aside. At rest nothing measured
    depends on them; left in the filter they would shrink by noise it takes for information, and make it deaf meanwhile.

    Args:
        kalman: the filter.
        layout: of its state.
        noise: standard deviation of measured voltages, pu.

    Attributes:
        seen: terminals as last expected, in the order of ``pgexcite.core.equivalent.TERMINALS``.
        held: whether it is held.
    """

    def __init__(self, kalman: MappedFilter, layout: Layout, noise: float) -> None:
        self._kalman, self._noise = kalman, noise
        self._x_s, self._bus, self._all = layout.x_s, layout.bus, slice(layout.x_s, layout.size)
        self.held = False
        self.seen: Array = np.zeros(4)
        self._aside: Array = np.zeros(2)
        self._turned = 0.0
        self._settled, self._settled_P = np.zeros(3), np.zeros((3, 3))

    @property
    def x_s(self) -> float:
        """Reactance, pu."""
        return float(self._kalman.x[self._x_s])

    @property
    def v_bus(self) -> float:
        """Voltage of the equivalent bus, pu."""
        return float(np.hypot(*self._kalman.x[self._bus]))

    # Holding.

    def covariance(self) -> Array:
        """Covariance of ``(x_s, b_d, b_q)``, with what has been put aside."""
        kalman = self._kalman
        P = kalman.P[self._all, self._all]
        if not self.held:
            return np.array(P)
        v_t, p_e, q_e, _ = self.seen
        at, x_s, bus = Terminals(v_t, p_e, q_e), self.x_s, kalman.x[self._bus]
        # At given terminals the voltage of the bus is on a straight line in x_s.
        slope = at.slope * complex(*bus) / at.behind(x_s)
        along = np.array([1.0, slope.real, slope.imag])
        outwards = np.concatenate(([0.0], directions(bus)[1]))
        aside = self._aside[0] * np.outer(along, along) + self._aside[1] * np.outer(outwards, outwards)
        return np.asarray(P + aside)

    def hold(self, sigma_x_s: float | None = None) -> None:
        """Take ``x_s`` and ``v_bus`` for known from here on.

        Args:
            sigma_x_s: standard deviation of ``x_s``, pu, where the filter has none of the network yet.
        """
        kalman = self._kalman
        fixed = np.zeros((kalman.x.size, 2))
        fixed[self._x_s, 0] = 1.0
        fixed[self._bus, 1] = directions(kalman.x[self._bus])[1]
        if sigma_x_s is None:
            own = fixed.T @ kalman.P @ fixed
            given_x_s = own[1, 1] - own[0, 1] ** 2 / own[0, 0]
            self._aside = np.array([own[0, 0], max(given_x_s, 0.0) + (self._noise / 10) ** 2])
            kalman.P = kalman.P - kalman.P @ fixed @ np.linalg.solve(own, fixed.T @ kalman.P)
        else:
            self._aside = np.array([sigma_x_s**2, self._noise**2])
        kalman.P = kalman.P + _HELD**2 * fixed @ fixed.T
        self.held = True

    def release(self) -> None:
        """Let them go, as uncertain as they were."""
        if self.held:
            self._kalman.P[self._all, self._all] = self.covariance()
            self.held = False

    def keep(self, before: Array, lowest: float, highest: float) -> None:
        """Give what is held its value in ``before`` again, and ``v_bus`` one within its bounds."""
        x, v_bus = self._kalman.x, self.v_bus
        wanted = min(max(v_bus, lowest), highest)
        if self.held:
            x[self._x_s], wanted = before[self._x_s], float(np.hypot(*before[self._bus]))
        x[self._bus] *= wanted / max(v_bus, 1e-9)

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
        x[self._all] = turn @ self._settled
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
        self._aside, self._turned = memory["aside"], float(memory["turned"])
        self._settled, self._settled_P = memory["settled"], memory["settled_P"]


def directions(bus: Array) -> tuple[Array, Array]:
    """Where ``(b_d, b_q)`` goes as the rotor angle grows, per rad, and, of length one, as the voltage of the bus does."""
    return np.array([bus[1], -bus[0]]), bus / max(float(np.hypot(bus[0], bus[1])), 1e-9)


def spread(network: Array, jump: Jump) -> Array:
    """Covariance of ``(x_s, b_d, b_q)`` after a change of this kind, shape ``(3, 3)``."""
    delta, x_s, v_bus = jump
    around, outwards = directions(network[1:])
    P = np.zeros((3, 3))
    P[0, 0] = (x_s * network[0]) ** 2
    P[1:, 1:] = delta**2 * np.outer(around, around) + v_bus**2 * np.outer(outwards, outwards)
    return P
