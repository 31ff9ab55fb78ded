"""An exciter that a third party might ship."""

from __future__ import annotations

from typing import ClassVar

from pgexcite.core.blocks import lag
from pgexcite.core.component import Equations, Signals
from pgexcite.core.declare import par, setpoint, state
from pgexcite.core.roles import Exciter


class Proportional(Exciter):
    """Proportional regulator behind one lag.

        v_ref --(+)-->[ K / (1+sT) | E_MIN..E_MAX ]--> e_fd
        v_t ----(-)   (+) <-- v_s

    Not modelled: transducer, ceiling that follows the terminal voltage.
    """

    source: ClassVar[str] = "none: an example"

    K: float = par(50.0, "pu", "gain", gt=0)
    T: float = par(0.05, "s", "time constant", ge=0)
    E_MIN: float = par(-5.0, "pu", "floor")
    E_MAX: float = par(5.0, "pu", "ceiling")

    e = state("pu", "field voltage", guess=1.0)
    v_ref = setpoint("pu", "voltage reference", guess=1.0)

    def equations(self, v: Signals) -> Equations:
        regulator = lag(v.v_ref - v.v_t + v.v_s, v.e, T=self.T, K=self.K, lower=self.E_MIN, upper=self.E_MAX)
        return Equations(ode=(regulator,), out={"e_fd": regulator.y})
