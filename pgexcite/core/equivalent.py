"""A unit against the rest of the grid as it looks from its terminals: one machine, a reactance, an infinite bus.

The machine is the unit's own component, so that this is the plant's equations once more, with another network around them.
Everything is in per unit of the unit's base, and the rotor angle is measured against the equivalent bus.
"""

from __future__ import annotations

import cmath
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.blocks import magnitude
from pgexcite.core.controller import Surroundings
from pgexcite.core.errors import ConfigError, Problem
from pgexcite.core.initialise import Initial, initialise
from pgexcite.core.nameplate import overridden
from pgexcite.core.network import Bus
from pgexcite.core.registry import find
from pgexcite.core.stage import ALPHA, BETA, FROZEN, GAMMA
from pgexcite.core.step import Kernel
from pgexcite.core.system import Device, Schedule, System

Array = NDArray[np.float64]

TERMINALS = ("v_t", "p_e", "q_e", "omega")
"""What is measured at the unit's terminals, in the order of ``Equivalent.sense``; the field voltage is an input."""

_SOURCE = "infinite_bus.equivalent"
_NEWTON = 2
"""Newton iterations of each stage: quadratic, from the last point of a step of 25 ms, leaves 1e-7."""


@dataclass(frozen=True)
class Terminals:
    """A unit's terminals at one instant, pu of its base.

    Attributes:
        v: voltage magnitude.
        p, q: power delivered.
    """

    v: float
    p: float
    q: float

    @property
    def slope(self) -> complex:
        """Change of the voltage behind a reactance with that reactance, against the terminal voltage."""
        return -1j * complex(self.p, -self.q) / self.v

    def behind(self, x_s: float) -> complex:
        """Voltage behind the reactance ``x_s``, against the terminal voltage."""
        return self.v + x_s * self.slope


@dataclass(frozen=True)
class Layout:
    """Where things are in the vector that is estimated: rotor states but the angle, then what the rest of the grid looks like.

    The angle is in ``(b_d, b_q)``, the voltage of the equivalent bus in the rotor's frame: ``v_bus sin(delta)`` and
    ``v_bus cos(delta)``. What cannot be told apart at rest is then a straight line, ``b = v - j x_s i``.

    Attributes:
        rotor: names of the machine's states but ``delta``.
    """

    rotor: tuple[str, ...]

    @property
    def omega(self) -> int:
        """Rotor speed, pu."""
        return self.rotor.index("omega")

    @property
    def p_m(self) -> int:
        """Mechanical torque, pu."""
        return len(self.rotor)

    @property
    def omega_bus(self) -> int:
        """Speed of the equivalent bus minus nominal, pu."""
        return len(self.rotor) + 1

    @property
    def x_s(self) -> int:
        """Reactance between the terminals and the equivalent bus, pu."""
        return len(self.rotor) + 2

    @property
    def bus(self) -> slice:
        """Voltage of the equivalent bus in the rotor's frame, pu."""
        return slice(len(self.rotor) + 3, len(self.rotor) + 5)

    @property
    def size(self) -> int:
        """Length of the vector."""
        return len(self.rotor) + 5


