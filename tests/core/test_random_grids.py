"""Random meshed grids with any mixture of units and loads: at rest at the start, sound under faults, the same in C."""

from __future__ import annotations

import numpy as np
import pytest

from pgexcite.core.component import Component
from pgexcite.core.events import BranchTrip, Fault
from pgexcite.core.network import Bus, Line
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.exciters.constant import ConstantField
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.governors.constant import ConstantTorque
from pgexcite.plugins.loads.zip import ConstantCurrent, ConstantImpedance, ConstantPower
from pgexcite.plugins.machines.classical import Classical
from pgexcite.plugins.machines.genrou import GENROU
from pgexcite.plugins.machines.gensal import GENSAL
from pgexcite.plugins.machines.kundur_flux import KundurFlux
from pgexcite.plugins.machines.one_axis import OneAxis
from pgexcite.plugins.machines.salient_pole import SalientPole
from pgexcite.plugins.sources.infinite_bus import InfiniteBus

UNITS: tuple[tuple[Component, Component], ...] = (
    (SalientPole(), ST1A(K_A=50.0, T_B=10.0, T_C=1.0)),
    (GENROU(saturation="quadratic", S10=0.1, S12=0.4), SEXS()),
    (GENSAL(), ConstantField()),
    (OneAxis(D=2.0), SEXS(T_A=0.0, T_B=0.0, T_E=0.0)),
    (KundurFlux(damper_1d=True, damper_1q=True), ST1A(T_A=0.02, K_A=100.0)),
    (Classical(D=2.0), ConstantField()),
)
LOADS = (ConstantImpedance, ConstantCurrent, ConstantPower)


def random_grid(seed):
    """A tree with chords; an infinite bus in half of the grids, else the first unit is the slack."""
    rng = np.random.default_rng(seed)
    names = [f"N{k}" for k in range(int(rng.integers(4, 12)))]
    ends = [(k, int(rng.integers(k))) for k in range(1, len(names))]
    ends += [tuple(rng.choice(len(names), 2, replace=False)) for _ in range(len(names) // 2)]
    lines = {
        f"L{k}": Line(
            **{"from": names[a], "to": names[b]}, R=float(rng.choice([0.0, 0.01])), X=float(rng.uniform(0.02, 0.15))
        )
        for k, (a, b) in enumerate(ends)
    }
    free = [names[k] for k in rng.permutation(len(names))]
    devices = []
    if seed % 2:
        source = InfiniteBus(X=float(rng.choice([0.0, 0.05])))
        devices.append(Device("infinite_bus.grid", free.pop(), 100.0, {"": source}, Schedule(V=1.0, angle=0.0)))
    for k in range(int(rng.integers(1, 4))):
        machine, exciter = UNITS[int(rng.integers(len(UNITS)))]
        parts = {
            "machine": machine,
            "exciter": exciter,
            "governor": ConstantTorque(holds=str(rng.choice(["torque", "power"]))),
        }
        plan = Schedule(P=float(rng.uniform(10, 70)), V=1.02) if devices else Schedule(V=1.02, angle=0.0)
        devices.append(Device(f"unit.G{k}", free.pop(), 100.0, parts, plan))
    for k in range(int(rng.integers(1, len(names)))):
        P, Q = float(rng.uniform(-10, 30)), float(rng.uniform(-10, 10))
        load = LOADS[int(rng.integers(3))](P=P, Q=Q)
        devices.append(Device(f"load.D{k}", str(rng.choice(names)), 100.0, {"": load}, Schedule(P=-P, Q=-Q)))
    return System(S_base=100.0, f_n=50.0, buses={name: Bus() for name in names}, lines=lines, devices=tuple(devices))


SOUND = {"completed", "lost_synchronism"}


def check(seed):
    system = random_grid(seed)
    sim = Simulation(system, Settings(1.0, 0.01, compile="never"))
    assert sim.initial.residual <= 1e-9
    stiff = {d.bus for d in system.devices if isinstance(d.components.get(""), InfiniteBus)}
    for bus in system.buses.keys() - stiff:
        sim.restart(Fault(type="fault", t=0.1, bus=bus, R=0.01 * (seed % 3), duration=0.1).changes())
        assert sim.run().ending.value in SOUND, (bus, sim.outcome)
        trace = sim.trace()
        assert all(np.isfinite(samples).all() for samples in trace.columns.values())
        assert not [entry for entry in trace.log if entry.kind == "solver"], bus
        assert max(trace[f"bus.{name}.v"].max() for name in system.buses) < 2.0
    for line in system.lines:
        sim.restart(BranchTrip(type="line_trip", t=0.1, name=line, reclose_after=0.2).changes())
        outcome = sim.run()
        # Without one of its lines a load may be cut off from every source.
        assert outcome.ending.value in SOUND or outcome.where.startswith("bus."), (line, outcome)
        assert np.abs(sim.state.z).max() < 50.0


@pytest.mark.parametrize("seed", [1, 2])
def test_random_grids(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3, 63))
def test_many_random_grids(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("rule", ["trapezoidal", "tr_bdf2"])
def test_random_grids_in_c(seed, rule):
    system = random_grid(seed)
    changes = Fault(type="fault", t=0.1, bus="N0" if not seed % 2 else "N1", R=0.02, duration=0.1).changes()
    ends = []
    for compile in ("never", "always"):
        sim = Simulation(system, Settings(1.0, 0.01, rule, compile), changes)
        sim.run()
        ends.append(sim.state.x)
    assert np.abs(ends[0] - ends[1]).max() < 1e-9
