"""The linearisation against finite differences of the reduced equations, and its modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from independent import Independent
from plants import kobbelv, regulated, two_units

from pgexcite.core.errors import PgexciteError
from pgexcite.core.events import Fault
from pgexcite.core.initialise import initialise
from pgexcite.core.linearise import linearise
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule
from pgexcite.plugins.exciters.constant import ConstantField
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.governors.constant import ConstantTorque
from pgexcite.plugins.machines.classical import Classical
from pgexcite.plugins.sources.infinite_bus import InfiniteBus


def at_rest(system):
    initial = initialise(system)
    return initial.model, initial.state, initial.p


def disturbed(system, t=0.6):
    sim = Simulation(
        system,
        Settings(1.0, 0.005, compile="never"),
        Fault(type="fault", t=0.1, bus="HV", R=0.02, duration=0.1).changes(),
    )
    sim.run(until=t)
    return sim.model, sim.state, sim.p


def differences(model, state, p, names, step=1e-6):
    """A, B, C, D by central differences: everything algebraic solved again at each of the shifted points."""
    reduced = Independent(model, state, p)
    mass = np.array(model.dae(state.x, state.z, state.d, state.u, p)[1]).ravel()
    rows = [model.x_names.index(name) for name in names]

    def evaluate(x, u):
        x, z, f = reduced.algebraic_at(x, state.z, u, p)
        return np.concatenate((f[rows] / mass[rows], np.array(reduced.y(x, z, u, p)).ravel()))

    def column(group, k):
        shifted = [{"x": np.array(state.x), "u": np.array(state.u)} for _ in range(2)]
        shifted[0][group][k] += step
        shifted[1][group][k] -= step
        return (evaluate(**shifted[0]) - evaluate(**shifted[1])) / (2 * step)

    by_x = np.array([column("x", k) for k in rows]).T
    by_u = np.array([column("u", k) for k in range(state.u.size)]).T
    n = len(rows)
    return by_x[:n], by_u[:n], by_x[n:], by_u[n:]


REGULATED = ST1A(T_R=0.02, K_A=50.0, T_A=0.02, T_C=1.0, T_B=10.0, K_F=0.02, T_F=1.0, K_C=0.05)


@pytest.mark.parametrize(
    "point",
    [
        pytest.param(at_rest(kobbelv()), id="constant_field"),
        pytest.param(at_rest(regulated()), id="zero_time_constants"),
        pytest.param(at_rest(regulated(exciter=REGULATED)), id="all_time_constants"),
        pytest.param(disturbed(regulated(exciter=REGULATED)), id="on_the_move"),
        pytest.param(at_rest(two_units()), id="two_units"),
        pytest.param(at_rest(two_units("G2", grid=False)), id="against_a_unit"),
        pytest.param(at_rest(two_units("centre_of_inertia", grid=False)), id="against_the_centre"),
    ],
)
def test_against_finite_differences(point):
    model, state, p = point
    lin = linearise(model, state, p)
    assert lin.held == ()
    for exact, numeric in zip((lin.A, lin.B, lin.C, lin.D), differences(*point, lin.x_names), strict=True):
        assert exact.shape == numeric.shape
        assert np.abs(exact - numeric).max() < 1e-6 * max(1.0, np.abs(exact).max())  # measured 4.5e-10


def test_states_without_a_time_constant_are_eliminated():
    lin = linearise(*at_rest(regulated()))
    left = {name.partition("exciter.")[2] for name in lin.x_names if ".exciter." in name}
    assert left == {"v_m"}
    lin = linearise(*at_rest(regulated(exciter=REGULATED)))
    assert {name.partition("exciter.")[2] for name in lin.x_names if ".exciter." in name} == {
        "v_m",
        "x_b",
        "v_a",
        "x_f",
    }


def test_a_state_at_its_limit_is_held():
    """With the regulator at its ceiling the field does not answer to the reference; the plant is that of a constant field."""
    exciter = ST1A(T_A=0.05, K_A=50.0, V_AMAX=3.0, V_RMAX=20.0)
    model, state, p = disturbed(kobbelv(exciter=exciter), t=0.15)
    v_a = "unit.G2.exciter.v_a"
    assert state.x[model.x_names.index(v_a)] == 3.0
    lin = linearise(model, state, p)
    assert lin.held == (v_a,)
    assert v_a not in lin.x_names
    assert np.all(lin.B[:, lin.u_names.index("unit.G2.exciter.v_ref")] == 0)
    e_fd = lin.y_names.index("unit.G2.e_fd")
    assert np.all(lin.C[e_fd] == 0)
    assert np.all(lin.D[e_fd] == 0)
    free = state.with_(x=np.where(np.array(model.x_names) == v_a, 2.9, state.x))
    assert linearise(model, free, p).held == ()


def test_a_limit_that_is_only_touched_does_not_hold():
    """At the ceiling, but driven away from it."""
    exciter = ST1A(T_A=0.05, K_A=50.0, V_AMAX=3.0)
    model, state, p = at_rest(kobbelv(exciter=exciter))
    touching = state.with_(x=np.where(np.array(model.x_names) == "unit.G2.exciter.v_a", 3.0, state.x))
    assert linearise(model, touching, p).held == ()


def test_the_classical_machine_in_closed_form():
    """``lambda^2 = -omega_0 K_S / 2H`` with ``K_S = E' V cos(delta) / X``."""
    model, state, p = at_rest(kobbelv(machine=Classical(H=2.9, Xp_d=0.35)))
    E = abs(1 + 0.35j * (0.86 - 0.51j))
    V = abs(1 - 0.27j * (0.86 - 0.51j))
    delta = np.angle(1 + 0.35j * (0.86 - 0.51j)) - np.angle(1 - 0.27j * (0.86 - 0.51j))
    K_S = E * V * np.cos(delta) / 0.62
    (mode,) = linearise(model, state, p).modes()
    assert mode.eigenvalue == pytest.approx(1j * np.sqrt(100 * np.pi * K_S / 5.8), abs=1e-9)  # measured below 1e-11
    assert mode.damping == pytest.approx(0.0, abs=1e-12)
    assert mode.frequency_hz == pytest.approx(mode.eigenvalue.imag / (2 * np.pi))
    assert list(mode.participation.values()) == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("system", [regulated(), two_units()], ids=["one_unit", "two_units"])
