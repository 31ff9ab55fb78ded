from __future__ import annotations

import pytest
from component_harness import Bench, at_terminal, terminal

from pgexcite.plugins.machines.one_axis import OneAxis
from pgexcite.plugins.machines.salient_pole import SalientPole


def at_rest(machine, at):
    return dict(machine.guess(at, {})) | at_terminal(at)


def test_phasor_diagram():
    machine, at = OneAxis(X_d=1.24, X_q=0.7, Xp_d=0.35), terminal(0.86, 0.51)
    E_Q = at.v + 0.7j * at.i
    i_d = (at.i * 1j * E_Q.conjugate() / abs(E_Q)).real
    assert machine.guess(at, {})["e_fd"] == pytest.approx(abs(E_Q) + (1.24 - 0.7) * i_d)
    assert machine.guess(at, {})["e_fd"] == pytest.approx(1.9246, abs=1e-4)  # measured 2e-6


def test_is_the_salient_pole_machine_without_dampers():
    data = {"X_d": 1.24, "X_q": 0.7, "Xp_d": 0.35, "H": 2.9, "Tp_d0": 6.5}
    at = terminal(0.86, 0.51)
    one, salient = OneAxis(**data), SalientPole(**data, Xpp_d=0.35, Xpp_q=0.7, Tpp_d0=0.0, Tpp_q0=0.0)
    off = {"v_re": 0.6, "v_im": 0.1}
    field = Bench(one)(at_rest(one, at) | off).rhs["ep_q"]
    assert field == pytest.approx(Bench(salient)(at_rest(salient, at) | off).rhs["ep_q"])


def test_transient_time_constant_shrinks_under_load():
    # With the terminals shorted the flux decays with Tp_d = Tp_d0 Xp_d / X_d.
    machine = OneAxis(X_d=2.0, X_q=1.9, Xp_d=0.4, Tp_d0=5.0)
    bench = Bench(machine)
    values = at_rest(machine, terminal(0.0, 0.0)) | {"v_re": 0.0, "e_fd": 0.0}
    point = bench(values)
    assert point.rhs["ep_q"] / point.mass["ep_q"] == pytest.approx(-values["ep_q"] / (5.0 * 0.4 / 2.0))


@pytest.mark.parametrize("curve", ["quadratic", "exponential"])
def test_saturated_open_circuit_needs_the_curve(curve):
    machine = OneAxis(saturation=curve, S10=0.1, S12=0.4)
    assert machine.guess(terminal(0, 0, 1.0), {})["e_fd"] == pytest.approx(1.1)
    assert machine.guess(terminal(0, 0, 1.2), {})["e_fd"] == pytest.approx(1.2 * 1.4)
