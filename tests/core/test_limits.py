"""Non-windup limits: the projected step against exact switching solutions, for all rules."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

from pgexcite.core.blocks import der, integrator, lag
from pgexcite.core.component import Component, Equations
from pgexcite.core.declare import par, port_out, state
from pgexcite.core.initialise import initialise
from pgexcite.core.network import Bus
from pgexcite.core.step import Kernel
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.sources.infinite_bus import InfiniteBus

RULES = ("trapezoidal", "tr_bdf2", "backward_euler")


class Driven(Component):
    """``u = U + A sin(W tau)`` into a limited lag (or integrator); the upper limit may move with ``tau`` as well."""

    T: float = par(0.2, "s", "time constant", ge=0)
    K: float = par(2.0, "pu", "gain")
    LOWER: float = par(-1.0, "pu", "lower limit")
    UPPER: float = par(1.0, "pu", "upper limit")
    SINK: float = par(0.0, "pu/s", "how fast the upper limit comes down")
    U: float = par(0.0, "pu", "constant part of the input")
    A: float = par(1.0, "pu", "amplitude")
    W: float = par(3.0, "rad/s", "frequency")
    CLOCK: float = par(0.0, "-", "1 lets time run")
    integrates: bool = par(False, "-", "an integrator in place of the lag")

    tau = state("s", "time")
    y = state("pu", "limited output")
    u = port_out("pu", "input")

    def equations(self, v):
        u = self.U + self.A * ca.sin(self.W * v.tau)
        upper = self.UPPER - self.SINK * v.tau
        if self.integrates:
            block = integrator(u, v.y, T=self.T, lower=self.LOWER, upper=upper)
        else:
            block = lag(u, v.y, T=self.T, K=self.K, lower=self.LOWER, upper=upper)
        return Equations(ode=(der(v.tau, self.CLOCK), block), out={"u": u})


def bench(integrates):
    """The block at rest, with no input."""
    system = System(
        S_base=100.0,
        f_n=50.0,
        buses={"B": Bus()},
        devices=(
            Device("infinite_bus.grid", "B", 100.0, {"": InfiniteBus()}, Schedule(V=1.0, angle=0.0)),
            Device("unit.X", "B", 100.0, {"block": Driven(integrates=integrates)}, Schedule(P=0.0, Q=0.0)),
        ),
    )
    initial = initialise(system)
    return initial, Kernel(initial.model, initial.state, initial.p, "never")


def adjusted(initial, CLOCK=1.0, **parameters):
    """Other parameters, and the clock running."""
    p = initial.p.copy()
    for name, value in {"CLOCK": CLOCK, **parameters}.items():
        p[initial.model.position("p", f"unit.X.block.{name}")] = value
    return p


def response(rule, h, t_end, integrates=False, pieces=({},)):
    """Times and the limited state after each step; the parameters of each piece hold for an equal share of the time."""
    initial, kernel = bench(integrates)
    state = initial.state
    n, rows = round(t_end / h / len(pieces)), []
    for parameters in pieces:
        state = kernel.settle(state, adjusted(initial, **parameters))
        segment = kernel.advance(state, adjusted(initial, **parameters), rule, h, n)
        assert not segment.failed
        rows.append(segment.x[:, initial.model.position("x", "unit.X.block.y")])
        state = segment.state
    y = np.concatenate(rows)
    return np.arange(1, y.size + 1) * h, y


@dataclass(frozen=True)
class Arc:
    """A piece of the exact solution: from ``t``, free from ``y``, or held."""

    t: float
    y: float
    held: bool


class Exact:
    """``T y' = K U + K A sin(W t) - y`` between non-windup limits: free arcs in closed form, instants by root finding."""

    def __init__(self, d, t_end):
        self.d, self.arcs = d, [Arc(0.0, 0.0, False)]
        gain = d.K * d.A / (1 + (d.W * d.T) ** 2)
        self.particular = lambda t: d.K * d.U + gain * (np.sin(d.W * t) - d.W * d.T * np.cos(d.W * t))
        grid = np.linspace(0.0, t_end, 4001)
        while True:
            arc = self.arcs[-1]
            ahead = grid[grid > arc.t + 1e-6]
            excess = self._pressure(arc) if arc.held else self._beyond(arc)
            out = np.flatnonzero([excess(t) > 0 for t in ahead])
            if not out.size:
                return
            before = ahead[out[0] - 1] if out[0] else arc.t + 1e-9
            t = brentq(excess, before, ahead[out[0]], xtol=1e-14)
            level = d.UPPER if self.free(arc, t) > 0 else d.LOWER
            self.arcs.append(Arc(t, arc.y if arc.held else level, not arc.held))

    def free(self, arc, t):
        if arc.held:
            return np.full_like(t, arc.y) if np.ndim(t) else arc.y
        return self.particular(t) + (arc.y - self.particular(arc.t)) * np.exp(-(t - arc.t) / self.d.T)

    def _beyond(self, arc):
        return lambda t: max(self.free(arc, t) - self.d.UPPER, self.d.LOWER - self.free(arc, t))

    def _pressure(self, arc):
        """Positive once the right-hand side leads back inside."""
        sign = -1.0 if arc.y == self.d.UPPER else 1.0
        return lambda t: sign * (self.d.K * (self.d.U + self.d.A * np.sin(self.d.W * t)) - arc.y)

    def __call__(self, t):
        y = np.empty_like(t)
        for k, arc in enumerate(self.arcs):
            end = self.arcs[k + 1].t if k + 1 < len(self.arcs) else np.inf
            here = (t >= arc.t) & (t < end)
            y[here] = self.free(arc, t[here])
        return y


