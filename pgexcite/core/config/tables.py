"""The tables of a scenario file that are not models: what a scenario itself says."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from pgexcite.core.settings import Compile, Rule

SLOTS = {
    "machine": None,
    "exciter": "constant_field",
    "governor": "constant_torque",
    "stabiliser": None,
    "limiter": None,
    "transfer": None,
}
"""Slots of a unit, each of the role of the same name, and the model that stands there when the file is silent."""

TAP_CHANGER = "tap_changer"
"""Slot of a transformer, and the role of what fills it."""


class Table(BaseModel):
    """A table whose keys are all known and whose values are of the stated type: text is never taken for a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class SimulationTable(Table):
    """How the run is integrated."""

    t_end: float = Field(gt=0, description="simulated time, s")
    h: float = Field(0.005, gt=0, description="step, s")
    rule: Rule = Field("tr_bdf2", description="integration rule")
    compile: Compile = Field("auto", description="whether the step is compiled to C")
    delta_max_deg: float = Field(180.0, gt=0, description="rotor angle beyond which synchronism is lost, degrees")
    collapse_below: float = Field(
        0.0, ge=0, description="voltage of a bus, pu, below which it collapses; 0 waits until no solution is left"
    )
    collapse_after: float = Field(1.0, ge=0, description="how long it must stay below, s")
    reference: str = Field(
        "auto", description="what rotor angles are measured against: auto, infinite_bus, centre_of_inertia or a unit"
    )


class SystemTable(Table):
    """Bases of the per-unit system."""

    S_base: float = Field(gt=0, description="system base, MVA")
    f_n: float = Field(gt=0, description="nominal frequency, Hz")


class InfiniteBusTable(Table):
    """An infinite bus; keys of its model stand beside these."""

    bus: str = Field(description="bus it is connected to")
    V: float | None = Field(
        None, gt=0, description="voltage, pu; follows from a unit with P, Q and V where it is left out"
    )
    angle_deg: float = Field(0.0, description="angle of its voltage, degrees")
    model: str = "infinite_bus"


class LoadTable(Table):
    """A load; keys of its model stand beside these."""

    bus: str = Field(description="bus it is connected to")
    model: str = "constant_impedance"


class UnitTable(Table):
    """A generating unit: what the power flow is told of it. Its models stand in sub-tables."""

    bus: str = Field(description="bus it is connected to")
    S_n: float = Field(gt=0, description="base of the unit, MVA")
    P: float | None = Field(None, description="active power delivered, MW")
    Q: float | None = Field(None, description="reactive power delivered, Mvar")
    V: float | None = Field(None, gt=0, description="terminal voltage held, pu")
    slack: bool = Field(False, description="holds voltage and angle; P and Q follow")
    angle_deg: float | None = Field(
        None, description="angle of the terminal voltage of a slack, degrees; 0 where left out"
    )
    Q_min: float | None = Field(None, description="lower reactive limit, Mvar; none where left out")
    Q_max: float | None = Field(None, description="upper reactive limit, Mvar; none where left out")


class RecordTable(Table):
    """What is written down of a run."""

    sinks: list[str] = Field(["config", "parquet", "summary", "rerun"], description="writers of the record, by name")


Expectation = Literal["completed", "lost_synchronism", "voltage_collapse", "diverged"]


class Document(Table):
    """The top level of a scenario file; every named table is validated by its own schema afterwards."""

    title: str = Field("", description="one line that says what the scenario shows")
    expect: Expectation = Field("completed", description="how the run ought to end")
    simulation: dict[str, Any] = Field({}, description="how the run is integrated")
    system: dict[str, Any] = Field({}, description="bases of the per-unit system")
    bus: dict[str, dict[str, Any]] = Field({}, description="buses by name")
    line: dict[str, dict[str, Any]] = Field({}, description="lines by name")
    transformer: dict[str, dict[str, Any]] = Field({}, description="transformers by name")
    shunt: dict[str, dict[str, Any]] = Field({}, description="shunts by name")
    infinite_bus: dict[str, dict[str, Any]] = Field({}, description="infinite buses by name")
    unit: dict[str, dict[str, Any]] = Field({}, description="generating units by name")
    load: dict[str, dict[str, Any]] = Field({}, description="loads by name")
    event: list[dict[str, Any]] = Field([], description="what happens, and when")
    controller: dict[str, dict[str, Any]] = Field({}, description="controllers by name")
    record: dict[str, Any] = Field({}, description="what is written down")


NAMED_TABLES = ("bus", "line", "transformer", "shunt", "infinite_bus", "unit", "load", "controller")
TOP_LEVEL = (*Document.model_fields, "include")
SINGLE_TABLES = ("simulation", "system", "record")
