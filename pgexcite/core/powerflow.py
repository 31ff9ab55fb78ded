"""Newton power flow in polar coordinates; any bus may hold any two of P, Q, V and angle (Kundur section 6.4.4).

Every bus has a voltage and an angle, each either held or unknown; it has a P row and a Q row where all of its devices say what
they deliver. That covers slack, PV and PQ buses alike, and a unit whose P, Q and V are all given while an infinite bus leaves its
own voltage open.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from pgexcite.core.errors import PowerFlowError, Problem
from pgexcite.core.network import Branch, Shunt
from pgexcite.core.system import Device, System

_TOLERANCE = 1e-12
_MAX_ITERATIONS = 50
_MAX_LIMIT_ROUNDS = 20

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]


@dataclass(frozen=True)
class PowerFlow:
    """A solved power flow.

    Attributes:
        v: bus -> voltage phasor, pu.
        s: device path -> apparent power delivered to its bus, pu of the system base.
        iterations: Newton iterations, all rounds of reactive limits together.
        at_limit: device paths held at a reactive limit instead of their voltage.
    """

    v: Mapping[str, complex]
    s: Mapping[str, complex]
    iterations: int
    at_limit: tuple[str, ...] = ()


def admittance_matrix(system: System) -> sp.csr_matrix:
    """Bus admittance matrix, ``(n_bus, n_bus)`` complex, pu of the system base, faults left out."""
    index = {name: k for k, name in enumerate(system.buses)}
    rows: list[int] = []
    cols: list[int] = []
    values: list[complex] = []
    for branch in system.branches().values():
        f, t = index[branch.from_bus], index[branch.to_bus]
        y = branch.admittances(_numbers(branch))
        rows += [f, f, t, t]
        cols += [f, t, f, t]
        values += [complex(y[2 * k], y[2 * k + 1]) for k in range(4)]
    for shunt in system.shunts.values():
        k = index[shunt.bus]
        rows.append(k)
        cols.append(k)
        values.append(shunt.status * complex(shunt.G, shunt.B))
    n = len(index)
    return sp.csr_matrix((values, (rows, cols)), shape=(n, n), dtype=complex)


def _numbers(element: Branch | Shunt) -> dict[str, float]:
    return {name: getattr(element, name) for name in element.numeric_parameters()}


@dataclass
class Buses:
    """What each bus holds, in the order of the system's buses; NaN marks an unknown V or angle and a free P or Q.

    Attributes:
        P, Q: delivered to the bus by its devices, pu of the system base.
        V: magnitude, pu.
        angle: rad.
    """

    P: Real
    Q: Real
    V: Real
    angle: Real


def solve(system: System) -> PowerFlow:
    """Solve the power flow.

    Raises:
        PowerFlowError: an island has no slack, the specification does not fit, Newton fails, or a slack or a scheduled Q is beyond
            its reactive limits; each problem names a bus or a device.
    """
    _check_islands(system)
    _check_reactive(system, {d.path: d.schedule.Q for d in system.devices if d.schedule.Q is not None})
    names = list(system.buses)
    index = {name: k for k, name in enumerate(names)}
    held: dict[str, float] = {}
    iterations = 0
    y = admittance_matrix(system)
    for _ in range(_MAX_LIMIT_ROUNDS):
        buses = specification(system, index, held)
        _check_count(buses, names)
        v, used = _newton(y, buses, names, system.S_base)
        iterations += used
        s = _share(system, index, v * np.conj(y @ v), held)
        changed = _apply_limits(system, index, v, s, held)
        if not changed:
            slack = [d.path for d in system.devices if d.schedule.angle is not None and d.schedule.Q is None]
            _check_reactive(system, {path: s[path].imag * system.S_base for path in slack})
            return PowerFlow({name: complex(v[k]) for name, k in index.items()}, s, iterations, tuple(held))
    raise PowerFlowError(
        [
            Problem(
                path, "its reactive limit and its voltage keep displacing each other; widen Q_min..Q_max or change V"
            )
            for path in held
        ]
    )


def _check_islands(system: System) -> None:
    anchored = {device.bus for device in system.devices if device.schedule.angle is not None}
    problems = [
        Problem(
            f"bus.{members[0]}",
            f"the island of {', '.join(members)} has no slack unit and no infinite bus",
            hint="connect it with a line or transformer, or set slack = true on one of its units",
        )
        for members in system.islands()
        if anchored.isdisjoint(members)
    ]
    if problems:
        raise PowerFlowError(problems)


def _check_reactive(system: System, delivered: Mapping[str, float]) -> None:
    """Refuse reactive powers (Mvar, by device) beyond the limits of devices that have no voltage to give up for them."""
    problems = []
    for path, Q in delivered.items():
        plan = system.device(path).schedule
        limit = min(max(Q, plan.Q_min), plan.Q_max)
        if abs(limit - Q) > 1e-9 * max(1.0, abs(limit)):
            name, side = ("Q_max", "above") if limit < Q else ("Q_min", "below")
            what = "the slack delivers" if plan.Q is None else "is scheduled to deliver"
            text = f"{what} {Q:.5g} Mvar, {side} its {name} = {limit:g} Mvar"
            problems.append(Problem(path, text, hint="widen the limit or change Q, V or the slack"))
    if problems:
        raise PowerFlowError(problems)


def specification(system: System, index: Mapping[str, int], held: Mapping[str, float]) -> Buses:
    """What every bus holds, pu of the system base; ``held`` are devices at a reactive limit, with that limit in Mvar."""
    n = len(index)
    buses = Buses(np.zeros(n), np.zeros(n), np.full(n, np.nan), np.full(n, np.nan))
    for device in system.devices:
        k, plan = index[device.bus], device.schedule
        reactive = held.get(device.path, plan.Q)
        buses.P[k] += np.nan if plan.P is None else plan.P / system.S_base
        buses.Q[k] += np.nan if reactive is None else reactive / system.S_base
        if plan.V is not None and device.path not in held:
            if not np.isnan(buses.V[k]) and abs(buses.V[k] - plan.V) > _TOLERANCE:
                raise PowerFlowError(
                    [Problem(f"{device.path}.V", f"bus {device.bus} is already held at {buses.V[k]:g} pu", plan.V)]
                )
            buses.V[k] = plan.V
        if plan.angle is not None:
            buses.angle[k] = plan.angle
    return buses


def _check_count(buses: Buses, names: list[str]) -> None:
    rows = int(np.sum(~np.isnan(buses.P)) + np.sum(~np.isnan(buses.Q)))
    unknowns = int(np.sum(np.isnan(buses.V)) + np.sum(np.isnan(buses.angle)))
    if rows == unknowns:
        return
    loose = [n for k, n in enumerate(names) if np.isnan(buses.V[k]) and np.isnan(buses.Q[k])]
    tight = [n for k, n in enumerate(names) if not np.isnan(buses.V[k]) and not np.isnan(buses.Q[k])]
    problems = [
        Problem(f"bus.{n}", "neither V nor Q is given here: give a device at this bus one of them") for n in loose
    ]
    problems += [
        Problem(f"bus.{n}", "V and Q are both given here: leave one out, or leave V out at an infinite bus")
        for n in tight
    ]
    if not problems:
        problems = [Problem("system", f"the power flow has {rows} equations for {unknowns} unknowns")]
    raise PowerFlowError(problems)


def _newton(y: sp.csr_matrix, buses: Buses, names: list[str], base: float) -> tuple[Complex, int]:
    P_rows, Q_rows = np.flatnonzero(~np.isnan(buses.P)), np.flatnonzero(~np.isnan(buses.Q))
    a_cols, V_cols = np.flatnonzero(np.isnan(buses.angle)), np.flatnonzero(np.isnan(buses.V))
    slack = np.nanmean(buses.angle) if np.any(~np.isnan(buses.angle)) else 0.0
    angle = np.where(np.isnan(buses.angle), slack, buses.angle)
    V = np.where(np.isnan(buses.V), 1.0, buses.V)

    def mismatch(V: Real, angle: Real) -> tuple[Complex, Real, Real]:
        v = V * np.exp(1j * angle)
        s = v * np.conj(y @ v)
        return v, s.real[P_rows] - buses.P[P_rows], s.imag[Q_rows] - buses.Q[Q_rows]

    v, dP, dQ = mismatch(V, angle)
    r = np.concatenate((dP, dQ))
    best = np.abs(r).max(initial=0.0)
    for iteration in range(_MAX_ITERATIONS):
        if best <= _TOLERANCE:
            return v, iteration
        ds_da, ds_dV = derivatives(y, v, V)
        jacobian = sp.bmat(
            [
                [ds_da.real[P_rows][:, a_cols], ds_dV.real[P_rows][:, V_cols]],
                [ds_da.imag[Q_rows][:, a_cols], ds_dV.imag[Q_rows][:, V_cols]],
            ],
            format="csc",
        )
        try:
            dx = splu(jacobian).solve(r)
        except RuntimeError:
            raise _failure(dP, dQ, P_rows, Q_rows, V, names, base, "the Jacobian is singular") from None
        scale = 1.0
        while True:
            trial_angle, trial_V = angle.copy(), V.copy()
            trial_angle[a_cols] -= scale * dx[: a_cols.size]
            trial_V[V_cols] -= scale * dx[a_cols.size :]
            trial = mismatch(trial_V, trial_angle)
            r_trial = np.concatenate(trial[1:])
            worst = np.abs(r_trial).max(initial=0.0)
            if worst < best or scale < 1e-3 or worst < 1e-11:
                break
            scale /= 2
        if worst >= best and worst > 1e-10:
            break
        stalled = worst >= best
        angle, V, (v, dP, dQ), r, best = trial_angle, trial_V, trial, r_trial, worst
        if stalled:
            return v, iteration + 1
    raise _failure(dP, dQ, P_rows, Q_rows, V, names, base, "no voltage satisfies the schedule")


def derivatives(y: sp.csr_matrix, v: Complex, V: Real) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """``dS/d angle`` and ``dS/d|V|`` of the bus injections."""
    current = sp.diags(np.conj(y @ v))
    diag_v, unit = sp.diags(v), sp.diags(v / V)
    ds_da = 1j * diag_v @ (current - np.conj(y @ diag_v))
    ds_dV = diag_v @ np.conj(y @ unit) + current @ unit
    return sp.csr_matrix(ds_da), sp.csr_matrix(ds_dV)


def _failure(
    dP: Real,
    dQ: Real,
    P_rows: NDArray[np.intp],
    Q_rows: NDArray[np.intp],
    V: Real,
    names: list[str],
    base: float,
    why: str,
) -> PowerFlowError:
    size = np.zeros(len(names))
    size[P_rows] += np.abs(dP)
    size[Q_rows] += np.abs(dQ)
    problems = []
    for k in np.argsort(-size)[:3]:
        if size[k] > _TOLERANCE:
            p = dP[np.flatnonzero(P_rows == k)].sum() * base
            q = dQ[np.flatnonzero(Q_rows == k)].sum() * base
            text = f"{why}; left over here {p:+.3g} MW, {q:+.3g} Mvar at {V[k]:.3f} pu"
            problems.append(Problem(f"bus.{names[k]}", text, hint="less transfer or more reactive support is needed"))
    return PowerFlowError(problems or [Problem("system", why)])


def _share(system: System, index: Mapping[str, int], s_bus: Complex, held: Mapping[str, float]) -> dict[str, complex]:
    """Devices' powers from the buses': what is scheduled stays, the rest goes to the free devices by their bases."""
    result: dict[str, complex] = {}
    for bus, k in index.items():
        here = [d for d in system.devices if d.bus == bus]
        P = _split(s_bus[k].real, here, {d.path: d.schedule.P for d in here}, system.S_base)
        Q = _split(s_bus[k].imag, here, {d.path: held.get(d.path, d.schedule.Q) for d in here}, system.S_base)
        result.update({d.path: complex(P[d.path], Q[d.path]) for d in here})
    return result


def _split(total: float, here: list[Device], scheduled: Mapping[str, float | None], base: float) -> dict[str, float]:
    known = {path: value / base for path, value in scheduled.items() if value is not None}
    free = [d for d in here if d.path not in known]
    rest, weight = total - sum(known.values()), sum(d.S_n for d in free)
    return known | {d.path: rest * d.S_n / weight for d in free}


def _apply_limits(
    system: System, index: Mapping[str, int], v: Complex, s: Mapping[str, complex], held: dict[str, float]
) -> bool:
    """Hold the reactive limit of devices beyond it, and give the voltage back where it came back; True if anything changed."""
    changed = False
    for device in system.devices:
        plan = device.schedule
        if plan.V is None or plan.Q is not None or plan.angle is not None:
            continue
        if device.path in held:
            over = abs(v[index[device.bus]]) > plan.V
            away = abs(abs(v[index[device.bus]]) - plan.V) > 1e-9
            if away and over == (held[device.path] == plan.Q_max):
                del held[device.path]
                changed = True
            continue
        Q = s[device.path].imag * system.S_base
        limit = min(max(Q, plan.Q_min), plan.Q_max)
        if abs(limit - Q) > 1e-9 * max(1.0, abs(limit)):
            held[device.path] = limit
            changed = True
    return changed
