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
        kinds = (Kind.STATE, Kind.ALGEBRAIC, Kind.DISCRETE, Kind.SETPOINT, Kind.CONSTANT, Kind.INPUT, Kind.BEFORE)
        own = [item.name for item in type(component).variables(*kinds)]
        self.names = list(dict.fromkeys([*own, "h", "v_re", "v_im", "tap", "omega_ref", "omega_0", "S_n"]))
        symbols = {name: ca.SX.sym(name) for name in self.names}
        parameters = {name: ca.SX.sym(name) for name in component.numeric_parameters()}
        self.parameters = {name: getattr(component, name) for name in parameters}
        stated = component.with_symbols(parameters).equations(Signals(symbols))
        self._discrete, self._outputs, self._before = tuple(stated.update), tuple(stated.out), tuple(stated.before)
        self._function = ca.Function(
            "automaton",
            [ca.vertcat(*symbols.values()), ca.vertcat(*parameters.values())],
            [ca.vertcat(*group.values()) for group in (stated.update, stated.out, stated.before)],
        )
        self.d = {item.name: float(item.default or 0.0) for item in type(component).variables(Kind.DISCRETE)}
        self.given = {"omega_ref": 1.0, "omega_0": 314.0, "S_n": 100.0, "v_im": 0.0, **given}
        self.out: dict[str, float] = {}

    def step(self, **signals: float) -> Mapping[str, float]:
        """Take one step at whose beginning the signals jump to these values; those not given keep their last."""
        self.given |= signals
        return self._step(self._evaluate()[2])

    def slide(self, **signals: float) -> Mapping[str, float]:
        """Take one step in which the signals move smoothly to these values."""
        before = self._evaluate()[2]
        self.given |= signals
        return self._step(before)

    def _step(self, before: Mapping[str, float]) -> Mapping[str, float]:
        self.d = self._evaluate(before)[0]
        self.out = self._evaluate(before)[1]
        return self.d

    def _evaluate(self, before: Mapping[str, float] | None = None) -> list[dict[str, float]]:
        """Next discrete states, outputs, and the signals wanted from a step's beginning."""
        values = {**dict.fromkeys(self.names, 0.0), **self.given, **self.d, **(before or {})}
        found = self._function([values[name] for name in self.names], list(self.parameters.values()))
        names = (self._discrete, self._outputs, self._before)
        return [dict(zip(n, item.full().ravel().tolist(), strict=True)) for n, item in zip(names, found, strict=True)]
