"""How far plans by shooting are iterated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

SHORTEST = 1.0 / 256.0
"""Shortest fraction of a Gauss-Newton step the line search tries."""
DECREASE = 1e-4
"""Armijo's constant: the share of the predicted decrease that must be had."""
SAME_STATE = 1e-9
"""Without derivatives to the state a prepared plan holds only where the state is what was expected, to rounding."""


@dataclass(frozen=True)
class ShootingOptions:
    """How far a plan is iterated.

    Attributes:
        mode: ``"rti"`` solves one prepared QP a sample, ``"converged"`` iterates every plan.
        max_iterations: QPs for one plan at the most, when converging.
        jump_iterations: QPs for one plan where the state is not what was expected.
        jump: difference of a state from what was expected that counts as a jump.
        jump_tolerance: change of a command at which a plan made after a jump is near enough: the next sample goes on from it.
        tolerance: largest change of a command at which a plan has converged.
        exact: whether the state comes out exactly as expected unless something happened (perfect information). A prepared plan
            then needs no derivatives to the state, which many states make dear.
        candidates: constant plans, evenly from the lower bounds to the upper ones, whose true costs are compared before iterating;
            the cheapest is where it starts. A tap or a limiter inside the horizon makes minima that no descent leaves.
    """

    mode: Literal["rti", "converged"] = "rti"
    max_iterations: int = 20
    jump_iterations: int = 2
    jump: float = 1e-3
    jump_tolerance: float = 1e-3
    tolerance: float = 1e-6
    exact: bool = False
    candidates: int = 0
