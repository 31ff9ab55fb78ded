from __future__ import annotations

import math

import numpy as np
import pytest
from component_harness import Bench, at_terminal, terminal
from hypothesis import given, settings
from hypothesis import strategies as st
from tapped import source

from pgexcite.core.declare import Kind
from pgexcite.core.initialise import initialise
from pgexcite.core.network import Bus
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.loads.exponential import AdditiveRecovery, ExponentialLoad, MultiplicativeRecovery
from pgexcite.plugins.loads.zip import ZIPLoad
from pgexcite.plugins.sources.infinite_bus import InfiniteBus

T_P, T_Q = 60.0, 40.0
FORMS = {"additive": AdditiveRecovery, "multiplicative": MultiplicativeRecovery}
every_form = pytest.mark.parametrize("form", FORMS)


def at(V, v_0=1.0, angle=0.4):
    return {"v_re": V * math.cos(angle), "v_im": V * math.sin(angle), "v_0": v_0}


@settings(deadline=None, max_examples=40)
@given(V=st.floats(0.01, 1.3), v_0=st.floats(0.5, 1.15), alpha=st.floats(0, 3))
def test_static_power_follows_the_exponent_and_changes_over(V, v_0, alpha):
    point = Bench(ExponentialLoad(P=50.0, Q=20.0, alpha=alpha, beta=2.0), S_n=200.0)(at(V, v_0))
    edge = min(0.7, v_0)
    expected = (max(V, edge) / v_0) ** alpha * (1.0 if edge <= V else (V / edge) ** 2)
    assert point.out["p"] == pytest.approx(0.25 * expected, rel=1e-12)
    assert point.out["q"] == pytest.approx(0.1 * (V / v_0) ** 2, rel=1e-9)
    v = complex(*(at(V)[name] for name in ("v_re", "v_im")))
    assert -v * point.current.conjugate() == pytest.approx(complex(point.out["p"], point.out["q"]), rel=1e-12)


def test_integer_exponents_are_the_zip_load():
    v = at(0.83, 0.97)
    mixed = ZIPLoad(P=50.0, Q=20.0, p_i=0, p_p=1, q_z=0, q_i=1)
    assert Bench(ExponentialLoad(P=50.0, Q=20.0, alpha=0.0, beta=1.0))(v).out == pytest.approx(Bench(mixed)(v).out)


@every_form
@pytest.mark.parametrize("V", [0.95, 0.6])
def test_jacobian_matches_finite_differences(form, V):
    load = FORMS[form](P=50.0, Q=20.0, alpha_t=1.8, beta_t=2.2, alpha_s=0.3)
    start = at(V) | ({"x_p": 0.1, "x_q": 0.2} if form == "additive" else {"z_p": 1.1, "z_q": 0.9})
    assert Bench(load).jacobian_error(start) < 1e-7


@every_form
def test_guess_is_the_steady_state(form):
    load = FORMS[form](P=50.0, Q=20.0)
    here = terminal(-0.5, -0.2, V=0.97, angle=0.3)
    bench = Bench(load)
    values = at_terminal(here) | {item.name: item.guess for item in type(load).variables(Kind.STATE)}
    point = bench(values | load.guess(here, {}))
    assert max(abs(r) for r in point.rhs.values()) < 1e-12
    assert point.current == pytest.approx(here.i, abs=1e-12)


def stepped(load, V, t_end=150.0, h=0.05):
    """The load on an infinite bus whose voltage steps from 1 to V at 1 s."""
    system = System(
        S_base=100.0,
        f_n=50.0,
        buses={"B": Bus()},
        devices=(
            Device("infinite_bus.grid", "B", 100.0, {"": InfiniteBus()}, Schedule(V=1.0, angle=0.0)),
            Device("load.L", "B", 100.0, {"": load}, Schedule(P=-load.P, Q=-load.Q)),
        ),
    )
    sim = Simulation(system, Settings(t_end, h, "tr_bdf2", "never"), source(1.0, V).changes())
    assert sim.run().ending.value == "completed"
    trace = sim.trace()
    after = np.flatnonzero(trace.t >= 1.0)[1:]  # from the second sample at the event on
    return trace.t[after] - 1.0, trace["load.L.p"][after], trace["load.L.q"][after]


@pytest.mark.parametrize("V", [0.95, 1.04, 0.72])
def test_additive_recovery_is_the_exponential(V):
    """P(t) = P_s + (P_t - P_s) exp(-t / T_p), exactly; and so for Q."""
    load = AdditiveRecovery(P=80.0, Q=30.0, alpha_t=1.9, alpha_s=0.4, beta_t=2.5, beta_s=0.7, T_p=T_P, T_q=T_Q)
    t, p, q = stepped(load, V)
    for y, y_0, a_t, a_s, T in ((p, 0.8, 1.9, 0.4, T_P), (q, 0.3, 2.5, 0.7, T_Q)):
        y_t, y_s = y_0 * V**a_t, y_0 * V**a_s
        assert np.abs(y - (y_s + (y_t - y_s) * np.exp(-t / T))).max() < 1e-6  # measured 3e-9


@pytest.mark.parametrize("V", [0.95, 1.04])
def test_multiplicative_recovery_has_its_own_time_constant(V):
    """The same exponential with ``T_p V^-alpha_t``."""
    load = MultiplicativeRecovery(P=80.0, Q=30.0, alpha_t=1.9, alpha_s=0.4, beta_t=2.5, beta_s=0.7, T_p=T_P, T_q=T_Q)
    t, p, q = stepped(load, V)
    for y, y_0, a_t, a_s, T in ((p, 0.8, 1.9, 0.4, T_P), (q, 0.3, 2.5, 0.7, T_Q)):
        y_t, y_s = y_0 * V**a_t, y_0 * V**a_s
        assert np.abs(y - (y_s + (y_t - y_s) * np.exp(-t / T * V**a_t))).max() < 1e-6  # measured 6e-10


@every_form
def test_below_v_min_it_is_an_admittance_that_recovers(form):
    """At 0.5 pu the admittance goes from the one at 0.7 pu at once to the one it would end with there."""
    load = FORMS[form](P=80.0, Q=0.0, alpha_t=2.0, alpha_s=0.0, T_p=5.0)
    _, p, _ = stepped(load, 0.5, t_end=120.0)
    assert p[0] == pytest.approx(0.8 * 0.7**2 * (0.5 / 0.7) ** 2, rel=1e-9)
    assert p[-1] == pytest.approx(0.8 * (0.5 / 0.7) ** 2, rel=1e-4)


def test_recovery_is_bounded():
    _, p, _ = stepped(MultiplicativeRecovery(P=80.0, alpha_s=0.0, z_MAX=1.05, T_p=5.0), 0.9)
    assert p[-1] == pytest.approx(0.8 * 1.05 * 0.81, rel=1e-9)


def test_a_load_step_scales_both_parts():
    from pgexcite.core.events import LoadStep

    load = AdditiveRecovery(P=40.0)
    system = System(
        100.0,
        50.0,
        {"B": Bus()},
        devices=(
            Device("infinite_bus.grid", "B", 100.0, {"": InfiniteBus()}, Schedule(V=1.0, angle=0.0)),
            Device("load.L", "B", 100.0, {"": load}, Schedule(P=-40.0, Q=0.0)),
        ),
    )
    assert initialise(system).residual < 2e-12  # measured 1e-12: the leak to earth at the bus
    sim = Simulation(system, Settings(1.0), LoadStep(type="load_step", t=0.5, load="L", dP=20.0).changes())
    sim.run()
    assert sim.trace()["load.L.p"][-1] == pytest.approx(0.6)
