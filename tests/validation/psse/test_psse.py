"""Machines and the simplified exciter against PSS/E: a three-bus system that loses a line."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pgexcite.core.events import BranchTrip
from pgexcite.core.network import Bus, Line
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.exciters.constant import ConstantField
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.governors.constant import ConstantTorque
from pgexcite.plugins.loads.zip import ConstantImpedance
from pgexcite.plugins.machines.genrou import GENROU
from pgexcite.plugins.machines.gensal import GENSAL
from pgexcite.plugins.sources.infinite_bus import InfiniteBus

ROUND = {
    "H": 6.175, "D": 0.05, "X_d": 1.8, "X_q": 1.7, "Xp_d": 0.3, "Xp_q": 0.55, "Xpp_d": 0.25, "X_l": 0.2,
    "Tp_d0": 8.0, "Tpp_d0": 0.03, "Tp_q0": 0.4, "Tpp_q0": 0.05,
}  # fmt: skip
SALIENT = {
    "H": 5.0, "X_d": 1.0, "X_q": 0.75, "Xp_d": 0.4, "Xpp_d": 0.25, "X_l": 0.1, "Tp_d0": 5.0, "Tpp_d0": 0.05, "Tpp_q0": 0.2,
}  # fmt: skip
MACHINES = {
    "genrou": GENROU(**ROUND, saturation="quadratic", S10=0.1, S12=0.8),
    "genrou_high_saturation": GENROU(**ROUND, saturation="quadratic", S10=0.5, S12=1.3),
    "genrou_no_saturation": GENROU(**ROUND),
    "gensal": GENSAL(**SALIENT, saturation="quadratic", S10=0.11, S12=0.62),
}
SEXS_DATA = {"T_A": 0.4 * 5.0, "T_B": 5.0, "K": 20.0, "E_MIN": -50.0, "E_MAX": 50.0}
EXCITERS = {"sexs": SEXS(**SEXS_DATA, T_E=1.0), "sexs_no_T_E": SEXS(**SEXS_DATA, T_E=0.0)}
T_EVENT = 1.0


def three_bus(machine, exciter, holds):
    parts = {"machine": machine, "exciter": exciter, "governor": ConstantTorque(holds=holds)}
    ends = {"L12": ("101", "102"), "L13": ("101", "103"), "L23": ("102", "103")}
    return System(
        S_base=100.0,
        f_n=60.0,
        buses={name: Bus() for name in ("101", "102", "103")},
        lines={name: Line(**{"from": a, "to": b}, R=0.01, X=0.12) for name, (a, b) in ends.items()},
        devices=(
            Device("infinite_bus.101", "101", 100.0, {"": InfiniteBus(X=1e-5)}, Schedule(V=1.05, angle=0.0)),
            Device("unit.102", "102", 100.0, parts, Schedule(P=100.0, V=1.02)),
            Device("load.103", "103", 100.0, {"": ConstantImpedance(P=250.0, Q=30.0)}, Schedule(P=-250.0, Q=-30.0)),
        ),
    )


@cache
def simulated(case, holds="power"):
    """Our curves of a case; PSS/E holds the mechanical power of a machine without a governor."""
    exciter = EXCITERS.get(case, ConstantField())
    system = three_bus(MACHINES.get(case, MACHINES["genrou"]), exciter, holds)
    sim = Simulation(
        system, Settings(20.0, 0.005, compile="never"), BranchTrip(type="line_trip", t=T_EVENT, name="L12").changes()
    )
    assert sim.run().ending.value == "completed"
    return sim.trace()


@cache
def published(case):
    """PSS/E's columns by name, and which of its rows stand behind the event."""
    path = Path(__file__).parent / f"{case}.csv"
    names = path.read_text().splitlines()[0].split(",")
    columns = dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))
    t = columns["t [s]"]
    return columns, np.arange(t.size) > np.flatnonzero(np.diff(t) == 0)[0]


def deviation(case, column, path, scale=1.0, *, holds="power", delay=0.0, since=0.0):
    """Largest difference from PSS/E, on both sides of the event."""
    trace, (columns, after) = simulated(case, holds), published(case)
    ours_after = np.arange(trace.t.size) > np.searchsorted(trace.t, T_EVENT)
    worst = 0.0
    for theirs, ours in ((~after, ~ours_after), (after, ours_after)):
        t = columns["t [s]"][theirs]
        found = np.interp(t - delay, trace.t[ours], scale * trace[path][ours])
        counted = t >= since
        worst = max(worst, float(np.abs(found - columns[column][theirs])[counted].max(initial=0.0)))
    return worst


DELTA = ("delta_102 [deg]", "unit.102.delta", 180 / np.pi)


@pytest.mark.parametrize("case", MACHINES)
def test_rotor_angle(case):
    assert deviation(case, *DELTA) < 0.01  # degrees; measured 0.0041, 0.0036, 0.0043, 0.0012


@pytest.mark.parametrize("case", ["genrou", "gensal"])
def test_psse_holds_power_not_torque(case):
    """A constant torque is ten times farther off: it is a different turbine, not a tolerance."""
    power, torque = (deviation(case, *DELTA, holds=holds) for holds in ("power", "torque"))
    assert torque > 5 * power  # measured 0.045 and 0.0041 degrees, 0.017 and 0.0012


@pytest.mark.parametrize("case", EXCITERS)
def test_voltage(case):
    assert deviation(case, "V_102 [pu]", "bus.102.v") < 1e-4  # measured 4.5e-5, 6.5e-5


@pytest.mark.parametrize("case", EXCITERS)
def test_branch_flows(case):
    for end, there in (("from", "101_103"), ("to", "103_101")):
        for kind, unit in (("p", "MW"), ("q", "Mvar")):
            column = f"{kind.upper()}_{there} [{unit}]"
            assert deviation(case, column, f"line.L13.{kind}_{end}", 100.0) < 0.03  # MW, Mvar; measured 0.018, 0.027


def test_field_voltage():
    assert deviation("sexs", "E_fd_102 [pu]", "unit.102.e_fd") < 2e-5  # measured 1.3e-5


def test_field_voltage_without_time_constant():
    """PSS/E's exciter without a time constant follows the voltage 1/240 s late, about one of its steps; ours does so at once."""
    case = ("sexs_no_T_E", "E_fd_102 [pu]", "unit.102.e_fd")
    assert deviation(*case, delay=1 / 240, since=1.01) < 2.5e-4  # measured 2.0e-4; 4.3e-3 without the delay
    assert deviation(*case, since=2.0) < 2.5e-4  # measured 2.2e-4