class Equivalent:
    """A unit as a single machine on an infinite bus, initialised at the terminals it has at the start of the run.

    Not modelled: resistance and local load between the terminals and the equivalent bus, the unit's governor.

    Args:
        surroundings: nameplate data and the initial point.
        unit: path of the unit.
        x_s: reactance assumed at first, pu of the unit's base.
        overrides: parameters of the machine that are not the nameplate's, by path (``unit.G2.machine.H``).
        where: path of the overrides in the configuration, for messages.

    Attributes:
        unit: path of the unit; its outputs have the paths they have in the plant.
        command: path of its field voltage's set-point.
        terminals: at the start of the run.
        f_n: nominal frequency, Hz.
        initial: the equivalent at its steady state, the bus at the angle zero.
        layout: of the vector that is estimated.
        start: that vector at the steady state, shape ``(layout.size,)``.
        offset: field voltage at this steady state minus the plant's at its initial point, pu.

    Raises:
        ConfigError: the machine is not one with a rotor angle and a speed, or an override is not valid.
        InitialisationError: it has no steady state there.
    """

    def __init__(
        self, surroundings: Surroundings, unit: str, x_s: float, overrides: Mapping[str, float], where: str
    ) -> None:
        system = overridden(surroundings.system, overrides, where)
        self.unit = unit
        self.command = f"{unit}.exciter.e_fd_ref"
        self.terminals = Terminals(*(surroundings.y_0[f"{unit}.{name}"] for name in ("v_t", "p_e", "q_e")))
        device = system.device(unit)
        self.f_n = system.f_n
        self._compile = surroundings.compile
        self.initial = _turned(initialise(_system(device, system.f_n, self.terminals, x_s)), unit)
        model = self.initial.model
        states = {
            path.rpartition(".")[2]: k for k, path in enumerate(model.x_names) if path.startswith(f"{unit}.machine.")
        }
        if not {"delta", "omega"} <= states.keys():
            text = "an equivalent of this machine needs states named delta and omega"
            raise ConfigError([Problem(f"{unit}.machine", text, type(device.components["machine"]).__name__)])
        self._delta = states.pop("delta")
        self._rotor = list(states.values())
        self.layout = Layout(tuple(states))
        self._x_s = model.position("p", f"{_SOURCE}.X")
        self._v_bus = model.position("u", f"{_SOURCE}.v")
        self._p_m = model.position("u", f"{unit}.governor.p_m")
        self._e_fd = model.position("u", self.command)
        x, u = self.initial.state.x, self.initial.state.u
        bus = in_rotor_frame(u[self._v_bus], x[self._delta])
        self.start = np.concatenate((x[self._rotor], [u[self._p_m], 0.0, x_s], bus))
        self.offset = float(u[self._e_fd] - surroundings.y_0[f"{unit}.e_fd"])

    @cached_property
    def kernel(self) -> Kernel:
        """A kernel of the equivalent."""
        return Kernel(self.initial.model, self.initial.state, self.initial.p, self._compile)

    def point(self, estimate: Array, e_fd: float) -> tuple[Array, Array, Array]:
        """States, commands and parameters of the equivalent at an estimate, in the frame of its bus; ``e_fd`` in pu."""
        x, u, p = (np.array(a) for a in (self.initial.state.x, self.initial.state.u, self.initial.p))
        layout = self.layout
        x[self._rotor] = estimate[: len(layout.rotor)]
        x[self._rotor[layout.omega]] -= estimate[layout.omega_bus]
        b_d, b_q = estimate[layout.bus]
        x[self._delta], u[self._v_bus] = np.arctan2(b_d, b_q), np.hypot(b_d, b_q)
        u[self._p_m], u[self._e_fd] = estimate[layout.p_m], e_fd
        p[self._x_s] = estimate[layout.x_s]
        return x, u, p

    def positions(self) -> dict[str, int]:
        """Where ``point`` puts ``delta`` in ``x``, ``v_bus``, ``p_m`` and ``e_fd`` in ``u``, ``x_s`` in ``p``."""
        places = {"delta": self._delta, "v_bus": self._v_bus, "p_m": self._p_m}
        return places | {"e_fd": self._e_fd, "x_s": self._x_s}

    @property
    def inertia(self) -> float:
        """Torque, pu, that changes the speed by 1 pu in a second: ``2 H``, s."""
        initial = self.initial
        mass = self.kernel.functions.prepare(FROZEN, initial.state.d, initial.state.u, initial.p)[1]
        return float(mass[self._rotor[self.layout.omega]])

    @property
    def rotor(self) -> tuple[int, ...]:
        """Where in ``x`` it puts the rotor's states, in the order of ``layout.rotor``."""
        return tuple(self._rotor)

    def functions(self, dt: float, steps: int) -> tuple[ca.Function, ca.Function]:
        """``propagate(xi, e_fd) -> xi`` over a sample and ``sense(xi, e_fd) -> TERMINALS``, of the vector ``Layout`` describes.

        Both are straight-line functions of the model's own stage: a fixed number of Newton iterations in each.

        Args:
            dt: sample time, s.
            steps: TR-BDF2 steps in a sample.
        """
        xi, e_fd = ca.SX.sym("xi", self.layout.size), ca.SX.sym("e_fd")
        roll = _Unrolled(self.kernel, *self._symbolic(xi, e_fd))
        y = roll.outputs()
        model, layout = self.initial.model, self.layout
        seen = y[[model.position("y", f"{self.unit}.{name}") for name in TERMINALS]]
        seen[TERMINALS.index("omega")] += xi[layout.omega_bus]
        sense = ca.Function("sense", [xi, e_fd], [seen], {"cse": True})
        for _ in range(steps):
            roll.step(dt / steps)
        rotor, delta = roll.x[self._rotor], roll.x[self._delta]
        rotor[layout.omega] += xi[layout.omega_bus]
        v_bus = magnitude(*ca.vertsplit(xi[layout.bus]))
        after = ca.vertcat(rotor, xi[layout.p_m : layout.x_s + 1], v_bus * ca.sin(delta), v_bus * ca.cos(delta))
        return ca.Function("propagate", [xi, e_fd], [after], {"cse": True}), sense

    def _symbolic(self, xi: ca.SX, e_fd: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """``x, z, u, p`` with numbers wherever nothing is estimated."""
        state, layout = self.initial.state, self.layout
        x, z, u, p = (ca.SX(ca.DM(a)) for a in (state.x, state.z, state.u, self.initial.p))
        for k, position in enumerate(self._rotor):
            x[position] = xi[k]
        # In the frame of the bus: exact, for the stator does not feel the speed.
        x[self._rotor[layout.omega]] -= xi[layout.omega_bus]
        b_d, b_q = ca.vertsplit(xi[layout.bus])
        x[self._delta], u[self._v_bus] = ca.atan2(b_d, b_q), magnitude(b_d, b_q)
        u[self._p_m], u[self._e_fd] = xi[layout.p_m], e_fd
        p[self._x_s] = xi[layout.x_s]
        return x, z, u, p


def in_rotor_frame(v: float, delta: float) -> Array:
    """The voltage ``v`` of the equivalent bus as ``(b_d, b_q)``, where the rotor is ``delta`` ahead of it."""
    return np.array([v * np.sin(delta), v * np.cos(delta)])


class _Unrolled:
    """The kernel's TR-BDF2 step as an expression."""

    def __init__(self, kernel: Kernel, x: ca.SX, z: ca.SX, u: ca.SX, p: ca.SX) -> None:
        assert kernel.functions.newton is not None, "one machine is never too large to be written out"
        self._functions, self._newton_step = kernel.functions, kernel.functions.newton
        self._given, self.x = (ca.SX(0, 1), u, p), x
        self._q, mass, _ = self._functions.prepare(FROZEN, *self._given)
        # The algebraic unknowns at the states given.
        self.z = self._newton(ca.vertcat(x, z), mass * x)[x.numel() :]

    def _newton(self, w: ca.SX, b: ca.SX) -> ca.SX:
        for _ in range(_NEWTON):
            w = self._newton_step(w, b, self._q)[0]
        return w

    def step(self, h: float) -> None:
        """Move on by ``h`` seconds."""
        n, c = self.x.numel(), GAMMA * h / 2
        self._q, mass, _ = self._functions.prepare(c, *self._given)
        start = ca.vertcat(self.x, self.z)
        middle = self._newton(start, mass * self.x + c * self._land()[1])
        b = mass * (ALPHA * middle[:n] - BETA * self.x)
        w = self._newton(middle + ((1 - GAMMA) / GAMMA) * (middle - start), b)
        self.x, self.z = w[:n], w[n:]

    def outputs(self) -> ca.SX:
        """All outputs of the model here."""
        return self._land()[2]

    def _land(self) -> Any:
        w, b = ca.vertcat(self.x, self.z), ca.SX.zeros(self.x.numel())
        return self._functions.land(w, b, self._q, self._given[0])


def _system(device: Device, f_n: float, at: Terminals, x_s: float) -> System:
    components: dict[str, Any] = {
        "machine": device.components["machine"],
        "exciter": find("exciter", "constant_field")(),
        "governor": find("governor", "constant_torque")(),
    }
    S_n = device.S_n
    schedule = Schedule(P=at.p * S_n, Q=at.q * S_n, V=at.v)
    source = {"": find("source", "infinite_bus")(X=x_s)}
    return System(
        S_base=S_n,
        f_n=f_n,
        buses={"terminals": Bus()},
        devices=(
            Device(device.path, "terminals", S_n, components, schedule),
            Device(_SOURCE, "terminals", S_n, source, Schedule(angle=0.0)),
        ),
        reference="infinite_bus",
    )


def _turned(initial: Initial, unit: str) -> Initial:
    """The same steady state with the equivalent bus, instead of the terminals, at the angle zero."""
    model, state = initial.model, initial.state
    source = model.position("u", f"{_SOURCE}.angle")
    angle = state.u[source]
    x, z, u = (np.array(a) for a in (state.x, state.z, state.u))
    x[model.position("x", f"{unit}.machine.delta")] -= angle
    u[source] = 0.0
    turn = cmath.rect(1.0, -angle)
    for pair in (("bus.terminals.v_re", "bus.terminals.v_im"), (f"{_SOURCE}.i_re", f"{_SOURCE}.i_im")):
        re, im = (model.position("z", path) for path in pair)
        turned = complex(z[re], z[im]) * turn
        z[re], z[im] = turned.real, turned.imag
    return replace(initial, state=state.with_(x=x, z=z, u=u))
