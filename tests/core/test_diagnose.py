"""How a run ends that does not complete: which machine, which bus, which equation, and when."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import kobbelv, two_units

from pgexcite.core.blocks import der
from pgexcite.core.component import Component, Equations
from pgexcite.core.declare import par, state
from pgexcite.core.events import BranchTrip, Change, Fault, LoadStep
from pgexcite.core.network import Bus, Line
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule, System
from pgexcite.core.trace import Ending
from pgexcite.plugins.exciters.constant import ConstantField
from pgexcite.plugins.loads.zip import ConstantCurrent, ConstantPower
from pgexcite.plugins.sources.infinite_bus import InfiniteBus


def run(system, changes, t_end=5.0, h=0.01, **settings):
    sim = Simulation(system, Settings(t_end, h, compile="never", **settings), changes)
    sim.run()
    return sim


def last(sim, path):
    return sim.trace()[path][-1]


def assert_kept(sim):
    """All samples up to the end are there, finite, and the log's last line says how it ended."""
    trace = sim.trace()
    assert trace.t[-1] == pytest.approx(sim.outcome.t)
    assert all(np.isfinite(samples).all() for samples in trace.columns.values())
    assert (trace.log[-1].kind, trace.log[-1].text) == ("outcome", sim.outcome.message)
    before = sim.state
    assert sim.run() is sim.outcome
    assert sim.state is before


# Loss of synchronism.


@pytest.mark.parametrize(("bus", "unit"), [("A", "unit.G1"), ("B", "unit.G2")])
def test_lost_synchronism_names_the_machine_and_the_time(bus, unit):
    sim = run(two_units(), Fault(type="fault", t=0.1, bus=bus, duration=0.8).changes())
    assert (sim.outcome.ending, sim.outcome.where) == (Ending.LOST_SYNCHRONISM, unit)
    assert_kept(sim)
    angle = np.degrees(np.abs(sim.trace()[f"{unit}.delta"]))
    assert angle[-1] > 180 > angle[:-1].max()
    told = f"{unit} lost synchronism at t = {sim.outcome.t:.4f} s: its rotor angle against the infinite bus reached"
    assert told in sim.outcome.message


@pytest.mark.parametrize("reference", ["centre_of_inertia", "G1", "G2"])
def test_without_an_infinite_bus_the_centre_of_inertia_decides_whatever_the_reference(reference):
    """Of two machines the lighter is farther from their centre."""
    sim = run(two_units(reference, grid=False), Fault(type="fault", t=0.1, bus="B", duration=0.8).changes())
    assert (sim.outcome.ending, sim.outcome.where) == (Ending.LOST_SYNCHRONISM, "unit.G2")
    weights = np.array([6.5 * 100, 2.9 * 175])
    angles = np.array([sim.trace()[f"unit.{name}.delta"] for name in ("G1", "G2")])
    from_centre = np.degrees(angles[1] - weights @ angles / weights.sum())
    assert from_centre[-1] > 180 > from_centre[:-1].max()
    assert "against the centre of inertia of its island reached" in sim.outcome.message


def cut_off(t):
    return [change for name in ("L3", "L4") for change in BranchTrip(type="line_trip", t=t, name=name).changes()]


@pytest.mark.parametrize("reference", ["infinite_bus", "centre_of_inertia"])
def test_an_island_that_drifts_away_from_the_infinite_bus_is_in_synchronism(reference):
    sim = run(two_units(reference), cut_off(0.5))
    assert sim.outcome.ending is Ending.COMPLETED
    trace = sim.trace()
    turned = np.degrees(trace["unit.G1.delta"] - trace["infinite_bus.grid.theta"])
    assert np.abs(turned).max() > 360  # measured 942: the turbines give more than the load takes
    assert np.abs(np.degrees(trace["unit.G1.delta"] - trace["unit.G2.delta"])).max() < 90


def test_a_machine_lost_inside_an_island_is_named():
    fault = Fault(type="fault", t=1.0, bus="B", duration=0.8).changes()
    sim = run(two_units(), [*cut_off(0.5), *fault])
    assert (sim.outcome.ending, sim.outcome.where) == (Ending.LOST_SYNCHRONISM, "unit.G2")


def test_a_machine_by_itself_cannot_lose_synchronism():
    trips = [change for name in ("L1", "L2") for change in BranchTrip(type="line_trip", t=0.5, name=name).changes()]
    assert run(two_units(), trips, t_end=1.0).outcome.ending is Ending.COMPLETED


