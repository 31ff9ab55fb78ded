"""A component's discrete map, compiled alone: one call is one step."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from pgexcite.core.component import Component, Signals
from pgexcite.core.declare import Kind


class Automaton:
    """Discrete states of a component, moved on by its ``update`` from signals that are given.

    Attributes:
        d: discrete states by name.
        out: outputs of the last step, by name.
    """

    def __init__(self, component: Component, **given: float) -> None:
        kinds = (Kind.STATE, Kind.ALGEBRAIC, Kind.DISCRETE, Kind.SETPOINT, Kind.CONSTANT, Kind.INPUT)
        own = [item.name for item in type(component).variables(*kinds)]
        self.names = list(dict.fromkeys([*own, "h", "v_re", "v_im", "tap", "omega_ref", "omega_0", "S_n"]))
        symbols = {name: ca.SX.sym(name) for name in self.names}
        parameters = {name: ca.SX.sym(name) for name in component.numeric_parameters()}
        self.parameters = {name: getattr(component, name) for name in parameters}
        stated = component.with_symbols(parameters).equations(Signals(symbols))
        self._discrete, self._outputs = tuple(stated.update), tuple(stated.out)
        self._function = ca.Function(
            "automaton",
            [ca.vertcat(*symbols.values()), ca.vertcat(*parameters.values())],
            [ca.vertcat(*stated.update.values()), ca.vertcat(*stated.out.values())],
        )
        self.d = {item.name: float(item.default or 0.0) for item in type(component).variables(Kind.DISCRETE)}
        self.given = {"omega_ref": 1.0, "omega_0": 314.0, "S_n": 100.0, "v_im": 0.0, **given}
        self.out: dict[str, float] = {}

    def step(self, **signals: float) -> Mapping[str, float]:
        """Take one step; signals not given keep their last value."""
        self.given |= signals
        values = {**dict.fromkeys(self.names, 0.0), **self.given, **self.d}
        arguments = [[values[name] for name in self.names], list(self.parameters.values())]
        moved, _ = self._function(*arguments)
        self.d = dict(zip(self._discrete, moved.full().ravel().tolist(), strict=True))
        values |= self.d
        out = self._function([values[name] for name in self.names], arguments[1])[1]
        self.out = dict(zip(self._outputs, out.full().ravel().tolist(), strict=True))
        return self.d
