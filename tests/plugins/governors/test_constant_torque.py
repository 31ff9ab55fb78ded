from __future__ import annotations

import pytest
from component_harness import Bench

from pgexcite.plugins.governors.constant import ConstantTorque


@pytest.mark.parametrize(("holds", "t_m"), [("torque", 0.8), ("power", 0.8 / 1.02)])
def test_what_it_holds_when_the_speed_rises(holds, t_m):
    point = Bench(ConstantTorque(holds=holds))({"p_m": 0.8, "omega": 1.02})
    assert point.out["t_m"] == pytest.approx(t_m)


@pytest.mark.parametrize("holds", ["torque", "power"])
def test_starts_from_the_machine_s_torque(holds):
    governor = ConstantTorque(holds=holds)
    start = governor.guess(None, {"t_m": 0.86})
    assert Bench(governor)({**start, "omega": 1.0}).out["t_m"] == 0.86


def test_jacobian_matches_finite_differences():
    assert Bench(ConstantTorque(holds="power")).jacobian_error({"p_m": 0.8, "omega": 1.02}) < 1e-8
