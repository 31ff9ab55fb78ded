"""Broken inputs and failing solvers by the thousand: what reaches the plant stays finite and within bounds, and the plant in step.

Each sample is, with probability, one of: sound; its state or its measurements NaN, infinite, huge, stale or constant; its plan
refused, not finite, out of bounds, late, or at random with a cost that is not a number. Faults strike every few seconds all the
while. The classical controller stands behind.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import pytest
from plants import regulated

from pgexcite.core import registry
from pgexcite.core.controller import Sample
from pgexcite.core.events import Fault
from pgexcite.core.mpc import Solution, Status
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.controllers.mpc import MPC
from pgexcite.plugins.transfers.field import FieldTransfer

H, DT = 0.005, 0.05
U_MIN, U_MAX = -3.2, 3.85
DEADLINE_MS = 20.0

INPUTS = ("nan", "one_nan", "inf", "huge", "stale", "constant")
PLANS = ("status", "nan", "inf", "above", "below", "late", "costless")
BACKENDS = [name for name in ("nmpc", "linear", "equivalent") if name in registry.names("mpc_backend")]


class Clock:
    """The ladder's clock: it stands still unless a solver is made late."""

    def __init__(self):
        self.now = 0.0

    def read(self):
        return self.now


@dataclass
class Trouble:
    """Draws what goes wrong: spells of one kind, so that staleness and long outages happen too."""

    rng: np.random.Generator
    rate: float
    kinds: tuple[str, ...]
    kind: str = ""
    left: int = 0

    def draw(self):
        if self.left == 0:
            self.kind = ""
            if self.rng.random() < self.rate:
                self.kind = str(self.rng.choice(self.kinds))
                self.left = int(self.rng.choice([1, 1, 2, 4, 30]))
        else:
            self.left -= 1
        return self.kind


class BrokenInputs:
    """A session whose samples are tampered with."""

    def __init__(self, session, trouble):
        self._session, self._trouble = session, trouble
        self._first = self._old = None
        self.seen = dict.fromkeys(("", *INPUTS), 0)
        self.actions = []

    def act(self, sample):
        kind = self._trouble.draw()
        self.seen[kind] += 1
        self._first = self._first or sample
        broken = self._break(kind, sample)
        if kind != "stale":
            self._old = sample
        action = self._session.act(broken)
        self.actions.append(action)
        return action

    def _break(self, kind, sample):
        if kind == "":
            return sample
        if kind in ("stale", "constant"):
            source = (self._old if kind == "stale" else self._first) or sample
            return replace(source, t=sample.t, active=sample.active)
        rng = self._trouble.rng
        worst = {
            "nan": np.nan,
            "one_nan": np.nan,
            "inf": rng.choice([np.inf, -np.inf]),
            "huge": rng.choice([-1, 1]) * 1e12,
        }

        def spoil(values):
            values = np.array(values, dtype=float)
            hit = np.ones(values.size, dtype=bool)
            if kind == "one_nan" and values.size:
                hit = np.arange(values.size) == rng.integers(values.size)
            values[hit] = worst[kind]
            return values

        measured = dict(zip(sample.measured, spoil(list(sample.measured.values())), strict=True))
        if sample.state is None:
            return replace(sample, measured=measured)
        part = rng.choice(["x", "z", "d", "u", "p"])
        p = spoil(sample.p) if part == "p" else sample.p
        state = sample.state if part == "p" else sample.state.with_(**{part: spoil(getattr(sample.state, part))})
        return Sample(sample.t, measured, sample.active, state, p)

    def __getattr__(self, name):
        return getattr(self._session, name)