def test_a_fault_that_never_clears():
    sim = run(kobbelv(), Fault(type="fault", t=0.1, bus="HV").changes())
    assert sim.outcome.ending is Ending.LOST_SYNCHRONISM
    assert len(sim.trace().log) == 2


@pytest.mark.parametrize("limit", [60.0, 120.0])
def test_the_limit_is_a_setting(limit):
    sim = run(kobbelv(), Fault(type="fault", t=0.1, bus="HV").changes(), delta_max_deg=limit)
    assert np.degrees(last(sim, "unit.G2.delta")) == pytest.approx(limit, abs=10)
    assert np.degrees(sim.trace()["unit.G2.delta"][-2]) < limit


def test_a_chunk_of_steps_is_cut_back_to_the_sample_where_it_ends():
    """A run that ends inside a chunk leaves the same point as one that is stepped by single steps."""
    changes = Fault(type="fault", t=0.1, bus="HV").changes()
    whole = run(kobbelv(), changes)
    single = Simulation(kobbelv(), Settings(5.0, 0.01, compile="never"), changes)
    while single.state.k < 500 and (single.outcome is None or single.outcome.ending is Ending.COMPLETED):
        single.run(until=single.state.t + 0.01)
    assert single.outcome == whole.outcome
    assert np.array_equal(single.state.x, whole.state.x)
    assert np.array_equal(single.trace().t, whole.trace().t)


# Voltage collapse.


def radial(P, X=0.5, V_min=0.2, Q=0.0, cls=ConstantPower):
    """A constant-power load at the end of a lossless line of two halves: the nose is at ``1 / 2X`` and ``V = 1 / sqrt 2``."""
    return System(
        S_base=100.0,
        f_n=50.0,
        buses={"INF": Bus(), "M": Bus(), "E": Bus()},
        lines={
            "L1": Line(**{"from": "INF", "to": "M"}, X=X / 2),
            "L2": Line(**{"from": "M", "to": "E"}, X=X / 2),
        },
        devices=(
            Device("infinite_bus.grid", "INF", 100.0, {"": InfiniteBus()}, Schedule(V=1.0, angle=0.0)),
            Device("load.D", "E", 100.0, {"": cls(P=P, Q=Q, V_min=V_min)}, Schedule(P=-P, Q=-Q)),
        ),
    )


def rising(dP, times):
    return [change for t in times for change in LoadStep(type="load_step", t=t, load="D", dP=dP).changes()]


def test_voltage_collapse_at_the_nose_of_the_pv_curve():
    """The demand rises by 3 MW every 0.1 s from 50 MW; the line carries 100 MW."""
    sim = run(radial(50.0), rising(3.0, 0.1 * np.arange(1, 30)))
    assert (sim.outcome.ending, sim.outcome.where) == (Ending.VOLTAGE_COLLAPSE, "bus.E")
    assert sim.outcome.t == pytest.approx(1.7)
    assert_kept(sim)
    p, v = last(sim, "load.D.p"), last(sim, "bus.E.v")
    assert p == pytest.approx(0.98)  # the last demand below the nose
    upper = np.sqrt((1 + np.sqrt(1 - 4 * (p * 0.5) ** 2)) / 2)
    assert v == pytest.approx(upper, abs=1e-9)  # measured 1.2e-12


def test_beyond_the_nose_a_load_with_a_changeover_to_impedance_has_a_voltage():
    """Below 0.75 pu it is an impedance; there is a solution at any demand, and it is found."""
    sim = run(radial(50.0, V_min=0.75), rising(3.0, 0.1 * np.arange(1, 30)))
    assert sim.outcome.ending is Ending.COMPLETED
    assert last(sim, "bus.E.v") < 0.75
    P = sim.get("load.D.P") / 100.0
    impedance = P / (0.75 * sim.get("load.D.v_0") / sim.get("load.D.v_0")) ** 2
    assert last(sim, "load.D.p") == pytest.approx(impedance * last(sim, "bus.E.v") ** 2, rel=1e-9)


def test_voltage_collapse_between_events():
    """Constant field, constant power: after a step of reactive demand the voltage slides until there is none."""
    system = two_units(grid=False, load=ConstantPower(P=150.0, Q=30.0, V_min=0.2))
    system = replace(
        system,
        devices=tuple(
            replace(d, components={**d.components, "exciter": ConstantField()}) if d.path.startswith("unit.") else d
            for d in system.devices
        ),
    )
    sim = run(system, LoadStep(type="load_step", t=0.5, load="L", dQ=60.0).changes(), t_end=20.0)
    assert (sim.outcome.ending, sim.outcome.where) == (Ending.VOLTAGE_COLLAPSE, "bus.L")
    assert 1.0 < sim.outcome.t < 5.0
    assert_kept(sim)
    v = sim.trace()["bus.L.v"]
    assert np.all(np.diff(v[-50:]) < 0)


