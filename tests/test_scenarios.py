"""Every scenario that ships runs and ends as it expects; the ones that show something show it."""

from pathlib import Path

import numpy as np
import pytest

from pgexcite import load
from pgexcite.studies.measures import swing_damping

CONFIGS = Path(__file__).parents[1] / "configs"
SCENARIOS = sorted(path for path in CONFIGS.rglob("*.toml") if not {"cases", "studies"} & {*path.parts})


def simulate(path, *overrides):
    scenario = load(path, overrides)
    simulation = scenario.simulation()
    return scenario, simulation.run(), simulation.trace()


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_a_scenario_ends_as_it_expects(path):
    scenario, outcome, _ = simulate(path)
    assert outcome.ending.value == scenario.expect


@pytest.mark.parametrize(("begins", "ends"), [(1.0, 6.0), (6.0, 10.0)], ids=["up", "down"])
@pytest.mark.parametrize(("name", "overshoot"), [("st1a", 0.11), ("nmpc", 1e-3), ("linear", 1e-3)])
def test_the_open_circuit_step_settles_fast_with_little_overshoot(name, overshoot, begins, ends):
    trace = simulate(CONFIGS / "smib" / f"open_circuit_{name}.toml")[2]
    t, v = trace.t, trace["unit.G2.v_t"]
    before = v[np.searchsorted(t, begins) - 1]
    during = (t > begins) & (t < ends)
    final = v[during][-1]
    answer = (v[during] - before) / (final - before)
    outside = np.abs(answer - 1) > 0.05
    peak = int(np.argmax(answer))
    assert t[during][outside][-1] - begins < 0.5  # measured 0.405 s to within 5 % of the step, all three
    assert answer[peak] - 1 < overshoot  # measured 0.1007, 0 and 0; 0.15 is asked for
    assert answer[peak:].min() > 1 - 0.02  # measured 0.99: it does not swing back
    assert abs(final - before) == pytest.approx(0.05, rel=0.02)  # measured 0.0498: the regulator's droop


@pytest.mark.parametrize(("name", "t_crit"), [("clearing_bolted", 0.1898), ("clearing_arc", 0.2805)])
def test_the_clearing_scenarios_are_within_two_per_cent_of_losing_synchronism(name, t_crit):
    path = CONFIGS / "smib" / f"{name}.toml"
    assert simulate(path)[1].ending.value == "completed"
    assert load(path).changes[1].t - load(path).changes[0].t == pytest.approx(t_crit, rel=0.02)
    beyond = simulate(path, f"event.0.duration={t_crit + 0.002}")[1]
    assert beyond.ending.value == "lost_synchronism"
    assert beyond.where == "unit.G2"


def test_a_stabiliser_with_the_lead_that_the_reduced_gain_asks_for_damps_as_the_weights_that_damp_do():
    """The shipped one has Kundur's settings, of an exciter without gain reduction."""
    lead = ("unit.G2.stabiliser.K_STAB=6.0", "unit.G2.stabiliser.T_1=0.35")
    smib = CONFIGS / "smib"
    runs = {"shipped": ("fault_st1a", ()), "lead": ("fault_st1a", lead), "nmpc": ("fault_nmpc_damped", ())}
    traces = {key: simulate(smib / f"{name}.toml", *overrides)[2] for key, (name, overrides) in runs.items()}
    damping = {key: swing_damping(trace, "G2") for key, trace in traces.items()}
    assert damping == pytest.approx({"shipped": 0.139, "lead": 0.203, "nmpc": 0.189}, abs=2e-3)  # measured 5e-4
    error = {key: np.trapezoid(np.abs(trace["unit.G2.v_t"] - 1), trace.t) for key, trace in traces.items()}
    assert error["nmpc"] < 0.8 * error["lead"]  # measured 0.098 against 0.139 pu s over 10 s


def test_a_fault_known_in_advance_swings_the_rotor_less():
    runs = {name: simulate(CONFIGS / "smib" / f"fault_{name}.toml")[2] for name in ("nmpc", "nmpc_known")}
    first_swing = {name: np.degrees(trace["unit.G2.delta"].max()) for name, trace in runs.items()}
    assert first_swing["nmpc_known"] < first_swing["nmpc"] - 2.0  # measured 52.76 against 55.53


def test_predictive_control_keeps_its_bounds_and_recovers_the_voltage_first():
    traces = {name: simulate(CONFIGS / "smib" / f"fault_{name}.toml")[2] for name in ("constant", "st1a", "nmpc")}
    e_fd = traces["nmpc"]["unit.G2.e_fd"]
    assert e_fd.min() >= -3.2
    assert e_fd.max() <= 3.2
    error = {name: np.trapezoid(np.abs(trace["unit.G2.v_t"] - 1), trace.t) for name, trace in traces.items()}
    assert error["nmpc"] < min(error["constant"], error["st1a"])
