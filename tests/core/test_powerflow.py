"""The power flow against closed forms, its reactive limits, and what it says when it fails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import kobbelv, two_units

from pgexcite.core.errors import PowerFlowError
from pgexcite.core.network import Bus, Line, Shunt, Transformer
from pgexcite.core.powerflow import admittance_matrix, solve
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.loads.zip import ConstantPower
from pgexcite.plugins.sources.infinite_bus import InfiniteBus


def grid(buses, devices, lines=(), transformers=(), shunts=()):
    """A system from ``(path, bus, schedule)`` and ``(from, to, values)``; the components do not matter to a power flow."""

    def branches(cls, ends, letter):
        return {f"{letter}{k}": cls(**{"from": a, "to": b}, **values) for k, (a, b, values) in enumerate(ends)}

    return System(
        S_base=100.0,
        f_n=50.0,
        buses={name: Bus() for name in buses},
        lines=branches(Line, lines, "L"),
        transformers=branches(Transformer, transformers, "T"),
        shunts={f"S{k}": Shunt(bus=bus, **values) for k, (bus, values) in enumerate(shunts)},
        devices=tuple(Device(path, bus, 100.0, {"": InfiniteBus()}, schedule) for path, bus, schedule in devices),
    )


SLACK = ("infinite_bus.grid", "A", Schedule(V=1.0, angle=0.0))


def radial(P, Q, X=0.5):
    return grid("AB", [SLACK, ("load.D", "B", Schedule(P=-P, Q=-Q))], [("A", "B", {"X": X})])


def problems(system):
    with pytest.raises(PowerFlowError) as caught:
        solve(system)
    return {problem.path: problem for problem in caught.value.problems}


@pytest.mark.parametrize("tangent", [-0.3, 0.0, 0.2, 0.5, 1.0])
def test_the_pv_curve_of_a_lossless_line(tangent):
    """``V^2 = 1/2 - Q X + sqrt(1/4 - Q X - P^2 X^2)`` up to the nose ``P = (sqrt(1 + t^2) - t) / 2 X`` (Van Cutsem and Vournas)."""
    X = 0.5
    nose = 100.0 * (np.sqrt(1 + tangent**2) - tangent) / (2 * X)
    for share in (0.0, 0.3, 0.6, 0.9, 0.99, 0.9999):
        P = share * nose
        Q = P * tangent
        flow = solve(radial(P, Q, X))
        p, q = P / 100, Q / 100
        expected = np.sqrt(0.5 - q * X + np.sqrt(0.25 - q * X - (p * X) ** 2))
        v = flow.v["B"]
        assert abs(v) == pytest.approx(expected, abs=1e-9)  # measured 3e-12
        assert np.angle(v) == pytest.approx(-np.arcsin(p * X / expected), abs=1e-9)
    found = problems(radial(1.001 * nose, 1.001 * nose * tangent, X))
    assert list(found) == ["bus.B"]
    assert "no voltage satisfies the schedule" in found["bus.B"].message


def test_slack_pv_and_pq_buses_keep_what_they_are_given():
    system = two_units()
    flow = solve(system)
    assert flow.v["INF"] == pytest.approx(1.0, abs=1e-12)
    assert abs(flow.v["A"]) == pytest.approx(1.02, abs=1e-12)
    assert abs(flow.v["B"]) == pytest.approx(1.01, abs=1e-12)
    assert flow.s["unit.G1"].real == pytest.approx(0.7, abs=1e-12)
    assert flow.s["load.L"] == pytest.approx(-1.5 - 0.3j, abs=1e-12)
    assert flow.iterations <= 6


def test_p_q_and_v_of_a_unit_leave_the_voltage_of_an_infinite_bus_open():
    flow = solve(kobbelv())
    assert abs(flow.v["G2"]) == pytest.approx(1.0, abs=1e-12)
    assert flow.s["unit.G2"] == pytest.approx(0.86 + 0.51j, abs=1e-12)
    expected = 1 - 0.27j * (0.86 - 0.51j)
    assert abs(flow.v["INF"]) == pytest.approx(abs(expected), abs=1e-12)
    assert np.angle(flow.v["INF"]) == 0.0
    assert np.angle(flow.v["G2"]) == pytest.approx(-np.angle(expected), abs=1e-12)


def test_transformer_ratio_and_line_charging():
    unloaded = [SLACK]
    flow = solve(grid("AB", unloaded, transformers=[("A", "B", {"X": 0.1, "tap": 1.05})]))
    assert flow.v["B"] == pytest.approx(1 / 1.05, abs=1e-12)
    flow = solve(grid("AB", unloaded, lines=[("A", "B", {"X": 0.2, "B": 0.3})]))
    assert flow.v["B"] == pytest.approx(1 / (1 - 0.2 * 0.15), abs=1e-12)
    flow = solve(grid("AB", unloaded, lines=[("A", "B", {"X": 0.2})], shunts=[("B", {"B": -0.5})]))
    assert flow.v["B"] == pytest.approx(1 / (1 + 0.2 * 0.5), abs=1e-12)


def test_branches_out_of_service_carry_nothing():
    lines = [("A", "B", {"X": 0.5}), ("A", "B", {"X": 0.1, "status": 0.0})]
    system = replace(radial(50.0, 0.0), lines=grid("AB", [], lines).lines)
    assert solve(system).v["B"] == pytest.approx(solve(radial(50.0, 0.0)).v["B"], abs=1e-12)


def test_devices_at_one_bus_share_what_is_left_by_their_bases():
    system = two_units()
    twin = Device("unit.G3", "A", 300.0, system.device("unit.G1").components, Schedule(P=30.0, V=1.02))
    flow = solve(replace(system, devices=(*system.devices, twin)))
    assert flow.s["unit.G3"].imag == pytest.approx(3 * flow.s["unit.G1"].imag, abs=1e-12)
    assert flow.s["unit.G3"].real == pytest.approx(0.3, abs=1e-12)


@settings(deadline=None, max_examples=50)
@given(
    demand=st.lists(st.floats(0.0, 60.0), min_size=4, max_size=4),
    tangent=st.floats(-0.3, 0.6),
    R=st.floats(0.0, 0.05),
    tap=st.floats(0.95, 1.05),
    V=st.floats(0.98, 1.05),
)
def test_power_balances_at_every_bus(demand, tangent, R, tap, V):
    names = "ABCDE"
    ring = [(a, b, {"R": R, "X": 0.1, "B": 0.05}) for a, b in zip("ABCD", "BCDE", strict=True)]
    loads = [(f"load.{n}", n, Schedule(P=-P, Q=-tangent * P)) for n, P in zip("BCDE", demand, strict=True)]
    devices = [SLACK, ("unit.G", "C", Schedule(P=40.0, V=V)), *loads]
    system = grid(names, devices, ring, [("E", "A", {"X": 0.1, "tap": tap})], [("D", {"B": 0.2})])
    flow = solve(system)
    v = np.array([flow.v[name] for name in names])
    injected = v * np.conj(admittance_matrix(system) @ v)
    for k, name in enumerate(names):
        here = sum(flow.s[d.path] for d in system.devices if d.bus == name)
        assert here == pytest.approx(injected[k], abs=1e-11)  # measured 1e-12, the tolerance


# Reactive limits.


def pair(first, second):
    """Two units that hold voltage at the ends of a short line, an infinite bus farther off."""
    devices = [SLACK, ("unit.1", "B", first), ("unit.2", "C", second)]
    return grid("ABC", devices, [("A", "B", {"X": 0.3}), ("B", "C", {"X": 0.05})])


def test_a_unit_beyond_its_reactive_limit_holds_the_limit():
    free = solve(pair(Schedule(P=20.0, V=1.05), Schedule(P=0.0, Q=0.0)))
    assert free.at_limit == ()
    limit = 0.5 * 100 * free.s["unit.1"].imag
    flow = solve(pair(Schedule(P=20.0, V=1.05, Q_max=limit), Schedule(P=0.0, Q=0.0)))
    assert flow.at_limit == ("unit.1",)
    assert 100 * flow.s["unit.1"].imag == pytest.approx(limit, abs=1e-9)
    assert 1.0 < abs(flow.v["B"]) < 1.05
    low = solve(pair(Schedule(P=20.0, V=0.95, Q_min=-5.0), Schedule(P=0.0, Q=0.0)))
    assert low.at_limit == ("unit.1",)
    assert abs(low.v["B"]) > 0.95


def test_a_unit_gets_its_voltage_back_when_another_goes_to_its_limit():
    """Unit 2 pulls the voltage down with more than it has; until it is at its limit unit 1 is beyond its own."""
    flow = solve(pair(Schedule(P=0.0, V=1.02, Q_max=30.0), Schedule(P=0.0, V=0.95, Q_min=-5.0)))
    assert flow.at_limit == ("unit.2",)
    assert abs(flow.v["B"]) == pytest.approx(1.02, abs=1e-12)
    assert 100 * flow.s["unit.1"].imag < 30.0
    alone = solve(pair(Schedule(P=0.0, V=1.02), Schedule(P=0.0, V=0.95)))
    assert 100 * alone.s["unit.1"].imag > 30.0


def test_limits_that_leave_no_unit_to_hold_the_voltage():
    """The nose again: with its unit at its limit the far end has no voltage for this load."""
    lines = [("A", "B", {"X": 0.5})]
    devices = [SLACK, ("load.D", "B", Schedule(P=-120.0, Q=0.0))]
    assert solve(grid("AB", [*devices, ("unit.1", "B", Schedule(P=0.0, V=1.0))], lines)).at_limit == ()
    found = problems(grid("AB", [*devices, ("unit.1", "B", Schedule(P=0.0, V=1.0, Q_max=5.0))], lines))
    assert list(found) == ["bus.B"]


@pytest.mark.parametrize(("limit", "side"), [({"Q_max": -50.0}, "above"), ({"Q_min": 500.0}, "below")])
def test_a_slack_beyond_its_reactive_limits_is_refused(limit, side):
    system = two_units(grid=False)
    tight = replace(system.devices[0], schedule=replace(system.devices[0].schedule, **limit))
    found = problems(replace(system, devices=(tight, *system.devices[1:])))
    assert list(found) == ["unit.G1"]
    assert f"{side} its {next(iter(limit))}" in found["unit.G1"].message
    wide = replace(tight, schedule=replace(tight.schedule, Q_min=-500.0, Q_max=500.0))
    assert solve(replace(system, devices=(wide, *system.devices[1:]))).at_limit == ()


def test_a_scheduled_reactive_power_outside_its_limits_is_refused():
    devices = [
        SLACK,
        ("unit.1", "B", Schedule(P=10.0, Q=30.0, Q_max=20.0)),
        ("unit.2", "B", Schedule(P=0, Q=-9, Q_min=-5)),
    ]
    found = problems(grid("AB", devices, [("A", "B", {"X": 0.1})]))
    assert list(found) == ["unit.1", "unit.2"]
    assert "scheduled to deliver 30 Mvar, above its Q_max = 20 Mvar" in found["unit.1"].message


# Failures.


def test_islands_are_named():
    devices = [SLACK, ("load.D", "B", Schedule(P=-10.0, Q=0.0)), ("load.E", "D", Schedule(P=-10.0, Q=0.0))]
    found = problems(grid("ABCD", devices, [("A", "B", {"X": 0.1}), ("C", "D", {"X": 0.1})]))
    assert "the island of C, D has no slack unit and no infinite bus" in found["bus.C"].message
    assert "slack = true" in found["bus.C"].hint


def test_a_line_out_of_service_makes_an_island():
    found = problems(grid("AB", [SLACK], [("A", "B", {"X": 0.1, "status": 0.0})]))
    assert list(found) == ["bus.B"]


def test_two_islands_with_a_slack_each_are_solved():
    second = ("infinite_bus.other", "C", Schedule(V=1.1, angle=0.3))
    flow = solve(grid("ABCD", [SLACK, second], [("A", "B", {"X": 0.1}), ("C", "D", {"X": 0.1})]))
    assert flow.v["D"] == pytest.approx(1.1 * np.exp(0.3j), abs=1e-12)


@pytest.mark.parametrize(
    ("schedule", "text"),
    [(Schedule(P=10.0), "neither V nor Q is given"), (Schedule(P=10.0, Q=0.0, V=1.0), "V and Q are both given")],
)
def test_too_little_and_too_much_is_said_of_the_bus(schedule, text):
    found = problems(grid("AB", [SLACK, ("unit.1", "B", schedule)], [("A", "B", {"X": 0.1})]))
    assert text in found["bus.B"].message


def test_two_voltages_at_one_bus():
    devices = [SLACK, ("unit.1", "B", Schedule(P=1.0, V=1.0)), ("unit.2", "B", Schedule(P=1.0, V=1.01))]
    found = problems(grid("AB", devices, [("A", "B", {"X": 0.1})]))
    assert "bus B is already held at 1 pu" in found["unit.2.V"].message


def test_an_overloaded_grid_names_the_buses_farthest_from_balance():
    system = two_units(load=ConstantPower(P=1500.0))
    heavy = replace(system.device("load.L"), schedule=Schedule(P=-2000.0, Q=-30.0))
    found = problems(replace(system, devices=tuple(heavy if d.path == "load.L" else d for d in system.devices)))
    assert "bus.L" in found
    assert "MW" in found["bus.L"].message
    assert "less transfer or more reactive support" in found["bus.L"].hint
