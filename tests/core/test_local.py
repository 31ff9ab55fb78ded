"""Linear predictions: transitions against finite differences, chained ones against the exact sensitivities at rest."""

from __future__ import annotations

import numpy as np
import pytest
from plants import kobbelv, regulated

from pgexcite.core.initialise import initialise
from pgexcite.core.local import LocalModel
from pgexcite.core.prediction import Predictor
from pgexcite.core.rollout import Horizon
from pgexcite.core.step import Kernel
from pgexcite.plugins.transfers.field import FieldTransfer

H = 0.005
OUTPUTS = ("unit.G2.v_t", "unit.G2.omega", "unit.G2.q_e", "unit.G2.i_fd", "unit.G2.delta")


def build(rule="tr_bdf2", compile="never"):
    initial = initialise(kobbelv())
    model = initial.model
    kernel = Kernel(model, initial.state, initial.p, compile)
    commands = [model.position("u", "unit.G2.exciter.e_fd_ref"), model.position("u", "unit.G2.governor.p_m")]
    outputs = [model.position("y", path) for path in OUTPUTS]
    predictor = Predictor(kernel, commands, outputs, 3, rule, transitions=True)
    return initial, kernel, commands, outputs, predictor


def away_from_rest(initial, kernel):
    x = initial.state.x.copy()
    x[initial.model.position("x", "unit.G2.machine.delta")] += 0.4
    x[initial.model.position("x", "unit.G2.machine.omega")] += 0.003
    return kernel.settle(initial.state.with_(x=x), initial.p)


@pytest.mark.parametrize("rule", ["tr_bdf2", "trapezoidal", "backward_euler"])
@pytest.mark.parametrize("compile", ["never", pytest.param("always", marks=pytest.mark.compiler)])
def test_transitions_are_the_derivatives_of_the_steps(rule, compile):
    initial, kernel, commands, outputs, predictor = build(rule, compile)
    start = away_from_rest(initial, kernel)
    found = predictor.transition(start, initial.p, 10, H)

    def ends(x, u):
        settled = kernel.settle(start.with_(x=x, u=u), initial.p)
        segment = kernel.advance(settled, initial.p, rule, H, 10)
        return segment.state.x, segment.y[-1][outputs], segment.state

    x_end, y_end, last = ends(start.x, start.u)
    assert np.array_equal(found.x, x_end)
    assert np.abs(found.y - y_end).max() < 1e-13
    e = 1e-6
    for k in range(start.x.size):
        step = np.eye(start.x.size)[k] * e
        up, down = ends(start.x + step, start.u), ends(start.x - step, start.u)
        assert np.abs(found.A[:, k] - (up[0] - down[0]) / (2 * e)).max() < 1e-6  # measured 5e-8
        outputs_at = [
            kernel.outputs(kernel.settle(last.with_(x=last.x + s), initial.p), initial.p)[outputs]
            for s in (step, -step)
        ]
        assert np.abs(found.C[:, k] - (outputs_at[0] - outputs_at[1]) / (2 * e)).max() < 1e-6
    for k, command in enumerate(commands):
        step = np.eye(start.u.size)[command] * e
        up, down = ends(start.x, start.u + step), ends(start.x, start.u - step)
        assert np.abs(found.B[:, k] - (up[0] - down[0]) / (2 * e)).max() < 1e-6
        total = found.C @ found.B[:, k] + found.D[:, k]
        assert np.abs(total - (up[1] - down[1]) / (2 * e)).max() < 1e-6


def test_at_rest_the_chain_is_that_of_the_exact_sensitivities():
    initial, kernel, commands, _, predictor = build()
    local = LocalModel(kernel, commands, predictor, kernel.settle(initial.state, initial.p))
    plan = np.tile(initial.state.u[commands], (3, 1))
    horizon = Horizon.plain(10, H, [0, 1, 2, 2, 2], initial.state, initial.p)
    y, G = local.predict(horizon, initial.state.x, plan, np.zeros(initial.state.x.size))
    exact = predictor.roll(initial.state, plan, horizon, derivatives=True)
    assert np.abs(y - exact.y).max() < 1e-12
    assert np.abs(G - exact.dy).max() < 1e-9 * np.abs(G).max()


