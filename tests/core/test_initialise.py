"""The steady state a run starts from: at rest for every shipped model, and an error that says which limit is in the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import kobbelv, regulated, two_units

from pgexcite.core import registry
from pgexcite.core.component import Equations
from pgexcite.core.declare import par, port_out
from pgexcite.core.errors import InitialisationError, PowerFlowError
from pgexcite.core.initialise import initialise
from pgexcite.core.roles import Limiter
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Schedule
from pgexcite.plugins.exciters.constant import ConstantField
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.governors.constant import ConstantTorque
from pgexcite.plugins.machines.classical import Classical
from pgexcite.plugins.stabilisers.kundur import KundurPSS


def shipped(role):
    return [pytest.param(role, name, id=f"{role}.{name}") for name in registry.names(role)]


@pytest.mark.parametrize(
    ("role", "name"), [case for role in ("machine", "exciter", "stabiliser", "governor") for case in shipped(role)]
)
def test_every_shipped_model_starts_and_stays_at_rest(role, name):
    plant = kobbelv if name == "classical" else regulated  # its field voltage is E': there is nothing to regulate
    sim = Simulation(plant(**{role: registry.find(role, name)()}), Settings(1.0, 0.01, compile="never"))
    assert sim.initial.residual <= 1e-9
    assert sim.run().ending.value == "completed"
    assert np.abs(sim.state.x - sim.initial.state.x).max() < 1e-9


@pytest.mark.parametrize(("role", "name"), shipped("load"))
def test_every_shipped_load_starts_and_stays_at_rest(role, name):
    cls = registry.find(role, name)
    rating = {"S_m": 200.0} if "S_m" in cls.model_fields else {}
    sim = Simulation(two_units(load=cls(P=150.0, Q=30.0, **rating)), Settings(1.0, 0.01, compile="never"))
    assert sim.initial.residual <= 1e-9
    assert sim.get("load.L.p") == pytest.approx(1.5, abs=1e-9)
    assert sim.get("load.L.q") == pytest.approx(0.3, abs=1e-9)
    sim.run()
    assert np.abs(sim.state.x - sim.initial.state.x).max() < 1e-9


@settings(deadline=None, max_examples=40)
@given(P=st.floats(0.05, 0.95), Q=st.floats(-0.3, 0.6), V=st.floats(0.95, 1.08))
def test_any_operating_point_of_the_plant(P, Q, V):
    """P, Q and V come out as asked for; the infinite bus and the set-points follow."""
    system = regulated(stabiliser=KundurPSS(), exciter=ST1A(V_RMAX=10.0, V_RMIN=-10.0))
    unit = replace(system.device("unit.G2"), schedule=Schedule(P=175 * P, Q=175 * Q, V=V))
    initial = initialise(replace(system, devices=(unit, system.devices[1])))
    model, state = initial.model, initial.state
    assert initial.residual <= 1e-9
    y = np.array(model.dae(state.x, state.z, state.d, state.u, initial.p)[5]).ravel()
    found = [y[model.position("y", f"unit.G2.{name}")] for name in ("p_e", "q_e", "v_t", "omega", "v_s")]
    assert found == pytest.approx([P, Q, V, 1.0, 0.0], abs=1e-9)  # measured below 1e-12


def test_machine_per_unit_and_system_per_unit():
    """The same plant on another system base is the same plant."""
    one, other = (initialise(kobbelv(S_base=base)) for base in (175.0, 100.0))
    assert np.abs(one.state.x - other.state.x).max() < 1e-11  # measured 2e-13
    current = [initial.state.z[initial.model.position("z", "infinite_bus.grid.i_re")] for initial in (one, other)]
    assert current[1] == pytest.approx(1.75 * current[0], abs=1e-11)


def test_a_classical_machine_without_inertia_is_an_infinite_bus():
    """As PSS/E reads GENCLS with H = 0: its speed never changes, and angles are measured against it."""
    system = two_units(grid=False)
    stiff = {"machine": Classical(H=0.0, Xp_d=1e-4), "exciter": ConstantField(), "governor": ConstantTorque()}
    first = replace(system.device("unit.G1"), components=stiff)
    system = replace(system, devices=(first, *system.devices[1:]))
    sim = Simulation(system, Settings(1.0, 0.005, compile="never"))
    assert sim.model.reference == "unit.G1"
    sim.set("load.L.P", 50.0)
    assert sim.run().ending.value == "completed"
    trace = sim.trace()
    assert np.abs(trace["unit.G1.omega"] - 1).max() < 1e-12  # measured 4e-14
    assert np.ptp(trace["unit.G1.delta"]) < 1e-10  # measured 6e-12
    assert np.ptp(trace["bus.A.v"]) < 1e-3
    assert np.ptp(trace["unit.G2.omega"]) > 1e-4


# What is in the way.


def violations(system):
    with pytest.raises(InitialisationError) as caught:
        initialise(system)
    return {problem.path: problem.message for problem in caught.value.problems}


@pytest.mark.parametrize(
    ("exciter", "path", "value"),
    [
        (ST1A(V_RMAX=1.5), "unit.G2.exciter.field voltage", "1.9246, above the upper limit 1.5"),
        (ST1A(V_RMIN=2.0), "unit.G2.exciter.field voltage", "1.9246, below the lower limit 2"),
        (ST1A(V_AMAX=1.5), "unit.G2.exciter.v_a", "1.9246, above the upper limit 1.5"),
        (ST1A(V_AMIN=2.5, V_AMAX=9.0), "unit.G2.exciter.v_a", "1.9246, below the lower limit 2.5"),
        (ST1A(V_IMAX=0.001), "unit.G2.exciter.voltage error", "above the upper limit 0.001"),
        (ST1A(V_RMAX=2.0, K_C=0.1), "unit.G2.exciter.field voltage", "above the upper limit 1.8075"),
        (SEXS(E_MAX=1.9), "unit.G2.exciter.v_e", "1.9246, above the upper limit 1.9"),
        (SEXS(E_MIN=1.95), "unit.G2.exciter.v_e", "1.9246, below the lower limit 1.95"),
        (ConstantField(E_MAX=1.9), "unit.G2.exciter.field voltage", "1.9246, above the upper limit 1.9"),
    ],
)
def test_a_violated_limit_is_named_with_value_and_limit(exciter, path, value):
    found = violations(kobbelv(exciter=exciter))
    assert list(found) == [path]
    assert value in found[path]


def test_all_that_is_in_the_way_is_said_at_once():
    system = two_units()
    low = {"unit.G1": SEXS(E_MAX=0.5), "unit.G2": ST1A(V_RMAX=0.5, V_IMAX=0.001)}
    devices = [
        replace(d, components={**d.components, "exciter": low[d.path]}) if d.path in low else d for d in system.devices
    ]
    found = violations(replace(system, devices=tuple(devices)))
    assert set(found) == {"unit.G1.exciter.v_e", "unit.G2.exciter.field voltage", "unit.G2.exciter.voltage error"}


def test_a_limit_that_is_just_met_is_no_violation():
    e_fd = 1.9245
    exact = Simulation(kobbelv(), Settings(1.0, compile="never")).get("unit.G2.e_fd")
    assert initialise(kobbelv(exciter=SEXS(E_MAX=exact))).residual <= 1e-9
    assert "above the upper limit 1.9245" in violations(kobbelv(exciter=SEXS(E_MAX=e_fd)))["unit.G2.exciter.v_e"]


class Holding(Limiter):
    """An underexcitation limiter that is active from the start."""

    signal: float = par(3.0, "pu", "signal")
    v_uel = port_out("pu", "signal")

    def equations(self, v):
        return Equations(out={"v_uel": self.signal})


@pytest.mark.parametrize("position", [2, 3])
def test_a_gate_that_holds_the_field_has_no_steady_state_at_this_point(position):
    found = violations(kobbelv(exciter=ST1A(uel_position=position), uel=Holding()))
    assert list(found) == ["unit.G2"]
    assert "no steady state at P = 0.86, Q = 0.51, V = 1 pu" in found["unit.G2"]


def test_a_power_flow_that_fails_comes_first():
    system = kobbelv(exciter=ST1A(V_RMAX=0.1))
    unit = replace(system.device("unit.G2"), schedule=Schedule(P=2000.0, V=1.0))
    grid = replace(system.devices[1], schedule=Schedule(V=1.0, angle=0.0))
    with pytest.raises(PowerFlowError):
        initialise(replace(system, devices=(unit, grid)))
