"""A unit against its equivalent bus: the same equations as the plant's, seen from the terminals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import kobbelv

from pgexcite.core.controller import Surroundings
from pgexcite.core.equivalent import TERMINALS, Equivalent
from pgexcite.core.errors import ConfigError
from pgexcite.core.events import Fault
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.machines.classical import Classical
from pgexcite.plugins.machines.genrou import GENROU
from pgexcite.plugins.machines.gensal import GENSAL
from pgexcite.plugins.machines.kundur_flux import KundurFlux
from pgexcite.plugins.machines.one_axis import OneAxis
from pgexcite.plugins.machines.salient_pole import SalientPole

UNIT, DT = "unit.G2", 0.05
X_S = 0.27
"""Reactance between the terminals of the plant and its infinite bus."""
MACHINES = [SalientPole(), GENSAL(), GENROU(), OneAxis(), Classical(), KundurFlux()]


def surroundings(sim):
    s = sim.initial.state
    y = sim.kernel.outputs(s, sim.initial.p)
    u_0 = dict(zip(sim.model.u_names, s.u, strict=True))
    y_0 = dict(zip(sim.model.y_names, y, strict=True))
    return Surroundings(0.005, "tr_bdf2", u_0, y_0, sim.model.system, compile="never")


def make(x_s=X_S, overrides=None, **slots):
    """The plant, its surroundings and its equivalent."""
    sim = Simulation(kobbelv(**slots), Settings(2.0, 0.005, "tr_bdf2", "never"))
    return sim, Equivalent(surroundings(sim), UNIT, x_s, overrides or {}, "options.model")


def estimate_of(sim, equivalent):
    """The true vector at the plant's present state."""
    layout = equivalent.layout
    delta, v_bus = sim.get(f"{UNIT}.delta"), sim.get("infinite_bus.grid.v")
    rotor = [sim.get(f"{UNIT}.machine.{name}") for name in layout.rotor]
    bus = v_bus * np.sin(delta), v_bus * np.cos(delta)
    return np.array([*rotor, sim.get(f"{UNIT}.governor.p_m"), 0.0, X_S, *bus])


def terminals_of(sim):
    return np.array([sim.get(f"{UNIT}.{name}") for name in TERMINALS])


@pytest.mark.parametrize("machine", MACHINES, ids=lambda machine: type(machine).__name__)
@pytest.mark.parametrize("x_s", [0.1, X_S, 0.6])
def test_it_is_at_rest_where_the_plant_is(machine, x_s):
    sim, equivalent = make(x_s, machine=machine)
    propagate, sense = equivalent.functions(DT, 2)
    e_fd = sim.get(f"{UNIT}.e_fd")
    seen = np.array(sense(equivalent.start, e_fd)).ravel()
    assert np.abs(seen - terminals_of(sim)).max() < 1e-9  # measured 4e-15
    after = np.array(propagate(equivalent.start, e_fd)).ravel()
    assert np.abs(after - equivalent.start).max() < 1e-8  # measured 3e-10: what rest leaves of the Newton iterations
    assert equivalent.offset == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("machine", MACHINES, ids=lambda machine: type(machine).__name__)
@pytest.mark.parametrize(("steps", "tolerance"), [(10, 1e-9), (2, 5e-3)], ids=["own steps", "long steps"])
def test_after_a_fault_it_goes_where_the_plant_goes(machine, steps, tolerance):
    """In the plant's own steps to the accuracy of its Newton iterations, in steps of 25 ms to that of the rule."""
    sim, equivalent = make(machine=machine)
    propagate, sense = equivalent.functions(DT, steps)
    sim.restart(Fault(type="fault", t=0.1, bus="HV", R=0.02, duration=0.1).changes())
    sim.run(until=0.2)
    sim._apply_due()
    xi = estimate_of(sim, equivalent)
    e_fd = sim.get(f"{UNIT}.e_fd")
    for k in range(10):
        sim.run(until=0.2 + (k + 1) * DT)
        xi = np.array(propagate(xi, e_fd)).ravel()
        assert np.abs(xi - estimate_of(sim, equivalent)).max() < tolerance  # measured 2e-11 and 2.9e-3
        assert (
            np.abs(np.array(sense(xi, e_fd)).ravel() - terminals_of(sim)).max() < tolerance
        )  # measured 3e-11 and 3.0e-3


