"""Every limiter branch of the shipped exciters and of the stabiliser, entered and left in a simulation of the plant.

What a limiter has at its input and at its output is worked out again from the recorded signals, with plain numpy.
"""

from __future__ import annotations

import numpy as np
import pytest
from plants import kobbelv

from pgexcite.core.component import Equations
from pgexcite.core.declare import par, port_out
from pgexcite.core.events import Change, Fault
from pgexcite.core.roles import Limiter
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.stabilisers.kundur import KundurPSS


class Over(Limiter):
    """An overexcitation limiter whose signal is a parameter."""

    signal: float = par(1000.0, "pu", "signal")
    v_oel = port_out("pu", "overexcitation limiter's signal")

    def equations(self, v):
        return Equations(out={"v_oel": self.signal})


class Under(Limiter):
    """An underexcitation limiter whose signal is a parameter."""

    signal: float = par(-1000.0, "pu", "signal")
    v_uel = port_out("pu", "underexcitation limiter's signal")

    def equations(self, v):
        return Equations(out={"v_uel": self.signal})


class Run:
    """A run of the plant under an exciter; signals by their last names."""

    def __init__(self, exciter, changes, t_end=1.0, h=0.005, **slots):
        system = kobbelv(exciter=exciter, **slots)
        sim = Simulation(system, Settings(t_end, h, "tr_bdf2", "never"), changes)
        assert sim.run().ending.value == "completed"
        self.exciter, self.trace = exciter, sim.trace()
        self.t = self.trace.t

    def __getattr__(self, name):
        for place in ("unit.G2", "unit.G2.exciter"):
            if f"{place}.{name}" in self.trace.columns:
                return self.trace[f"{place}.{name}"]
        if name == "v_s":  # a unit without a stabiliser
            return np.zeros_like(self.t)
        raise AttributeError(name)

    def error(self):
        """ST1A's sum at the input, with nothing but the stabiliser added."""
        e = self.exciter
        feedback = e.K_F / e.T_F * (self.e_fd - self.x_f) if e.T_F else 0.0
        return self.v_ref - self.v_m - feedback + (self.v_s if e.pss_position == 1 else 0.0)

    def demand(self):
        """ST1A's sum in front of the rectifier."""
        e = self.exciter
        return self.v_a - np.maximum(e.K_LR * (self.i_fd - e.I_LR), 0.0) + (self.v_s if e.pss_position == 2 else 0.0)

    def rectified(self, demand):
        e = self.exciter
        return np.clip(demand, self.v_t * e.V_RMIN, self.v_t * e.V_RMAX - e.K_C * self.i_fd)


def entered_and_left(active):
    """Active for a while, and inactive before and after."""
    return bool(active.any() and not active[0] and not active[-1])


def reference_steps(*steps):
    return [Change(t, {}, "step", {"unit.G2.exciter.v_ref": step}) for t, step in steps]


def signal(slot, t, value):
    return Change(t, {f"unit.G2.{slot}.signal": value}, "limiter")


FAULT = Fault(type="fault", t=0.1, bus="HV", R=0.02, duration=0.1).changes()
UP_AND_DOWN = reference_steps((0.1, 0.2), (0.3, -0.4), (0.5, 0.2))
TEMPERATE = {"T_R": 0.02, "K_A": 20.0, "V_RMIN": -20.0, "V_RMAX": 20.0}
CLOSE = 1e-12  # measured 1.1e-14


@pytest.mark.parametrize("T_B", [0.0, 1.0])
def test_st1a_error_is_clipped_on_both_sides(T_B):
    exciter = ST1A(**TEMPERATE, V_IMIN=-0.05, V_IMAX=0.15, T_C=T_B / 5, T_B=T_B)
    run = Run(exciter, UP_AND_DOWN)
    assert entered_and_left(run.error() > 0.15)
    assert entered_and_left(run.error() < -0.05)
    limited = np.clip(run.error(), -0.05, 0.15)
    expected = run.x_b + 0.2 * (limited - run.x_b) if T_B else limited
    assert run.v_a == pytest.approx(20.0 * expected, abs=CLOSE)
    if T_B:  # what stands behind the clip follows the clipped error only
        assert run.x_b.max() < 0.15
        assert run.x_b.min() > -0.05


