"""What every machine model must satisfy, whatever its circuits."""

from __future__ import annotations

import math
from functools import cache

import pytest
from component_harness import Bench, at_terminal, machine_at_rest, rest_residual, terminal
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pgexcite.core.roles import Machine
from pgexcite.plugins.machines.classical import Classical
from pgexcite.plugins.machines.genrou import GENROU
from pgexcite.plugins.machines.gensal import GENSAL
from pgexcite.plugins.machines.kundur_flux import KundurFlux
from pgexcite.plugins.machines.one_axis import OneAxis
from pgexcite.plugins.machines.salient_pole import SalientPole

_CURVES = (
    {},
    {"saturation": "quadratic", "S10": 0.1, "S12": 0.4},
    {"saturation": "exponential", "S10": 0.1, "S12": 0.4},
)
_DAMPERS = {"damper_1d": True, "damper_1q": True, "damper_2q": True}

MACHINES: dict[str, Machine] = {
    "classical": Classical(R_a=0.01, D=1.0),
    "infinite": Classical(H=0.0),
    **{f"{cls.__name__}-{c.get('saturation', 'none')}": cls(R_a=0.004, D=1.0, **c)
       for cls in (OneAxis, SalientPole, GENSAL, GENROU) for c in _CURVES},
    **{f"KundurFlux-{s}-{len(d)}": KundurFlux(saturation=s, K_D=1.0, **d)
       for s in ("none", "total", "incremental") for d in ({}, _DAMPERS)},
    "KundurFlux-speed-voltage": KundurFlux(speed_voltage=True, K_D=1.0, **_DAMPERS),
}  # fmt: skip


@cache
def bench(name: str) -> Bench:
    return Bench(MACHINES[name])


every_machine = pytest.mark.parametrize("name", MACHINES)
# Normal and very abnormal operation: motoring, under- and overexcited, low and high voltage.
operating_points = st.builds(
    terminal, st.floats(-0.9, 1.0), st.floats(-0.35, 1.0), st.floats(0.85, 1.15), st.floats(-math.pi, math.pi)
)


@every_machine
@settings(max_examples=30, deadline=None)
@given(at=operating_points)
def test_guess_is_the_steady_state(name, at):
    guess = dict(MACHINES[name].guess(at, {}))
    residual = rest_residual(bench(name), guess | at_terminal(at), at)
    assert abs(residual).max() < 1e-11  # measured 2e-14


@every_machine
def test_solved_steady_state_has_no_residual(name):
    at = terminal(0.86, 0.51, 1.02, 0.3)
    values = machine_at_rest(bench(name), at)
    assert abs(rest_residual(bench(name), values, at)).max() < 1e-10
    known = dict(MACHINES[name].guess(at, {}))
    assert values["e_fd"] == pytest.approx(known["e_fd"], abs=1e-8)


@every_machine
@settings(max_examples=20, deadline=None)
@given(at=operating_points, off=st.floats(-0.3, 0.3))
def test_terminal_relations_hold_off_the_steady_state_too(name, at, off):
    values = dict(MACHINES[name].guess(at, {})) | at_terminal(at)
    values["delta"] += off
    point = bench(name)(values)
    v = complex(values["v_re"], values["v_im"])
    assert complex(point.out["p_e"], point.out["q_e"]) == pytest.approx(v * point.current.conjugate(), abs=1e-12)
    assert point.out["v_t"] == pytest.approx(abs(v))
    assert (point.out["delta"], point.out["omega"]) == (values["delta"], values["omega"])


@every_machine
@settings(max_examples=10, deadline=None)
@given(at=operating_points, turn=st.floats(-3, 3))
def test_turning_the_frame_changes_nothing(name, at, turn):
    values = dict(MACHINES[name].guess(at, {})) | at_terminal(at)
    values["delta"] += 0.1
    v = complex(values["v_re"], values["v_im"]) * complex(math.cos(turn), math.sin(turn))
    turned = values | {"delta": values["delta"] + turn, "v_re": v.real, "v_im": v.imag}
    one, other = bench(name)(values), bench(name)(turned)
    for state, rhs in one.rhs.items():
        assert other.rhs[state] == pytest.approx(rhs, abs=1e-10)


