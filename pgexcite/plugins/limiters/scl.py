"""Stator-current limiter."""

from __future__ import annotations

from typing import ClassVar, Literal

import casadi as ca

from pgexcite.core.blocks import der
from pgexcite.core.component import Equations, Signals
from pgexcite.core.declare import Expr, par, port_in, port_out, state
from pgexcite.plugins.limiters.timing import TimedLimiter

_LOWEST_VOLTAGE = 0.1
"""Terminal voltage, pu, below which the armature current is no longer computed from power and voltage."""


class SCL(TimedLimiter):
    """Moves the voltage reference until the stator current is back at its limit.

    Down where the machine delivers reactive power, up where it takes some:

        i_t - I_LIM --(q_e > 0)-->[ -(K_P + K_I/s) | -V_MAX..0 ]--(+)--> v_scl, summed at the regulator's input
                    --(q_e < 0)-->[  (K_P + K_I/s) |  0..V_MAX ]--(+)

    Between ``-Q_DB`` and ``Q_DB`` the action fades out: there the current is active power, which the field cannot change. What acts
    no more decays with ``T_TR``. Timing as in ``TimedLimiter``.

    Of SCL1C there are the limit (``I_LIM`` is its ``I_SCLlim``, 1.05 in its samples), a PI regulator for each side and the dead
    band of reactive power (``Q_DB`` is its ``V_SCLdb``, 0.1 in its samples). Ours are: the dead band as a ramp from 0 to ``Q_DB``,
    in place of a switch at it; the timer; decay with ``T_TR``; the defaults of the gains and of ``V_MAX`` (samples: 0.03 to 1
    and 0.2 to 1).

    Not modelled: SCL1C's separate settings of the two sides and its transducers, SCL2C's takeover.
    """

    source: ClassVar[str] = "IEEE Std 421.5-2016, model SCL1C, reduced"

    I_LIM: float = par(1.05, "pu", "stator current the limiter brings it down to", gt=0)
    K_P: float = par(0.05, "pu", "proportional gain", ge=0)
    K_I: float = par(0.05, "pu/s", "integral gain", gt=0)
    V_MAX: float = par(0.2, "pu", "largest signal", gt=0)
    Q_DB: float = par(0.05, "pu", "reactive power below which the action fades out", gt=0)
    T_TR: float = par(1.0, "s", "time constant with which the signal decays", gt=0)

    v_t = port_in("pu", "terminal voltage")
    p_e = port_in("pu", "active power delivered")
    q_e = port_in("pu", "reactive power delivered")
    v_scl = port_out("pu", "limiter's signal")
    x_o = state("pu", "integrator of the overexcited side")
    x_u = state("pu", "integrator of the underexcited side")

    @property
    def acts_as(self) -> Literal["sum"]:
        return "sum"

    def equations(self, v: Signals) -> Equations:
        square = v.p_e * v.p_e + v.q_e * v.q_e
        i_t = ca.sqrt(square + 1e-12) / ca.fmax(v.v_t, _LOWEST_VOLTAGE)
        error = self.I_LIM - i_t
        zero = ca.SX(0)
        over = v.active * _between(v.q_e / self.Q_DB, 0.0, 1.0)
        under = v.active * _between(-v.q_e / self.Q_DB, 0.0, 1.0)
        down = der(v.x_o, over * self.K_I * error - (1 - over) * v.x_o / self.T_TR, lower=-self.V_MAX, upper=zero)
        up = der(v.x_u, -under * self.K_I * error - (1 - under) * v.x_u / self.T_TR, lower=zero, upper=self.V_MAX)
        v_scl = _between(v.x_o + over * self.K_P * error, -self.V_MAX, 0.0)
        v_scl += _between(v.x_u - under * self.K_P * error, 0.0, self.V_MAX)
        return Equations(
            ode=(down, up),
            out={"v_scl": v_scl},
            update=self.clock(v, i_t, self.I_LIM),
            before={"current_before": i_t},
        )


def _between(signal: Expr, lower: Expr, upper: Expr) -> Expr:
    return ca.fmin(ca.fmax(signal, lower), upper)
