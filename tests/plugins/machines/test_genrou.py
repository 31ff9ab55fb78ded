from __future__ import annotations

import math

import pytest
from component_harness import Bench, at_terminal, terminal

from pgexcite.plugins.machines.genrou import GENROU
from pgexcite.plugins.machines.gensal import GENSAL

_PSSE = {
    "Tp_d0": 8.0, "Tpp_d0": 0.03, "Tp_q0": 0.4, "Tpp_q0": 0.05, "H": 6.175, "D": 0.05,
    "X_d": 1.8, "X_q": 1.7, "Xp_d": 0.3, "Xp_q": 0.55, "Xpp_d": 0.25, "X_l": 0.2,
}  # fmt: skip
_AT = terminal(1.0, -0.03247, 1.02, math.radians(-0.944))


def at_rest(machine, at):
    return dict(machine.guess(at, {})) | at_terminal(at)


@pytest.mark.parametrize(
    ("saturation", "delta"),
    [
        ({}, 58.9624),  # PSS/E drops saturation where S(1.0) = 0
        ({"saturation": "quadratic", "S10": 0.1, "S12": 0.8}, 55.0949),
        ({"saturation": "quadratic", "S10": 0.5, "S12": 1.3}, 48.0636),
    ],
)
def test_initial_angle_of_psse(saturation, delta):
    # First samples of PSS/E's runs of the three-bus GENROU cases (PowerSimulationsDynamics.jl test data, BSD-3).
    machine = GENROU(**_PSSE, **saturation)
    assert math.degrees(machine.guess(_AT, {})["delta"]) == pytest.approx(delta, abs=5e-4)  # measured 3e-5


def test_initial_field_voltage_of_psse():
    # From the SEXS case of the same collection: E_fd = 2.15312 at t = 0.
    machine = GENROU(**_PSSE, saturation="quadratic", S10=0.1, S12=0.8)
    assert machine.guess(_AT, {})["e_fd"] == pytest.approx(2.15312, abs=5e-5)  # measured 7e-6


def test_no_load_saturation_reads_the_open_circuit_curve():
    machine = GENROU(**_PSSE, saturation="quadratic", S10=0.1, S12=0.8)
    assert machine.guess(terminal(0, 0, 1.0), {})["e_fd"] == pytest.approx(1.1)
    assert machine.guess(terminal(0, 0, 1.2), {})["e_fd"] == pytest.approx(1.2 * 1.8)


def test_currents_of_a_short_circuit_in_three_stages():
    machine = GENROU(**_PSSE)
    bench = Bench(machine)
    values = at_rest(machine, terminal(0, 0)) | {"v_re": 0.0, "v_im": 0.0}
    assert abs(bench(values).current) == pytest.approx(1 / machine.Xpp_d)
    transient = values | {"psi_1d": 1 - (machine.Xp_d - machine.X_l) / machine.Xp_d}
    assert abs(bench(transient).current) == pytest.approx(1 / machine.Xp_d)
    ep_q = machine.Xp_d / machine.X_d
    steady = values | {"ep_q": ep_q, "psi_1d": ep_q - (machine.Xp_d - machine.X_l) / machine.X_d}
    point = bench(steady)
    assert abs(point.current) == pytest.approx(1 / machine.X_d)
    assert max(abs(point.rhs[name]) for name in ("ep_q", "psi_1d", "ep_d", "psi_2q")) < 1e-12


def test_without_the_first_q_axis_circuit_it_is_the_salient_pole_machine():
    # X'_q = X_q leaves the first q-axis circuit without effect.
    data = {key: _PSSE[key] for key in ("Tp_d0", "Tpp_d0", "Tpp_q0", "H", "X_d", "X_q", "Xp_d", "Xpp_d", "X_l")}
    round_rotor, salient = GENROU(**data, Xp_q=data["X_q"], Tp_q0=1.0), GENSAL(**data)
    at = terminal(0.7, 0.2)
    off = {"v_re": 0.7, "omega": 1.01}
    one, other = (Bench(machine)(at_rest(machine, at) | off) for machine in (round_rotor, salient))
    assert one.current == pytest.approx(other.current)
    assert one.rhs["psi_1d"] == pytest.approx(other.rhs["psi_1d"])
    ratio = (data["Xpp_d"] - data["X_l"]) / (data["X_q"] - data["X_l"]) - 1
    assert one.rhs["psi_2q"] * ratio == pytest.approx(other.rhs["epp_d"])


def test_zero_subtransient_time_constants_make_algebraic_rows():
    machine = GENROU(**{**_PSSE, "Tpp_d0": 0.0, "Tpp_q0": 0.0})
    point = Bench(machine)(at_rest(machine, _AT))
    assert point.mass["psi_1d"] == point.mass["psi_2q"] == 0
