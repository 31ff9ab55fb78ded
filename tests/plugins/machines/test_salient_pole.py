from __future__ import annotations

import math

import numpy as np
import pytest
from component_harness import Bench, at_terminal, smib_matrix, terminal

from pgexcite.plugins.machines.salient_pole import SalientPole

_AT = terminal(0.86, 0.51)
_X_E = 0.12 + 0.15009
"""Transformer and line that put the rotor at 39 degrees against the infinite bus."""


@pytest.fixture(scope="module")
def plant():
    """The 175 MVA hydro unit at rated load, constant field, linearised by an independent elimination."""
    machine = SalientPole()
    values = dict(machine.guess(_AT, {})) | at_terminal(_AT)
    return values, *smib_matrix(Bench(machine), values, 1j * _X_E)


def test_operating_point_of_the_hydro_unit(plant):
    values = plant[0]
    grid = _AT.v - 1j * _X_E * _AT.i
    assert abs(grid) == pytest.approx(0.893, abs=1e-4)  # measured 8e-6
    assert math.degrees(values["delta"] - np.angle(grid)) == pytest.approx(39.0, abs=1e-3)  # measured 3e-5
    assert values["e_fd"] == pytest.approx(1.92460, abs=1e-5)  # measured 2e-6


def test_modes_of_the_hydro_unit(plant):
    """Eigenvalues of an independent hand-derived linearisation of the same unit, to all its digits."""
    found = sorted(np.linalg.eigvals(plant[2]), key=lambda s: (s.real, s.imag))
    expected = [-23.897247, -16.605245, -0.656849 - 8.493234j, -0.656849 + 8.493234j, -0.285725]
    assert found == pytest.approx(expected, rel=1e-5)  # measured 2e-7


def test_subtransient_time_constants_may_be_zero():
    machine = SalientPole(Tpp_d0=0.0, Tpp_q0=0.0)
    values = dict(machine.guess(_AT, {})) | at_terminal(_AT)
    names, A, _ = smib_matrix(Bench(machine), values, 1j * _X_E)
    assert names == ("delta", "omega", "ep_q")
    assert np.isfinite(np.linalg.eigvals(A)).all()


def test_frozen_subtransient_circuits_leave_the_transient_voltage_constant():
    machine = SalientPole(Tpp_d0=999.0, Tpp_q0=999.0)
    values = dict(machine.guess(_AT, {})) | at_terminal(_AT) | {"v_re": 0.5}
    point = Bench(machine)(values)
    assert abs(point.rhs["epp_q"] / point.mass["epp_q"]) < 1e-3


def test_subtransient_reactances_carry_the_first_current_of_a_short_circuit():
    machine = SalientPole()
    values = dict(machine.guess(terminal(0, 0), {})) | {"v_re": 0.0, "v_im": 0.0}
    assert abs(Bench(machine)(values).current) == pytest.approx(1 / machine.Xpp_d)


def test_saturation_raises_the_field_current_only():
    plain, saturated = SalientPole(), SalientPole(saturation="quadratic", S10=0.1, S12=0.4)
    one, other = plain.guess(_AT, {}), saturated.guess(_AT, {})
    assert one["delta"] == other["delta"]
    ep_q = one["ep_q"]
    assert ep_q > 1
    A = 1 - 0.2 / (math.sqrt(4.8) - 1)
    assert other["e_fd"] - one["e_fd"] == pytest.approx(0.1 * ((ep_q - A) / (1 - A)) ** 2)
