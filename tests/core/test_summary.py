import json
from dataclasses import replace

import numpy as np
import pytest

from pgexcite.core.result import ControllerStatistics
from pgexcite.core.summary import after, settled_at, summarise, voltage_target
from pgexcite.core.trace import LogEntry, Trace


def trace_of(t, v_t, events=(), **columns):
    log = [LogEntry(at, "event", "something happens") for at in events]
    columns = {
        "unit.G.v_t": np.asarray(v_t, float),
        **{f"unit.G.{k}": np.asarray(v, float) for k, v in columns.items()},
    }
    return Trace(np.asarray(t, float), columns, {}, log)


def test_keys_are_those_of_the_file_format(synthetic_run):
    found = summarise(synthetic_run(mpc=True))
    assert list(found) == ["outcome", "where", "active", "t_end", "steps", "wall_time", "units", "controllers"]
    assert list(found["units"]["G2"]) == [
        "delta_max_deg", "v_t_min", "v_t_iae", "omega_max", "e_fd_max", "i_fd_max", "settled_at",
    ]  # fmt: skip
    assert found["controllers"]["mpc"] == {
        "samples": 100,
        "solve_ms": {"median": 2.0, "p99": pytest.approx(8.86), "max": 9.0},
        "fallbacks": 1,
        "cost": 8.1,
    }
    json.dumps(found, allow_nan=False)


def test_extremes_see_both_sides_of_an_event(synthetic_run):
    result = synthetic_run()
    unit = summarise(result)["units"]["G2"]
    assert unit["v_t_min"] == np.min(result.trace["unit.G2.v_t"])
    assert unit["delta_max_deg"] == pytest.approx(np.degrees(np.max(result.trace["unit.G2.delta"])))


def test_iae_of_a_dip_is_its_area():
    trace = trace_of([0, 1, 1, 2, 2, 4], [1, 1, 0.4, 0.4, 1, 1], events=(1, 2))
    result_units = np.trapezoid(np.abs(trace["unit.G.v_t"] - voltage_target(trace, "G")), trace.t)
    assert result_units == pytest.approx(0.6)


def test_target_follows_a_reference_that_an_event_steps_and_not_one_that_a_controller_moves():
    t = [0, 1, 1, 2, 3]
    trace = trace_of(t, np.ones(5), events=(1,))
    stepped = {**trace.columns, "unit.G.exciter.v_ref": np.array([1.1, 1.1, 1.15, 1.2, 1.3])}
    target = voltage_target(replace(trace, columns=stepped), "G")
    np.testing.assert_allclose(target, [1, 1, 1.05, 1.05, 1.05], atol=1e-15)


def test_target_is_the_reference_of_the_controller_in_charge():
    trace = trace_of([0, 1, 2, 3], np.ones(4))
    own = {"V_ref_G": [1.0, 1.05, 1.05, 1.05], "active": [1.0, 1.0, 0.0, 1.0], "V_ref_GG": [2.0] * 4}
    columns = trace.columns | {f"controller.mpc.{key}": np.array(value) for key, value in own.items()}
    np.testing.assert_array_equal(voltage_target(replace(trace, columns=columns), "G"), [1.0, 1.05, 1.0, 1.05])


def test_settling_time_of_an_exponential():
    """|e^(-t/T)| falls below 1 % of the final value 1 at T ln(100 * 0.2) for a 0.2 pu dip."""
    t = np.concatenate([[0.0, 1.0], np.linspace(1.0, 11.0, 10001)])
    v = np.concatenate([[1.0, 1.0], 1.0 - 0.2 * np.exp(-np.linspace(0, 10, 10001) / 0.5)])
    found = settled_at(trace_of(t, v, events=(1.0,)), "G")
    assert found == pytest.approx(1.0 + 0.5 * np.log(20.0), abs=1.5e-3)  # one sample of 1 ms


def test_an_oscillation_outside_the_band_never_settles():
    t = np.linspace(0, 10, 2001)
    assert settled_at(trace_of(t, 1 + 0.02 * np.sin(2 * np.pi * t), events=(0.0,)), "G") is None


def test_a_voltage_that_is_never_disturbed_is_settled_from_the_event_on():
    t = np.linspace(0, 10, 1001)
    assert settled_at(trace_of(t, np.ones(1001), events=(2.0,)), "G") == pytest.approx(2.0)


def test_a_lost_machine_is_never_settled(synthetic_run):
    result = synthetic_run(clearing=0.5)
    summary = summarise(result)
    assert summary["outcome"] == "lost_synchronism"
    assert summary["units"]["G2"]["settled_at"] is None


def test_missing_signals_and_idle_controllers_are_null(synthetic_run):
    result = synthetic_run()
    few = {k: v for k, v in result.trace.columns.items() if not k.endswith(("e_fd", "i_fd"))}
    result = replace(result, trace=replace(result.trace, columns=few), controllers={"mpc": ControllerStatistics()})
    summary = summarise(result)
    assert summary["units"]["G2"]["e_fd_max"] is None
    assert summary["controllers"]["mpc"]["solve_ms"] is None


def test_a_run_that_ended_at_once_has_a_summary():
    assert settled_at(trace_of([0.0], [1.0]), "G") is None


def test_after_picks_the_sample_behind_the_jump():
    assert after(trace_of([0, 1, 1, 2], np.ones(4)), 1.0) == 2
