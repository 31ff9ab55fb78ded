"""Plans in C are those of Python: in closed loop under one and watched by the other, and each takes up what the other remembers."""

from __future__ import annotations

import numpy as np
import pytest
from plants import REGULATED, kobbelv, regulated, two_units

from pgexcite.core.compiling import compiler
from pgexcite.core.events import Fault
from pgexcite.core.mpc import Status
from pgexcite.core.plans_in_c import PlansInC
from pgexcite.core.plans_in_python import PlansInPython
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.controllers.mpc import MPC
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.limiters.oel import OEL

FAULT = Fault(type="fault", t=0.2, bus="HV", R=0.02, duration=0.1)
SECONDARY = {"command": "v_ref", "u_min": 0.9, "u_max": 1.05, "dt": 0.1, "V_ref": 0.99}
KINDS = {
    "one move": {},
    "a move in each sample": {"N_p": 12, "N_c": 12},
    "coarser steps": {"N_p": 20, "N_c": 20, "options": {"step": 0.025}},
    "blocks": {"N_p": 10, "N_c": 3, "P": 6e4},
    "growing intervals": {"N_p": 6, "N_c": 6, "growth": 1.5},
    "computing delay": {"N_p": 8, "N_c": 8, "delayed": True},
    "known fault": {"N_p": 8, "N_c": 8, "disturbance_known": True},
    "reference steps": {"N_p": 8, "N_c": 8, "V_ref_steps": [(0.45, 1.02)]},
    "reference previews": {"N_p": 8, "N_c": 8, "V_ref_known": [(0.45, 1.02)]},
    "converged": {"N_p": 8, "N_c": 8, "options": {"mode": "converged", "max_iterations": 100}},
    "three programs after a jump": {"N_p": 8, "N_c": 8, "P": 6e4, "options": {"jump_iterations": 3}},
    "wrong model": {"N_p": 8, "N_c": 8, "options": {"mismatch": {"line.L1.X": 0.3}}},
    "secondary": SECONDARY,
}

pytestmark = pytest.mark.compiler


class _Watched:
    """Plans of one kind, each compared with that of the other for the same sample."""

    def __init__(self, acting, watching):
        self.acting, self.watching = acting, watching
        self.statuses, self.plans, self.off, self.others = [], [], 0.0, 0

    def plan(self, state, t, p, u_last):
        ours, theirs = (each.plan(state, t, p, u_last) for each in (self.acting, self.watching))
        assert ours.status is theirs.status
        assert ours.iterations == theirs.iterations
        assert ours.step == pytest.approx(theirs.step, abs=1e-8)
        assert ours.cost == pytest.approx(theirs.cost, rel=1e-9, abs=1e-9)
        self.off = max(self.off, float(np.abs(ours.u - theirs.u).max()))
        self.statuses.append(ours.status)
        self.plans.append(ours.u)
        return ours

    def prepare(self, u):
        self.acting.prepare(u)
        self.watching.prepare(u)

    def lost(self):
        self.acting.lost()
        self.watching.lost()

    def memory(self):
        return self.acting.memory()

    def recall(self, memory):
        self.acting.recall(memory)
        self.watching.recall(memory)


def simulation(kind, t_end=0.8):
    assert compiler(), "this test needs a C compiler"
    options = {"unit": "G2"} | KINDS[kind]
    system = regulated() if "command" in options else kobbelv()
    return Simulation(system, Settings(t_end, 0.005, "tr_bdf2", "always"), FAULT.changes(), {"mpc": MPC(**options)})


def watched(sim):
    """Have its controller's plans made by C and by Python."""
    solver = sim.sessions["mpc"].solver
    assert isinstance(solver.plans, PlansInC)
    in_c = solver.plans
    solver.plan_in_python()
    assert isinstance(solver.plans, PlansInPython)
    solver.plans = _Watched(in_c, solver.plans)
    return solver.plans


@pytest.mark.parametrize("kind", KINDS)
def test_plans_in_c_are_those_of_python(kind):
    sim = simulation(kind)
    plans = watched(sim)
    sim.run()
    assert plans.off < 1e-9  # measured 3e-12 at most
    assert all(status.usable for status in plans.statuses)
    assert np.ptp(plans.plans) > 0.01


