"""Buses, branches and shunts: the passive network, in per unit of the system base."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import ClassVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pgexcite.core.declare import Expr, par


class NetworkElement(BaseModel):
    """Base of the network's records; ``float`` fields become symbols, as with components."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True, allow_inf_nan=False)

    @classmethod
    def numeric_parameters(cls) -> tuple[str, ...]:
        """Names of the parameters that become symbols: those annotated ``float``."""
        return tuple(name for name, info in cls.model_fields.items() if info.annotation is float)


class Bus(NetworkElement):
    """A node of the network.

    The three fault parameters make a three-phase fault without recompiling anything: with ``fault_status`` 1 the bus is tied to
    earth through ``fault_R + j fault_X``; both zero is a bolted fault.
    """

    V_n: float = par(1.0, "kV", "nominal voltage, for display", gt=0)
    fault_status: float = par(0.0, "-", "1 while a three-phase fault is on", ge=0, le=1)
    fault_R: float = par(0.0, "pu", "fault resistance", ge=0)
    fault_X: float = par(0.0, "pu", "fault reactance", ge=0)


class Branch(NetworkElement, ABC):
    """A two-terminal element; ``currents`` gives what it draws from each end."""

    kind: ClassVar[str] = ""

    from_bus: str = Field(alias="from", description="bus at the sending end")
    to_bus: str = Field(alias="to", description="bus at the receiving end")
    R: float = par(0.0, "pu", "series resistance on the system base", ge=0)
    X: float = par(..., "pu", "series reactance on the system base")
    status: float = par(1.0, "-", "1 in service, 0 out", ge=0, le=1)

    @model_validator(mode="after")
    def _check(self) -> Branch:
        if self.R == 0 and self.X == 0:
            raise ValueError("R and X are both zero: join the two buses into one instead")
        if self.from_bus == self.to_bus:
            raise ValueError(f"both ends are at bus {self.from_bus!r}")
        return self

    @abstractmethod
    def admittances(self, p: Mapping[str, Expr]) -> tuple[Expr, ...]:
        """Two-port admittances as eight reals ``(g_ff, b_ff, g_ft, b_ft, g_tf, b_tf, g_tt, b_tt)`` from parameters ``p``."""


def _series(p: Mapping[str, Expr]) -> tuple[Expr, Expr]:
    square = p["R"] * p["R"] + p["X"] * p["X"]
    return p["status"] * p["R"] / square, -p["status"] * p["X"] / square


class Line(Branch):
    """A line as a pi section (Kundur section 6.1.4)."""

    kind: ClassVar[str] = "line"

    B: float = par(0.0, "pu", "total charging susceptance on the system base", ge=0)

    def admittances(self, p: Mapping[str, Expr]) -> tuple[Expr, ...]:
        g, b = _series(p)
        own = b + p["status"] * p["B"] / 2
        return g, own, -g, -b, -g, -b, g, own


class Transformer(Branch):
    """A two-winding transformer, ideal ratio ``tap : 1`` at the sending end, impedance on the receiving side.

    Kundur section 6.2; no magnetising branch, no phase shift.
    """

    kind: ClassVar[str] = "transformer"

    tap: float = par(1.0, "-", "off-nominal ratio, sending side over receiving side", gt=0)

    def admittances(self, p: Mapping[str, Expr]) -> tuple[Expr, ...]:
        g, b = _series(p)
        n = p["tap"]
        return g / (n * n), b / (n * n), -g / n, -b / n, -g / n, -b / n, g, b


class Shunt(NetworkElement):
    """A fixed shunt admittance at a bus."""

    bus: str = Field(description="bus it is connected to")
    G: float = par(0.0, "pu", "conductance on the system base", ge=0)
    B: float = par(0.0, "pu", "susceptance on the system base, positive for a capacitor")
    status: float = par(1.0, "-", "1 in service, 0 out", ge=0, le=1)


def complex_product(g: Expr, b: Expr, v: tuple[Expr, Expr]) -> tuple[Expr, Expr]:
    """``(g + jb) (v_re + j v_im)`` as a pair."""
    return g * v[0] - b * v[1], g * v[1] + b * v[0]


def islands(buses: Iterable[str], links: Iterable[tuple[str, str]]) -> dict[str, tuple[str, ...]]:
    """For each bus all that are joined to it by links between two buses, itself among them, in the order the buses came in."""
    joined = {bus: [bus] for bus in buses}
    for one, other in links:
        keep, join = joined[one], joined[other]
        if keep is not join:
            keep += join
            joined.update(dict.fromkeys(join, keep))
    place = {bus: k for k, bus in enumerate(joined)}
    found = {id(members): tuple(sorted(members, key=place.__getitem__)) for members in joined.values()}
    return {bus: found[id(members)] for bus, members in joined.items()}
