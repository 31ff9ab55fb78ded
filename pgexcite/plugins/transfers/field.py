"""Field transfer: hands the field over between the excitation system and a controller, without a bump either way."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pgexcite.core.blocks import clip, der
from pgexcite.core.component import Equations, Signals, Terminal
from pgexcite.core.declare import Expr, par, port_out, setpoint, state
from pgexcite.core.roles import Transfer


class FieldTransfer(Transfer):
    """Stands between the exciter and the field winding.

        e_fd of the exciter --(+)----> manual = 0 --+
                 bias b --------(+)                 +--> [clip floor .. ceiling] --> e_fd
        e_fd_cmd --------------------> manual = 1 --+

        manual = 1:  b = e_fd_cmd, limited, - e_fd of the exciter     (the standby tracks)
        manual = 0:  T_B b' = -b                                      (the difference fades)

    With ``ceiling = "rectifier"`` the limits are those of a static exciter fed from the terminals, ``v_t V_RMIN`` and
    ``v_t V_RMAX - K_C i_fd``; with ``"fixed"`` they are ``V_RMIN`` and ``V_RMAX``. A controller that takes over starts from the
    field voltage in force, so there is no bump that way either.

    Not modelled: the exciter's inner states do not track; what they would do differently is in the bias while it fades.
    """

    source: ClassVar[str] = "IEEE Std 421.2-2014 (transfer between regulators); bias by construction"
    ordered = (("V_RMIN", "V_RMAX"),)

    T_B: float = par(0.5, "s", "time constant with which the difference fades after control is handed back", gt=0)
    V_RMIN: float = par(-999.0, "pu", "floor")
    V_RMAX: float = par(999.0, "pu", "ceiling")
    K_C: float = par(0.0, "pu", "rectifier regulation: ceiling lost per pu of field current", ge=0)
    ceiling: Literal["fixed", "rectifier"] = par("fixed", "-", "whether the limits follow the terminal voltage")

    b = state("pu", "difference between the field voltage commanded and the exciter's")
    e_fd_cmd = setpoint("pu", "field voltage commanded by a controller")
    manual = setpoint("-", "1 while a controller drives the field, 0 while the exciter does")
    e_fd_exciter = port_out("pu", "field voltage the exciter asks for")

    def equations(self, v: Signals) -> Equations:
        auto = 1 - v.manual
        low, high = self._limits(v)
        commanded = clip(v.e_fd_cmd, low, high, "commanded field voltage")
        track = der(v.b, v.manual * (commanded - v.e_fd) - v.b, T=auto * self.T_B)
        wanted = v.manual * commanded + auto * (v.e_fd + v.b)
        return Equations(
            ode=(track,),
            out={"e_fd": clip(wanted, low, high, "field voltage"), "e_fd_exciter": v.e_fd},
            hold={"e_fd_cmd": v.e_fd, "manual": 0.0},
        )

    def _limits(self, v: Signals) -> tuple[Expr, Expr]:
        if self.ceiling == "fixed":
            return self.V_RMIN, self.V_RMAX
        return v.v_t * self.V_RMIN, v.v_t * self.V_RMAX - self.K_C * v.i_fd

    def guess(self, terminal: Terminal | None, known: Mapping[str, float]) -> Mapping[str, float]:
        return {"e_fd_cmd": known["e_fd"]}
