"""Critical clearing time: how long a fault may last before synchronism is lost."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from pgexcite.core.config import Scenario
from pgexcite.core.errors import PgexciteError
from pgexcite.core.events import Change
from pgexcite.core.simulate import Simulation
from pgexcite.core.trace import Ending

_FIRST_GUESS = 0.1
"""Duration the search starts from when the scenario's fault never clears, s."""


@dataclass(frozen=True)
class ClearingTime:
    """The critical clearing time of a fault.

    Attributes:
        t_crit: middle of the bracket, s from the fault's beginning.
        delta_crit_deg: rotor angle at that clearing, degrees, against the infinite bus or (without one) the centre of inertia.
        bracket: longest duration found stable and shortest found not to be, s.
        unit: machine that is farthest out at clearing.
        outcome: how the run at the upper end of the bracket ends.
        runs: simulations it took.
    """

    t_crit: float
    delta_crit_deg: float
    bracket: tuple[float, float]
    unit: str
    outcome: str
    runs: int


@dataclass(frozen=True)
class _Trial:
    stable: bool
    delta_deg: float
    unit: str
    message: str


def critical_clearing_time(scenario: Scenario, tolerance: float = 1e-4) -> ClearingTime:
    """Bisect over the duration of the scenario's one fault; stable is a run that completes.

    Events at the instant the fault clears (the trip of the faulted line) move with it. Events happen at step boundaries, so the
    step is divided until it is no longer than the tolerance; one model serves all runs.

    Args:
        scenario: with exactly one fault.
        tolerance: width of the final bracket, s; rounded to a whole part of the step.

    Raises:
        PgexciteError: there is not exactly one fault, or no critical time within the run.
    """
    h = scenario.settings.h / math.ceil(scenario.settings.h / tolerance - 1e-9)
    search = _Search(scenario, h)
    low, high = 0, max(1, round(search.duration / h))
    while (trial := search.trial(high)).stable:
        low, high = high, 2 * high
        if high * h > search.longest:
            raise PgexciteError(
                f"{scenario.path}: even a fault of {low * h:g} s leaves the machines in step; "
                "there is no critical clearing time before simulation.t_end"
            )
    while high - low > 1:
        middle = (low + high) // 2
        found = search.trial(middle)
        if found.stable:
            low = middle
        else:
            high, trial = middle, found
    if low == 0:
        raise PgexciteError(
            f"{scenario.path}: even a fault of {h:g} s ends as {trial.message}: no clearing is fast enough"
        )
    last = search.trial(low)
    return ClearingTime(
        t_crit=(low + high) * h / 2,
        delta_crit_deg=(last.delta_deg + trial.delta_deg) / 2,
        bracket=(low * h, high * h),
        unit=last.unit,
        outcome=trial.message,
        runs=search.runs,
    )


class _Search:
    """Runs of one model that differ in when the fault clears, counted in steps."""

    def __init__(self, scenario: Scenario, h: float) -> None:
        timed = [change for change in scenario.changes if change.when is None]
        begins = [c for c in timed if any(p.endswith(".fault_status") and v == 1 for p, v in c.values.items())]
        if len(begins) != 1:
            raise PgexciteError(
                f"{scenario.path}: a critical clearing time needs exactly one fault among the events, not {len(begins)}"
            )
        self.begin = begins[0]
        self._path = next(path for path in self.begin.values if path.endswith(".fault_status"))
        clearing = [change for change in timed if change.values.get(self._path) == 0]
        t_clear = clearing[0].t if clearing else self.begin.t + _FIRST_GUESS
        self._moving = [c for c in timed if clearing and abs(c.t - t_clear) < 1e-9] or [
            Change(t_clear, {self._path: 0.0}, "fault cleared")
        ]
        self._fixed = [change for change in scenario.changes if change not in self._moving]
        self.duration = t_clear - self.begin.t
        self.longest = scenario.settings.t_end - self.begin.t
        self.runs = 0
        self._h = h
        settings = replace(scenario.settings, h=h)
        self._simulation = Simulation(scenario.system, settings, scenario.changes, scenario.controllers)

    def trial(self, steps: int) -> _Trial:
        """One run with a fault of so many steps."""
        self.runs += 1
        simulation, t_clear = self._simulation, self.begin.t + steps * self._h
        simulation.restart([*self._fixed, *(replace(change, t=t_clear) for change in self._moving)])
        simulation.run(until=t_clear)
        angles = _rotor_angles(simulation)
        unit = max(angles, key=lambda name: abs(angles[name]))
        outcome = simulation.run()
        return _Trial(outcome.ending is Ending.COMPLETED, math.degrees(angles[unit]), unit, outcome.ending.value)


def _rotor_angles(simulation: Simulation) -> dict[str, float]:
    """Rotor angles now, rad, against the infinite bus or the centre of inertia."""
    devices = simulation.model.system.devices
    machines = {device.path: device for device in devices if "machine" in device.components}
    angles = {path: simulation.get(f"{path}.delta") for path in machines}
    sources = [device.path for device in devices if device.path.startswith("infinite_bus.")]
    if sources:
        frame = simulation.get(f"{sources[0]}.theta")
    else:
        weights = [getattr(device.components["machine"], "H", 0.0) * device.S_n for device in machines.values()]
        frame = float(np.average(list(angles.values()), weights=weights))
    return {path: angle - frame for path, angle in angles.items()}
