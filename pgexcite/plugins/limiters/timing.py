"""What limiters with a timer share: a clock that counts overload, sets a latch, and cools down."""

from __future__ import annotations

from typing import Literal

import casadi as ca

from pgexcite.core.component import Signals
from pgexcite.core.declare import Expr, discrete, par
from pgexcite.core.roles import Limiter

_ROUNDING = 1e-6
"""Seconds by which a sum of steps may fall short of a delay."""


class TimedLimiter(Limiter):
    """A limiter that tolerates an overload for a while.

        current > K_PU limit:  timer' = 1  or  K_INV [(current / (K_PU limit))^C - 1]
        otherwise:             timer' = -K_COOL, not below zero
        timer >= T_LIM      ->  active = 1, the timer stays where it is
        active, and current < K_RESET limit for T_RESET  ->  active = 0, the timer cools down

    The clock runs in the step's discrete map. It looks at the current at the end of each step and counts the whole step by it: a
    delay is exact after an event, which moves the current at the step's beginning, and ends up to one step early where the current
    crossed its threshold smoothly within a step. An overload that comes back before the timer has cooled down is tolerated for the
    rest of ``T_LIM`` only.
    """

    timing: Literal["fixed", "inverse"] = par("fixed", "-", "whether an overload's time depends on its size")
    T_LIM: float = par(10.0, "s", "what the timer reads when the limiter acts", ge=0)
    K_PU: float = par(1.05, "-", "pick-up, over the limit", gt=0)
    K_INV: float = par(0.296, "-", "inverse time: speed of the timer per unit of C-th power of overload", gt=0)
    C: float = par(2.0, "-", "inverse time: exponent", gt=0)
    K_COOL: float = par(1.0, "s/s", "speed at which the timer runs back", ge=0)
    K_RESET: float = par(0.98, "-", "release, over the limit", gt=0)
    T_RESET: float = par(5.0, "s", "how long the current must stay below the release", ge=0)

    timer = discrete("s", "overload counted so far")
    below = discrete("s", "time spent below the release while active")
    active = discrete("-", "1 while the limiter acts")

    def clock(self, v: Signals, current: Expr, limit: Expr) -> dict[str, Expr]:
        """Next values of ``timer``, ``below`` and ``active``."""
        pickup = self.K_PU * limit
        over = current > pickup
        speed: Expr = 1.0
        if self.timing == "inverse":
            speed = self.K_INV * (ca.exp(self.C * ca.log(ca.fmax(current / pickup, 1.0))) - 1)
        counted = v.timer + v.h * ca.if_else(over, speed, -self.K_COOL)
        timer = ca.if_else(v.active, v.timer, ca.fmin(ca.fmax(counted, 0.0), self.T_LIM))
        below = v.active * (current < self.K_RESET * limit) * (v.below + v.h)
        released = v.active * (below >= self.T_RESET - _ROUNDING) * (below > 0)
        due = (1 - v.active) * over * (timer >= self.T_LIM - _ROUNDING)
        return {"timer": timer, "below": (1 - released) * below, "active": due + v.active * (1 - released)}
