"""The unscented filter on a true single machine - infinite bus: how near it gets, how fast, and what it does when it cannot."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pgexcite.core.config import load
from pgexcite.core.controller import Surroundings
from pgexcite.core.equivalent import TERMINALS, Equivalent
from pgexcite.core.events import Change
from pgexcite.plugins.estimators.ukf import UKF

CONFIGS = Path(__file__).parents[3] / "configs" / "smib"
UNIT = "unit.G2"
EVENTS = {"fault_equivalent": (0.27, 1.1), "line_trip_equivalent": (0.5, 1.0)}
"""Scenario -> true x_s after its event, and when that is over, s."""

EXACT = ("controller.mpc.measurement.noise=0.0", "controller.mpc.measurement.noise_omega=0.0")


def simulation(name, *overrides, t_end=4.0):
    scenario = load(CONFIGS / f"{name}.toml", [f"simulation.t_end={t_end}", *overrides])
    return scenario.simulation()


def reseeded(sim, seed):
    """The same run with other noise; nothing is compiled again."""
    mpc = sim._controllers["mpc"]
    measurement = mpc.measurement.model_copy(update={"seed": seed})
    sim._controllers = {"mpc": mpc.model_copy(update={"measurement": measurement})}
    sim.restart()
    assert sim.run().ending.value == "completed"
    return sim.trace()


def errors(name, seeds, *overrides):
    """Worst relative errors of x_s and v_bus from 1 s after the event on, their rms in sigmas then, and the lowest x_s of all."""
    truth, over = EVENTS[name]
    sim = simulation(name, *overrides)
    v_bus = sim.get("infinite_bus.grid.v")
    rows = []
    for seed in seeds:
        trace = reseeded(sim, seed)
        late = trace.t >= over + 1.0 - 1e-9
        at = int(np.argmax(late))
        x, v = trace["controller.mpc.x_s"], trace["controller.mpc.v_bus"]
        sigmas = (x[at] - truth) / trace["controller.mpc.sigma_x_s"][at]
        rows.append((np.abs(x[late] / truth - 1).max(), np.abs(v[late] / v_bus - 1).max(), sigmas, x.min()))
    x, v, sigmas, lowest = np.array(rows).T
    return x.max(), v.max(), float(np.sqrt(np.mean(sigmas**2))), lowest.min()


# After an event.


@pytest.mark.parametrize("name", EVENTS)
def test_one_second_after_an_event_the_network_is_known(name):
    x_s, v_bus, _, lowest = errors(name, range(1, 4))
    assert x_s < 0.05  # measured 0.02 and 0.04
    assert v_bus < 0.02  # measured 0.005 and 0.007
    assert lowest >= 0.02


@pytest.mark.slow
@pytest.mark.parametrize("x_s_0", [0.2, 0.3, 0.5])
@pytest.mark.parametrize("name", EVENTS)
def test_over_fifty_seeds_the_network_is_known_after_one_second(name, x_s_0):
    """1 % of noise; from the first second after the event to the end of the run, whatever x_s is assumed at first."""
    x_s, v_bus, sigmas, lowest = errors(name, range(1, 51), f"controller.mpc.options.estimation.x_s={x_s_0}")
    assert x_s < 0.05  # see docs/estimation.md
    assert v_bus < 0.02  # measured 0.005 and 0.007
    assert 0.4 < sigmas < 1.3  # measured 0.55 to 0.71: the one-sigma band is honest
    assert lowest >= 0.02  # measured 0.19


@pytest.mark.slow
@pytest.mark.parametrize("name", EVENTS)
def test_on_standby_it_learns_enough(name):
    """The static exciter damps the swing, and with it what can be learnt."""
    x_s, v_bus, _, _ = errors(name, range(1, 51), "controller.mpc.active=false")
    assert x_s < 0.05  # see docs/estimation.md
    assert v_bus < 0.02  # measured 0.007


def test_a_fault_is_seen_as_little_voltage_behind_little_reactance():
    """The arc of .02 pu at HV, with the line of .15 behind it: .12 pu behind .14 pu. A bus out of phase would explain it too."""
    trace = reseeded(simulation("fault_equivalent", t_end=1.1), 1)
    during = (trace.t > 1.0) & (trace.t < 1.1)
    assert trace["controller.mpc.v_bus"][during].max() < 0.4
    assert trace["controller.mpc.x_s"][during].max() < 0.25


def test_a_fault_that_clears_between_two_samples_is_understood_at_the_next():
    """The rotor has been braked for a part of the sample only, which the model does not know."""
    for begins, duration in ((1.0, 0.12), (1.0, 0.135), (1.0, 0.225), (1.03, 0.1)):
        fault = f'event=[{{type="fault", t={begins}, bus="HV", R=0.02, duration={duration}}}]'
        trace = reseeded(simulation("fault_equivalent", *EXACT, fault, t_end=3.0), 1)
        assert trace["controller.mpc.network_change"].min() == 0  # never unexplained
        later = trace.t > begins + duration + 0.25
        np.testing.assert_allclose(trace["controller.mpc.x_s"][later], 0.27, rtol=0.1)  # measured 0.08


@pytest.mark.slow
def test_faster_sampling_tells_more():
    x_s, _, _, _ = errors("line_trip_equivalent", range(1, 51), "controller.mpc.dt=0.025", "controller.mpc.N_p=10")
    assert x_s < 0.045  # measured 0.036


# At rest.


def drift(trace, since):
    """Largest relative change of x_s and v_bus after an instant."""
    rest = trace.t >= since
    return [
        np.abs(trace[f"controller.mpc.{n}"][rest] / trace[f"controller.mpc.{n}"][rest][0] - 1).max()
        for n in ("x_s", "v_bus")
    ]


def at_rest(t_end):
    sim = simulation("fault_equivalent", t_end=t_end)
    sim.restart(())
    assert sim.run().ending.value == "completed"
    return sim.trace()


def test_at_rest_it_stays_put():
    trace = at_rest(60.0)
    x_s, v_bus = drift(trace, 0.1)
    assert x_s == 0.0
    assert v_bus < 0.01  # measured 0.002
    assert trace["controller.mpc.network_held"].min() == 1.0
    assert trace["controller.mpc.sigma_x_s"][-1] == pytest.approx(0.12, abs=1e-4)  # nothing has been learnt of it


@pytest.mark.slow
def test_at_rest_it_stays_put_for_ten_minutes():
    x_s, v_bus = drift(at_rest(600.0), 0.1)
    assert x_s == 0.0
    assert v_bus < 0.01  # measured 0.003


@pytest.mark.slow
def test_when_a_fault_has_died_away_it_stays_put_for_ten_minutes():
    trace = simulation("fault_equivalent", t_end=630.0)
    trace.run()
    x_s, v_bus = drift(trace.trace(), 30.0)
    assert x_s == 0.0
    assert v_bus < 0.01  # measured 0.004


def test_a_change_of_the_grids_voltage_at_rest_is_followed():
    """Given x_s, the bus's voltage can be seen at rest; the unit's voltage comes back to its reference."""
    sim = simulation("fault_equivalent", t_end=25.0)
    v_bus = sim.get("infinite_bus.grid.v")
    sim.restart([Change(1.0, {"infinite_bus.grid.v": 0.98 * v_bus}, "the grid's voltage falls by 2 %")])
    sim.run()
    trace = sim.trace()
    v = trace["controller.mpc.v_bus"]
    assert v[-1] / v[0] == pytest.approx(0.98, abs=0.005)  # measured 0.979
    late = trace.t > 20.0
    assert abs(trace["unit.G2.v_t"][late].mean() - 1.0) < 3e-3  # measured 4e-4


def test_a_turbine_that_gives_less_is_followed():
    sim = simulation("fault_equivalent", t_end=20.0)
    sim.restart([Change(1.0 + 0.1 * k, {"unit.G2.governor.p_m": 0.86 - 0.005 * k}, "ramp") for k in range(1, 61)])
    sim.run()
    trace = sim.trace()
    assert trace["controller.mpc.p_m"][-1] == pytest.approx(0.56, abs=0.01)  # measured 0.557
    assert trace["controller.mpc.level"].max() == 0


# The filter alone, on what it is fed.


@pytest.fixture(scope="module")
def plant():
    return simulation("fault_equivalent")


@pytest.fixture(scope="module")
def equivalent(plant):
    s, y = plant.initial.state, plant.kernel.outputs(plant.initial.state, plant.initial.p)
    given = Surroundings(
        0.005,
        "tr_bdf2",
        dict(zip(plant.model.u_names, s.u, strict=True)),
        dict(zip(plant.model.y_names, y, strict=True)),
        plant.model.system,
        compile="never",
    )
    return Equivalent(given, UNIT, UKF().x_s, {}, "options.model")


@pytest.fixture(scope="module")
def fed(plant):
    """Noisy terminals and field voltage of a fault run, a row for each sample."""
    plant.restart()
    plant.run()
    trace = plant.trace()
    after = np.searchsorted(trace.t, np.arange(0, 80) * 0.05 + 1e-9) - 1
    before = np.searchsorted(trace.t, np.arange(0, 80) * 0.05 - 1e-9)
    rng = np.random.default_rng(5)
    seen = np.array([trace[f"{UNIT}.{name}"][after] for name in TERMINALS]).T
    return seen + rng.normal(size=seen.shape) * [0.01, 0.01, 0.01, 1e-4], trace[f"{UNIT}.e_fd"][before]


def run(observer, fed, samples=80):
    seen, e_fd = fed
    return [observer.observe(seen[k], e_fd[k]) for k in range(samples)]


def test_its_memory_is_all_it_remembers(equivalent, fed):
    """Taken over by another filter in mid-fault, the rest of the run has the same bits."""
    seen, e_fd = fed
    first, second = (UKF().start(equivalent, 0.05, "never") for _ in range(2))
    for k in range(22):
        first.observe(seen[k], e_fd[k])
    second.recall({key: np.array(value) for key, value in first.memory().items()})
    for k in range(22, 80):
        one, other = (observer.observe(seen[k], e_fd[k]) for observer in (first, second))
        assert np.array_equal(one.value, other.value)
        assert one.diagnostics == other.diagnostics or np.isnan(one.diagnostics["nis"])


def test_lost_samples_are_left_out(equivalent, fed):
    seen, e_fd = fed
    observer = UKF().start(equivalent, 0.05, "never")
    lost = np.random.default_rng(2).random(80) < 0.3
    for k in range(80):
        estimate = observer.observe(None if lost[k] else seen[k], e_fd[k])
        assert np.isnan(estimate.diagnostics["nis"]) == lost[k]
        assert estimate.sound
        assert np.isfinite(estimate.value).all()
    assert estimate.diagnostics["x_s"] == pytest.approx(0.27, rel=0.05)  # measured 0.009


def test_without_measurements_it_grows_uncertain_and_knows_it(equivalent, fed):
    observer = UKF().start(equivalent, 0.05, "never")
    run(observer, fed)
    deviations = [observer.observe(None, 1.92).diagnostics["sigma_p_m"] for _ in range(40)]
    assert all(later > sooner for sooner, later in pairwise(deviations))


def test_one_wild_sample_changes_little(equivalent, fed):
    """A voltage of twice nominal for one sample, at rest and in mid-swing."""
    for wild in (10, 40):
        seen = fed[0].copy()
        seen[wild, 0] = 2.0
        observer = UKF().start(equivalent, 0.05, "never")
        estimates = run(observer, (seen, fed[1]))
        assert all(estimate.sound for estimate in estimates)
        assert estimates[-1].diagnostics["x_s"] == pytest.approx(0.27, rel=0.05)  # measured 0.004


@pytest.mark.parametrize("nonsense", ["noise", "contradictory", "unphysical"])
def test_what_it_cannot_explain_is_a_divergence_and_what_it_can_ends_it(equivalent, fed, nonsense):
    seen, e_fd = fed
    rng = np.random.default_rng(7)
    observer = UKF().start(equivalent, 0.05, "never")
    run(observer, fed, 30)
    unsound = 0
    for k in range(60):
        wrong = {
            "noise": rng.normal(1.0, 0.5, size=4),
            "contradictory": np.array([1.0, 0.2, -0.8, 1.004 if k % 2 else 0.996]),
            "unphysical": np.array([1.0, -30.0, 40.0, 1.0]),
        }[nonsense]
        estimate = observer.observe(wrong, 1.92)
        unsound += not estimate.sound
        assert np.isfinite(estimate.value).all()
        assert 0.02 <= estimate.diagnostics["x_s"] <= 2.0
        assert 0.05 - 1e-12 <= estimate.diagnostics["v_bus"] <= 1.5 + 1e-12
    assert unsound > 30  # measured 52 of 60
    sound = [observer.observe(seen[79], e_fd[79]).sound for _ in range(40)]
    assert all(sound[20:])  # measured from the 14th on


@pytest.mark.parametrize("broken", [np.nan, -1.0])
def test_a_covariance_that_is_none_is_a_divergence(equivalent, fed, broken):
    observer = UKF().start(equivalent, 0.05, "never")
    run(observer, fed, 40)
    observer._kalman.P[3, 3] = broken
    seen, e_fd = fed
    sound = [observer.observe(seen[k], e_fd[k]).sound for k in range(40, 80)]
    assert not sound[0]
    assert all(sound[10:])  # measured from the 6th on


def test_it_starts_where_the_unit_is_and_believes_what_it_is_told(equivalent, fed):
    estimate = UKF(spread=0.2).start(equivalent, 0.05, "never").observe(fed[0][0], fed[1][0])
    assert estimate.diagnostics["x_s"] == 0.3
    assert estimate.diagnostics["sigma_x_s"] == pytest.approx(0.06, rel=1e-3)
    slope = abs(equivalent.terminals.behind(0.301)) - abs(equivalent.terminals.behind(0.3))
    expected = np.hypot(0.06 * slope / 1e-3, 1e-3)
    assert estimate.diagnostics["sigma_v_bus"] == pytest.approx(expected, rel=0.05)
