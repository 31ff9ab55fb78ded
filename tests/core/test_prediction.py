"""Predictions are the plant's own steps, and their sensitivities are those of the discrete-time plant."""

from __future__ import annotations

import numpy as np
import pytest
from plants import kobbelv, regulated

from pgexcite.core.compiling import compiler
from pgexcite.core.events import Fault
from pgexcite.core.prediction import Predictor
from pgexcite.core.rollout import Horizon
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.step import Kernel

MOVES = np.array([[2.5], [1.0], [2.2]])
IN_FORCE = [0, 1, 2, 2, 2]
FAULT = Fault(type="fault", t=0.1, bus="HV", R=0.02, duration=0.1)
RULES = ["trapezoidal", "tr_bdf2", "backward_euler"]


def swinging(rule, command="unit.G2.exciter.e_fd_ref", compiled="never", t=0.3, transitions=False):
    """A plant in mid-swing and a predictor of it."""
    system = kobbelv() if command.endswith("e_fd_ref") else regulated()
    sim = Simulation(system, Settings(1.0, 0.005, rule, "never"), FAULT.changes())
    sim.run(until=t)
    model = sim.model
    kernel = Kernel(model, sim.initial.state, sim.initial.p, compiled)
    outputs = [model.position("y", f"unit.G2.{name}") for name in ("v_t", "omega", "delta", "i_fd")]
    return sim, Predictor(kernel, [model.position("u", command)], outputs, 3, rule, transitions=transitions)


def roll(sim, predictor, moves, derivatives=False):
    horizon = Horizon.plain(10, 0.005, IN_FORCE, sim.state, sim.p)
    return predictor.roll(sim.state, moves, horizon, derivatives=derivatives)


@pytest.mark.parametrize("rule", RULES)
def test_prediction_is_what_the_simulation_does(rule):
    sim, predictor = swinging(rule)
    predicted = roll(sim, predictor, MOVES).y
    for k, move in enumerate(MOVES.ravel()):
        sim.set("unit.G2.exciter.e_fd_ref", move)
        sim.run(until=0.3 + 0.05 * (k + 1))
        assert sim.get("unit.G2.v_t") == predicted[k, 0]
        assert sim.get("unit.G2.delta") == predicted[k, 2]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(
    ("command", "moves"),
    [("unit.G2.exciter.e_fd_ref", MOVES), ("unit.G2.exciter.v_ref", np.array([[1.011], [1.009], [1.0105]]))],
)
@pytest.mark.parametrize("t", [0.15, 0.4])  # during the fault and after it
def test_sensitivities_match_finite_differences(rule, command, moves, t):
    sim, predictor = swinging(rule, command, t=t)
    exact = roll(sim, predictor, moves, derivatives=True).dy
    e = 1e-6
    for k in range(3):
        up, down = moves.copy(), moves.copy()
        up[k] += e
        down[k] -= e
        numeric = (roll(sim, predictor, up).y - roll(sim, predictor, down).y) / (2 * e)
        # measured 3e-8 at most, of derivatives up to 5
        assert np.abs(exact[:, :, k] - numeric).max() < 1e-6 * max(1.0, np.abs(numeric).max())


def test_moves_do_not_act_backwards():
    sim, predictor = swinging("tr_bdf2")
    dy = roll(sim, predictor, MOVES, derivatives=True).dy
    assert np.all(dy[0, :, 1:] == 0)
    assert np.all(dy[1, :, 2] == 0)
    assert np.all(np.abs(dy[2, 0]) > 0)


@pytest.mark.parametrize("rule", RULES)
def test_chained_transitions_are_the_direct_derivatives(rule):
    sim, direct = swinging(rule)
    _, chained = swinging(rule, transitions=True)
    a, b = roll(sim, direct, MOVES, derivatives=True), roll(sim, chained, MOVES, derivatives=True)
    assert np.array_equal(a.y, b.y)
    assert np.abs(a.dy - b.dy).max() < 1e-12  # measured 2e-15