def complementary(value, drive, lower, upper):
    """A non-windup state is at a limit only while it is driven against it, and leaves in the step in which that ends."""
    for limit, sign in ((upper, 1.0), (lower, -1.0)):
        held = sign * value >= sign * limit - CLOSE
        driven = sign * (drive - limit) >= 0
        assert entered_and_left(held)
        assert not np.any(sign * value > sign * limit + CLOSE)
        assert not np.any(held[1:] & held[:-1] & ~driven[1:] & ~driven[:-1])


def test_st1a_regulator_does_not_wind_up():
    run = Run(ST1A(**TEMPERATE, T_A=0.05, V_AMIN=0.5, V_AMAX=4.0), UP_AND_DOWN)
    complementary(run.v_a, 20.0 * run.error(), 0.5, 4.0)


def test_st1a_regulator_without_time_constant_is_clipped():
    run = Run(ST1A(**TEMPERATE, T_A=0.0, V_AMIN=0.5, V_AMAX=4.0), UP_AND_DOWN)
    for beyond in (20.0 * run.error() > 4.0, 20.0 * run.error() < 0.5):
        assert entered_and_left(beyond)
    assert run.v_a == pytest.approx(np.clip(20.0 * run.error(), 0.5, 4.0), abs=CLOSE)


@pytest.mark.parametrize("T_A", [0.0, 0.05])
def test_st1a_ceiling_and_floor_follow_terminal_voltage_and_field_current(T_A):
    exciter = ST1A(T_A=T_A, K_A=50.0, V_RMAX=4.0, V_RMIN=-2.0, K_C=0.1)
    run = Run(exciter, [*FAULT, *reference_steps((0.5, -0.3), (0.7, 0.3))], t_end=2.0)
    assert entered_and_left(run.demand() > run.v_t * 4.0 - 0.1 * run.i_fd)
    assert entered_and_left(run.demand() < run.v_t * -2.0)
    assert run.e_fd == pytest.approx(run.rectified(run.demand()), abs=CLOSE)
    assert run.e_fd.max() < 4.0


def test_st1a_rectifier_winds_up_behind_the_regulator():
    run = Run(ST1A(T_A=0.05, K_A=50.0, V_RMAX=3.0), FAULT)
    assert run.v_a.max() > run.e_fd.max() + 1.0


def test_st1a_field_current_limiter():
    run = Run(ST1A(K_A=50.0, K_LR=4.54, I_LR=2.2), FAULT, t_end=4.0)
    assert entered_and_left(run.i_fd > 2.2)
    assert run.e_fd == pytest.approx(run.rectified(run.demand()), abs=CLOSE)
    assert np.max(run.v_a - run.demand()) > 0.3


@pytest.mark.parametrize(
    ("position", "idle", "active"),
    [(1, 0.0, -0.05), (2, 1000.0, 0.05), (3, 1000.0, 1.0)],
    ids=["sum", "input", "output"],
)
def test_st1a_overexcitation_limiter(position, idle, active):
    changes = [signal("oel", 0.1, active), signal("oel", 0.4, idle)]
    run = Run(ST1A(**TEMPERATE, oel_position=position), changes, t_end=2.0, oel=Over(signal=idle))
    check_limiter(run, position, run.v_oel, np.minimum, idle)
    assert run.e_fd.min() < 1.2 < run.e_fd[0]


@pytest.mark.parametrize(
    ("position", "idle", "active"),
    [(1, 0.0, 0.05), (2, -1000.0, 0.15), (3, -1000.0, 3.0)],
    ids=["sum", "input", "output"],
)
def test_st1a_underexcitation_limiter(position, idle, active):
    changes = [signal("uel", 0.1, active), signal("uel", 0.4, idle)]
    run = Run(ST1A(**TEMPERATE, uel_position=position), changes, t_end=2.0, uel=Under(signal=idle))
    check_limiter(run, position, run.v_uel, np.maximum, idle)
    assert run.e_fd.max() > 2.6 > run.e_fd[0]


def check_limiter(run, position, limiter, gate, idle):
    error = run.error() + (limiter if position == 1 else 0.0)
    chosen = gate(error, limiter) if position == 2 else error
    assert run.v_a == pytest.approx(20.0 * chosen, abs=CLOSE)
    demand = gate(run.demand(), limiter) if position == 3 else run.demand()
    assert run.e_fd == pytest.approx(run.rectified(demand), abs=CLOSE)
    taken = {1: limiter != idle, 2: chosen != error, 3: demand != run.demand()}[position]
    assert entered_and_left(taken)


