"""The perfect-model NMPC: its QP, its convergence, and the same problem solved by an independent NLP solver."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from plants import kobbelv, voltage_problem

from pgexcite.core.controller import Plant, Sample, Surroundings
from pgexcite.core.errors import ConfigError
from pgexcite.core.events import Fault
from pgexcite.core.mpc import Status
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.step import Kernel
from pgexcite.plugins.mpc_backends.nmpc import NMPC

FAULT = Fault(type="fault", t=0.1, bus="HV", R=0.02, duration=0.1)
COMMAND = "unit.G2.exciter.e_fd_ref"
H = 0.005


def make(t, rule="tr_bdf2", mismatch=None, **changes):
    """The plant at ``t`` of a fault run, the problem, and a solver of it."""
    sim = Simulation(kobbelv(), Settings(1.0, H, rule, "never"), FAULT.changes())
    sim.run(until=t)
    model = sim.model
    problem = voltage_problem(COMMAND, **changes)
    surroundings = Surroundings(H, rule, dict(zip(model.u_names, sim.state.u, strict=True)), {}, model.system)
    plant = Plant(model, Kernel(model, sim.initial.state, sim.initial.p, "never"), sim.p)
    options = NMPC(mode="converged", max_iterations=100, tolerance=1e-9, mismatch=mismatch or {})
    solver = options.start(problem, surroundings, plant)
    return sim, problem, solver


def solve(sim, solver):
    u = np.array([sim.get(COMMAND)])
    return u, solver.solve(Sample(sim.state.t, {}, True, sim.state, sim.p), u)


def gradient(sim, problem, plan, u_last):
    """Gradient of the true cost by central differences of plain simulation runs."""

    def cost(moves):
        kernel, state, total, last = sim.kernel, sim.state, 0.0, u_last[0]
        k = sim.model.position("u", COMMAND)
        for j in range(problem.N_p):
            value = moves[min(j, problem.N_c - 1), 0]
            if value != state.u[k]:
                u = state.u.copy()
                u[k] = value
                state = kernel.settle(state.with_(u=u), sim.p)
            state = kernel.advance(state, sim.p, "tr_bdf2", H, round(problem.dt / H)).state
            y = kernel.outputs(state, sim.p)
            v, omega = y[sim.model.position("y", "unit.G2.v_t")], y[sim.model.position("y", "unit.G2.omega")]
            total += problem.Q[0] * (1.0 - v) ** 2 + problem.P[0] * (1 - omega) ** 2
        for j in range(problem.N_c):
            total += problem.R[0] * (moves[j, 0] - last) ** 2
            last = moves[j, 0]
        return total

    e, result = 1e-5, []
    for j in range(problem.N_c):
        up, down = plan.copy(), plan.copy()
        up[j] += e
        down[j] -= e
        result.append((cost(up) - cost(down)) / (2 * e))
    return np.array(result), cost(plan)


@pytest.mark.parametrize("t", [0.12, 0.22, 0.4])
@pytest.mark.parametrize("weights", [{}, {"Q": np.array([3.0]), "R": np.array([1.0])}])
def test_converged_plan_satisfies_the_optimality_conditions_of_the_true_problem(t, weights):
    sim, problem, solver = make(t, **weights)
    u_last, solution = solve(sim, solver)
    assert solution.status is Status.CONVERGED
    slope, cost = gradient(sim, problem, solution.u, u_last)
    assert solution.cost == pytest.approx(cost, rel=1e-12)
    plan, scale = solution.u.ravel(), max(1.0, abs(cost))
    inside = (plan > -3.2 + 1e-9) & (plan < 3.2 - 1e-9)
    assert np.all(np.abs(slope[inside]) < 1e-5 * scale)  # measured 2e-7
    assert np.all(slope[plan >= 3.2 - 1e-9] <= 1e-6)
    assert np.all(slope[plan <= -3.2 + 1e-9] >= -1e-6)


def ipopt_plan(sim, problem, u_last):
    """The same discretised problem as one sparse NLP: every TR-BDF2 stage of every step an equality, solved by ipopt."""
    model, rule_gamma = sim.model, 2 - np.sqrt(2)
    alpha, beta = 1 / (rule_gamma * (2 - rule_gamma)), (1 - rule_gamma) ** 2 / (rule_gamma * (2 - rule_gamma))
    n_x, n_z = len(model.x_names), len(model.z_names)
    k = model.position("u", COMMAND)
    iv, iw = model.position("y", "unit.G2.v_t"), model.position("y", "unit.G2.omega")
    U = [ca.MX.sym(f"u{j}") for j in range(problem.N_c)]
    unknowns, start, equalities, cost = list(U), [u_last[0]] * problem.N_c, [], 0
    x, z, guess = ca.DM(sim.state.x), ca.DM(sim.state.z), sim.state
    c = rule_gamma * H / 2
    for j in range(problem.N_p):
        u = ca.vertcat(
            *[U[min(j, problem.N_c - 1)] if i == k else float(sim.state.u[i]) for i in range(sim.state.u.size)]
        )
        for _ in range(round(problem.dt / H)):
            f0, mass = model.dae(x, z, model.d_0, u, sim.p)[:2]
            guess = sim.kernel.advance(guess, sim.p, "tr_bdf2", H, 1).state
            stages = []
            for _ in range(2):
                xs, zs = ca.MX.sym("x", n_x), ca.MX.sym("z", n_z)
                unknowns += [xs, zs]
                start += [*guess.x, *guess.z]
                stages.append((xs, zs))
            (xm, zm), (x1, z1) = stages
            fm, _, _, _, gm, *_ = model.dae(xm, zm, model.d_0, u, sim.p)
            f1, _, _, _, g1, *_ = model.dae(x1, z1, model.d_0, u, sim.p)
            equalities += [mass * (xm - x) - c * (f0 + fm), gm, mass * (x1 - alpha * xm + beta * x) - c * f1, g1]
            x, z = x1, z1
        y = model.dae(x, z, model.d_0, u, sim.p)[5]
        cost += problem.Q[0] * (1.0 - y[iv]) ** 2 + problem.P[0] * (1 - y[iw]) ** 2
    last = u_last[0]
    for move in U:
        cost += problem.R[0] * (move - last) ** 2
        last = move
    w = ca.vertcat(*unknowns)
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.tol": 1e-11, "ipopt.bound_relax_factor": 0.0}
    solver = ca.nlpsol("nlp", "ipopt", {"x": w, "f": cost, "g": ca.vertcat(*equalities)}, options)
    n = w.numel()
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    low[: problem.N_c], high[: problem.N_c] = problem.u_min[0], problem.u_max[0]
    found = solver(x0=start, lbx=low, ubx=high, lbg=0, ubg=0)
    assert solver.stats()["success"]
    return np.array(found["x"]).ravel()[: problem.N_c], float(found["f"])


@pytest.mark.parametrize("t", [0.12, 0.22, 0.4])
@pytest.mark.parametrize(
    "changes", [{"blocks": (1,)}, {"blocks": (1, 1, 1), "Q": np.array([3.0]), "R": np.array([0.1])}]
)
def test_converged_plan_is_that_of_an_independent_solver(t, changes):
    sim, problem, solver = make(t, **changes)
    u_last, solution = solve(sim, solver)
    expected, cost = ipopt_plan(sim, problem, u_last)
    assert solution.status is Status.CONVERGED
    assert np.abs(solution.u.ravel() - expected).max() < 1e-6  # measured 2e-8
    assert solution.cost == pytest.approx(cost, rel=1e-8)


def test_bounds_on_the_move_hold():
    sim, _, solver = make(0.22, du_max=np.array([0.3]))
    u_last, solution = solve(sim, solver)
    moves = np.diff(solution.u.ravel(), prepend=u_last)
    assert np.abs(moves).max() == pytest.approx(0.3, abs=1e-8)


def test_a_model_that_is_wrong_about_a_parameter_predicts_with_it_from_the_true_state():
    R = np.array([1.0])
    sim, _, solver = make(0.25, R=R)
    u, right = solve(sim, solver)
    same = make(0.25, R=R, mismatch={"line.L1.X": 0.15, "unit.G2.machine.H": 2.9})[2]
    assert np.array_equal(solve(sim, same)[1].u, right.u)
    wrong = make(0.25, R=R, mismatch={"line.L1.X": 0.3})[2]
    plan = solve(sim, wrong)[1]
    assert plan.status is Status.CONVERGED
    assert np.abs(plan.u - right.u).max() > 0.1  # measured 0.18
    elsewhere = sim.p.copy()
    elsewhere[sim.model.index["p"]["line.L1.X"]] = 0.3
    told = solver.solve(Sample(sim.state.t, {}, True, sim.state, elsewhere), u)
    assert told.u == pytest.approx(plan.u, abs=1e-6)  # the plan of a solver whose plant really is so
    assert sim.get("line.L1.X") == 0.15


def test_a_mismatch_of_a_parameter_that_does_not_exist_is_refused():
    with pytest.raises(ConfigError, match=r"options\.mismatch\.line\.L9\.X.*no such parameter"):
        make(0.0, mismatch={"line.L9.X": 0.3})


@pytest.mark.parametrize(("bound", "du_max"), [(3.2, np.inf), (-3.2, np.inf), (3.2, 0.5)])
def test_where_neither_the_old_plan_nor_holding_can_be_predicted_the_bounds_are_tried(bound, du_max, monkeypatch):
    sim, _, solver = make(0.25, du_max=np.array([du_max]))
    u = sim.get(COMMAND)
    begin = u + np.clip(bound - u, -du_max * np.arange(1, 4), du_max * np.arange(1, 4))
    roll, tried = solver.predictor.roll, []

    def fails_elsewhere(state, plan, horizon, **options):
        tried.append(plan.ravel().copy())
        near = np.allclose(plan.ravel(), begin) or len(tried) > 4
        return roll(state, plan, horizon, **options) if near else None

    monkeypatch.setattr(solver.predictor, "roll", fails_elsewhere)
    solution = solve(sim, solver)[1]
    assert any(np.allclose(plan, begin) for plan in tried)
    assert solution.status.usable
    assert np.abs(np.diff(solution.u.ravel(), prepend=u)).max() <= du_max + 1e-6
    monkeypatch.setattr(solver.predictor, "roll", lambda *_, **__: None)
    assert solve(sim, solver)[1].status is Status.PREDICTION_FAILED
