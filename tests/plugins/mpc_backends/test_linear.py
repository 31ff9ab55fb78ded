"""Linear MPC on its own model: offset-free, the same as NMPC where it ought to be, and blind to the plant's state."""

from __future__ import annotations

from typing import NoReturn

import numpy as np
import pytest
from plants import kobbelv, regulated, voltage_problem
from pydantic import ValidationError

from pgexcite.core.controller import Plant, Sample, Surroundings
from pgexcite.core.errors import ConfigError
from pgexcite.core.events import Change, Fault, HandOver
from pgexcite.core.measurement import Measurement
from pgexcite.core.mpc import Status
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.step import Kernel
from pgexcite.plugins.controllers.mpc import MPC
from pgexcite.plugins.mpc_backends.linear import Linear
from pgexcite.plugins.mpc_backends.nmpc import NMPC
from pgexcite.plugins.transfers.field import FieldTransfer

H = 0.005
COMMAND = "unit.G2.exciter.e_fd_ref"
FAULT = Fault(type="fault", t=0.2, bus="HV", R=0.02, duration=0.1).changes()
MISMATCHES = {
    "line twice as long": {"line.L1.X": 0.3},
    "X_d 30 % low": {"unit.G2.machine.X_d": 0.868},
    "T'd0 30 % high": {"unit.G2.machine.Tp_d0": 8.45},
}


def simulation(changes=(), t_end=2.0, system=None, options=None, **controller):
    config = MPC(**({"unit": "G2", "backend": "linear", "options": options or {}} | controller))
    return Simulation(system or kobbelv(), Settings(t_end, H, "tr_bdf2", "never"), changes, {"mpc": config})


def run(*args, **kwargs):
    sim = simulation(*args, **kwargs)
    assert sim.run().ending.value == "completed"
    return sim


def deviation(sim, since, reference=1.0):
    """Largest voltage error after an instant."""
    trace = sim.trace()
    return np.abs(trace["unit.G2.v_t"][trace.t > since] - reference).max()


def sent(sim):
    """Commands in force in each sample."""
    trace = sim.trace()
    ends = np.arange(0.05, trace.t[-1] + 1e-9, 0.05)
    return trace[COMMAND][np.searchsorted(trace.t, ends - 1e-9)]


def area(sim):
    trace = sim.trace()
    return np.trapezoid(np.abs(trace["unit.G2.v_t"] - 1.0), trace.t)


# Offset.


@pytest.mark.parametrize("model", MISMATCHES.values(), ids=MISMATCHES)
@pytest.mark.parametrize("relinearise", ["once", "every"])
def test_no_offset_remains_under_mismatch(model, relinearise):
    options = {"model": model, "relinearise": relinearise}
    sim = run(t_end=8.0, options=options, V_ref_steps=((0.5, 1.02),))
    assert deviation(sim, 7.0, 1.02) < 3e-5  # measured 7e-6
    trace = sim.trace()
    assert np.abs(trace["unit.G2.v_t"][trace.t <= 0.5] - 1.0).max() < 1e-9  # it starts at rest


def test_it_is_the_disturbances_that_remove_the_offset():
    options = {"model": MISMATCHES["line twice as long"], "disturbances": ()}
    assert deviation(run(t_end=8.0, options=options, V_ref_steps=((0.5, 1.02),)), 7.0, 1.02) > 3e-3  # measured 7e-3


def test_a_turbine_that_gives_another_torque_leaves_no_offset():
    change = [Change(0.5, {"unit.G2.governor.p_m": 0.5}, "the turbine gives less")]
    sim = run(change, t_end=10.0)
    assert deviation(sim, 9.0) < 2e-4  # measured 9e-5
    assert sim.trace()["controller.mpc.disturbance.torque"][-1] == pytest.approx(0.5 - 0.86, rel=0.03)  # measured 0.02
    fixed = run(change, t_end=10.0, options={"disturbances": ("v_t", "q_e")})
    assert deviation(fixed, 9.0) > 1e-3  # measured 1.6e-2


