"""Wiring: what drives what, each misfit with its own message, and the pieces of the assembled model."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from plants import kobbelv, regulated, two_units

from pgexcite.core.assemble import assemble
from pgexcite.core.blocks import der, lag
from pgexcite.core.component import Component, Equations
from pgexcite.core.declare import algebraic, constant, discrete, par, port_in, port_out, setpoint, state
from pgexcite.core.errors import AssemblyError
from pgexcite.core.initialise import initialise
from pgexcite.core.roles import Exciter, Load
from pgexcite.core.system import Device, Schedule


class Block(Component):
    """A gain from ``a`` to ``b``."""

    K: float = par(1.0, "-", "gain")
    a = port_in("pu", "input", default=1.0)
    b = port_out("pu", "output")

    def equations(self, v):
        return Equations(out={"b": self.K * v.a})


class Back(Component):
    """A gain from ``b`` back to ``a``."""

    b = port_in("pu", "input")
    a = port_out("pu", "output")

    def equations(self, v):
        return Equations(out={"a": 0.5 * v.b})


class LaggedBack(Component):
    """The same behind a lag: no loop."""

    b = port_in("pu", "input")
    a = port_out("pu", "output")
    x = state("pu", "lagged")

    def equations(self, v):
        return Equations(ode=(lag(0.5 * v.b, v.x, T=0.1),), out={"a": v.x})


def with_device(**components):
    system = kobbelv()
    extra = Device("unit.X", "HV", 100.0, components, Schedule(P=0.0, Q=0.0))
    return replace(system, devices=(*system.devices, extra))


def refused(system):
    with pytest.raises(AssemblyError) as caught:
        assemble(system)
    return str(caught.value)


def without(slot):
    system = regulated()
    unit = system.device("unit.G2")
    kept = {name: component for name, component in unit.components.items() if name != slot}
    return replace(system, devices=(replace(unit, components=kept), *system.devices[1:]))


@pytest.mark.parametrize(
    ("slot", "path", "port"),
    [
        ("exciter", "unit.G2.machine", "e_fd"),
        ("governor", "unit.G2.machine", "t_m"),
        ("machine", "unit.G2.exciter", "v_t"),
    ],
)
def test_an_input_nothing_drives(slot, path, port):
    message = refused(without(slot))
    assert message == f"{path}: nothing in unit.G2 drives its input {port!r}; add a component with that output"


def test_an_input_with_a_default_may_stay_open():
    assert "unit.G2.v_s" not in assemble(without("stabiliser")).index["y"]
    model = assemble(with_device(block=Block(K=3.0)))
    y = model.dae(*(np.zeros(len(model.index[g])) for g in "xzdu"), model.p_0)[5]
    assert float(y[model.position("y", "unit.X.b")]) == 3.0


def test_two_drivers_of_one_signal():
    message = refused(with_device(one=Block(), two=Block()))
    assert message == "unit.X: two components drive 'b'; leave one out"


def test_an_algebraic_loop():
    message = refused(with_device(block=Block(), back=Back()))
    assert message.startswith("unit.X: algebraic loop through the signals ")
    assert "b -> a -> b" in message or "a -> b -> a" in message


def test_a_loop_with_a_state_is_none():
    model = assemble(with_device(block=Block(), back=LaggedBack()))
    assert "unit.X.back.x" in model.index["x"]


class Last(Component):
    """A gain from ``b`` to ``c``."""

    b = port_in("pu", "input")
    c = port_out("pu", "output")

    def equations(self, v):
        return Equations(out={"c": 10.0 * v.b})


class First(Component):
    """A constant ``a``."""

    A: float = par(2.0, "pu", "value")
    a = port_out("pu", "output")

    def equations(self, v):
        return Equations(out={"a": self.A})


@pytest.mark.parametrize("order", [("last", "block", "first"), ("first", "block", "last")])
def test_a_chain_of_outputs_is_followed_whatever_the_order(order):
    parts = {"last": Last(), "block": Block(K=3.0), "first": First()}
    model = assemble(with_device(**{name: parts[name] for name in order}))
    y = model.dae(*(np.zeros(len(model.index[g])) for g in "xzdu"), model.p_0)[5]
    assert float(y[model.position("y", "unit.X.c")]) == 60.0


class NoRow(Component):
    """A state without its equation."""

    x = state("pu", "a state")
    y = state("pu", "another")

    def equations(self, v):
        return Equations(ode=(der(v.x, -v.x),))


class NoResidual(Component):
    """An algebraic unknown without its residual."""

    z = algebraic("pu", "an unknown")

    def equations(self, v):
        return Equations()


class NoOutput(Component):
    """A port without its value."""

    b = port_out("pu", "declared")

    def equations(self, v):
        return Equations()


class ExtraOutput(Component):
    """A value without its port."""

    def equations(self, v):
        return Equations(out={"c": 1.0})


class NoUpdate(Component):
    """A discrete state that is never renewed."""

    d = discrete("-", "a counter")

    def equations(self, v):
        return Equations()


class NoHold(Component):
    """A constant nothing fixes."""

    k = constant("pu", "an initial value")

    def equations(self, v):
        return Equations()


class NoCurrent(Load):
    """A load that draws nothing it says."""

    def equations(self, v):
        return Equations(out={"p": 0.0, "q": 0.0})


@pytest.mark.parametrize(
    ("cls", "text"),
    [
        (NoRow, "2 states are declared, 1 rows are stated"),
        (NoResidual, "1 algebraic unknowns are declared, 0 residuals are stated"),
        (NoOutput, "output b declared but not stated"),
        (ExtraOutput, "output c stated but not declared"),
        (NoUpdate, "discrete d declared but not stated"),
        (NoHold, "constant k declared but not stated"),
        (NoCurrent, "has a terminal but states no current"),
    ],
)
def test_a_component_must_state_what_it_declares(cls, text):
    assert refused(with_device(block=cls())) == f"unit.X.block: {text}"


def test_a_row_of_the_wrong_state():
    class Twice(NoRow):
        def equations(self, v):
            return Equations(ode=(der(v.x, -v.x), der(v.x, -v.x)))

    assert refused(with_device(block=Twice())) == "unit.X.block: no row is stated for the state y"


def test_equations_that_use_an_unknown_signal():
    class Misspelt(Block):
        def equations(self, v):
            return Equations(out={"b": v.aa})

    with pytest.raises(AttributeError, match=r"no signal 'aa' here; declared are: .*S_n, a,"):
        assemble(with_device(block=Misspelt()))


def test_a_unit_with_too_many_set_points():
    class TwoReferences(Exciter):
        v_ref = setpoint("pu", "one")
        w_ref = setpoint("pu", "two")

        def equations(self, v):
            return Equations(out={"e_fd": v.v_ref + v.w_ref})

    with pytest.raises(
        AssemblyError, match=r"unit\.G2: .* a unit has two set-points, one of its governor and one of its exciter"
    ):
        initialise(kobbelv(exciter=TwoReferences()))


@pytest.mark.parametrize("reference", ["G9", "HV"])
def test_a_reference_that_is_no_unit(reference):
    assert refused(kobbelv(reference)) == f"simulation.reference: no unit {reference!r}; units are G2"


@pytest.mark.parametrize(
    ("system", "expected"),
    [
        (kobbelv(), "infinite_bus.grid"),
        (kobbelv("G2"), "unit.G2"),
        (two_units(grid=False), "centre_of_inertia"),
        (two_units("G2", grid=False), "unit.G2"),
    ],
)
def test_the_reference_chosen(system, expected):
    model = assemble(system)
    assert model.reference == expected
    still = {model.x_names[k] for k in np.flatnonzero(model.inert)}
    assert still == {"infinite_bus.grid": {"infinite_bus.grid.theta"}, "unit.G2": {"unit.G2.machine.delta"}}.get(
        expected, set()
    )


def test_every_quantity_has_a_name_a_unit_and_its_number():
    model = assemble(regulated())
    for group in ("x", "z", "d", "u", "p", "y"):
        names = list(model.index[group])
        assert len(names) == len(set(names))
        assert all(path in model.units for path in names), [path for path in names if path not in model.units]
    p = dict(zip(model.p_names, model.p_0, strict=True))
    assert (p["unit.G2.machine.X_d"], p["line.L1.X"], p["system.f_n"], p["unit.G2.S_n"]) == (1.24, 0.15, 50.0, 175.0)
    with pytest.raises(KeyError, match=r"nearest: unit\.G2\.machine\.X_d"):
        model.position("p", "unit.G2.machine.Xd")


def test_parameters_are_symbols():
    """One function for any number: nothing of a float parameter is baked in."""
    low, high = assemble(kobbelv()), assemble(replace(kobbelv(S_base=100.0), S_base=175.0))
    assert low.dae.serialize() == high.dae.serialize()
    assert low.fingerprint == high.fingerprint
    assert assemble(regulated()).fingerprint != low.fingerprint


def test_currents_balance_at_every_bus():
    """Kirchhoff's rows are the sum of devices and branches, on the system base, at any voltage."""
    initial = initialise(two_units())
    model, state = initial.model, initial.state
    g = np.array(model.dae(state.x, state.z, state.d, state.u, initial.p)[4]).ravel()
    assert np.abs(g).max() < 1e-10
    flow = initial.flow
    y = np.array(model.dae(state.x, state.z, state.d, state.u, initial.p)[5]).ravel()
    out = {name: y[model.position("y", name)] for name in model.y_names}
    assert out["line.L1.p_from"] == pytest.approx(flow.s["unit.G1"].real, abs=1e-10)
    assert out["line.L2.q_from"] == pytest.approx(flow.s["unit.G2"].imag, abs=1e-10)
    losses = sum(out[f"line.L{k}.p_{end}"] for k in range(1, 5) for end in ("from", "to"))
    assert losses == pytest.approx(sum(s.real for s in flow.s.values()), abs=1e-10)
    assert losses > 0


def test_everything_is_casadi_sx():
    model = assemble(kobbelv())
    assert isinstance(model.dae, ca.Function)
    assert model.dae.is_a("SXFunction")
