import numpy as np
import pytest

from pgexcite.core.network import Bus, Line, Transformer
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.sinks.single_line import HOP, diagram, place_buses
from pgexcite.plugins.sinks.single_line_view import voltage_colours


def ring(n):
    """Buses in a ring, a unit at the first and a load at each."""
    lines = {f"L{k}": Line(**{"from": f"B{k}", "to": f"B{(k + 1) % n}", "X": 0.1}) for k in range(n)}
    devices = [Device("unit.G", "B0", 100.0, {}, Schedule())]
    devices += [Device(f"load.D{k}", f"B{k}", 100.0, {}, Schedule()) for k in range(n)]
    return System(100.0, 50.0, {f"B{k}": Bus() for k in range(n)}, lines=lines, devices=tuple(devices))


def test_a_radial_grid_is_a_straight_line_with_the_unit_at_the_left(plain_system):
    at = place_buses(plain_system)
    xs, ys = zip(*(at[name] for name in ("G", "HV", "grid")), strict=True)
    np.testing.assert_allclose(np.diff(xs), HOP, rtol=1e-6)
    np.testing.assert_allclose(ys, 0.0, atol=1e-6)


def test_the_same_system_gives_the_same_drawing():
    first, second = place_buses(ring(9)), place_buses(ring(9))
    for bus in first:
        np.testing.assert_array_equal(first[bus], second[bus])


def test_a_ring_is_drawn_round():
    at = np.array(list(place_buses(ring(8)).values()))
    radius = np.linalg.norm(at - at.mean(axis=0), axis=1)
    assert np.ptp(radius) < 0.05 * np.mean(radius)


@pytest.mark.parametrize("n", [1, 2, 3, 40])
def test_no_two_buses_fall_together(n):
    buses = {f"B{k}": Bus() for k in range(n)}
    lines = {f"L{k}": Line(**{"from": f"B{k // 2}", "to": f"B{k}", "X": 0.1}) for k in range(1, n)}
    at = np.array(list(place_buses(System(100.0, 50.0, buses, lines=lines)).values()))
    apart = np.linalg.norm(at[:, None] - at[None], axis=2)[~np.eye(n, dtype=bool)]
    assert n == 1 or np.min(apart) > 0.2 * HOP


def test_parallel_branches_are_drawn_apart():
    lines = {name: Line(**{"from": "A", "to": "B", "X": 0.1}) for name in ("L1", "L2")}
    lines["L3"] = Line(**{"from": "B", "to": "A", "X": 0.1})
    drawn = diagram(System(100.0, 50.0, {"A": Bus(), "B": Bus()}, lines=lines)).branches
    middles = [line.mean(axis=0) for line in drawn.values()]
    gaps = [np.linalg.norm(a - b) for k, a in enumerate(middles) for b in middles[:k]]
    assert min(gaps) > 15


def test_everything_is_drawn_once_and_inside_the_bounds(plain_system):
    drawn = diagram(plain_system)
    assert set(drawn.buses) == {"G", "HV", "grid"}
    assert set(drawn.branches) == {"line.L1", "transformer.T1"}
    assert set(drawn.symbols) == {"transformer.T1", "unit.G2", "infinite_bus.grid"}
    (left, right), (top, bottom) = drawn.bounds()
    for lines in drawn.symbols.values():
        for line in lines:
            assert np.all((line[:, 0] > left) & (line[:, 0] < right) & (line[:, 1] > top) & (line[:, 1] < bottom))


def test_devices_of_one_bus_stand_apart():
    transformer = Transformer(**{"from": "A", "to": "B", "X": 0.1})
    devices = tuple(Device(f"{kind}.X", "A", 100.0, {}, Schedule()) for kind in ("unit", "load", "infinite_bus"))
    drawn = diagram(System(100.0, 50.0, {"A": Bus(), "B": Bus()}, transformers={"T": transformer}, devices=devices))
    anchors = np.array([drawn.anchors[device.path] for device in devices])
    assert min(np.linalg.norm(a - b) for k, a in enumerate(anchors) for b in anchors[:k]) > 25


def test_colours_tell_low_normal_and_high_voltage():
    low, normal, high = voltage_colours(np.array([0.3, 1.0, 1.2])).astype(int)
    assert low.argmax() == 2
    assert normal.argmax() == 1
    assert high.argmax() == 0
