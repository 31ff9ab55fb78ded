"""On-load tap changer: the automaton that keeps the voltage behind a transformer within a dead band."""

from __future__ import annotations

import math
from typing import ClassVar

import casadi as ca

from pgexcite.core.blocks import magnitude, share_above
from pgexcite.core.component import Equations, Signals
from pgexcite.core.declare import before, discrete, par
from pgexcite.core.roles import TapChanger

_ROUNDING = 1e-6
"""Seconds by which a timer may fall short of its delay (sums of the step), and pu by which a tap may miss its end."""


class OLTC(TapChanger):
    """One step at a time, after a first delay and then after shorter ones, while the voltage is outside its dead band.

        |V| - V_ref  > half_deadband: side = +1  --+
        |V| - V_ref  < -half_deadband: side = -1 --+--> timer >= T_first (T_next after a tap) --> position += direction * side
        otherwise: side = 0, timer = 0

        ratio = tap + step * position,  kept within tap_min .. tap_max

    The timer starts when the voltage leaves the dead band and is reset when it returns and when it crosses to the other side. Of
    the step in which the voltage leaves the dead band the part outside counts, by a straight line between the step's beginning
    (after an event there) and its end. A tap is made at the first end of a step not before it is due; the time by which it comes
    late counts for the next one, so that taps keep their pace on any step up to the delay.

    With the bus at the receiving end a high voltage raises the ratio; at the sending end it lowers it. Position 0 is the
    transformer's own ``tap``.

    Not modelled: the voltage transducer, delays that shorten with the deviation, the time a tap takes.
    """

    source: ClassVar[str] = (
        "T. Van Cutsem, C. Vournas, Voltage Stability of Electric Power Systems, Kluwer 1998, section 4.4; "
        "T. Van Cutsem, L. Papangelis, IEEE PES-TR19, Nordic test system (data of the defaults)"
    )
    ordered = (("tap_min", "tap_max"),)

    V_ref: float = par(1.0, "pu", "voltage held", gt=0)
    half_deadband: float = par(0.01, "pu", "deviation that is left alone", ge=0)
    T_first: float = par(30.0, "s", "delay of the first tap", ge=0)
    T_next: float = par(10.0, "s", "delay of each tap after the first", ge=0)
    step: float = par(0.01, "pu", "change of the ratio by one tap", gt=0)
    tap_min: float = par(0.88, "-", "lowest ratio", gt=0)
    tap_max: float = par(1.20, "-", "highest ratio", gt=0)
    blocked: float = par(0.0, "-", "1 while the automaton is blocked, which also resets its timer", ge=0, le=1)

    position = discrete("-", "taps away from the initial ratio")
    timer = discrete("s", "time the voltage has been outside its dead band since the last tap was due")
    side = discrete("-", "side of the dead band the voltage is on: -1, 0 or 1")
    repeated = discrete("-", "1 once a tap has been made on this side")

    error_before = before("pu", "deviation of the voltage at the beginning of a step")

    def remarks(self) -> tuple[str, ...]:
        if 2 * self.half_deadband >= self.step:
            return ()
        return (
            f"a dead band of +-{self.half_deadband:g} pu is narrower than a step of {self.step:g} pu: taps may hunt",
        )

    @property
    def longest_step(self) -> float:
        return self.T_next or math.inf

    @property
    def reach(self) -> tuple[float, float]:
        return self.tap_min, self.tap_max

    def equations(self, v: Signals) -> Equations:
        error = magnitude(v.v_re, v.v_im) - self.V_ref
        outside = (error > self.half_deadband) - (error < -self.half_deadband)
        side = (1 - self.blocked) * outside
        beyond_before, beyond = (side * e - self.half_deadband for e in (v.error_before, error))
        stays = (side != 0) * (side == v.side) * (beyond_before > 0)
        repeated = stays * v.repeated
        timer = stays * v.timer + (side != 0) * share_above(beyond_before, beyond) * v.h
        delay = ca.if_else(repeated, self.T_next, self.T_first)
        due = timer >= delay - _ROUNDING
        wanted = v.position + self._direction * side
        ratio = v.tap + self.step * wanted
        free = (ratio <= self.tap_max + _ROUNDING) * (ratio >= self.tap_min - _ROUNDING)
        taps = due * free
        return Equations(
            out={"ratio": v.tap + self.step * v.position},
            current=(ca.SX(0), ca.SX(0)),
            update={
                "position": ca.if_else(taps, wanted, v.position),
                "timer": ca.if_else(taps, ca.fmin(timer - delay, self.T_next), ca.if_else(due, delay, timer)),
                "side": side,
                "repeated": ca.if_else(taps, 1.0, repeated),
            },
            before={"error_before": error},
        )