def test_what_rest_cannot_tell_apart_is_a_straight_line():
    """Whatever x_s, the voltage of the bus in the rotor's frame on this line gives the same terminals, and rest."""
    sim, equivalent = make(0.3)
    propagate, sense = equivalent.functions(DT, 2)
    start = equivalent.start
    along = make(0.301)[1].start - start
    e_fd = sim.get(f"{UNIT}.e_fd")
    for far in (-200, 100, 400):
        xi = start + far * along
        assert np.abs(np.array(sense(xi, e_fd)).ravel() - terminals_of(sim)).max() < 1e-9  # measured 4e-12
        assert np.abs(np.array(propagate(xi, e_fd)).ravel() - xi).max() < 1e-7  # measured 4e-10


def test_the_frequency_of_the_bus_shifts_the_speed_and_nothing_else():
    equivalent = make()[1]
    propagate, sense = equivalent.functions(DT, 2)
    layout = equivalent.layout
    xi = equivalent.start.copy()
    xi[layout.omega] += 0.003
    shift = np.zeros(layout.size)
    shift[[layout.omega, layout.omega_bus]] = -0.02
    for f in (propagate, sense):
        moved, plain = (np.array(f(point, 2.5)).ravel() for point in (xi + shift, xi))
        expected = shift if f is propagate else np.array([0.0, 0.0, 0.0, -0.02])
        assert np.abs(moved - plain - expected).max() < 1e-12  # measured 2e-15


def test_a_point_of_the_planning_model_is_the_estimate():
    equivalent = make()[1]
    xi = equivalent.start + 0.01
    x, u, p = equivalent.point(xi, 2.5)
    start = equivalent.initial.state
    state = equivalent.kernel.settle(start.with_(x=x, u=u), p)
    y = equivalent.kernel.outputs(state, p)
    model, layout = equivalent.initial.model, equivalent.layout
    seen = np.array(equivalent.functions(DT, 1)[1](xi, 2.5)).ravel()
    seen[3] -= xi[layout.omega_bus]
    assert [y[model.position("y", f"{UNIT}.{name}")] for name in TERMINALS] == pytest.approx(seen, abs=1e-9)
    assert y[model.position("y", f"{UNIT}.delta")] == pytest.approx(np.arctan2(*xi[layout.bus]))
    assert y[model.position("y", f"{UNIT}.e_fd")] == 2.5


def test_a_machine_believed_to_be_another_starts_at_the_same_terminals():
    sim, equivalent = make(overrides={f"{UNIT}.machine.X_d": 0.868})
    _, sense = equivalent.functions(DT, 2)
    assert np.abs(np.array(sense(equivalent.start, 0.0)).ravel() - terminals_of(sim)).max() < 1e-9  # measured 3e-16
    i_d = (sim.get(f"{UNIT}.e_fd") - sim.get(f"{UNIT}.machine.ep_q")) / (1.24 - 0.35)
    assert equivalent.offset == pytest.approx((0.868 - 1.24) * i_d, abs=1e-9)


def test_a_machine_without_an_angle_is_refused(monkeypatch):
    sim, _ = make()
    given = surroundings(sim)
    initial = Simulation(kobbelv(), Settings(1.0, 0.005, compile="never")).initial
    renamed = replace(initial.model, x_names=tuple(n.replace("delta", "theta_r") for n in initial.model.x_names))
    monkeypatch.setattr("pgexcite.core.equivalent._turned", lambda *_: replace(initial, model=renamed))
    with pytest.raises(ConfigError, match="states named delta and omega"):
        Equivalent(given, UNIT, X_S, {}, "options.model")


def test_an_override_that_names_nothing_is_refused():
    with pytest.raises(ConfigError, match=r"options\.model\.unit\.G2\.machine\.X_dd"):
        make(overrides={f"{UNIT}.machine.X_dd": 1.0})
