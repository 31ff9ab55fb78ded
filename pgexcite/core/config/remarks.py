"""What is valid and yet likely not what was meant."""

from __future__ import annotations

from pgexcite.core.config.scenario import Scenario
from pgexcite.core.events import boundary

_MOVED = 1e-6
"""Steps; an event that is nearer to a step boundary stands on it."""


def remarks(scenario: Scenario) -> list[str]:
    """A sentence each: reactances below zero, what components say, events that the run ends before, and events the step moves."""
    branches = scenario.system.branches()
    negative = [(path, branch.X) for path, branch in branches.items() if branch.X < 0]
    found = [f"{path}.X = {X:g} is negative, as that of a series capacitor" for path, X in negative]
    parts = [(d.component_path(slot), c) for d in scenario.system.devices for slot, c in d.components.items()]
    found += [f"{path}: {text}" for path, component in parts for text in component.remarks()]
    end = scenario.settings.t_end
    late = [change for change in scenario.changes if change.when is None and change.t > end]
    h = scenario.settings.h
    timed = [
        (change, boundary(change.t, h) * h) for change in scenario.changes if change.when is None and change.t <= end
    ]
    found += [
        f"{change.text} takes place at {at:g} s, the next whole step of simulation.h = {h:g} s, and not at {change.t:g} s"
        for change, at in timed
        if abs(at - change.t) > _MOVED * h
    ]
    return found + [f"the run ends at {end:g} s, before {change.text} (t = {change.t:g} s)" for change in late]
