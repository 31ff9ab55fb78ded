"""A synchronous condenser is a machine scheduled with no active power: nothing else is needed."""

from __future__ import annotations

import pytest

from pgexcite.core.events import LoadStep
from pgexcite.core.initialise import initialise
from pgexcite.core.network import Bus, Line
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.governors.constant import ConstantTorque
from pgexcite.plugins.loads.zip import ConstantImpedance
from pgexcite.plugins.machines.gensal import GENSAL
from pgexcite.plugins.sources.infinite_bus import InfiniteBus


def plant(K):
    parts = {
        "machine": GENSAL(R_a=0.005),
        "exciter": SEXS(T_A=0.0, T_B=0.0, T_E=0.05, K=K, E_MIN=-2.0, E_MAX=6.0),
        "governor": ConstantTorque(),
    }
    return System(
        S_base=100.0,
        f_n=50.0,
        buses={"INF": Bus(), "B": Bus()},
        lines={"L1": Line(**{"from": "INF", "to": "B"}, X=0.3)},
        devices=(
            Device("infinite_bus.grid", "INF", 100.0, {"": InfiniteBus()}, Schedule(V=1.0, angle=0.0)),
            Device("unit.SC", "B", 60.0, parts, Schedule(P=0.0, V=1.0)),
            Device("load.L", "B", 100.0, {"": ConstantImpedance(P=60.0, Q=20.0)}, Schedule(P=-60.0, Q=-20.0)),
        ),
    )


def test_it_takes_its_losses_from_the_shaft_and_gives_reactive_power():
    initial = initialise(plant(100.0))
    assert initial.residual < 1e-9
    s = initial.flow.s["unit.SC"] * 100 / 60
    assert s.real == pytest.approx(0.0, abs=1e-12)
    assert s.imag > 0.3
    torque = initial.state.u[initial.model.position("u", "unit.SC.governor.p_m")]
    assert torque == pytest.approx(0.005 * abs(s) ** 2, rel=1e-6)  # at 1 pu voltage the current is the apparent power


def test_it_holds_the_voltage_against_a_load_and_stays_in_step():
    def end(K):
        step = LoadStep(type="load_step", t=0.5, load="L", dQ=15.0)
        sim = Simulation(plant(K), Settings(15.0, 0.005), step.changes())
        assert sim.run().ending.value == "completed"
        trace = sim.trace()
        assert trace["unit.SC.omega"][-1] == pytest.approx(1.0, abs=1e-4)
        assert trace["unit.SC.p_e"][-1] == pytest.approx(0.0, abs=1e-2)
        return 1.0 - trace["bus.B.v"][-1], trace["unit.SC.q_e"][-1] - trace["unit.SC.q_e"][0]

    drop, more = end(100.0)
    assert drop < 0.006
    assert more * 0.6 > 0.12
    assert end(5.0)[0] > 4 * drop
