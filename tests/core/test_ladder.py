"""What the ladder takes for a lost measurement."""

from __future__ import annotations

import numpy as np
import pytest

from pgexcite.core.controller import Sample
from pgexcite.core.ladder import Actuator, Ladder, LadderOptions
from pgexcite.core.mpc import ControlProblem, Solution, Status

SIGNALS = ("unit.G.v_t", "unit.G.omega", "unit.G.e_fd")


class Planner:
    """A solver that is always content, and wants ``u`` next; it notes what it was told."""

    def __init__(self):
        self.u, self.told = 1.0, []

    def solve(self, sample, u_last):
        self.told.append(dict(sample.measured))
        return Solution(Status.CONVERGED, np.array([[self.u]]), 0.0, 1, 0.0)

    def memory(self):
        return {}

    def recall(self, memory):
        pass


def ladder(*, perfect=False):
    one = np.ones(1)
    problem = ControlProblem(
        dt=0.05, N_p=3, blocks=(1,), commands=("unit.G.transfer.e_fd_cmd",), voltages=SIGNALS[:1], speeds=SIGNALS[1:2],
        Q=one, P=one, R=one, u_min=-3 * one, u_max=3 * one, du_max=np.inf * one, V_ref=one,
    )  # fmt: skip
    actuator = Actuator(("unit.G.transfer.e_fd_cmd",), ("unit.G.e_fd",), {"unit.G.transfer.manual": 1.0})
    options = LadderOptions(1, 2, 3, 0.0, 0.01, perfect)
    planner = Planner()
    return Ladder(problem, planner, actuator, options, one), planner


def levels(session, planner, measured, wanted, *, active=True):
    """Level of each sample, for measured values of one signal after the other and commands wanted; standby follows a release."""
    found = []
    for k, (value, u) in enumerate(zip(measured, wanted, strict=True)):
        planner.u = u
        action = session.act(Sample(0.05 * k, dict.fromkeys(SIGNALS, value), active))
        found.append(int(action.diagnostics["level"]))
        active = active if action.release is None else not action.release
    return found


def test_at_rest_nothing_is_lost():
    assert levels(*ladder(), [1.0] * 10, [1.0] * 10) == [0] * 10


def test_a_measurement_that_hangs_while_the_command_moves_is_lost():
    """It hangs from the third sample on: two samples are forgiven, one follows the old plan, then the classical controller is in
    charge; three good plans after the measurement moves again, control comes back."""
    measured = [1.0, 0.99, *([0.98] * 8), 0.97, 0.96, 0.95, 0.94, 0.93]
    wanted = list(np.linspace(1.0, 2.0, len(measured)))
    assert levels(*ladder(), measured, wanted) == [0, 0, 0, 0, 0, 1, 2, 2, 2, 2, 2, 2, 2, 0, 0]


def test_perfect_information_cannot_hang():
    session, planner = ladder(perfect=True)
    assert levels(session, planner, [1.0] * 10, np.linspace(1.0, 2.0, 10)) == [0] * 10


@pytest.mark.parametrize("value", [np.inf, -np.inf, 1e12, -1e12, np.nan])
def test_what_no_machine_does_is_told_as_lost(value):
    session, planner = ladder()
    assert levels(session, planner, [1.0, *[value] * 5], [1.0] * 6) == [0, 0, 0, 1, 2, 2]
    assert all(np.isnan(list(told.values())).all() for told in planner.told[1:])


def test_what_was_seen_last_is_remembered():
    first, planner = ladder()
    levels(first, planner, [1.0, 0.9, 0.8], [1.0, 1.1, 1.2])
    second, _ = ladder()
    second.recall(first.memory())
    for session in (first, second):
        assert session.act(Sample(0.15, dict.fromkeys(SIGNALS, 0.8))).diagnostics["level"] == 0
        assert session.memory()["stale"] == 1
