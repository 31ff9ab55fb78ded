from __future__ import annotations

import numpy as np
import pytest
from component_harness import Bench
from plants import regulated

from pgexcite.core.events import ParameterStep
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.limiters.scl import SCL

H = 0.01


def run(step, t_end=60.0, *, back=None, exciter=None, **parameters):
    limiter = SCL(**({"I_LIM": 1.03, "K_PU": 1.01, "T_LIM": 2.0} | parameters))
    path = "unit.G2.exciter.v_ref"
    events = [ParameterStep(type="set", t=1.0, path=path, step=step)]
    if back is not None:
        events.append(ParameterStep(type="set", t=back, path=path, step=-step))
    plant = regulated(exciter=exciter or ST1A(), **{"limiter.scl": limiter})
    sim = Simulation(plant, Settings(t_end, H, "tr_bdf2", "never"), [c for e in events for c in e.changes()])
    assert sim.run().ending.value == "completed"
    trace = sim.trace()
    i_t = np.hypot(trace["unit.G2.p_e"], trace["unit.G2.q_e"]) / trace["unit.G2.v_t"]
    return trace, i_t


@pytest.mark.parametrize("exciter", [ST1A(), SEXS(E_MAX=6.0, K=100.0)], ids=["st1a", "sexs"])
def test_overexcited_it_lowers_the_reference(exciter):
    trace, i_t = run(0.04, exciter=exciter)
    assert i_t.max() > 1.05
    assert i_t[-1] == pytest.approx(1.03, abs=2e-3)
    assert trace["unit.G2.v_scl"][-1] < 0
    acted = np.argmax(trace["unit.G2.limiter.scl.active"])
    timer = trace["unit.G2.limiter.scl.timer"]
    assert timer[acted] == pytest.approx(2.0)
    assert np.all(np.diff(timer[:acted]) <= H + 1e-9)
    assert trace.t[acted] - 1.0 < 3.5  # the swing after the step takes the current below its pick-up for a moment


def test_underexcited_it_raises_the_reference():
    trace, i_t = run(-0.22, I_LIM=1.07)
    assert trace["unit.G2.q_e"][-1] < 0
    assert i_t.max() > 1.09
    assert i_t[-1] == pytest.approx(1.07, abs=2e-3)
    assert trace["unit.G2.v_scl"][-1] > 0


def test_it_lets_go():
    trace, _ = run(0.04, 50.0, back=20.0)
    assert trace["unit.G2.limiter.scl.active"][-1] == 0
    assert trace["unit.G2.v_scl"][-1] == pytest.approx(0.0, abs=1e-6)
    assert trace["unit.G2.v_t"][-1] == pytest.approx(1.0, abs=1e-3)


def test_active_power_alone_is_left_alone():
    """Without reactive power the field cannot lower the current: no action."""
    point = Bench(SCL())({"v_t": 1.0, "p_e": 1.3, "q_e": 0.0, "active": 1.0, "x_o": 0.0, "x_u": 0.0})
    assert point.out["v_scl"] == 0.0
    assert max(abs(r) for r in point.rhs.values()) == 0.0


@pytest.mark.parametrize("q_e", [0.8, -0.8, 0.02])
def test_jacobian_matches_finite_differences(q_e):
    point = {"v_t": 0.97, "p_e": 0.9, "q_e": q_e, "active": 1.0, "x_o": -0.02, "x_u": 0.03}
    assert Bench(SCL()).jacobian_error(point) < 1e-7