@pytest.mark.parametrize(("X", "ending"), [(0.4, Ending.COMPLETED), (0.6, Ending.VOLTAGE_COLLAPSE)])
def test_voltage_collapse_when_a_line_trips(X, ending):
    """80 MW over what is left, ``X`` and 0.2 pu in series: that carries 83 MW, or 62."""
    system = radial(80.0, X=0.4)
    system = replace(system, lines={**system.lines, "L3": Line(**{"from": "INF", "to": "M"}, X=X)})
    sim = run(system, BranchTrip(type="line_trip", t=0.5, name="L1").changes(), t_end=1.0)
    assert sim.outcome.ending is ending
    assert sim.outcome.t == (1.0 if ending is Ending.COMPLETED else 0.5)


@pytest.mark.parametrize("line", ["L1", "L2"])
@pytest.mark.parametrize("cls", [ConstantPower, ConstantCurrent])
@pytest.mark.parametrize("V_min", [0.2, 0.7])
def test_an_islanded_load_has_no_voltage_until_it_is_connected_again(line, cls, V_min):
    """The current of a constant power vanishes as its voltage runs away to infinity: that is no solution, but zero is one."""
    trip = BranchTrip(type="line_trip", t=0.5, name=line, reclose_after=0.3)
    sim = run(radial(40.0, Q=10.0, cls=cls, V_min=V_min), trip.changes(), t_end=1.0)
    assert sim.outcome.ending is Ending.COMPLETED
    trace = sim.trace()
    off = (trace.t > 0.5) & (trace.t < 0.8)
    assert np.abs(trace["bus.E.v"][off]).max() < 1e-9
    assert np.abs(trace["load.D.p"][off]).max() < 1e-9
    assert last(sim, "bus.E.v") == pytest.approx(trace["bus.E.v"][0], abs=1e-9)


@pytest.mark.parametrize("system", [kobbelv(), two_units()])
def test_a_source_short_circuited_at_its_own_bus(system):
    sim = run(system, Fault(type="fault", t=0.5, bus="INF", duration=0.1).changes())
    assert (sim.outcome.ending, sim.outcome.where) == (Ending.VOLTAGE_COLLAPSE, "bus.INF")


# Divergence.


class Runaway(Component):
    """``x' = RATE (1 + x^2)``: a tangent, infinite after ``pi / 2 RATE`` seconds."""

    RATE: float = par(0.0, "1/s", "how fast")
    x = state("pu", "what runs away")

    def equations(self, v):
        return Equations(ode=(der(v.x, self.RATE * (1 + v.x * v.x)),))


def test_divergence_names_the_equation():
    system = kobbelv()
    runaway = Device("unit.R", "HV", 100.0, {"block": Runaway()}, Schedule(P=0.0, Q=0.0))
    system = replace(system, devices=(*system.devices, runaway))
    sim = run(system, [Change(0.5, {"unit.R.block.RATE": 1.0}, "off it goes")])
    assert (sim.outcome.ending, sim.outcome.where) == (Ending.DIVERGED, "unit.R.block.x")
    assert sim.outcome.t == pytest.approx(0.5 + np.pi / 2, abs=0.02)
    assert "unit.R.block.x" in sim.outcome.message
    assert_kept(sim)


class Quotient(Component):
    """``x' = A / B - 1``: not a number once both are zero."""

    A: float = par(1.0, "-", "above")
    B: float = par(1.0, "-", "below")
    x = state("pu", "what has no value then")

    def equations(self, v):
        return Equations(ode=(der(v.x, self.A / self.B - 1),))


def test_an_equation_without_a_value_is_no_voltage_collapse():
    system = kobbelv()
    block = Device("unit.R", "HV", 100.0, {"block": Quotient()}, Schedule(P=0.0, Q=0.0))
    zero = Change(0.5, {"unit.R.block.A": 0.0, "unit.R.block.B": 0.0}, "nothing over nothing")
    sim = run(replace(system, devices=(*system.devices, block)), [zero])
    assert (sim.outcome.ending, sim.outcome.where) == (Ending.DIVERGED, "unit.R.block.x")
    assert sim.outcome.t == 0.5
    assert_kept(sim)