def test_no_offset_remains_in_secondary_control():
    """The field voltage is then the regulator's, and the field current can differ from the model's at rest."""
    secondary = {"command": "v_ref", "u_min": 0.9, "u_max": 1.05, "dt": 0.1, "V_ref": 0.99}
    model = MISMATCHES["X_d 30 % low"]
    assert deviation(run((), 20.0, regulated(), {"model": model}, **secondary), 19.0, 0.99) < 1e-6  # measured 1e-10
    without = run((), 20.0, regulated(), {"model": model, "disturbances": ("v_t", "q_e", "torque")}, **secondary)
    assert deviation(without, 19.0, 0.99) > 1e-3  # measured 2.8e-3


# The plan.


def problem_at_rest(sim, **changes):
    return voltage_problem(COMMAND, **changes), surroundings_of(sim)


def surroundings_of(sim):
    y = sim.kernel.outputs(sim.initial.state, sim.initial.p)
    model = sim.model
    u_0 = dict(zip(model.u_names, sim.initial.state.u, strict=True))
    return Surroundings(H, "tr_bdf2", u_0, dict(zip(model.y_names, y, strict=True)), model.system, (), "never")


def measured(sim):
    y = sim.kernel.outputs(sim.state, sim.p)
    return {f"unit.G2.{name}": y[sim.model.position("y", f"unit.G2.{name}")] for name in SIGNALS}


SIGNALS = ("v_t", "omega", "p_e", "q_e", "e_fd", "i_fd")


@pytest.mark.parametrize("changes", [{}, {"growth": 1.3}, {"delayed": True}])
def test_for_small_deviations_the_plan_is_that_of_nmpc(changes):
    sim = Simulation(kobbelv(), Settings(1.0, H, "tr_bdf2", "never"))
    problem, surroundings = problem_at_rest(sim, V_ref=np.array([1.0001]), R=np.array([0.1]), **changes)
    plant = Plant(sim.model, Kernel(sim.model, sim.initial.state, sim.initial.p, "never"), sim.p)
    u = np.array([sim.get(COMMAND)])
    exact = NMPC(mode="converged", tolerance=1e-10).start(problem, surroundings, plant)
    expected = exact.solve(Sample(0.0, {}, True, sim.state, sim.p), u)
    for relinearise in ("once", "every"):
        solver = Linear(relinearise=relinearise).start(problem, surroundings, None)
        solution = solver.solve(Sample(0.0, measured(sim)), u)
        moves, wanted = solution.u - u, expected.u - u
        assert np.abs(wanted).max() > 1e-3
        assert (
            np.abs(moves - wanted).max() < 2e-5 * np.abs(wanted).max()
        )  # measured 5e-6, ten times that with ten times the step
        assert solution.cost == pytest.approx(expected.cost, rel=2e-5)  # measured 4e-6


def test_relinearised_every_sample_it_stays_with_nmpc_along_a_small_swing():
    """Both in closed loop on the same plant, whose parameters the model has right."""
    kick = [
        Change(0.2, {"unit.G2.governor.p_m": 0.87}, "more"),
        Change(0.3, {"unit.G2.governor.p_m": 0.86}, "as before"),
    ]
    exact = run(kick, backend="nmpc", options={"mode": "converged"})
    linear = run(kick, options={"relinearise": "every"})
    moved = np.ptp(sent(exact))
    assert moved > 0.02
    later = slice(12, None)  # the torque is not known to it before it shows
    assert np.abs(sent(linear) - sent(exact))[later].max() < 0.1 * moved  # measured 0.04


@pytest.mark.parametrize(
    "changes", [{}, {"N_c": 3, "du_max": 0.3, "soft": ({"signal": "i_fd", "upper": 2.5, "weight": 1e3},)}]
)
def test_another_solver_gives_the_same_plans(changes):
    commands = [sent(run(FAULT, options={"solver": name}, **changes)) for name in ("proxqp", "daqp")]
    assert np.abs(commands[0] - commands[1]).max() < 1e-6  # measured 1.5e-8
    assert np.ptp(commands[0]) > 0.5


