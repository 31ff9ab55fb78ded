"""Weights and bounds for each signal of a controller of several units."""

from __future__ import annotations

import numpy as np
import pytest
from plants import two_units
from pydantic import ValidationError

from pgexcite.core.config.validate import Collector
from pgexcite.core.errors import ConfigError
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.controllers.mpc import MPC


def run(**options):
    """Secondary control of both units of the two-unit plant."""
    config = MPC(
        **({"unit": ("G1", "G2"), "command": "v_ref", "u_min": 0.5, "u_max": 2.0, "N_p": 3, "dt": 0.1} | options)
    )
    sim = Simulation(two_units(), Settings(3.0, 0.01, "tr_bdf2", "never"), (), {"mpc": config})
    sim.run()
    return sim


def moved(sim, unit):
    return abs(sim.get(f"unit.{unit}.v_t") - sim.trace()[f"unit.{unit}.v_t"][0])


def test_a_list_with_equal_numbers_is_the_number():
    one, each = run(V_ref=1.03, Q=100.0, R=0.1), run(V_ref=[1.03, 1.03], Q=[100.0, 100.0], R=[0.1, 0.1])
    assert np.array_equal(one.state.x, each.state.x)


def test_each_voltage_has_its_reference_and_its_weight():
    sim = run(V_ref=[1.04, 0.99])
    assert sim.get("unit.G1.v_t") == pytest.approx(1.04, abs=2e-3)
    assert sim.get("unit.G2.v_t") == pytest.approx(0.99, abs=2e-3)


def test_each_unit_has_its_bounds():
    sim = run(V_ref=[1.04, 1.04], u_max=[1.12, 2.0], du_max=[0.01, 1.0])
    trace = sim.trace()
    first, second = (trace[f"unit.{unit}.exciter.v_ref"] for unit in ("G1", "G2"))
    assert first.max() <= 1.12
    assert np.abs(np.diff(first)).max() <= 0.01 + 1e-8
    assert np.abs(np.diff(second)).max() > 0.015


def test_a_unit_whose_moves_are_dear_leaves_the_work_to_the_other():
    cheap, dear = run(V_ref=1.04, R=[0.01, 0.01]), run(V_ref=1.04, R=[1e6, 0.01])
    at = "unit.G1.exciter.v_ref"
    assert np.ptp(cheap.trace()[at]) > 0.01
    assert np.ptp(dear.trace()[at]) < 1e-3


def test_references_to_come_may_be_lists():
    sim = run(V_ref=[1.02, 1.01], V_ref_known=[[1.0, [1.03, 1.0]]], V_ref_steps=[[2.0, 1.02]])
    problem = sim.sessions["mpc"].problem
    assert problem.reference_at(1.5).tolist() == [1.03, 1.0]
    assert problem.reference_at(2.5).tolist() == [1.02, 1.02]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"Q": [1.0, 2.0, 3.0]}, r"Q = \[1.0, 2.0, 3.0\] has 3 numbers for 2"),
        ({"u_max": [1.1]}, r"u_max = \[1.1\] has 1 numbers for 2"),
        ({"V_ref_known": [[1.0, [1.0, 1.0, 1.0]]]}, r"V_ref_known at t = 1: \[1.0, 1.0, 1.0\] has 3 numbers for 2"),
        ({"u_min": [0.9, 1.2], "u_max": [1.1, 1.1]}, "must be below"),
        ({"P": [-1.0, 5.0]}, "not negative"),
        ({"R": "much"}, "not negative"),
        ({"du_max": 0.0}, "positive"),
        ({"u_max": float("nan")}, "number"),
        ({"Q": []}, "not negative"),
    ],
)
def test_what_does_not_fit_is_refused(options, message):
    with pytest.raises(ValidationError, match=message):
        MPC(**({"unit": ("G1", "G2")} | options))


def test_the_message_names_the_key():
    collect = Collector()
    collect.validate(MPC, {"unit": "G1", "R": "much"}, "controller.mpc", strict=None)
    assert [problem.path for problem in collect.problems] == ["controller.mpc.R"]


def test_a_soft_bound_may_be_on_any_output():
    free, bounded = run(V_ref=1.04), run(V_ref=1.04, soft=({"signal": "bus.L.v", "upper": 0.995, "weight": 1e5},))
    at_load = [sim.trace()["bus.L.v"][-1] for sim in (free, bounded)]
    assert at_load[0] > at_load[1] + 5e-3
    with pytest.raises(ConfigError, match=r"bus\.X\.v"):
        run(soft=({"signal": "bus.X.v", "upper": 1.0},))
