"""Why a step could not be taken: no algebraic solution any more (voltage collapse), or something else (divergence)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.declare import Kind
from pgexcite.core.model import Model, State
from pgexcite.core.settings import Rule
from pgexcite.core.stage import FROZEN
from pgexcite.core.step import Kernel
from pgexcite.core.trace import Ending, Outcome

Array = NDArray[np.float64]

_NEARLY_SINGULAR = 0.05
"""Smallest singular value of the algebraic equations, against its value at the start of the run, that counts as singular."""
_DEVICES = 1e-12
"""Weight of devices' own unknowns against voltages in telling which bus is to blame."""
_LOWEST_AT_REST = {"v_oel": -1e-9, "v_scl": -1e-9}
_HIGHEST_AT_REST = {"v_uel": 1e-9, "v_scl": 1e-9}
"""Limiters' signals, pu, that ask for nothing: an underexcitation limiter's may be low, an overexcitation limiter's high."""


def algebraic_jacobian(kernel: Kernel, state: State, p: Array) -> Array:
    """``dg/dz`` with the algebraic rows of zero-mass states left out, shape ``(n_z, n_z)``."""
    n_x = len(kernel.model.x_names)
    w = np.concatenate((state.x, state.z))
    jacobian = kernel.functions.residual(w, state.x, FROZEN, state.d, state.u, p)[1]
    return np.array(jacobian.full())[n_x:, n_x:]


def smallest_singular_value(kernel: Kernel, state: State, p: Array) -> float:
    """Distance of the algebraic equations from having no unique solution."""
    values = np.linalg.svd(algebraic_jacobian(kernel, state, p), compute_uv=False)
    return float(values[-1]) if values.size else np.inf


def active_devices(model: Model, d: Array) -> tuple[str, ...]:
    """Limiters that act and tap changers away from their initial position at discrete states ``d``, each with what it does."""
    found = []
    for device in model.system.devices:
        for slot, component in device.components.items():
            path = device.component_path(slot)
            if component.role == "limiter" and _discrete(model, d, f"{path}.active") > 0:
                found.append(f"{path} acts")
            position = _discrete(model, d, f"{path}.position") if component.role == "tap_changer" else 0.0
            if position:
                found.append(f"{path} at position {position:+.0f}")
    return tuple(found)


def limiters_at_work(model: Model, y: Array) -> tuple[str, ...]:
    """Limiters whose signal asks for more or less excitation at outputs ``y``, each with that signal.

    By the sign of what the signal is for: an underexcitation limiter raises (``v_uel`` above zero), an overexcitation limiter
    lowers (``v_oel`` below zero), a stator-current limiter does either. Whether a gate selects the signal is not told.
    """
    found = []
    for device in model.system.devices:
        for slot, component in device.components.items():
            for port in component.variables(Kind.OUTPUT) if component.role == "limiter" else ():
                signal = float(y[model.position("y", f"{device.path}.{port.name}")])
                if _LOWEST_AT_REST.get(port.name, -np.inf) > signal or _HIGHEST_AT_REST.get(port.name, np.inf) < signal:
                    found.append(f"{device.component_path(slot)}: {port.name} = {signal:.4g} pu")
    return tuple(found)


def _discrete(model: Model, d: Array, path: str) -> float:
    return float(d[model.index["d"][path]]) if path in model.index["d"] else 0.0


def collapse(model: Model, state: State, bus: str, text: str) -> Outcome:
    """A voltage collapse at ``bus``, with what was active then."""
    return _with_active(model, state, Ending.VOLTAGE_COLLAPSE, f"bus.{bus}", f"voltage collapse at bus {bus} {text}")


def lost_synchronism(model: Model, state: State, unit: str, text: str) -> Outcome:
    """A loss of synchronism of ``unit`` (a path), with what was active then."""
    at = f"{unit} lost synchronism at t = {state.t:.4f} s: {text}"
    return _with_active(model, state, Ending.LOST_SYNCHRONISM, unit, at)


def _with_active(model: Model, state: State, ending: Ending, where: str, text: str) -> Outcome:
    active = active_devices(model, state.d)
    told = f"{text}; active: {', '.join(active)}" if active else text
    return Outcome(ending, state.t, where, told, active)


def diagnose(kernel: Kernel, state: State, p: Array, rule: Rule, h: float, healthy: float) -> Outcome:
    """Outcome for a run whose next step cannot be taken from ``state``.

    Args:
        healthy: ``smallest_singular_value`` at the start of the run.
    """
    last, fine = state, h / 64
    while fine > h / 5000:
        segment = kernel.advance(last, p, rule, fine, 64)
        last = segment.state
        if not segment.failed:
            break
        fine /= 8
    worst, residual = _worst_equation(kernel, last, p, h)
    if not np.isfinite(residual):
        text = f"the equation of {worst} has no finite value at t = {state.t:.4f} s"
        return Outcome(Ending.DIVERGED, state.t, worst, text)
    jacobian = algebraic_jacobian(kernel, last, p)
    settled = kernel.settle(last, p)
    singular = np.linalg.svd(jacobian)
    if settled is None or singular.S[-1] < _NEARLY_SINGULAR * healthy:
        bus = _weakest_bus(kernel.model, singular.Vh[-1])
        text = f"at t = {state.t:.4f} s: from then on no voltage satisfies the network and its loads"
        return collapse(kernel.model, state, bus, text)
    text = f"the step after t = {state.t:.4f} s has no solution; the equation furthest from being satisfied is that of {worst}"
    return Outcome(Ending.DIVERGED, state.t, worst, text)


def _weakest_bus(model: Model, direction: Array) -> str:
    """The bus whose voltage moves most in the direction the equations no longer determine.

    Where no voltage moves at all it is the bus of the device that no longer determines something: a source short-circuited by a
    bolted fault at its own bus.
    """
    size = dict.fromkeys(model.system.buses, 0.0)
    buses = {f"bus.{name}": name for name in model.system.buses}
    buses |= {d.component_path(slot): d.bus for d in model.system.devices for slot in d.components}
    for path, component in zip(model.z_names, direction, strict=True):
        owner = path.rpartition(".")[0]
        size[buses[owner]] += component * component * (1.0 if owner.startswith("bus.") else _DEVICES)
    return max(size, key=lambda name: size[name])


def _worst_equation(kernel: Kernel, state: State, p: Array, h: float) -> tuple[str, float]:
    """The row furthest from being satisfied by a step that stays at ``state``, and its residual; infinite where it has no value."""
    model = kernel.model
    mass = np.array(model.dae(state.x, state.z, state.d, state.u, p)[1]).ravel()
    w = np.concatenate((state.x, state.z))
    r = np.array(kernel.functions.residual(w, mass * state.x, h, state.d, state.u, p)[0]).ravel()
    r[~np.isfinite(r)] = np.inf
    k = int(np.argmax(np.abs(r)))
    return str((*model.x_names, *model.z_names)[k]), float(abs(r[k]))