@pytest.mark.parametrize("kind", ["one move", "a move in each sample", "coarser steps"])
@pytest.mark.parametrize("t", [0.1, 0.25, 0.5])
def test_each_takes_up_what_the_other_remembers(kind, t):
    sim = simulation(kind)
    plans = watched(sim)
    sim.run(until=t)
    for source, target in ((plans.acting, plans.watching), (plans.watching, plans.acting)):
        kept = source.memory()
        target.recall(kept)
        after = target.memory()
        names = {name for name in kept if name != "multipliers"}
        assert names == {name for name in after if name != "multipliers"}
        assert {"plan", "prepared:plan", "prepared:G"} <= names
        assert all(np.array_equal(kept[name], after[name]) for name in names)
    sim.run()
    assert plans.off < 1e-9


def limited(dt, h, **options):
    """A regulator whose limiter counts and acts; the horizon has both in it."""
    exciter = REGULATED["exciter"].model_copy(update={"oel_position": 1})
    system = regulated(exciter=exciter, oel=OEL(acts="summing", I_LIM=2.0, T_LIM=0.12, T_RESET=0.1))
    sag = Fault(type="fault", t=0.15, bus="HV", R=0.2, duration=0.15).changes()
    mpc = MPC(**{**SECONDARY, "unit": "G2", "dt": dt, "u_max": 1.1, "V_ref": 1.05, **options})
    return Simulation(system, Settings(1.5, h, "tr_bdf2", "always"), sag, {"mpc": mpc})


@pytest.mark.parametrize("N_c", [2, 12])
@pytest.mark.parametrize(("dt", "h"), [(0.1, 0.005), (0.0375, 0.0125)])
def test_limiters_count_in_c_as_in_python_and_in_the_plant(dt, h, N_c):
    """Timers are expected to the last bit, whatever the sample time over the step comes to in floating point."""
    sim = limited(dt, h, N_p=12, N_c=N_c)
    plans = watched(sim)
    counted = 0
    for t in np.arange(dt, 1.5, dt):
        sim.run(until=t)
        if t - dt < 0.3 - 1e-9 and t > 0.15:
            continue  # nobody expects the fault
        counted += sim.state.d[0] > 0
        for each in (plans.acting, plans.watching):
            assert np.array_equal(each.memory()["prepared:d"], sim.state.d)
    assert plans.off < 1e-9  # measured 6e-15
    assert counted > 5
    assert np.ptp(sim.trace()["unit.G2.oel.active"]) == 1


def test_plans_of_two_units_in_c_are_those_of_python():
    mpc = MPC(
        unit=("G1", "G2"), **{**SECONDARY, "u_min": 0.8, "u_max": 1.2, "dt": 0.05, "V_ref": [1.0, 1.02]}, N_p=6, N_c=3
    )
    fault = Fault(type="fault", t=0.2, bus="L", R=0.02, duration=0.1).changes()
    sim = Simulation(two_units(exciter=SEXS()), Settings(0.8, 0.005, "tr_bdf2", "always"), fault, {"mpc": mpc})
    plans = watched(sim)
    sim.run()
    assert plans.off < 1e-9  # measured 2e-12
    assert np.ptp(plans.plans, axis=0).min() > 0.01


@pytest.mark.parametrize("why", ["no state", "no plan", "recalled", "no command"])
def test_nothing_is_prepared_from_a_sample_that_does_not_count(why):
    sim = simulation("computing delay")
    plans = watched(sim)
    sim.run(until=0.1)
    command = np.array([2.0])
    for each in (plans.acting, plans.watching):
        kept = each.memory()
        assert "prepared:plan" in kept
        assert each.plan(sim.state, 0.1, sim.p, command).status.usable
        if why == "no state":
            each.lost()
        elif why == "no plan":
            beyond = sim.state.with_(x=1e9 * sim.state.x)
            assert each.plan(beyond, 0.15, sim.p, command).status is Status.PREDICTION_FAILED
        elif why == "recalled":
            each.recall({"plan": kept["plan"]})
        each.prepare(command * np.nan if why == "no command" else command)
        assert "prepared:plan" not in each.memory()


@pytest.mark.parametrize(
    "options",
    [{"du_max": 0.2}, {"soft": [{"signal": "i_fd", "upper": 3.0, "weight": 1e3}]}, {"options": {"candidates": 3}}],
)
def test_what_c_does_not_do_alike_is_planned_in_python(options):
    sim = Simulation(
        kobbelv(), Settings(0.1, 0.005, "tr_bdf2", "always"), (), {"mpc": MPC(**({"unit": "G2"} | options))}
    )
    assert isinstance(sim.sessions["mpc"].solver.plans, PlansInPython)
