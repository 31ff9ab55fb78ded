"""Control passes between classical controller and MPC, both ways in one run, without a bump."""

from __future__ import annotations

import numpy as np
import pytest
from plants import regulated

from pgexcite.core.events import Change, Fault, HandOver
from pgexcite.core.mpc import Solution, Status
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.controllers.mpc import MPC
from pgexcite.plugins.transfers.field import FieldTransfer

H = 0.005


def run(changes=(), *, active=False, transfer=None, t_end=3.0, sabotage=None, **options):
    system = regulated(transfer=transfer or FieldTransfer(V_RMIN=-3.85, V_RMAX=3.85))
    config = MPC(**({"unit": "G2", "active": active} | options))
    sim = Simulation(system, Settings(t_end, H, "tr_bdf2", "never"), changes, {"mpc": config})
    if sabotage:
        session = sim._running["mpc"].session
        session.solver = sabotage(session.solver)
    assert sim.run().ending.value == "completed"
    return sim


def over(t, to):
    return HandOver(type="hand_over", t=t, controller="mpc", to=to).changes()[0]


def jump_at(trace, path, t):
    """Largest difference between consecutive samples around an instant."""
    near = np.abs(trace.t - t) < 2.5 * H
    return np.abs(np.diff(trace[path][near])).max()


def test_standby_changes_nothing():
    """A controller on standby leaves the plant to the classical one, to the last digit."""
    with_mpc = run(Fault(type="fault", t=0.3, bus="HV", R=0.02, duration=0.1).changes())
    alone = Simulation(
        regulated(transfer=FieldTransfer(V_RMIN=-3.85, V_RMAX=3.85)),
        Settings(3.0, H, "tr_bdf2", "never"),
        Fault(type="fault", t=0.3, bus="HV", R=0.02, duration=0.1).changes(),
    )
    alone.run()
    assert np.array_equal(with_mpc.state.x, alone.state.x)


def test_at_rest_there_is_no_bump_either_way():
    sim = run([over(0.5, "controller"), over(1.5, "classical")])
    trace = sim.trace()
    e_fd = trace["unit.G2.e_fd"]
    assert np.ptp(e_fd) < 1e-6  # measured 2e-8
    assert sim.get("unit.G2.transfer.manual") == 0.0


@pytest.mark.parametrize("way", ["controller", "classical"])
def test_in_mid_swing_the_field_voltage_does_not_jump(way):
    """At the instant of the hand-over the field voltage is what it was; only its slope changes."""
    fault = Fault(type="fault", t=0.3, bus="HV", R=0.02, duration=0.1).changes()
    t = 0.75
    # A bound on the move keeps MPC itself from stepping, so that a step could only come from the hand-over.
    reach = {"u_min": -3.85, "u_max": 3.85, "du_max": 1e-3 if way == "controller" else 1e5}
    sim = run([*fault, over(t, way)], active=way == "classical", t_end=0.9, **reach)
    trace = sim.trace()
    at = np.flatnonzero(np.abs(trace.t - t) < 1e-9)
    before, after = trace["unit.G2.e_fd"][at[0]], trace["unit.G2.e_fd"][at[-1]]
    assert abs(after - before) < 1.1e-3  # measured 1e-12 back to classical, 1e-3 to MPC: the move it is allowed
    classical = trace["unit.G2.e_fd_exciter"][at[-1]]
    if way == "classical":
        assert abs(classical - before) > 0.1  # the exciter alone would have jumped


def test_handed_back_the_difference_fades():
    fault = Fault(type="fault", t=0.3, bus="HV", R=0.02, duration=0.1).changes()
    sim = run([*fault, over(0.75, "classical")], active=True, t_end=6.0)
    trace = sim.trace()
    difference = np.abs(trace["unit.G2.e_fd"] - trace["unit.G2.e_fd_exciter"])
    assert difference[trace.t > 5.0].max() < 1e-3
    assert abs(trace["unit.G2.v_t"][-1] - 1.0) < 2e-3


def test_set_point_returns_after_hand_back():
    sim = run([over(1.0, "classical")], active=True, t_end=20.0, command="v_ref", u_min=0.9, u_max=1.05, V_ref=0.97)
    trace = sim.trace()
    v_ref = trace["unit.G2.exciter.v_ref"]
    start = v_ref[0]
    assert abs(trace["unit.G2.v_t"][np.searchsorted(trace.t, 0.99)] - 0.97) < 5e-3
    assert np.abs(np.diff(v_ref[trace.t > 1.0])).max() <= 0.01 * 0.05 + 1e-12
    assert v_ref[-1] == pytest.approx(start, abs=1e-12)


class _FailsBetween:
    """A solver whose plans are bad between two of its calls."""

    def __init__(self, good, first, last):
        self._good, self._span, self._count = good, (first, last), 0

    def solve(self, sample, u_last):
        self._count += 1
        if self._span[0] <= self._count <= self._span[1]:
            return Solution(Status.QP_FAILED, np.zeros((1, 1)), np.inf, 0, np.inf)
        return self._good.solve(sample, u_last)

    def prepare(self, u):
        self._good.prepare(u)

    def memory(self):
        return self._good.memory()


