"""What limiters with a timer share: a clock that counts overload, sets a latch, and cools down."""

from __future__ import annotations

from typing import Literal

import casadi as ca

from pgexcite.core.blocks import share_above
from pgexcite.core.component import Signals
from pgexcite.core.declare import Expr, before, discrete, par
from pgexcite.core.roles import Limiter

_ROUNDING = 1e-6
"""Seconds by which a sum of steps may fall short of a delay."""


class TimedLimiter(Limiter):
    """A limiter that tolerates an overload for a while.

        current > K_PU limit:  timer' = 1  or  K_INV [(current / (K_PU limit))^C - 1]
        otherwise:             timer' = -K_COOL, not below zero
        timer >= T_LIM      ->  active = 1, the timer stays where it is
        active, and current < K_RESET limit for T_RESET  ->  active = 0, the timer cools down

    The clock takes the current to run on a straight line from a step's beginning (after an event there) to its end. Of a step in
    which it crosses a threshold each part counts as what it is; an inverse time is the trapezoidal integral. The limiter acts and
    releases at the first end of a step not before it is due. An overload that comes back before the timer has cooled down is
    tolerated for the rest of ``T_LIM`` only.

    The inverse time is that of OEL2C (IEEE Std 421.5-2016): ``K_INV``, ``C``, ``T_LIM``, ``T_RESET`` and ``K_PU limit`` are its
    ``K_2``, ``c_2``, ``T_FCL``, ``T_off`` and ``I_TFPU``, and the defaults of the first four those of its sample sets (0.296, 2,
    10 s, 5 s). The rest is ours: one latch in place of a reference that ramps between an instantaneous and a thermal limit;
    cooling at ``K_COOL`` s/s (OEL2C's fixed rate ``FIXED_RD``; ``K_CD`` of the 2005 edition's limiter is 1, too); release below
    ``K_RESET limit`` (OEL2C lets go at a current ``I_THOFF`` below its reference, once its timer has cooled down).
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
    current_before = before("pu", "current at the beginning of a step")

    def clock(self, v: Signals, current: Expr, limit: Expr) -> dict[str, Expr]:
        """Next values of ``timer``, ``below`` and ``active``; the component hands ``current`` on as ``current_before``."""
        pickup, release = self.K_PU * limit, self.K_RESET * limit
        over = current > pickup
        share = share_above(v.current_before - pickup, current - pickup)
        heated = v.h * share * (self._speed(v.current_before / pickup) + self._speed(current / pickup)) / 2
        cooled = v.h * (1 - share) * self.K_COOL
        rising, falling = ca.fmax(v.timer - cooled, 0) + heated, ca.fmax(v.timer + heated - cooled, 0)
        timer = ca.if_else(v.active, v.timer, ca.fmin(ca.if_else(over, rising, falling), self.T_LIM))
        spent = (v.current_before < release) * v.below + v.h * share_above(
            release - v.current_before, release - current
        )
        below = v.active * (current < release) * spent
        released = v.active * (below >= self.T_RESET - _ROUNDING) * (below > 0)
        due = (1 - v.active) * over * (timer >= self.T_LIM - _ROUNDING)
        return {"timer": timer, "below": (1 - released) * below, "active": due + v.active * (1 - released)}

    def _speed(self, overload: Expr) -> Expr:
        """Speed of the timer at an overload (current over pick-up); at and below pick-up that of an overload just beginning."""
        if self.timing == "fixed":
            return ca.SX(1)
        return self.K_INV * (ca.exp(self.C * ca.log(ca.fmax(overload, 1.0))) - 1)
