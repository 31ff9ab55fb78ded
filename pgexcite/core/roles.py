"""The families a component can belong to, with the standard ports of each (IEEE 421.5, Kundur)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

from pgexcite.core.component import Component
from pgexcite.core.declare import Kind, par, port_in, port_out


class Machine(Component):
    """A synchronous machine: reads its bus voltage, injects a current in per unit of its own base.

    The field voltage is on the air-gap-line base (1 pu gives 1 pu open-circuit voltage on the air-gap line), and so is ``i_fd``:
    in the unsaturated steady state ``i_fd = e_fd``.
    """

    role: ClassVar[str] = "machine"
    has_terminal: ClassVar[bool] = True

    e_fd = port_in("pu", "field voltage, air-gap-line base")
    t_m = port_in("pu", "mechanical torque on the machine's base")
    v_t = port_out("pu", "terminal voltage")
    i_fd = port_out("pu", "field current, air-gap-line base")
    omega = port_out("pu", "rotor speed")
    delta = port_out("rad", "rotor angle against the angle reference")
    p_e = port_out("pu", "electrical power delivered to the bus")
    q_e = port_out("pu", "reactive power delivered to the bus")


class Exciter(Component):
    """An excitation system: from the terminal voltage to the field voltage."""

    role: ClassVar[str] = "exciter"

    v_t = port_in("pu", "terminal voltage")
    i_fd = port_in("pu", "field current")
    v_s = port_in("pu", "stabiliser signal", default=0.0)
    e_fd = port_out("pu", "field voltage")

    LIMITERS: ClassVar[tuple[str, ...]] = ("v_oel", "v_uel", "v_scl")

    def takes(self) -> Mapping[str, Literal["sum", "gate", "nothing"]]:
        """What becomes of each limiter's signal it has an input for; summed, unless an exciter says otherwise."""
        return {item.name: "sum" for item in self.variables(Kind.INPUT) if item.name in self.LIMITERS}


class _DrivesField(Component):
    e_fd = port_out("pu", "field voltage")


class Transfer(_DrivesField):
    """Stands in series between the excitation system and the field: reads the exciter's ``e_fd`` and drives the machine's."""

    role: ClassVar[str] = "transfer"

    e_fd = port_in("pu", "field voltage of the excitation system")
    v_t = port_in("pu", "terminal voltage")
    i_fd = port_in("pu", "field current")


class Stabiliser(Component):
    """A power system stabiliser: from speed or power to a signal at the regulator's input."""

    role: ClassVar[str] = "stabiliser"

    v_s = port_out("pu", "stabiliser signal")


class Limiter(Component):
    """An excitation limiter: from machine quantities to a signal the exciter sums or takes over with."""

    role: ClassVar[str] = "limiter"

    @property
    def acts_as(self) -> Literal["sum", "gate", "either"]:
        """What its signal is made for: to be summed at the regulator's input, for a gate to select, or either."""
        return "either"


class Governor(Component):
    """A turbine and governor: from speed to mechanical torque."""

    role: ClassVar[str] = "governor"

    omega = port_in("pu", "rotor speed")
    t_m = port_out("pu", "mechanical torque on the machine's base")


class Load(Component):
    """A load: draws a current that depends on its bus voltage, in per unit of the system base."""

    role: ClassVar[str] = "load"
    has_terminal: ClassVar[bool] = True

    p = port_out("pu", "active power drawn")
    q = port_out("pu", "reactive power drawn")


class TapChanger(Component):
    """Drives the ratio of the transformer it belongs to from the voltage of one of that transformer's buses.

    It reads the voltage of its device's bus and injects nothing there. Beside what every component is given it has ``tap``, the
    transformer's own ratio: where the run starts. Its output replaces that ratio in the network's equations.
    """

    role: ClassVar[str] = "tap_changer"
    has_terminal: ClassVar[bool] = True

    regulates: Literal["to", "from"] = par("to", "-", "which of the transformer's buses has its voltage held")

    ratio = port_out("-", "ratio of the transformer, sending side over receiving side")

    @property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest ratio."""
        return 0.0, math.inf

    @property
    def _direction(self) -> int:
        """Sign with which the ratio follows the voltage: at the receiving end a higher ratio lowers it."""
        return 1 if self.regulates == "to" else -1


class Source(Component):
    """A voltage source that stands for the rest of the grid."""

    role: ClassVar[str] = "source"
    has_terminal: ClassVar[bool] = True

    p = port_out("pu", "active power delivered")
    q = port_out("pu", "reactive power delivered")