def test_bounds_hold():
    trace = run(FAULT, N_c=3, du_max=0.3, u_max=2.4, u_min=1.5).trace()
    assert trace[COMMAND].max() <= 2.4
    assert trace[COMMAND].min() >= 1.5
    assert np.abs(np.diff(trace[COMMAND])).max() <= 0.3 + 1e-8


def test_a_limit_of_the_model_does_not_lock_the_command():
    """Beyond the ceiling the command has no effect in a model linearised there; it must come back all the same."""
    system = regulated(transfer=FieldTransfer(V_RMIN=-2.0, V_RMAX=2.4))
    sim = run(FAULT, t_end=6.0, system=system)
    trace = sim.trace()
    assert trace["unit.G2.transfer.e_fd_cmd"].max() > 2.4 + 0.1
    assert trace["unit.G2.e_fd"].max() <= 2.4 + 1e-9
    assert deviation(sim, 5.0) < 2e-3  # measured 4e-4


def test_a_known_change_at_a_sample_is_expected_in_what_is_measured_there():
    """Both changes of the fault fall on samples: the measurements are of the network after them, and surprise nobody."""
    surprised, known = (run(FAULT, t_end=1.0, disturbance_known=flag).trace() for flag in (False, True))
    innovations = [trace["controller.mpc.innovation"][trace.t < 0.5].max() for trace in (surprised, known)]
    assert innovations[0] > 2.0  # measured 2.16 pu
    assert innovations[1] < 0.1  # measured 0.045
    cleared = (known.t > 0.3) & (known.t < 0.4)
    assert known[COMMAND][cleared].min() > 2.0  # measured 2.2: it goes on supporting the voltage


def test_a_known_fault_costs_less():
    surprised, known = (run(FAULT, t_end=3.0, disturbance_known=flag) for flag in (False, True))
    costs = [sim.result().controllers["mpc"].cost for sim in (surprised, known)]
    assert costs[1] < 0.98 * costs[0]  # measured 0.969


def test_computing_delay_is_compensated():
    prompt, delayed = (run(FAULT, t_end=4.0, delayed=flag) for flag in (False, True))
    costs = [sim.result().controllers["mpc"].cost for sim in (prompt, delayed)]
    assert costs[0] < costs[1] < 1.01 * costs[0]  # measured 1.0046


@pytest.mark.parametrize("controller", [{}, {"delayed": True}, {"relinearise": "once"}])
def test_a_delay_that_is_known_is_made_up_for(controller):
    """A step of the reference that meets a right model: what is predicted over the delay is what happens."""
    options = {key: controller[key] for key in controller if key == "relinearise"}
    rest = {key: controller[key] for key in controller if key != "relinearise"} | {"V_ref_steps": ((0.3, 1.005),)}
    late = Measurement(delay=2)
    prompt, known, unknown = (
        run(t_end=2.0, options=options, **rest, **more)
        for more in ({}, {"measurement": late, "known_delay": 2}, {"measurement": late})
    )
    gaps = [np.abs(sim.trace()["unit.G2.v_t"] - prompt.trace()["unit.G2.v_t"]).max() for sim in (known, unknown)]
    assert gaps[0] < 1e-4
    assert gaps[1] > 10 * gaps[0]


# When the model is linearised.


def test_the_model_is_linearised_when_it_is_said_to_be():
    def ages(**options):
        trace = run(FAULT, t_end=1.0, options=options).trace()
        return trace["controller.mpc.age"][np.isfinite(trace["controller.mpc.age"])]

    assert set(ages(relinearise="every")) == {0}
    assert ages(relinearise="once").max() == 20
    assert ages(relinearise="scheduled", every=4).max() == 3


def test_at_another_operating_point_relinearising_pays():
    change = [Change(0.5, {"unit.G2.governor.p_m": 0.3}, "the turbine gives less")]
    once, every = (run(change, t_end=5.0, options={"relinearise": mode}) for mode in ("once", "every"))
    assert area(every) < 0.5 * area(once)  # measured 0.29


# What it measures.