SINE, T_END = Driven(), 4.4
STEPS = (0.02, 0.01, 0.005, 0.0025, 0.00125)
ORDER = {"trapezoidal": 2, "tr_bdf2": 2, "backward_euler": 1}
ERROR = {
    "sine": {"trapezoidal": 35.0, "tr_bdf2": 2.0, "backward_euler": 1.3},  # measured 29.5, 1.6, 1.1
    "steps": {"trapezoidal": 150.0, "tr_bdf2": 2.0, "backward_euler": 4.5},  # measured 121, 1.5, 3.8
    "integrator": {"trapezoidal": 18.0, "tr_bdf2": 1.1, "backward_euler": 3.0},  # measured 15, 0.9, 2.4
    "moving": {"trapezoidal": 60.0, "tr_bdf2": 0.9, "backward_euler": 2.0},  # measured 48, 0.7, 1.7
}
"""Largest error over ``h**order``. The trapezoidal rule's is that of its two starting steps of backward Euler."""


def within(case, rule, h, y, exact):
    return np.abs(y - exact).max() < ERROR[case][rule] * h ** ORDER[rule]


@pytest.mark.parametrize("rule", RULES)
def test_non_windup_lag_against_the_exact_switching_solution(rule):
    exact = Exact(SINE, T_END)
    assert [arc.held for arc in exact.arcs] == [False, True] * 4 + [False]
    errors = []
    for h in STEPS:
        t, y = response(rule, h, T_END)
        errors.append(np.abs(y - exact(t)).max())
        assert within("sine", rule, h, y, exact(t))
        assert (y.min(), y.max()) == (SINE.LOWER, SINE.UPPER)
        for entered, left in zip(exact.arcs[1::2], exact.arcs[2::2], strict=True):
            held = t[(y == entered.y) & (t > entered.t - 0.3) & (t < left.t + 0.3)]
            early = 0.1 * h if rule == "backward_euler" else 0.0  # measured 0.084 h
            assert -early <= held[0] - entered.t < h + 1e-9
            assert -h - 1e-9 < held[-1] - left.t <= 0
    observed = np.log2(errors[0] / errors[-1]) / (len(STEPS) - 1)
    assert observed == pytest.approx(ORDER[rule], abs=0.1)  # measured 1.91, 1.98, 0.99


@pytest.mark.parametrize("rule", RULES)
def test_steps_of_the_input_wind_nothing_up(rule):
    """Against the upper limit for 0.44 s, and off it in the very step in which the input turns."""
    T, K = SINE.T, SINE.K
    for h in STEPS[1:4]:
        t, y = response(rule, h, 1.5, pieces=[{"CLOCK": 0.0, "U": U} for U in (2.0, -2.0, 0.25)])
        up = np.minimum(2 * K * (1 - np.exp(-t / T)), 1.0)
        down = np.maximum(-2 * K + (1 + 2 * K) * np.exp(-(t - 0.5) / T), -1.0)
        back = 0.25 * K + (-1 - 0.25 * K) * np.exp(-(t - 1.0) / T)
        assert within("steps", rule, h, y, np.select([t < 0.5 + h / 2, t < 1.0 + h / 2], [up, down], back))
        assert y[round(0.5 / h) - 1] == 1.0 > y[round(0.5 / h)]


@pytest.mark.parametrize("rule", RULES)
def test_a_limited_lag_without_a_time_constant_is_a_clip(rule):
    t, y = response(rule, 0.01, T_END, pieces=[{"T": 0.0}])
    assert np.abs(y - np.clip(SINE.K * np.sin(SINE.W * t), -1, 1)).max() < 1e-11  # measured 9e-13
    assert (y.min(), y.max()) == (-1.0, 1.0)


@pytest.mark.parametrize("rule", RULES)
def test_non_windup_integrator_against_the_exact_switching_solution(rule):
    """``T y' = sin(W t)`` between -0.3 and 1: a limit is left where the input changes sign."""
    T, W = SINE.T, SINE.W
    ends = np.arccos(1 - W * T) / W, np.pi / W, (2 * np.pi - np.arccos(-1 + 1.3 * W * T)) / W, 2 * np.pi / W
    for h in STEPS[1:4]:
        t, y = response(rule, h, 3.0, integrates=True, pieces=[{"LOWER": -0.3}])
        free = (1 - np.cos(W * t)) / (W * T)
        arcs = [free, 1.0, 1 + free - 2 / (W * T), -0.3]
        exact = np.select([t < end for end in ends], arcs, np.minimum(free - 0.3, 1.0))
        assert within("integrator", rule, h, y, exact)
        assert (y.min(), y.max()) == (-0.3, 1.0)


@pytest.mark.parametrize("rule", RULES)
def test_a_limit_that_moves_is_followed(rule):
    """The upper limit comes down by 0.3 pu/s on a lag that is driven against it."""
    for h in STEPS[1:4]:
        t, y = response(rule, h, 3.0, pieces=[{"U": 1.0, "A": 0.0, "SINK": 0.3}])
        free, limit = SINE.K * (1 - np.exp(-t / SINE.T)), 1 - 0.3 * t
        assert within("moving", rule, h, y, np.minimum(free, limit))
        assert np.abs(y - limit)[free > limit + 2 * h].max() < 1e-12  # measured 4e-14
