from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from component_harness import Bench, at_terminal, smib_matrix, terminal

from pgexcite.plugins.machines.classical import Classical


def at_rest(machine, at):
    return dict(machine.guess(at, {})) | at_terminal(at)


def test_constant_voltage_behind_the_transient_reactance():
    machine, at = Classical(Xp_d=0.3, R_a=0.01), terminal(0.9, 0.3, 1.0, math.radians(36))
    values = at_rest(machine, at)
    E = at.v + (0.01 + 0.3j) * at.i
    assert values["e_fd"] == pytest.approx(abs(E))
    assert values["delta"] == pytest.approx(cmath.phase(E))


def test_kundur_example_12_2():
    # E_t = 1 at 36 deg, P = .9, Q = .3, X_E = .65, f = 60 Hz: E' = 1.123 at 49.92 deg, K_S = .757.
    at = terminal(0.9, 0.3, 1.0, math.radians(36))
    for K_D, eigenvalue in ((0.0, 6.387j), (10.0, -0.714 + 6.35j)):
        machine = Classical(H=3.5, Xp_d=0.3, D=K_D)
        bench, values = Bench(machine, f_n=60.0), at_rest(machine, at)
        names, A, _ = smib_matrix(bench, values, 0.65j)
        assert values["e_fd"] == pytest.approx(1.123, abs=1e-3)  # measured 6e-5
        assert math.degrees(values["delta"]) == pytest.approx(49.92, abs=0.02)  # measured 8e-3
        K_S = -2 * 3.5 * A[names.index("omega"), names.index("delta")]
        assert pytest.approx(0.757, abs=1e-3) == K_S  # measured 4e-4
        assert np.linalg.eigvals(A)[0] in (
            pytest.approx(eigenvalue, abs=5e-3),
            pytest.approx(eigenvalue.conjugate(), abs=5e-3),
        )


def test_no_inertia_is_an_infinite_bus():
    machine, at = Classical(H=0.0, Xp_d=1e-5, D=2.0), terminal(1.5, 0.7)
    disturbed = at_rest(machine, at) | {"v_re": 0.2, "omega": 1.01, "t_m": 9.0}
    point = Bench(machine)(disturbed)
    assert (point.rhs["omega"], point.mass["omega"]) == (0.0, 1.0)
    assert point.rhs["delta"] == pytest.approx(2 * math.pi * 50 * 0.01)


def test_inertia_may_be_swept_through_zero_without_recompiling():
    bench = Bench(Classical())
    values = at_rest(Classical(), terminal(0.5, 0.1)) | {"t_m": 0.6}
    assert bench(values, H=0.0).rhs["omega"] == 0
    assert bench(values, H=2.0).rhs["omega"] == pytest.approx(0.1)
