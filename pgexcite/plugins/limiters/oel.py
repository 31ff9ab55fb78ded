"""Overexcitation limiter with fixed or inverse time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import casadi as ca

from pgexcite.core.blocks import clip, der, lag
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import par, port_in, port_out, state
from pgexcite.plugins.limiters.timing import TimedLimiter

_OUT_OF_REACH = 1e3
"""A signal, pu, that no low-value gate ever selects."""


class OEL(TimedLimiter):
    """Brings the field current down to its limit once it has been above it for too long.

        i_fd -->[ 1/(1+sT_F) ]--(-)                       active
        I_LIM ------------------(+)-->[ K_P + K_I/s | V_MIN..V_MAX ]--/ ----> v_oel

    ``acts`` says how the exciter uses ``v_oel``:

    - ``"takeover"``, for a low-value gate (ST1A's oel_position 2 or 3): out of reach until the limiter is active; the integrator
      follows ``K_TR e_fd`` until then, and while the gate selects something else, so that it takes over and hands back without a
      bump. ``K_TR`` is 1 for a gate at the field voltage, ``1/K_A`` for one at the regulator's input, and so are the gains.
    - ``"summing"``, for a sum at the regulator's input: zero until the limiter is active, then between ``V_MIN`` and zero; after
      release it decays with ``T_TR``. The gains are those of the field voltage over ``K_A``.

    Currents are on the air-gap-line base. Timing as in ``TimedLimiter``. Of OEL2C there are the transducer (``T_F`` is its
    ``T_R``), the inverse time and the PI regulator with its limits (+-10 pu in its samples, too). ``K_TR``, ``T_TR`` and the way
    the integrator follows are ours, and so are the defaults of ``K_P`` and ``K_I``: OEL2C's samples are proportional only where
    they take over (0.5 at the regulator's input, 500 at its output) and 0.3 + 1/s at the sum.

    Not modelled: OEL2C's instantaneous limit (ST1A has ``K_LR``), ramps and filter of its reference, differential action,
    lead-lags.
    """

    source: ClassVar[str] = "IEEE Std 421.5-2016, model OEL2C, reduced"
    ordered = (("V_MIN", "V_MAX"),)

    acts: Literal["takeover", "summing"] = par("takeover", "-", "how the exciter uses the signal")
    I_LIM: float = par(..., "pu", "field current the limiter brings it down to", gt=0)
    T_F: float = par(0.02, "s", "field current transducer time constant", ge=0)
    K_P: float = par(5.0, "pu", "proportional gain", ge=0)
    K_I: float = par(5.0, "pu/s", "integral gain", gt=0)
    V_MIN: float = par(-10.0, "pu", "lowest signal")
    V_MAX: float = par(10.0, "pu", "highest signal of a limiter that takes over")
    K_TR: float = par(1.0, "-", "takeover: share of the field voltage the integrator follows", gt=0)
    T_TR: float = par(0.1, "s", "time constant with which it follows, or decays", gt=0)

    i_fd = port_in("pu", "field current")
    e_fd = port_in("pu", "field voltage")
    v_oel = port_out("pu", "limiter's signal")
    i_m = state("pu", "sensed field current", guess=1.0)
    x_i = state("pu", "integrator")

    @property
    def acts_as(self) -> Literal["sum", "gate"]:
        return "gate" if self.acts == "takeover" else "sum"

    def equations(self, v: Signals) -> Equations:
        sensed = lag(v.i_fd, v.i_m, T=self.T_F)
        error = self.I_LIM - sensed.y
        signal = v.x_i + self.K_P * error
        if self.acts == "takeover":
            follow = (self.K_TR * v.e_fd - v.x_i) / self.T_TR
            excess = ca.fmax(signal - self.K_TR * v.e_fd, 0.0) / self.T_TR
            drive = v.active * (self.K_I * error - excess) + (1 - v.active) * follow
            integral = der(v.x_i, drive, lower=self.V_MIN, upper=self.V_MAX)
            v_oel = v.active * signal + (1 - v.active) * _OUT_OF_REACH
        else:
            drive = v.active * self.K_I * error - (1 - v.active) * v.x_i / self.T_TR
            integral = der(v.x_i, drive, lower=self.V_MIN, upper=ca.SX(0))
            v_oel = clip(v.x_i + v.active * self.K_P * error, self.V_MIN, ca.SX(0), "limiter's signal")
        return Equations(
            ode=(sensed, integral),
            out={"v_oel": v_oel},
            update=self.clock(v, sensed.y, self.I_LIM),
            before={"current_before": sensed.y},
        )

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        return {"i_m": known["i_fd"], "x_i": self.K_TR * known["e_fd"] if self.acts == "takeover" else 0.0}