@pytest.mark.parametrize("relinearise", ["once", "every"])
def test_lost_samples_are_left_out(relinearise):
    options = {"relinearise": relinearise}
    whole = run(FAULT, t_end=4.0, options=options)
    lossy = run(FAULT, t_end=4.0, options=options, measurement=Measurement(loss=0.3, seed=3), max_age=20)
    assert np.isnan(lossy.trace()["controller.mpc.innovation"]).sum() > 100
    assert area(lossy) < 1.25 * area(whole)  # measured 1.00 (once) and 1.12 (every)
    assert lossy.result().controllers["mpc"].fallbacks == 0


def test_a_lost_sample_is_bridged_by_the_model():
    """With a right model and nothing unforeseen, the plan without the measurement is the plan with it."""
    sim = simulation(V_ref_steps=((0.1, 1.01),))
    sim.run(until=0.2)
    session = sim._running["mpc"].session
    memory = {key: np.array(value) for key, value in session.solver.memory().items()}
    u = np.array([sim.get(COMMAND)])
    seen = session.solver.solve(Sample(0.2, measured(sim)), u).u
    session.solver.recall(memory)
    blind = session.solver.solve(Sample(0.2, dict.fromkeys(measured(sim), np.nan)), u).u
    assert np.abs(seen - u).max() > 1e-2
    assert np.abs(seen - blind).max() < 5e-3


def test_told_of_noise_it_keeps_the_field_quieter():
    noise = Measurement(noise=0.01, noise_omega=1e-4, seed=2)
    told = {"sigma": 0.01, "sigma_omega": 1e-4, "drift": 1e-3}
    rough, quiet = (run(t_end=4.0, measurement=noise, options=options) for options in ({}, told))
    moves = [np.abs(np.diff(sim.trace()[COMMAND])).sum() for sim in (rough, quiet)]
    assert moves[1] < 0.2 * moves[0]  # measured 0.10
    assert deviation(quiet, 1.0) < 0.01  # measured 0.0066, of instruments good to 0.01


@pytest.mark.parametrize("extra", [{"delay": 1}, {"noise": 0.01, "noise_omega": 1e-4, "loss": 0.1}])
@pytest.mark.parametrize("model", MISMATCHES.values(), ids=MISMATCHES)
def test_bad_instruments_and_a_wrong_model_together_do_not_unsettle_it(model, extra):
    options = {"model": model} | ({"sigma": 0.01, "sigma_omega": 1e-4, "drift": 1e-3} if "noise" in extra else {})
    sim = run(FAULT, t_end=6.0, options=options, measurement=Measurement(**extra))
    assert deviation(sim, 5.0) < 0.01  # measured 0.002 with the delay, 0.005 with noise and losses


class _Poisoned:
    """Whatever is looked up in it ends the test."""

    def __getattribute__(self, name: str) -> NoReturn:
        raise AssertionError(f"the controller looked at the plant: {name}")


def test_it_never_sees_the_plant():
    sim = simulation(FAULT)
    assert sim._running["mpc"].controller.information == "measured"
    problem, surroundings = problem_at_rest(sim)
    honest = Linear().start(problem, surroundings, None)
    tempted = Linear().start(problem, surroundings, _Poisoned())
    sim.run(until=0.4)
    u = np.array([sim.get(COMMAND)])
    for t in (0.0, 0.05):
        plain = honest.solve(Sample(t, measured(sim)), u)
        shown = tempted.solve(Sample(t, measured(sim), True, _Poisoned(), _Poisoned()), u)
        assert np.array_equal(plain.u, shown.u)
    samples = []
    session = sim._running["mpc"].session
    solve = session.solver.solve
    session.solver.solve = lambda sample, u: samples.append(sample) or solve(sample, u)
    sim.run(until=0.6)
    assert samples
    assert all(sample.state is None and sample.p is None for sample in samples)