def test_the_ladder_goes_down_and_up_again():
    fault = Fault(type="fault", t=0.3, bus="HV", R=0.02, duration=0.1).changes()
    sim = run(fault, active=True, sabotage=lambda good: _FailsBetween(good, 10, 20), max_reuse=2, recover_after=5)
    trace = sim.trace()
    level = trace["controller.mpc.level"]
    changes = level[np.flatnonzero(np.diff(level)) + 1]
    assert list(changes) == [1, 2, 0]
    log = [entry.text for entry in trace.log if entry.kind == "controller"]
    assert [text.split(":")[1].strip() for text in log] == [
        "takes charge",
        "the last plan is followed",
        "hands over to the classical controller",
        "plans have been good for 5 samples",
        "takes charge",
    ]
    manual = trace["unit.G2.transfer.manual"]
    assert manual[0] == 0
    assert manual[-1] == 1
    assert np.isfinite(trace["unit.G2.e_fd"]).all()
    assert sim.result().controllers["mpc"].fallbacks == 3
    for t in trace.t[np.flatnonzero(np.diff(manual) < 0)]:
        assert jump_at(trace, "unit.G2.e_fd", t) < 0.7  # one step of the regulator's own motion in mid-swing


def test_the_ceiling_follows_the_terminal_voltage():
    transfer = FieldTransfer(V_RMIN=-3.0, V_RMAX=3.0, K_C=0.05, ceiling="rectifier")
    fault = Fault(type="fault", t=0.3, bus="HV", R=0.02, duration=0.1).changes()
    trace = run(fault, active=True, transfer=transfer, t_end=1.0).trace()
    ceiling = 3.0 * trace["unit.G2.v_t"] - 0.05 * trace["unit.G2.i_fd"]
    assert (trace["unit.G2.e_fd"] <= ceiling + 1e-9).all()
    assert np.any(np.abs(trace["unit.G2.e_fd"] - ceiling) < 1e-9)
    assert trace["unit.G2.transfer.e_fd_cmd"].max() > ceiling.min()


@pytest.mark.parametrize("t", [0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9])
def test_the_first_move_after_taking_over_keeps_its_bound(t):
    """Several moves, and a plan from standby that was never in force: it must not be where the first move comes from."""
    fault = Fault(type="fault", t=0.3, bus="HV", R=0.02, duration=0.1).changes()
    reach = {"u_min": -3.85, "u_max": 3.85, "du_max": 0.05, "N_c": 5, "R": 1e-4}
    sim = run([*fault, over(t, "controller")], t_end=t + 0.03, **reach)
    trace = sim.trace()
    at = np.flatnonzero(np.abs(trace.t - t) < 1e-9)
    assert abs(trace["unit.G2.e_fd"][at[-1]] - trace["unit.G2.e_fd"][at[0]]) <= 0.05 + 1e-6


def test_an_order_to_hand_over_is_final():
    """After a step down of its own the controller would come back; told to hand over meanwhile, it stays away."""
    sim = run(
        [over(1.2, "classical")],
        active=True,
        sabotage=lambda good: _FailsBetween(good, 10, 20),
        max_reuse=2,
        recover_after=5,
    )
    assert sim.get("unit.G2.transfer.manual") == 0.0
    assert not any("control is taken back" in entry.text for entry in sim.trace().log)


def test_on_standby_the_set_point_belongs_to_others():
    step = Change(1.0, {}, "v_ref steps", {"unit.G2.exciter.v_ref": 0.02})
    sim = run([step], active=False, command="v_ref", u_min=0.9, u_max=1.1)
    trace = sim.trace()
    v_ref = trace["unit.G2.exciter.v_ref"]
    assert v_ref[-1] == pytest.approx(v_ref[0] + 0.02, abs=1e-12)


def test_a_solver_whose_arithmetic_fails_is_a_failed_plan():
    class Singular:
        def solve(self, sample, u_last):
            raise np.linalg.LinAlgError("singular")

        def prepare(self, u):
            pass

        def memory(self):
            return {}

    sim = run(active=True, sabotage=lambda _: Singular(), max_reuse=2, t_end=1.0)
    log = " ".join(entry.text for entry in sim.trace().log)
    assert "LinAlgError: singular" in log
    assert np.ptp(sim.trace()["unit.G2.e_fd"]) < 1e-6


def test_the_standby_bias_does_not_wind_up_against_the_ceiling():
    """A command beyond the ceiling leaves a bias to what was in force, not to what was asked for."""
    fault = Fault(type="fault", t=0.3, bus="HV", R=0.02, duration=0.1).changes()
    transfer = FieldTransfer(V_RMIN=-2.0, V_RMAX=2.0)
    trace = run([*fault, over(0.45, "classical")], active=True, transfer=transfer, t_end=0.6).trace()
    at = np.flatnonzero(np.abs(trace.t - 0.45) < 1e-9)[-1]
    assert trace["unit.G2.transfer.e_fd_cmd"][at - 2] > 2.05  # measured 2.084
    in_force = trace["unit.G2.transfer.b"][at] + trace["unit.G2.e_fd_exciter"][at]
    assert in_force == pytest.approx(2.0, abs=1e-9)
