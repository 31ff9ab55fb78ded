from __future__ import annotations

import math

import numpy as np
import pytest
from component_harness import Bench, at_terminal, smib_matrix, terminal

from pgexcite.plugins.machines.gensal import GENSAL
from pgexcite.plugins.machines.salient_pole import SalientPole


def at_rest(machine, at):
    return dict(machine.guess(at, {})) | at_terminal(at)


def test_initial_angle_of_psse():
    # The first sample of PSS/E's run of the three-bus GENSAL case (PowerSimulationsDynamics.jl test data, BSD-3).
    machine = GENSAL(
        Tp_d0=5.0, Tpp_d0=0.05, Tpp_q0=0.2, H=5.0, X_d=1.0, X_q=0.75, Xp_d=0.4, Xpp_d=0.25, X_l=0.1,
        saturation="quadratic", S10=0.11, S12=0.62,
    )  # fmt: skip
    at = terminal(1.0, -0.03247, 1.02, math.radians(-0.944))
    assert math.degrees(machine.guess(at, {})["delta"]) == pytest.approx(35.4891, abs=5e-4)  # measured 5e-5


def test_short_circuit_currents_fall_from_subtransient_to_transient():
    machine = GENSAL()
    bench = Bench(machine)
    values = at_rest(machine, terminal(0, 0)) | {"v_re": 0.0, "v_im": 0.0}
    assert abs(bench(values).current) == pytest.approx(1 / machine.Xpp_d)
    i_d = 1 / machine.Xp_d
    decayed = values | {"psi_1d": 1.0 - (machine.Xp_d - machine.X_l) * i_d}
    point = bench(decayed)
    assert abs(point.current) == pytest.approx(i_d)
    assert point.rhs["psi_1d"] == pytest.approx(0)


def test_equal_transient_and_subtransient_reactance_is_legal():
    machine = GENSAL(X_d=2.1, X_q=2.1, Xp_d=0.4, Xpp_d=0.4, Tpp_d0=999, Tpp_q0=999)
    point = Bench(machine)(at_rest(machine, terminal(0.9, 0.1)))
    assert max(abs(item) for item in point.rhs.values()) < 1e-12


def test_difference_to_the_form_without_leakage():
    """What the feedback of the damper on the field, which SalientPole leaves out, does to the modes of the hydro unit."""
    at, Z = terminal(0.86, 0.51), 0.27009j
    data = {"X_d": 1.24, "X_q": 0.7, "Xp_d": 0.35, "Xpp_d": 0.24, "Tp_d0": 6.5, "Tpp_d0": 0.05, "Tpp_q0": 0.1, "H": 2.9}
    modes = []
    for machine in (SalientPole(**data, Xpp_q=0.24), GENSAL(**data, X_l=0.15)):
        values = at_rest(machine, at)
        modes.append(
            sorted(np.linalg.eigvals(smib_matrix(Bench(machine), values, Z)[1]), key=lambda s: (s.real, s.imag))
        )
    without, leakage = modes
    swing, field = -2, -1
    assert leakage[swing] == pytest.approx(-0.71848 + 8.50090j, abs=1e-4)
    assert without[swing] == pytest.approx(-0.72148 + 8.50085j, abs=1e-4)
    assert leakage[field].real / without[field].real == pytest.approx(0.982, abs=1e-3)


def test_saturation_acts_on_the_transient_flux():
    machine = GENSAL(saturation="exponential", S10=0.1, S12=0.4)
    assert machine.guess(terminal(0, 0, 1.0), {})["e_fd"] == pytest.approx(1.1)
    values = at_rest(machine, terminal(0.6, 0.3))
    unsaturated = GENSAL().guess(terminal(0.6, 0.3), {})
    exponent = math.log(4) / math.log(1.2)
    assert values["e_fd"] - unsaturated["e_fd"] == pytest.approx(0.1 * values["ep_q"] ** (exponent + 1))
