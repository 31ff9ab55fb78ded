"""Voltage collapse that is no loss of solution: a bus that stays below a voltage nobody can be supplied at.

Where loads become constant impedances at low voltage the network's equations keep a solution however far the voltage sags, so a
collapse has to be told by the voltage itself and by how long it stays there: a fault, which is cleared, is none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.model import Model

Array = NDArray[np.float64]

_ROUNDING = 1e-9


class Undervoltage:
    """Watches how long each bus has been below a voltage.

    Args:
        model: its buses are watched.
        below: voltage, pu; 0 watches nothing.
        duration: s a bus must stay below it.
        h: time between samples, s.

    Attributes:
        elapsed: s each bus has been below the voltage, shape ``(n_buses,)``.
    """

    def __init__(self, model: Model, below: float, duration: float, h: float) -> None:
        self._below, self._duration, self._h = below, duration, h
        self.buses = tuple(model.system.buses)
        self._columns = np.array([model.position("y", f"bus.{bus}.v") for bus in self.buses], dtype=int)
        self.elapsed: Array = np.zeros(len(self.buses))

    def watch(self, y: Array) -> tuple[int, str, float] | None:
        """Go through consecutive samples of the outputs, shape ``(n, n_y)``.

        Returns:
            The first sample at which a bus has been below for the whole duration: row, bus (the lowest of those) and its
            voltage. ``None`` where there is none.
        """
        if not self._below or not y.shape[0]:
            return None
        voltages = y[:, self._columns]
        low = voltages < self._below
        if not low.any():
            self.elapsed[:] = 0.0
            return None
        steps = np.arange(1, y.shape[0] + 1)[:, None]
        last_up = np.maximum.accumulate(np.where(low, 0, steps), axis=0)
        elapsed = (steps - last_up) * self._h + np.where(last_up == 0, self.elapsed, 0.0)
        self.elapsed = elapsed[-1].copy()
        due = low & (elapsed >= self._duration - _ROUNDING)
        if not due.any():
            return None
        row = int(np.argmax(due.any(axis=1)))
        bus = int(np.argmin(np.where(due[row], voltages[row], np.inf)))
        return row, self.buses[bus], float(voltages[row, bus])
