"""Predictions are the plant's own steps, and their sensitivities are those of the discrete-time plant."""

from __future__ import annotations

import numpy as np
import pytest
from plants import kobbelv, regulated

from pgexcite.core.codegen import compiler
from pgexcite.core.events import Fault
from pgexcite.core.prediction import Predictor
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.step import Kernel

MOVES = np.array([[2.5], [1.0], [2.2]])
IN_FORCE = np.array([0, 1, 2, 2, 2])
COUNTS = [10] * 5
LENGTHS = [0.005] * 5
FAULT = Fault(type="fault", t=0.1, bus="HV", R=0.02, duration=0.1)
RULES = ["trapezoidal", "tr_bdf2", "backward_euler"]


def swinging(rule, command="unit.G2.exciter.e_fd_ref", compiled="never", t=0.3):
    """A plant in mid-swing and a predictor of it."""
    system = kobbelv() if command.endswith("e_fd_ref") else regulated()
    sim = Simulation(system, Settings(1.0, 0.005, rule, "never"), FAULT.changes())
    sim.run(until=t)
    model = sim.model
    kernel = Kernel(model, sim.initial.state, sim.initial.p, compiled)
    outputs = [model.position("y", f"unit.G2.{name}") for name in ("v_t", "omega", "delta", "i_fd")]
    return sim, Predictor(kernel, [model.position("u", command)], outputs, 3, rule)


def roll(sim, predictor, moves, derivatives=False):
    return predictor.roll(sim.state, sim.p, moves, COUNTS, LENGTHS, IN_FORCE, derivatives=derivatives)


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


@pytest.mark.compiler
@pytest.mark.parametrize("rule", RULES)
def test_c_gives_the_same_numbers(rule):
    assert compiler(), "this test needs a C compiler"
    sim, in_vm = swinging(rule)
    _, in_c = swinging(rule, compiled="always")
    a, b = roll(sim, in_vm, MOVES, derivatives=True), roll(sim, in_c, MOVES, derivatives=True)
    assert np.abs(a.y - b.y).max() < 1e-9  # measured 0
    assert np.abs(a.dy - b.dy).max() < 1e-9  # measured 0


def test_a_horizon_that_cannot_be_stepped_gives_no_prediction():
    sim, predictor = swinging("tr_bdf2")
    assert (
        predictor.roll(sim.state, sim.p, np.full((3, 1), np.nan), COUNTS, LENGTHS, IN_FORCE, derivatives=True) is None
    )
