"""Voltage collapse told by the voltage: a bus that stays below ``collapse_below`` for ``collapse_after``."""

from __future__ import annotations

import numpy as np
import pytest
from plants import kobbelv

from pgexcite.core.events import Fault, ParameterStep
from pgexcite.core.model import State
from pgexcite.core.network import Bus, Line, Transformer
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule, System
from pgexcite.core.trace import Ending
from pgexcite.core.undervoltage import Undervoltage
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.limiters.oel import OEL
from pgexcite.plugins.loads.zip import ConstantImpedance
from pgexcite.plugins.sources.infinite_bus import InfiniteBus
from pgexcite.plugins.tap_changers.oltc import OLTC

TAPS = OLTC(V_ref=1.0, half_deadband=0.01, T_first=1.0, T_next=0.5, step=0.01)


def fed(t_low, voltage=0.5, t_end=10.0, **settings):
    """A tap changer feeds a load from a source whose voltage drops to ``voltage`` at ``t_low``."""
    system = System(
        S_base=100.0,
        f_n=50.0,
        buses={"INF": Bus(), "HV": Bus(), "LV": Bus()},
        lines={"L1": Line(**{"from": "INF", "to": "HV"}, X=0.05)},
        transformers={"T1": Transformer(**{"from": "HV", "to": "LV"}, X=0.05)},
        devices=(
            Device("transformer.T1", "LV", 100.0, {"tap_changer": TAPS}, Schedule(P=0.0, Q=0.0)),
            Device("infinite_bus.grid", "INF", 100.0, {"": InfiniteBus()}, Schedule(V=1.0, angle=0.0)),
            Device("load.L", "LV", 100.0, {"": ConstantImpedance(P=20.0)}, Schedule(P=-20.0, Q=0.0)),
        ),
    )
    drop = ParameterStep(type="set", t=t_low, path="infinite_bus.grid.v", value=voltage).changes()
    return Simulation(system, Settings(t_end, 0.01, compile="never", **settings), drop)


def test_a_sagging_bus_ends_the_run_with_its_name_the_time_and_what_was_active():
    sim = fed(2.0, collapse_below=0.7, collapse_after=3.0)
    outcome = sim.run()
    trace = sim.trace()
    assert (outcome.ending, outcome.t) == (Ending.VOLTAGE_COLLAPSE, pytest.approx(5.0))
    assert outcome.where == "bus." + min(("INF", "HV", "LV"), key=lambda b: trace[f"bus.{b}.v"][-1])
    taps = trace["transformer.T1.tap_changer.position"][-1]
    assert outcome.active == (f"transformer.T1.tap_changer at position {taps:+.0f}",)
    assert outcome.active[0] in outcome.message
    assert "5.0000 s" in outcome.message
    assert trace.t[-1] == sim.state.t == outcome.t
    assert trace.log[-1].text == outcome.message


def test_a_limiter_that_acts_is_named():
    system = kobbelv(exciter=ST1A(oel_position=3), limiter=OEL(I_LIM=0.8, T_LIM=0.5))
    sim = Simulation(system, Settings(20.0, 0.01, compile="never", collapse_below=0.8, collapse_after=0.0))
    outcome = sim.run()
    assert outcome.ending is Ending.VOLTAGE_COLLAPSE
    assert outcome.active == ("unit.G2.limiter acts",)
    assert sim.trace()["unit.G2.limiter.active"][-1] == 1.0


def test_it_is_off_by_default_and_a_cleared_fault_is_no_collapse():
    assert fed(2.0).run().ending is Ending.COMPLETED
    fault = Fault(type="fault", t=1.0, bus="HV", R=0.02, duration=0.1).changes()
    for after, ending in ((0.2, Ending.COMPLETED), (0.05, Ending.VOLTAGE_COLLAPSE)):
        settings = Settings(3.0, 0.01, compile="never", collapse_below=0.7, collapse_after=after)
        assert Simulation(kobbelv(), settings, fault).run().ending is ending


def test_the_time_below_outlasts_chunks_pauses_and_snapshots(tmp_path):
    whole = fed(2.0, t_end=20.0, collapse_below=0.7, collapse_after=7.0)
    whole.run()
    assert whole.outcome.t == pytest.approx(9.0)  # more than one chunk of steps after the drop
    paused = fed(2.0, t_end=20.0, collapse_below=0.7, collapse_after=7.0)
    for until in (2.5, 4.0, 8.5):
        paused.run(until=until)
    paused.save(tmp_path / "at.npz")
    resumed = fed(2.0, t_end=20.0, collapse_below=0.7, collapse_after=7.0)
    resumed.resume(tmp_path / "at.npz")
    assert resumed.run() == paused.run() == whole.outcome
    assert isinstance(resumed.state, State)


def test_elapsed_time_starts_again_when_the_voltage_returns():
    sim = fed(100.0)
    model = sim.model
    watch = Undervoltage(model, 0.7, 0.05, 0.01)
    y = np.ones((10, len(model.y_names)))
    column = model.position("y", "bus.LV.v")
    y[[1, 2, 3, 4, 6, 7, 8, 9], column] = 0.6
    assert watch.watch(y) is None
    assert watch.elapsed == pytest.approx([0.0, 0.0, 0.04])
    assert watch.watch(y[6:]) == (0, "LV", 0.6)
