"""Fixtures shared by all tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pgexcite.core.declare import par
from pgexcite.core.network import Bus, Line, Transformer
from pgexcite.core.result import ControllerStatistics, RunResult
from pgexcite.core.roles import Machine, Source
from pgexcite.core.system import Device, Schedule, System
from pgexcite.core.trace import Ending, LogEntry, Outcome, Trace


class PlainMachine(Machine):
    """Parameters of the paper's unit, no equations: enough for what only looks at a system."""

    H: float = par(2.9, "s", "inertia constant")
    R_a: float = par(0.0, "pu", "armature resistance")
    X_d: float = par(1.24, "pu", "synchronous reactance, direct axis")
    X_q: float = par(0.70, "pu", "synchronous reactance, quadrature axis")
    Xp_d: float = par(0.35, "pu", "transient reactance")


class PlainSource(Source):
    """A source without equations."""


@pytest.fixture(scope="session")
def plain_system() -> System:
    """The paper's plant: unit, transformer, line, infinite bus, all on 175 MVA."""
    return System(
        S_base=175.0,
        f_n=50.0,
        buses={"G": Bus(V_n=16.5), "HV": Bus(V_n=420.0), "grid": Bus(V_n=420.0)},
        lines={"L1": Line(**{"from": "HV", "to": "grid", "X": 0.15})},
        transformers={"T1": Transformer(**{"from": "G", "to": "HV", "X": 0.12})},
        devices=(
            Device("unit.G2", "G", 175.0, {"machine": PlainMachine()}, Schedule(P=150.5, Q=89.25, V=1.0)),
            Device("infinite_bus.grid", "grid", 175.0, {"": PlainSource()}, Schedule(angle=0.0)),
        ),
    )


@pytest.fixture(scope="session")
def synthetic_run(plain_system: System) -> Callable[..., RunResult]:
    """A function that makes a finished run of the paper's plant from a classical swing, without the kernel.

    Arguments: ``title``, ``gain`` of a make-believe voltage regulator (0: constant field), ``clearing`` [s], ``t_end`` [s], ``mpc``
    (adds a controller).
    """

    def make(
        title: str = "synthetic", gain: float = 0.0, clearing: float = 0.1, t_end: float = 5.0, mpc: bool = False
    ) -> RunResult:
        trace = _swing(plain_system, gain, clearing, t_end)
        statistics = {}
        if mpc:
            n = len(trace.t)
            cost = np.cumsum(np.abs(trace["unit.G2.v_t"] - 1.0)) * 1e-2
            columns = {
                **trace.columns,
                "controller.mpc.cost": cost,
                "controller.mpc.solve_ms": 1.0 + np.sin(np.arange(n)) ** 2,
            }
            units = {**trace.units, "controller.mpc.cost": "-", "controller.mpc.solve_ms": "ms"}
            trace = replace(trace, columns=columns, units=units)
            statistics["mpc"] = ControllerStatistics(samples=100, solve_ms=(1.0, 2.0, 9.0), fallbacks=1, cost=8.1)
        lost = bool(np.max(trace["unit.G2.delta"]) > np.pi)
        ending = Ending.LOST_SYNCHRONISM if lost else Ending.COMPLETED
        outcome = Outcome(ending, float(trace.t[-1]), "unit.G2" if lost else "", "")
        config = {"title": title, "simulation": {"t_end": t_end, "h": 0.005}}
        return RunResult(title, config, plain_system, outcome, trace, len(trace.t) - 3, 0.25, statistics)

    return make


def _swing(system: System, gain: float, clearing: float, t_end: float) -> Trace:
    h, fault_at = 0.005, 0.5
    x_q, xp_d, x_t, x_l, e_fd0, v_inf, p_m = 0.70, 0.35, 0.12, 0.1501, 1.9246, 0.893, 0.86
    v0 = 1.0
    i0 = np.conj((0.86 + 0.51j) / v0)
    behind = np.angle(v0 + 1j * x_q * i0)
    frame = np.angle(v0 - 1j * (x_t + x_l) * i0)
    e0 = v0 + 1j * xp_d * i0
    state = np.array([np.angle(e0) - frame, 1.0, e_fd0])
    shift = behind - np.angle(e0)
    e_mag = abs(e0)

    def network(delta: float, faulted: bool) -> tuple[complex, complex, complex]:
        e = e_mag * np.exp(1j * delta)
        y = np.array([[1 / (1j * (xp_d + x_t)) + 1 / (1j * x_l) + (1 / 0.02 if faulted else 0.0)]])
        v_hv = (e / (1j * (xp_d + x_t)) + v_inf / (1j * x_l)) / y[0, 0]
        i = (e - v_hv) / (1j * (xp_d + x_t))
        return e - 1j * xp_d * i, v_hv, i

    samples: dict[str, list[float]] = {}

    def keep(t: float, faulted: bool) -> None:
        v, v_hv, i = network(state[0], faulted)
        s = v * np.conj(i)
        s_line = v_hv * np.conj((v_hv - v_inf) / (1j * x_l))
        s_t = v * np.conj((v - v_hv) / (1j * x_t))
        row = {
            "t": t, "unit.G2.delta": state[0] + shift, "unit.G2.omega": state[1], "unit.G2.v_t": abs(v),
            "unit.G2.e_fd": state[2], "unit.G2.i_fd": e_fd0 * (0.6 + 0.4 * abs(i) / abs(i0)), "unit.G2.p_e": s.real,
            "unit.G2.q_e": s.imag, "unit.G2.machine.delta": state[0] + shift, "unit.G2.exciter.v_ref": 1.0,
            "bus.G.v": abs(v), "bus.HV.v": abs(v_hv), "bus.grid.v": v_inf, "bus.G.angle": float(np.angle(v)),
            "line.L1.p_from": s_line.real, "line.L1.q_from": s_line.imag,
            "transformer.T1.p_from": s_t.real, "transformer.T1.q_from": s_t.imag,
        }  # fmt: skip
        for name, value in row.items():
            samples.setdefault(name, []).append(float(value))

    steps = round(t_end / h)
    on, off = round(fault_at / h), round((fault_at + clearing) / h)
    keep(0.0, False)
    for k in range(steps):
        if k in (on, off):
            keep(k * h, k == on)
        faulted = on <= k < off
        for _ in range(5):
            v, _hv, i = network(state[0], faulted)
            p_e = (v * np.conj(i)).real
            target = np.clip(e_fd0 + gain * (1.0 - abs(v)), -3.2, 3.2) if gain else e_fd0
            slope = np.array(
                [2 * np.pi * 50 * (state[1] - 1), (p_m - p_e - 8.0 * (state[1] - 1)) / 5.8, (target - state[2]) / 0.02]
            )
            state = state + h / 5 * slope
        keep((k + 1) * h, faulted)
        if state[0] > 1.2 * np.pi:
            break
    t = np.array(samples.pop("t"))
    columns = {name: np.array(values) for name, values in samples.items()}
    units = {name: "rad" if name.endswith(("delta", "angle")) else "pu" for name in columns}
    log = (
        LogEntry(fault_at, "event", "three-phase fault at bus HV (R = 0.02, X = 0 pu)"),
        LogEntry(fault_at + clearing, "event", "fault at bus HV cleared"),
        LogEntry(float(t[-1]), "outcome", "completed"),
    )
    return Trace(t, columns, units, log)
