"""P-V curves by a ramp: against the closed form, the continuation, and where limiters act."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pgexcite.core.config import load
from pgexcite.core.events import BranchTrip
from pgexcite.core.network import Line
from pgexcite.studies.pv import pv_curve
from pgexcite.studies.pv_ramp import Pace, pv_by_ramp

CONFIGS = Path(__file__).parents[2] / "configs"
TWO_BUS = CONFIGS / "cases" / "two_bus.toml"
FAST = Pace(light=0.5, heavy=2000.0, growth=1.05, every=0.04, begins=30.0)


def two_bus(*overrides):
    return load(
        TWO_BUS,
        ['load.L.model="constant_impedance"', 'load.L.bus="L"', "load.L.P=10.0", "simulation.h=0.02", *overrides],
    )


@pytest.mark.parametrize("tan_phi", [0.0, 0.4])
def test_without_dynamics_it_is_the_closed_form_on_both_branches(tan_phi):
    scenario = two_bus(f"load.L.Q={10 * tan_phi}")
    found = pv_by_ramp(scenario.system, scenario.settings, "L", pace=FAST)
    p, v = found.P / 100, found.V
    residual = v**4 + (2 * p * tan_phi - 1) * v**2 + p**2 * (1 + tan_phi**2)
    assert np.abs(residual).max() < 1e-9  # measured 7e-13
    assert v[0] > 0.97
    assert v[-1] < 0.05
    nose = pv_curve(scenario.system)
    assert found.nose[0] == pytest.approx(nose.P_max, rel=1e-3)  # measured 4e-5: the points do not meet the nose itself
    assert found.acted == {}


def test_every_step_has_its_point_the_last_one_too():
    """Three steps of ten: the quotient of the logarithms is 2.9999999999999996."""
    scenario = two_bus("load.L.Q=0.0")
    found = pv_by_ramp(scenario.system, scenario.settings, "L", pace=Pace(1.0, 1000.0, 10.0, 0.2, 30.0))
    admittance = found.P / found.V**2
    assert np.array_equal(np.round(admittance / admittance[0], 6), [1.0, 10.0, 100.0, 1e3])


def test_changes_before_the_ramp_act_on_it():
    """The second of two lines trips: half the power."""
    scenario = two_bus()
    double = replace(scenario.system, lines=scenario.system.lines | {"Y": Line(**{"from": "E", "to": "L"}, X=1.0)})
    trip = BranchTrip(type="line_trip", t=28.0, name="Y").changes()
    whole, halved = (pv_by_ramp(double, scenario.settings, "L", c, FAST) for c in ((), trip))
    assert halved.nose[0] == pytest.approx(whole.nose[0] / 2, rel=1e-2)