@every_machine
@settings(max_examples=10, deadline=None)
@given(at=operating_points, off=st.floats(-0.2, 0.2))
def test_jacobian_matches_finite_differences(name, at, off):
    values = dict(MACHINES[name].guess(at, {})) | at_terminal(at)
    for state in bench(name).states:
        values[state] += off * (1e-2 if state == "omega" else 1.0)
    assert bench(name).jacobian_error(values) < 1e-5  # measured 5e-10, more only where a saturation curve starts


@every_machine
def test_air_gap_torque_exceeds_terminal_power_by_the_copper_loss(name):
    machine = MACHINES[name]
    at = terminal(0.7, 0.2)
    t_e = machine.guess(at, {})["t_m"]
    assert t_e == pytest.approx(0.7 + machine.R_a * abs(at.i) ** 2)


@pytest.mark.parametrize("name", [name for name in MACHINES if name != "KundurFlux-speed-voltage"])  # its currents move
def test_swing_equation(name):
    machine, at = MACHINES[name], terminal(0.7, 0.2)
    damping = machine.K_D if isinstance(machine, KundurFlux) else machine.D
    rest = dict(machine.guess(at, {})) | at_terminal(at)
    point = bench(name)(rest | {"omega": 1.01, "omega_ref": 1.002, "t_m": rest["t_m"] + 0.1})
    assert point.rhs["delta"] == pytest.approx(2 * math.pi * 50 * 0.008)
    if machine.H > 0:
        assert point.rhs["omega"] == pytest.approx(0.1 - 0.01 * damping)
        assert point.mass["omega"] == 2 * machine.H


@every_machine
def test_bolted_fault_gives_finite_equations(name):
    values = dict(MACHINES[name].guess(terminal(0.7, 0.2), {})) | {"v_re": 0.0, "v_im": 0.0}
    point = bench(name)(values)
    assert all(math.isfinite(item) for item in (*point.rhs.values(), *point.out.values(), abs(point.current)))
    assert point.out["p_e"] == 0


@pytest.mark.parametrize("cls", [OneAxis, SalientPole, GENSAL, GENROU, KundurFlux])
def test_unsaturated_field_current_equals_field_voltage_at_rest(cls):
    machine, at = cls(), terminal(0.5, 0.1)
    values = dict(machine.guess(at, {})) | at_terminal(at)
    assert Bench(machine)(values).out["i_fd"] == pytest.approx(values["e_fd"], abs=1e-12)


@pytest.mark.parametrize("cls", [OneAxis, SalientPole, GENSAL, GENROU, KundurFlux])
def test_unsaturated_open_circuit_needs_the_air_gap_line(cls):
    assert cls().guess(terminal(0.0, 0.0, 0.9), {})["e_fd"] == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("cls", "wrong", "text"),
    [
        (Classical, {"H": -1.0}, "greater than or equal to 0"),
        (Classical, {"Xp_d": 0.0}, "greater than 0"),
        (OneAxis, {"Xp_d": 2.0}, "Xp_d = 2.0 must not exceed X_d"),
        (SalientPole, {"Xpp_q": 0.9}, "Xpp_q = 0.9 must not exceed X_q"),
        (GENSAL, {"X_l": 0.3}, "X_l = 0.3 must not exceed Xpp_d"),
        (GENSAL, {"Xp_d": 0.1, "Xpp_d": 0.1}, "X_l = 0.1 must be below Xp_d"),
        (GENROU, {"Xp_q": 0.22}, "Xpp_d = 0.25 must not exceed Xp_q"),
        (GENROU, {"saturation": "quadratic", "S10": 0.3, "S12": 0.2}, "S12 = 0.2 must be above S10 = 0.3"),
        (GENROU, {"saturation": "quadratic"}, "S12 = 0.0 must be above S10"),
        (OneAxis, {"saturation": "exponential", "S12": 0.2}, "S10 must be above 0"),
        (GENROU, {"saturation": "cubic"}, "'none', 'quadratic' or 'exponential'"),
        (SalientPole, {"H": float("nan")}, "finite number"),
    ],
)
def test_impossible_data_are_refused(cls, wrong, text):
    with pytest.raises(ValidationError, match=text):
        cls(**wrong)
