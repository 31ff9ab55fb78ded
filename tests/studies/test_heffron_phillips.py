from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import kobbelv, regulated

from pgexcite.core.errors import PgexciteError
from pgexcite.core.system import Device, Schedule
from pgexcite.plugins.exciters.constant import ConstantField
from pgexcite.plugins.governors.constant import ConstantTorque
from pgexcite.plugins.machines.classical import Classical
from pgexcite.plugins.machines.one_axis import OneAxis
from pgexcite.studies.heffron_phillips import heffron_phillips

PLANT = {"X_d": 1.24, "X_q": 0.70, "Xp_d": 0.35, "Tp_d0": 6.5, "H": 2.9}


def closed_form(P=0.86, Q=0.51, X_e=0.27):
    """K1 to K6 of a machine without resistance (DeMello and Concordia 1969, appendix)."""
    i = np.conj(complex(P, Q))
    X_d, X_q, Xp_d = PLANT["X_d"], PLANT["X_q"], PLANT["Xp_d"]
    angle = np.angle(1 + 1j * X_q * i)
    turn = np.exp(1j * (np.pi / 2 - angle))
    v, current, grid = 1 * turn, i * turn, (1 - 1j * X_e * i) * turn
    i_d, i_q, v_d, v_q, V = current.real, current.imag, v.real, v.imag, abs(grid)
    delta = np.arctan2(grid.real, grid.imag)
    ep_q = v_q + Xp_d * i_d
    d_id, d_iq = V * np.sin(delta) / (Xp_d + X_e), V * np.cos(delta) / (X_q + X_e)
    K1 = (ep_q + (X_q - Xp_d) * i_d) * d_iq + (X_q - Xp_d) * i_q * d_id
    K2 = i_q + (X_q - Xp_d) * i_q / (Xp_d + X_e)
    K3 = (Xp_d + X_e) / (X_d + X_e)
    K4 = (X_d - Xp_d) * d_id
    K5 = v_d * X_q * d_iq - v_q * Xp_d * d_id
    K6 = v_q * (1 - Xp_d / (Xp_d + X_e))
    return {"K1": K1, "K2": K2, "K3": K3, "K4": K4, "K5": K5, "K6": K6, "T3": K3 * PLANT["Tp_d0"]}


@pytest.mark.parametrize(
    "system",
    [
        pytest.param(kobbelv(machine=OneAxis(**PLANT)), id="one_axis"),
        pytest.param(kobbelv(machine=OneAxis(**PLANT), S_base=100.0), id="other_base"),
        pytest.param(kobbelv(), id="dampers_follow_without_lag"),
        pytest.param(regulated(machine=OneAxis(**PLANT)), id="regulated"),
    ],
)
def test_against_the_closed_form(system):
    found, expected = heffron_phillips(system), closed_form()
    for name, value in expected.items():
        assert getattr(found, name) == pytest.approx(value, abs=1e-12), name  # measured 9e-16
    assert (found.H, found.omega_0) == (PLANT["H"], pytest.approx(100 * np.pi))


def test_a_constant_field_damps_and_a_fast_regulator_does_not():
    """K5 is negative here: a regulator adds synchronising torque and takes damping away."""
    diagram = heffron_phillips(kobbelv())
    K_S, K_D = diagram.torque(8.5)
    assert K_S < 0 < K_D
    K_S, K_D = diagram.torque(8.5, 200 / (1 + 0.02 * 8.5j))
    assert K_S > 0 > K_D


def test_a_machine_without_a_field_circuit_is_refused():
    with pytest.raises(PgexciteError, match=r"unit\.G2: its machine has no field circuit"):
        heffron_phillips(kobbelv(machine=Classical()))


def test_more_than_one_machine_is_refused():
    system = kobbelv()
    parts = {"machine": OneAxis(), "exciter": ConstantField(), "governor": ConstantTorque()}
    second = Device("unit.G3", "HV", 100.0, parts, Schedule(P=10.0, Q=0.0))
    with pytest.raises(PgexciteError, match="this system has 2 units"):
        heffron_phillips(replace(system, devices=(*system.devices, second)))