def test_away_from_rest_the_first_sample_is_exact_and_pieces_add_up():
    initial, kernel, commands, outputs, predictor = build()
    start = away_from_rest(initial, kernel)
    local = LocalModel(kernel, commands, predictor, start)
    whole = Horizon.plain(10, H, [0], start, initial.p)
    exact = kernel.advance(start, initial.p, "tr_bdf2", H, 10)
    one = local.sample(whole, start.x, start.u[commands])
    assert np.abs(one.y - exact.y[-1][outputs]).max() < 1e-12
    split = Horizon(
        np.array([4, 6], dtype=np.int32),
        np.full(2, H),
        np.zeros(2, dtype=np.int32),
        np.zeros(2, dtype=np.int32),
        np.array([0, 1], dtype=np.int32),
        whole.p,
        whole.u,
    )
    two = local.sample(split, start.x, start.u[commands])
    # Both pieces are linearised at the point, so the second one does not know where the first has led: a small difference.
    assert np.abs(one.y - two.y).max() < 2e-3  # measured 4e-4
    plan = start.u[commands][None]
    assert np.abs(local.predict(split, start.x, plan, np.zeros(start.x.size))[0][0] - two.y).max() < 1e-12


def test_outputs_in_another_network_are_those_after_the_change():
    """A fault at the point itself, and states a little beside it."""
    initial, kernel, commands, outputs, predictor = build()
    start = away_from_rest(initial, kernel)
    local = LocalModel(kernel, commands, predictor, start)
    p = initial.p.copy()
    p[[initial.model.position("p", f"bus.HV.fault_{name}") for name in ("status", "R")]] = 1.0, 0.02
    u = start.u.copy()
    u[commands[0]] += 0.3
    for beside, off in ((0.0, 1e-12), (1e-3, 1e-5)):  # measured below 1e-14, and 2e-6: second order
        x = start.x + beside * np.sign(np.sin(np.arange(start.x.size) + 1.0)) * kernel.mass.astype(bool)
        exact = kernel.outputs(kernel.settle(start.with_(x=x, u=u), p), p)[outputs]
        y, C = local.outputs(x, u[commands], start.u, p)
        assert np.abs(y - exact).max() < off
        assert C.shape == (len(outputs), start.x.size)


def test_a_push_moves_the_states_at_the_end_of_every_sample():
    initial, kernel, commands, _, predictor = build()
    local = LocalModel(kernel, commands, predictor, kernel.settle(initial.state, initial.p))
    plan = np.tile(initial.state.u[commands], (3, 1))
    push = np.zeros(initial.state.x.size)
    push[initial.model.position("x", "unit.G2.machine.omega")] = 1e-3
    y = local.predict(Horizon.plain(10, H, [0, 1, 2], initial.state, initial.p), initial.state.x, plan, push)[0]
    assert y[0, 1] - 1.0 == pytest.approx(1e-3, rel=1e-6)
    assert y[1, 1] - 1.0 > 1.5e-3


def test_rows_without_mass_and_inert_states_are_carried_along():
    """A field transfer in manual has a state without dynamics, the infinite bus one that never moves."""
    initial = initialise(regulated(transfer=FieldTransfer(V_RMIN=-3.85, V_RMAX=3.85)))
    model = initial.model
    kernel = Kernel(model, initial.state, initial.p, "never")
    u = initial.state.u.copy()
    u[model.position("u", "unit.G2.transfer.manual")] = 1.0
    point = kernel.settle(initial.state.with_(u=u), initial.p)
    command = model.position("u", "unit.G2.transfer.e_fd_cmd")
    predictor = Predictor(kernel, [command], [model.position("y", "unit.G2.v_t")], 1, "tr_bdf2", transitions=True)
    step = predictor.transition(point, initial.p, 10, H)
    inert = model.position("x", "infinite_bus.grid.theta")
    assert np.abs(step.A[inert] - np.eye(step.x.size)[inert]).max() < 1e-14
    massless = model.position("x", "unit.G2.transfer.b")
    assert not step.A[:, massless].any()
    assert step.B[massless, 0] != 0
    assert step.B[model.position("x", "unit.G2.machine.ep_q"), 0] > 0
