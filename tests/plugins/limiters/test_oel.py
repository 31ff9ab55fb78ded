from __future__ import annotations

import numpy as np
import pytest
from automaton import Automaton
from component_harness import Bench
from plants import regulated
from pydantic import ValidationError

from pgexcite.core.events import ParameterStep
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.limiters.oel import OEL

H = 0.01
REST = 1.92463  # field current of the plant at its operating point, pu
LIMIT = 2.05
TAKEOVER = {
    "output gate": (ST1A(oel_position=3, V_RMAX=6.0), OEL(I_LIM=LIMIT, T_LIM=3.0)),
    "input gate": (
        ST1A(oel_position=2, V_RMAX=6.0),
        OEL(I_LIM=LIMIT, T_LIM=3.0, K_P=5.0 / 200, K_I=5.0 / 200, K_TR=1.0 / 200),
    ),
}
SUMMING = {
    "st1a": (ST1A(oel_position=1, V_RMAX=6.0), OEL(acts="summing", I_LIM=LIMIT, T_LIM=3.0, K_P=0.02, K_I=0.05)),
    "sexs": (SEXS(E_MAX=6.0), OEL(acts="summing", I_LIM=LIMIT, T_LIM=3.0, K_P=0.1, K_I=0.1)),
}
WAYS = TAKEOVER | SUMMING


def clocked(limiter, course, h=H):
    """``(timer, active)`` at the end of each step while the field current follows ``course(t)``."""
    machine = Automaton(limiter, h=h, i_m=1.0)
    rows = []
    for k in range(1, round(course[-1][0] / h) + 1):
        current = next((i for until, i in course if k * h <= until + 1e-9), course[-1][1])
        state = machine.step(i_m=current)
        rows.append((k * h, state["timer"], state["active"]))
    return np.array(rows)


def first(rows, active):
    return rows[np.flatnonzero(rows[:, 2] == active)[0], 0]


def test_fixed_time_to_the_step():
    """The limiter acts on the step at which the overload has lasted T_LIM, whatever its size above pick-up."""
    for current in (1.051 * LIMIT, 2 * LIMIT):
        rows = clocked(OEL(I_LIM=LIMIT, T_LIM=4.0), [(1.0, 1.0), (8.0, current)])
        assert first(rows, 1) == pytest.approx(5.0)
    assert clocked(OEL(I_LIM=LIMIT, T_LIM=4.0), [(20.0, 1.049 * LIMIT)])[:, 2].max() == 0


@pytest.mark.parametrize("overload", [1.2, 1.6, 2.0])
def test_inverse_time(overload):
    """Constant overload i: T_LIM / (K_INV (i^C - 1)), to the step."""
    limiter = OEL(I_LIM=LIMIT, T_LIM=10.0, timing="inverse", K_PU=1.0, K_INV=0.296, C=2.0)
    expected = 10.0 / (0.296 * (overload**2 - 1))
    rows = clocked(limiter, [(expected + 1.0, overload * LIMIT)])
    assert 0 <= first(rows, 1) - expected < H + 1e-6


def test_it_cools_down_and_an_overload_that_comes_back_meets_the_rest():
    limiter = OEL(I_LIM=LIMIT, T_LIM=4.0, K_COOL=0.5)
    rows = clocked(limiter, [(3.0, 3.0), (5.0, 1.0), (9.0, 3.0)])
    timer = dict(zip(rows[:, 0].round(6), rows[:, 1], strict=True))
    assert timer[3.0] == pytest.approx(3.0)
    assert timer[5.0] == pytest.approx(2.0)
    assert first(rows, 1) == pytest.approx(7.0)
    assert clocked(limiter, [(1.0, 3.0), (20.0, 1.0)])[-1, 1] == 0.0


