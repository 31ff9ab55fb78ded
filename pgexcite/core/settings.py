"""How a run is integrated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Rule = Literal["tr_bdf2", "trapezoidal", "backward_euler"]
Compile = Literal["auto", "wait", "never", "always"]


@dataclass(frozen=True)
class Settings:
    """Settings of a run.

    Attributes:
        t_end: simulated time, s.
        h: step, s.
        rule: integration rule.
        compile: whether the step is compiled to C: ``"auto"`` where a compiler is found and needs a second or so (or has done it
            before), ``"wait"`` where one is found, however long it takes, ``"never"``, or ``"always"``, which fails where there is
            none.
        delta_max_deg: a rotor angle beyond this from the reference, degrees, is a loss of synchronism.
        collapse_below: a bus that stays below this voltage, pu, is a voltage collapse; 0 waits until no solution is left.
        collapse_after: how long it must stay below, s.
    """

    t_end: float
    h: float = 0.005
    rule: Rule = "tr_bdf2"
    compile: Compile = "auto"
    delta_max_deg: float = 180.0
    collapse_below: float = 0.0
    collapse_after: float = 1.0