def test_modes(system):
    lin = linearise(*at_rest(system))
    modes, values = lin.modes(), lin.eigenvalues()
    pairs = sum(mode.eigenvalue.imag > 0 for mode in modes)
    assert len(modes) + pairs == len(values) == len(lin.x_names)
    assert [mode.eigenvalue.real for mode in modes] == sorted((mode.eigenvalue.real for mode in modes), reverse=True)
    for mode in modes:
        assert sum(mode.participation.values()) == pytest.approx(1.0, abs=1e-12)
        assert list(mode.participation.values()) == sorted(mode.participation.values(), reverse=True)
        assert set(mode.participation) == set(lin.x_names)
        assert mode.damping == pytest.approx(-mode.eigenvalue.real / abs(mode.eigenvalue))
        assert np.abs(values - mode.eigenvalue).min() < 1e-9
        assert set(mode.as_dict()) == {"re", "im", "damping", "frequency_hz", "participation"}
    assert values.sum() == pytest.approx(np.trace(lin.A), abs=1e-8)


def test_the_reference_moves_no_mode():
    """Angles against the infinite bus, a unit or the centre of inertia: the same modes, once the idle angle is left out."""
    expected = linearise(*at_rest(two_units("infinite_bus"))).eigenvalues()
    assert np.abs(expected).min() > 0.01
    for reference in ("G1", "centre_of_inertia"):
        values = linearise(*at_rest(two_units(reference))).eigenvalues()
        values = values[np.argsort(np.abs(values))][len(values) - len(expected) :]
        for value in expected:
            assert np.abs(values - value).min() < 1e-7, (reference, value)


@pytest.mark.parametrize("reference", ["auto", "INF", "G1", "centre_of_inertia"])
def test_a_machine_without_inertia_adds_no_modes(reference):
    """The modes are those with an infinite bus behind its reactance, and where it is the reference itself nothing else."""
    system = two_units(reference)

    def ended(path, **components):
        plan = Schedule(P=None, V=1.0, angle=0.0)
        return replace(system, devices=(*system.devices[:3], Device(path, "INF", 100.0, components, plan)))

    bus = replace(ended("infinite_bus.INF", **{"": InfiniteBus(X=0.01)}), reference="infinite_bus")
    machine = {"machine": Classical(H=0.0, Xp_d=0.01), "exciter": ConstantField(), "governor": ConstantTorque()}
    expected = linearise(*at_rest(bus)).eigenvalues()
    lin = linearise(*at_rest(ended("unit.INF", **machine)))
    assert not any(name.startswith("unit.INF.machine.omega") for name in lin.x_names)
    values = lin.eigenvalues()
    values = values[np.argsort(np.abs(values))]
    if reference in {"auto", "INF"}:
        assert len(values) == len(expected)
    for value in expected:
        assert np.abs(values - value).min() < 1e-7


def test_nothing_to_move():
    system = two_units()
    bare = replace(system, devices=system.devices[2:])
    lin = linearise(*at_rest(bare))
    assert lin.x_names == ()
    assert lin.modes() == []
    assert lin.D.shape == (len(lin.y_names), len(lin.u_names))


def test_singular_equations_are_refused():
    model, state, p = at_rest(kobbelv())
    p = p.copy()
    p[model.position("p", "bus.INF.fault_status")] = 1.0
    with pytest.raises(PgexciteError, match="the algebraic equations are singular"):
        linearise(model, state, p)