def test_release_after_its_delay_and_not_before():
    """Below K_RESET for T_RESET without a break releases it; the timer then cools from T_LIM."""
    limiter = OEL(I_LIM=LIMIT, T_LIM=1.0, T_RESET=2.0, K_RESET=0.98, K_COOL=0.25)
    broken = [(1.0, 3.0), (2.5, 1.0), (2.6, LIMIT), (4.5, 1.0), (6.0, 1.0)]
    rows = clocked(limiter, broken)
    released = rows[np.flatnonzero((rows[:, 2] == 0) & (rows[:, 0] > 1.0))[0], 0]
    assert released == pytest.approx(4.6)
    assert rows[-1, 1] == pytest.approx(1.0 - 0.25 * (6.0 - 4.6), abs=1e-9)
    held = clocked(limiter, [(1.0, 3.0), (30.0, 0.99 * LIMIT)])
    assert held[-1, 2] == 1
    assert held[-1, 1] == pytest.approx(1.0)


def run(exciter, limiter, t_end, *, step=0.1, back=None):
    """The regulated plant with a reference that asks for more field current than allowed, from 1 s to ``back``."""
    path = "unit.G2.exciter.v_ref"
    events = [ParameterStep(type="set", t=1.0, path=path, step=step)]
    if back is not None:
        events.append(ParameterStep(type="set", t=back, path=path, step=-step))
    plant = regulated(exciter=exciter, **{"limiter.oel": limiter})
    changes = [change for event in events for change in event.changes()]
    sim = Simulation(plant, Settings(t_end, H, "tr_bdf2", "never"), changes)
    assert sim.run().ending.value == "completed"
    return sim.trace()


@pytest.mark.parametrize("way", WAYS)
def test_the_field_current_comes_down_to_its_limit(way):
    trace = run(*WAYS[way], 25.0)
    i_fd, active = trace["unit.G2.i_fd"], trace["unit.G2.limiter.oel.active"]
    over = np.flatnonzero(i_fd > 1.05 * LIMIT)
    assert active[-1] == 1
    acted, began = trace.t[np.argmax(active)], trace.t[over[0]]
    assert 3.0 - 2 * H <= acted - began <= 3.0 + 0.05  # the transducer's 20 ms
    assert i_fd[over].max() > 1.08 * LIMIT
    assert i_fd[-1] == pytest.approx(LIMIT, abs=5e-3)


@pytest.mark.parametrize("way", WAYS)
def test_it_hands_back(way):
    """Once the reference asks for less it lets go after T_RESET, and the regulator holds the voltage as before."""
    trace = run(*WAYS[way], 45.0, back=15.0)
    active = trace["unit.G2.limiter.oel.active"]
    released = trace.t[np.flatnonzero(np.diff(active) == -1)[0] + 1]
    assert released == pytest.approx(20.0, abs=1.0)
    assert trace["unit.G2.i_fd"][-1] == pytest.approx(REST, abs=2e-3)
    assert trace["unit.G2.v_t"][-1] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("way", TAKEOVER)
def test_it_takes_over_without_a_bump(way):
    trace = run(*WAYS[way], 8.0)
    at = np.argmax(trace["unit.G2.limiter.oel.active"])
    e_fd = trace["unit.G2.e_fd"]
    # The proportional part acts at once, the integrator starts where the regulator was.
    expected = e_fd[at - 1] + 5.0 * (LIMIT - trace["unit.G2.limiter.oel.i_m"][at])
    assert e_fd[at] == pytest.approx(expected, abs=0.05 * abs(expected) + 0.05)


@pytest.mark.parametrize("way", WAYS)
def test_it_does_nothing_below_its_limit(way):
    exciter, limiter = WAYS[way]
    with_it, without = (
        run(exciter, limiter, 6.0, step=0.005),
        run(exciter, limiter.model_copy(update={"I_LIM": 50.0}), 6.0, step=0.005),
    )
    assert np.abs(with_it["unit.G2.e_fd"] - without["unit.G2.e_fd"]).max() < 1e-9


@pytest.mark.parametrize("active", [0.0, 1.0])
@pytest.mark.parametrize("acts", ["takeover", "summing"])
def test_jacobian_matches_finite_differences(acts, active):
    point = {"i_fd": 2.4, "e_fd": 2.5, "i_m": 2.3, "x_i": 1.9 if acts == "takeover" else -0.3, "active": active}
    assert Bench(OEL(acts=acts, I_LIM=LIMIT)).jacobian_error(point) < 1e-7


def test_the_limit_is_required():
    with pytest.raises(ValidationError, match="I_LIM"):
        OEL()
