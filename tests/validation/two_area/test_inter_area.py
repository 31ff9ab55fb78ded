"""Inter-area damping: predictive control of all four fields against static exciters with stabilisers.

The stabilisers' figures agree with the linearised system; those of MPC have no linear counterpart and are taken from the
trajectory.
"""

from __future__ import annotations

import numpy as np
import pytest

from pgexcite.core.config import load
from pgexcite.core.linearise import linearise
from pgexcite.core.simulate import Simulation
from pgexcite.studies.ringdown import mode_near, ringdown_modes

INTER_AREA = (0.25, 0.9)  # Hz


def run(pytestconfig, name, *overrides):
    scenario = load(pytestconfig.rootpath / "configs" / "two_area" / f"{name}.toml", overrides)
    sim = Simulation(scenario.system, scenario.settings, scenario.changes, scenario.controllers)
    return sim, sim.run().ending.value


def inter_area(sim, begin=1.0):
    """The inter-area mode in the angle between the areas."""
    trace = sim.trace()
    t = np.arange(begin, trace.t[-1] - 0.1, 0.05)
    between = np.interp(t, trace.t, trace["unit.G1.delta"] - trace["unit.G3.delta"])
    return mode_near(ringdown_modes(t, between), INTER_AREA)


def test_stabilisers_damp_as_the_linearised_system_says(pytestconfig):
    sim, ending = run(pytestconfig, "small_thyristor_pss")
    assert ending == "completed"
    start = sim.initial
    modes = linearise(start.model, start.state, start.p).modes()
    expected = next(m for m in modes if INTER_AREA[0] < m.frequency_hz < INTER_AREA[1] and m.damping < 0.3)
    found = inter_area(sim)
    assert found.eigenvalue == pytest.approx(expected.eigenvalue, abs=2e-3)  # measured 5e-4
    assert found.damping == pytest.approx(0.135, abs=0.005)


@pytest.mark.slow
def test_predictive_control_damps_a_small_disturbance_better(pytestconfig):
    sim, ending = run(pytestconfig, "small_nmpc")
    assert ending == "completed"
    found = inter_area(sim)
    assert found is None or found.damping > 0.4  # measured 0.70
    trace = sim.trace()
    late = trace.t > 6.0
    between = trace["unit.G1.delta"] - trace["unit.G3.delta"]
    assert np.ptp(np.degrees(between[late])) < 1e-3  # measured 3e-6
    assert sim.result().controllers["mpc"].fallbacks == 0


@pytest.mark.slow
def test_one_move_alone_damps_no_better_than_the_stabilisers(pytestconfig):
    """The paper's ``N_c = 1``: about what the stabilisers do. It is the further moves that damp."""
    sim, _ = run(pytestconfig, "small_nmpc", "controller.mpc.N_c=1")
    assert inter_area(sim).damping == pytest.approx(0.13, abs=0.02)  # measured 0.1305


@pytest.mark.slow
def test_predictive_control_survives_a_fault_the_stabilisers_do_not(pytestconfig):
    """Bolted fault at bus 7 for 0.1 s, cleared by opening one of the two circuits between buses 7 and 8 for good."""
    classical, lost = run(pytestconfig, "fault_thyristor_pss")
    predictive, kept = run(pytestconfig, "fault_nmpc")
    assert lost == "lost_synchronism"
    assert classical.outcome.t == pytest.approx(2.57, abs=0.05)
    assert kept == "completed"
    trace = predictive.trace()
    for unit in ("G1", "G2", "G3", "G4"):
        assert abs(trace[f"unit.{unit}.omega"][-1] - trace["unit.G1.omega"][-1]) < 1e-4
        assert trace[f"unit.{unit}.e_fd"].max() <= 4.0 + 1e-9
