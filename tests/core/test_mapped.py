"""One function at many points: the same numbers as point by point, in CasADi's virtual machine and as C."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from pgexcite.core.mapped import Mapped

RNG = np.random.default_rng(3)


def function():
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    return ca.Function("bent", [x, u], [ca.vertcat(ca.sin(x[0]) * u[1], x[1] * x[2] + u[0])])


@pytest.mark.parametrize("how", ["never", pytest.param("always", marks=pytest.mark.compiler)])
def test_all_points_at_once_are_each_point_alone(how):
    f = function()
    mapped = Mapped(f, 7, how)
    assert mapped.compiled == (how == "always")
    for _ in range(2):  # the arrays are read again at every call
        mapped.points[:], mapped.common[:] = RNG.normal(size=(7, 3)), RNG.normal(size=2)
        alone = np.array([np.array(f(point, mapped.common)).ravel() for point in mapped.points])
        assert np.abs(mapped() - alone).max() < 1e-15  # measured 0


@pytest.mark.compiler
def test_two_maps_of_one_function_do_not_share_what_they_work_on():
    first, second = (Mapped(function(), 2, "always") for _ in range(2))
    first.points[:], second.points[:] = 1.0, 2.0
    before = first().copy()
    second()
    assert np.array_equal(first.values, before)