def test_what_the_plant_is_like_does_not_reach_the_model():
    """The same measurements give the same plans whatever plant they come from."""
    plans = []
    for X in (0.15, 0.3):
        sim = Simulation(kobbelv(), Settings(1.0, H, "tr_bdf2", "never"))
        sim.set("line.L1.X", X)
        problem, surroundings = problem_at_rest(sim)
        solver = Linear().start(problem, surroundings, None)
        seen = {"v_t": 0.95, "omega": 1.001, "p_e": 0.8, "q_e": 0.4, "e_fd": 1.9, "i_fd": 1.95}
        sample = Sample(0.0, {f"unit.G2.{name}": value for name, value in seen.items()})
        plans.append(solver.solve(sample, np.array([1.9])).u)
    assert np.array_equal(*plans)


def test_nonsense_is_not_followed_and_not_kept():
    sim = simulation()
    sim.run(until=0.2)
    solver = sim._running["mpc"].session.solver
    u = np.array([sim.get(COMMAND)])
    for value in (1e200, 1e4, -np.inf):
        nonsense = solver.solve(Sample(0.2, dict.fromkeys(measured(sim), value)), u)
        assert nonsense.status is Status.STATE_UNKNOWN
    sane = solver.solve(Sample(0.25, measured(sim)), u)
    assert sane.status is Status.CONVERGED
    assert np.abs(sane.u - u).max() < 1e-6


# In a run.


@pytest.mark.parametrize(
    ("options", "controller"),
    [
        ({"relinearise": "once"}, {}),
        ({"relinearise": "every"}, {"disturbance_known": True}),
        ({"relinearise": "scheduled", "every": 7}, {"delayed": True}),
        ({}, {"known_delay": 1}),
    ],
)
def test_a_resumed_run_goes_on_to_the_last_bit(tmp_path, options, controller):
    def fresh():
        instruments = Measurement(noise=0.005, loss=0.2, delay=1)
        return simulation(FAULT, 1.0, None, options, N_c=2, measurement=instruments, **controller)

    whole, first, second = fresh(), fresh(), fresh()
    whole.run()
    first.run(until=0.22)
    first.save(tmp_path / "snapshot.npz")
    second.resume(tmp_path / "snapshot.npz")
    second.run()
    assert np.array_equal(whole.state.x, second.state.x)
    assert np.array_equal(whole.state.u, second.state.u)


def over(t, to):
    return HandOver(type="hand_over", t=t, controller="mpc", to=to).changes()[0]


def test_it_follows_on_standby_and_takes_over_without_a_bump():
    system = regulated(transfer=FieldTransfer(V_RMIN=-3.85, V_RMAX=3.85))
    at_rest = run([over(0.5, "controller"), over(1.5, "classical")], 2.0, system, active=False)
    assert np.ptp(at_rest.trace()["unit.G2.e_fd"]) < 1e-6  # measured 1e-11
    sim = run([*FAULT, over(0.6, "controller")], 6.0, system, active=False)
    trace = sim.trace()
    at = np.searchsorted(trace.t, 0.6 - 1e-9)
    # The estimator was in step by then: its first innovations in charge are no larger than those just before.
    innovation = trace["controller.mpc.innovation"]
    assert np.nanmax(innovation[at : at + 40]) < 1.5 * np.nanmax(innovation[at - 40 : at])
    assert deviation(sim, 5.0) < 3e-3


def test_refusals_say_what_to_do():
    def start(**options):
        simulation(options=options)

    with pytest.raises(ValidationError, match="did you mean 'proxqp'"):
        start(solver="proxpq")
    with pytest.raises(ValidationError, match="known to qpsolvers but not installed"):
        start(solver="gurobi")
    with pytest.raises(ConfigError, match=r"options\.model\.line\.L1\.Y: there is no such parameter.*'line\.L1\.X'"):
        start(model={"line.L1.Y": 0.3})
    with pytest.raises(ConfigError, match=r"unit\.G2\.machine\.H: should be greater than 0"):
        start(model={"unit.G2.machine.H": -1.0})
    with pytest.raises(ConfigError, match=r"cannot tell .*p_e.* apart at rest"):
        start(disturbances=("v_t", "p_e", "q_e", "i_fd", "torque"))