@pytest.mark.parametrize("rule", RULES)
def test_derivatives_to_the_initial_states_match_finite_differences(rule):
    sim, predictor = swinging(rule, transitions=True)
    exact = roll(sim, predictor, MOVES, derivatives=True).dx
    horizon, e = Horizon.plain(10, 0.005, IN_FORCE, sim.state, sim.p), 1e-6
    for k in range(sim.state.x.size):
        ends = []
        for sign in (1, -1):
            x = sim.state.x.copy()
            x[k] += sign * e
            state = sim.kernel.settle(sim.state.with_(x=x), sim.p).with_(startup=sim.state.startup)
            ends.append(predictor.roll(state, MOVES, horizon, derivatives=False).y)
        numeric = (ends[0] - ends[1]) / (2 * e)
        assert np.abs(exact[:, :, k] - numeric).max() < 1e-6 * max(1.0, np.abs(numeric).max())  # measured 5e-9


@pytest.mark.parametrize("transitions", [False, True])
@pytest.mark.parametrize("rule", RULES)
def test_a_known_disturbance_inside_a_sample(rule, transitions):
    """A fault that begins and ends within the horizon, not at the ends of samples, is predicted as the simulation runs it."""
    sim, predictor = swinging(rule, t=0.05, transitions=transitions)
    faulted = sim.p.copy()
    for path, value in FAULT.changes()[0].values.items():
        faulted[sim.model.position("p", path)] = value
    pieces = [
        (10, 0, 0, 1),
        (4, 1, 1, 0),
        (6, 1, 1, 1),
        (10, 2, 1, 1),
        (4, 2, 1, 0),
        (6, 2, 0, 1),
    ]  # steps, move, row, end
    sim.restart(Fault(type="fault", t=0.1, bus="HV", R=0.02, duration=0.12).changes())
    sim.run(until=0.05)
    counts, moves, rows, ends = (np.array(column, dtype=np.int32) for column in zip(*pieces, strict=True))
    p, u = np.vstack((sim.p, faulted)), np.vstack((sim.state.u, sim.state.u))
    horizon = Horizon(counts, np.full(len(pieces), 0.005), moves, rows, ends, p, u)
    predicted = predictor.roll(sim.state, MOVES, horizon, derivatives=True)
    start, e = sim.state, 1e-6
    for k in range(3):
        up, down = MOVES.copy(), MOVES.copy()
        up[k] += e
        down[k] -= e
        ys = [predictor.roll(start, m, horizon, derivatives=False).y for m in (up, down)]
        assert np.abs((ys[0] - ys[1]) / (2 * e) - predicted.dy[:, :, k]).max() < 1e-6
    for k, move in enumerate(MOVES.ravel()):
        sim.set("unit.G2.exciter.e_fd_ref", move)
        sim.run(until=0.05 * (k + 2))
        assert sim.get("unit.G2.v_t") == pytest.approx(predicted.y[k, 0], abs=1e-12)
        assert sim.get("unit.G2.delta") == pytest.approx(predicted.y[k, 2], abs=1e-12)


@pytest.mark.compiler
@pytest.mark.parametrize("transitions", [False, True])
@pytest.mark.parametrize("rule", RULES)
def test_c_gives_the_same_numbers(rule, transitions):
    assert compiler(), "this test needs a C compiler"
    sim, in_vm = swinging(rule, transitions=transitions)
    _, in_c = swinging(rule, compiled="always", transitions=transitions)
    a, b = roll(sim, in_vm, MOVES, derivatives=True), roll(sim, in_c, MOVES, derivatives=True)
    assert np.abs(a.y - b.y).max() < 1e-9  # measured 0
    assert np.abs(a.dy - b.dy).max() < 1e-9  # measured 0
    # Without derivatives, in a library that has not computed any.
    _, in_c = swinging(rule, compiled="always", transitions=transitions)
    assert np.array_equal(roll(sim, in_c, MOVES).y, b.y)


def test_a_horizon_that_cannot_be_stepped_gives_no_prediction():
    sim, predictor = swinging("tr_bdf2")
    assert roll(sim, predictor, np.full((3, 1), np.nan), derivatives=True) is None