def test_st1a_overexcitation_gate_has_the_last_word():
    changes = [signal("uel", 0.1, 3.0), signal("oel", 0.1, 1.0), signal("uel", 0.3, -1e3), signal("oel", 0.3, 1e3)]
    run = Run(ST1A(**TEMPERATE, uel_position=3, oel_position=3), changes, oel=Over(), uel=Under())
    assert np.all(run.e_fd[(run.t > 0.1) & (run.t < 0.3)] == 1.0)
    assert entered_and_left(run.e_fd == 1.0)


@pytest.mark.parametrize("T_A", [0.0, 0.02])
def test_st1a_rate_feedback(T_A):
    """With its ceiling in the way, too: the feedback is of the field voltage, behind the limit."""
    exciter = ST1A(K_A=50.0, T_A=T_A, V_RMAX=3.0, K_F=0.03, T_F=0.5)
    run = Run(exciter, FAULT, h=0.002)
    assert entered_and_left(run.demand() > run.rectified(run.demand()))
    if T_A == 0:
        assert run.v_a == pytest.approx(50.0 * run.error(), abs=CLOSE)
    steps = np.diff(run.t)
    slope = (run.e_fd - run.x_f) / 0.5
    integral = np.concatenate(([0.0], np.cumsum(steps * (slope[1:] + slope[:-1]) / 2)))
    assert run.x_f - run.x_f[0] == pytest.approx(
        integral, abs=5e-5
    )  # measured 9e-6: the integral is by the trapezoidal rule


def test_stabiliser_behind_the_regulator():
    run = Run(ST1A(**TEMPERATE, pss_position=2), FAULT, stabiliser=KundurPSS())
    assert np.abs(run.v_s).max() > 0.05
    assert run.e_fd == pytest.approx(run.rectified(run.demand()), abs=CLOSE)
    assert run.v_a == pytest.approx(20.0 * run.error(), abs=CLOSE)


def test_stabiliser_is_clipped_on_both_sides():
    limits = {"V_SMIN": -0.03, "V_SMAX": 0.05}
    run = Run(ST1A(**TEMPERATE), FAULT, t_end=3.0, stabiliser=KundurPSS(**limits, T_3=0.1, T_4=0.05))
    names = [f"unit.G2.stabiliser.{name}" for name in ("x_w", "x_1", "x_2")]
    x_w, x_1, x_2 = (run.trace[name] for name in names)
    first = x_1 + 0.154 / 0.033 * (9.5 * (run.omega - 1) - x_w - x_1)
    second = x_2 + 0.1 / 0.05 * (first - x_2)
    assert entered_and_left(second > 0.05)
    assert entered_and_left(second < -0.03)
    assert run.v_s == pytest.approx(np.clip(second, -0.03, 0.05), abs=CLOSE)


def test_sexs_does_not_wind_up():
    run = Run(SEXS(T_A=0.5, T_B=2.0, T_E=0.05, E_MIN=1.7, E_MAX=2.5), UP_AND_DOWN)
    complementary(run.v_e, 20.0 * sexs_lead(run), 1.7, 2.5)
    assert np.array_equal(run.e_fd, run.v_e)


def test_sexs_without_time_constant_is_clipped():
    run = Run(SEXS(T_R=0.01, T_A=0.5, T_B=2.0, T_E=0.0, E_MIN=1.5, E_MAX=3.0), UP_AND_DOWN)
    demand = 20.0 * sexs_lead(run)
    assert entered_and_left(demand > 3.0)
    assert entered_and_left(demand < 1.5)
    assert run.e_fd == pytest.approx(np.clip(demand, 1.5, 3.0), abs=CLOSE)


def sexs_lead(run):
    error = run.v_ref - run.v_m
    return run.x_b + 0.5 / 2.0 * (error - run.x_b)


def test_sexs_sums_its_limiters():
    changes = [signal("oel", 0.1, -0.05), signal("oel", 0.3, 0.0), signal("uel", 0.5, 0.05), signal("uel", 0.7, 0.0)]
    run = Run(SEXS(T_A=0.0, T_B=0.0, T_E=0.0), changes, oel=Over(signal=0.0), uel=Under(signal=0.0))
    assert run.e_fd == pytest.approx(20.0 * (run.v_ref - run.v_m + run.v_uel + run.v_oel), abs=CLOSE)
    assert run.e_fd.min() < 1.2
    assert run.e_fd.max() > 2.5