class FailingSolver:
    """A solver whose plans are tampered with, or late."""

    def __init__(self, solver, trouble, clock):
        self._solver, self._trouble, self._clock = solver, trouble, clock
        self.seen = dict.fromkeys(("", *PLANS), 0)

    def solve(self, sample, u_last):
        solution = self._solver.solve(sample, u_last)
        kind = self._trouble.draw()
        self.seen[kind] += 1
        rng = self._trouble.rng
        if kind == "status":
            bad = [status for status in Status if not status.usable]
            return replace(solution, status=bad[rng.integers(len(bad))])
        if kind == "late":
            self._clock.now += (1.0 + rng.random()) * DEADLINE_MS / 1e3
            return solution
        value = {"nan": np.nan, "inf": -np.inf, "above": U_MAX + 1e-3, "below": -1e9}
        if kind == "costless":
            return Solution(Status.CONVERGED, rng.uniform(U_MIN, U_MAX, solution.u.shape), np.nan, 0, np.nan)
        if kind:
            u = solution.u.copy()
            u[rng.integers(u.shape[0])] = value[kind]
            return Solution(Status.CONVERGED, u, 0.0, 1, 0.0)
        return solution

    def __getattr__(self, name):
        return getattr(self._solver, name)


def inject(monkeypatch, backend, samples, seed, *, inputs, plans):
    """A run of this many samples under trouble; the simulation, the session and the solver."""
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock.read)
    rng = np.random.default_rng(seed)
    t_end = samples * DT
    faults = [
        change
        for k in range(int(t_end / 8.0))
        for change in Fault(type="fault", t=1.0 + 8.0 * k, bus="HV", R=0.02, duration=0.1).changes()
    ]
    config = MPC(unit="G2", backend=backend, u_min=U_MIN, u_max=U_MAX, N_c=2, deadline_ms=DEADLINE_MS, recover_after=5)
    transfer = FieldTransfer(V_RMIN=-3.85, V_RMAX=3.85)
    sim = Simulation(regulated(transfer=transfer), Settings(t_end, H, "tr_bdf2", "auto"), faults, {"mpc": config})
    running = sim._running["mpc"]
    running.session.solver = solver = FailingSolver(running.session.solver, Trouble(rng, plans, PLANS), clock)
    running.session = session = BrokenInputs(running.session, Trouble(rng, inputs, INPUTS))
    sim.run()
    return sim, session, solver


def assert_safe(sim, session):
    """No non-finite or out-of-bounds command, and the plant in step."""
    assert sim.outcome.ending.value == "completed", sim.outcome.message
    for action in session.actions:
        for path, value in action.commands.items():
            low, high = (0.0, 1.0) if path.endswith("manual") else (U_MIN, U_MAX)
            assert np.isfinite(value), action
            assert low <= value <= high, action
        assert np.isfinite(action.stage_cost)
    trace = sim.trace()
    for path in ("unit.G2.e_fd", "unit.G2.v_t", "unit.G2.machine.delta"):
        assert np.isfinite(trace[path]).all()
    assert np.degrees(trace["unit.G2.delta"]).max() < 120


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_broken_reaches_the_plant(backend, seed, monkeypatch):
    sim, session, _ = inject(monkeypatch, backend, 500, seed, inputs=0.05, plans=0.05)
    assert_safe(sim, session)
    assert sum(session.seen.values()) == 500
    assert session.seen[""] < 450
    levels = set(sim.trace()["controller.mpc.level"])
    assert levels == {0.0, 1.0, 2.0}


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_nothing_broken_reaches_the_plant_in_ten_thousand_samples(backend, monkeypatch):
    samples = 0
    seen = dict.fromkeys((*INPUTS, *PLANS), 0)
    for seed, (inputs, plans) in enumerate([(0.05, 0.05), (0.3, 0.0), (0.0, 0.3), (0.2, 0.2)]):
        sim, session, solver = inject(monkeypatch, backend, 2500, 100 + seed, inputs=inputs, plans=plans)
        assert_safe(sim, session)
        samples += len(session.actions)
        for kind in seen:
            seen[kind] += session.seen.get(kind, 0) + solver.seen.get(kind, 0)
    assert samples == 10_000
    assert min(seen.values()) > 50, seen
