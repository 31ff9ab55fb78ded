"""IEEE ST1A potential-source controlled-rectifier excitation system (IEEE Std 421.5-2005, clause 7.1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import casadi as ca

from pgexcite.core.blocks import clip, high_value_gate, lag, lead_lag, low_value_gate, rate
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, par, port_in, setpoint, state
from pgexcite.core.roles import Exciter

_OUT_OF_REACH = 1e3
"""A limiter's signal, pu, that no gate ever selects."""

Position = Literal[0, 1, 2, 3]
"""Where a limiter acts: 0 nowhere, 1 summed at the input, 2 gate at the input, 3 gate at the output."""


class ST1A(Exciter):
    """Static exciter with transient gain reduction, fed from the machine's own terminals.

        v_t -->[ 1/(1+sT_R) ]--(-)
        v_ref ------------------(+)-->[clip V_IMIN..V_IMAX]-->(2)-->[ (1+sT_C)/(1+sT_B) ]-->[ (1+sT_C1)/(1+sT_B1) ]--+
        v_s, v_scl, v_uel, v_oel (1) (+)                                                                               |
        [ sK_F/(1+sT_F) ] ------(-)                                                                                  |
            ^           +--------------------------------------------------------------------------------------------+
            |           +-->[ K_A/(1+sT_A) | V_AMIN..V_AMAX ]--(+)-->(3)-->[clip v_t V_RMIN .. v_t V_RMAX - K_C i_fd]--+--> e_fd
            |                    max(0, K_LR (i_fd - I_LR)) ---(-)  v_s (pss_position 2) --(+)                         |
            +----------------------------------------------------------------------------------------------------------+

    At (2) and (3) stand a high-value gate with ``v_uel`` and then a low-value gate with ``v_oel``. The 2005 edition has the
    overexcitation limiter at the output only; its other positions are those of ST1C in the 2016 edition. A position other than 0
    wants a limiter in the unit that is made for it, and a limiter a position. The limits of the regulator do not wind up,
    those of the rectifier do. A time constant of zero takes its block out.

    Defaults: Kundur's thyristor exciter; the limits of the error and of the regulator are out of reach.

    Not modelled: rectifier regulation other than ``K_C``; load compensation.
    """

    source: ClassVar[str] = "IEEE Std 421.5-2005, clause 7.1 (ST1A)"
    ordered = (("V_IMIN", "V_IMAX"), ("V_AMIN", "V_AMAX"), ("V_RMIN", "V_RMAX"))
    proper = (("T_C", "T_B"), ("T_C1", "T_B1"), ("K_F", "T_F"))

    T_R: float = par(0.02, "s", "voltage transducer time constant", ge=0)
    V_IMIN: float = par(-999.0, "pu", "lowest voltage error")
    V_IMAX: float = par(999.0, "pu", "highest voltage error")
    T_C: float = par(0.0, "s", "lead of the first lead-lag", ge=0)
    T_B: float = par(0.0, "s", "lag of the first lead-lag", ge=0)
    T_C1: float = par(0.0, "s", "lead of the second lead-lag", ge=0)
    T_B1: float = par(0.0, "s", "lag of the second lead-lag", ge=0)
    K_A: float = par(200.0, "pu", "regulator gain", gt=0)
    T_A: float = par(0.0, "s", "regulator time constant", ge=0)
    V_AMIN: float = par(-999.0, "pu", "lowest regulator output (does not wind up)")
    V_AMAX: float = par(999.0, "pu", "highest regulator output (does not wind up)")
    V_RMIN: float = par(-6.4, "pu", "floor at rated terminal voltage")
    V_RMAX: float = par(6.4, "pu", "ceiling at rated terminal voltage")
    K_C: float = par(0.0, "pu", "rectifier regulation: ceiling lost per pu of field current", ge=0)
    K_F: float = par(0.0, "pu", "gain of the rate feedback", ge=0)
    T_F: float = par(0.0, "s", "time constant of the rate feedback", ge=0)
    K_LR: float = par(0.0, "pu", "gain of the field-current limiter; 0 switches it off", ge=0)
    I_LR: float = par(4.4, "pu", "field current the limiter starts at", ge=0)
    uel_position: Position = par(0, "-", "underexcitation limiter: 0 none, 1 summed, 2 gate at input, 3 gate at output")
    oel_position: Position = par(0, "-", "overexcitation limiter: 0 none, 1 summed, 2 gate at input, 3 gate at output")
    pss_position: Literal[1, 2] = par(1, "-", "stabiliser: 1 summed at the input, 2 summed at the regulator's output")

    v_uel = port_in("pu", "underexcitation limiter's signal", default=-_OUT_OF_REACH)
    v_oel = port_in("pu", "overexcitation limiter's signal", default=_OUT_OF_REACH)
    v_scl = port_in("pu", "stator-current limiter's signal, summed at the input", default=0.0)
    v_m = state("pu", "sensed terminal voltage", guess=1.0)
    x_b = state("pu", "first lead-lag")
    x_b1 = state("pu", "second lead-lag")
    v_a = state("pu", "regulator output", guess=1.0)
    x_f = state("pu", "field voltage lagged by T_F", guess=1.0)
    v_ref = setpoint("pu", "voltage reference", guess=1.0)

    def takes(self) -> Mapping[str, Literal["sum", "gate", "nothing"]]:
        at: dict[int, Literal["sum", "gate", "nothing"]] = {0: "nothing", 1: "sum", 2: "gate", 3: "gate"}
        return {"v_oel": at[self.oel_position], "v_uel": at[self.uel_position], "v_scl": "sum"}

    def equations(self, v: Signals) -> Equations:
        e_fd = self._rectifier(v)
        sensed = lag(v.v_t, v.v_m, T=self.T_R)
        feedback = rate(e_fd, v.x_f, T=self.T_F, K=self.K_F)
        error = v.v_ref - sensed.y - feedback.y + self._summed(v)
        limited = self._gates(v, 2, clip(error, self.V_IMIN, self.V_IMAX, "voltage error"))
        first = lead_lag(limited, v.x_b, T_lead=self.T_C, T_lag=self.T_B)
        second = lead_lag(first.y, v.x_b1, T_lead=self.T_C1, T_lag=self.T_B1)
        regulator = lag(second.y, v.v_a, T=self.T_A, K=self.K_A, lower=self.V_AMIN, upper=self.V_AMAX)
        return Equations(ode=(sensed, first, second, regulator, feedback), out={"e_fd": e_fd})

    def _rectifier(self, v: Signals) -> Expr:
        demand = v.v_a - ca.fmax(self.K_LR * (v.i_fd - self.I_LR), 0.0)
        if self.pss_position == 2:
            demand += v.v_s
        ceiling = v.v_t * self.V_RMAX - self.K_C * v.i_fd
        return clip(self._gates(v, 3, demand), v.v_t * self.V_RMIN, ceiling, "field voltage")

    def _summed(self, v: Signals) -> Expr:
        total: Expr = v.v_scl
        if self.pss_position == 1:
            total += v.v_s
        if self.uel_position == 1:
            total += v.v_uel
        if self.oel_position == 1:
            total += v.v_oel
        return total

    def _gates(self, v: Signals, position: int, signal: Expr) -> Expr:
        if self.uel_position == position:
            signal = high_value_gate(signal, v.v_uel)
        if self.oel_position == position:
            signal = low_value_gate(signal, v.v_oel)
        return signal

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        e_fd, v_t = known["e_fd"], known["v_t"]
        v_a = e_fd + max(self.K_LR * (known["i_fd"] - self.I_LR), 0.0)
        error = v_a / self.K_A
        return {"v_m": v_t, "x_b": error, "x_b1": error, "v_a": v_a, "x_f": e_fd, "v_ref": v_t + error}
