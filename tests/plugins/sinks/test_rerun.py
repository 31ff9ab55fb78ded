import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from pgexcite.core.config import from_data, load
from pgexcite.core.realtime import timed
from pgexcite.core.record import read_trace, write_record
from pgexcite.core.recording import entity
from pgexcite.core.timing import PHASES, Timing
from pgexcite.core.trace import Trace
from pgexcite.plugins.sinks.config import ConfigSink
from pgexcite.plugins.sinks.overview import Overview, frames
from pgexcite.plugins.sinks.parquet import ParquetSink
from pgexcite.plugins.sinks.rerun import RerunSink, serve
from pgexcite.plugins.sinks.summary import SummarySink

ST1A = Path(__file__).parents[3] / "configs" / "smib" / "fault_st1a.toml"


def read_back(path):
    """Entity -> (time [s], step, values), in order of step."""
    chunks = {}
    for chunk in rr.chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            time = np.asarray(batch["time"].cast("int64")) * 1e-9
            values = np.array([row[0] for row in batch["Scalars:scalars"].to_pylist()])
            chunks.setdefault(chunk.entity_path, []).append((time, np.asarray(batch["step"]), values))
    joined = {path: [np.concatenate(part) for part in zip(*parts, strict=True)] for path, parts in chunks.items()}
    return {path: [column[np.argsort(parts[1])] for column in parts] for path, parts in joined.items()}


def test_the_recording_holds_the_trace(synthetic_run, tmp_path):
    result = synthetic_run(mpc=True, t_end=25.0)  # more than one chunk
    found = read_back(RerunSink().write(result, tmp_path))
    for path, samples in result.trace.columns.items():
        time, step, values = found[entity(path)]
        np.testing.assert_array_equal(values, samples)
        np.testing.assert_array_equal(step, np.arange(len(samples)))
        np.testing.assert_allclose(time, result.trace.t, rtol=0, atol=1e-9)  # rerun's clock counts nanoseconds


def test_the_recording_of_a_real_run_equals_its_parquet_file(tmp_path):
    scenario = load(ST1A, ["simulation.t_end=2.0"])
    simulation = scenario.simulation()
    simulation.run()
    result = simulation.result(scenario.title, scenario.resolved)
    sinks = [ConfigSink(), ParquetSink(), SummarySink(), RerunSink()]
    directory = write_record(result, tmp_path / "run", sinks)
    assert sorted(path.name for path in directory.iterdir()) == [
        "config.toml",
        "run.rrd",
        "summary.json",
        "trace.parquet",
    ]
    trace, found = read_trace(directory), read_back(directory / "run.rrd")
    assert len(trace.columns) > 20
    for path, samples in trace.columns.items():
        time, _, values = found[entity(path)]
        np.testing.assert_array_equal(values, samples)
        np.testing.assert_allclose(time, trace.t, rtol=0, atol=1e-9)
    assert from_data(tomllib.loads((directory / "config.toml").read_text())).system == scenario.system


def test_both_sides_of_an_event_share_one_time(synthetic_run, tmp_path):
    time, _, values = read_back(RerunSink().write(synthetic_run(), tmp_path))["/unit/G2/v_t"]
    before, after = np.flatnonzero(time == 0.5)
    assert values[before] == pytest.approx(1.0, abs=1e-4)
    assert values[after] < 0.5


def test_rotor_angles_are_shown_in_degrees(synthetic_run, tmp_path):
    result = synthetic_run()
    found = read_back(RerunSink().write(result, tmp_path))
    np.testing.assert_allclose(found["/degrees/unit/G2/delta"][2], np.degrees(result.trace["unit.G2.delta"]))


def test_estimates_are_shown_with_their_one_sigma_bands(synthetic_run, tmp_path):
    result = synthetic_run(mpc=True)
    n = len(result.trace.t)
    x_s, sigma = np.linspace(0.3, 0.5, n), np.linspace(0.1, 0.01, n)
    estimated = {"controller.mpc.x_s": x_s, "controller.mpc.sigma_x_s": sigma, "controller.mpc.v_bus": x_s}
    trace = replace(result.trace, columns={**result.trace.columns, **estimated})
    found = read_back(RerunSink().write(replace(result, trace=trace), tmp_path))
    np.testing.assert_array_equal(found["/above/controller/mpc/x_s"][2], x_s + sigma)
    np.testing.assert_array_equal(found["/below/controller/mpc/x_s"][2], x_s - sigma)
    assert "/above/controller/mpc/v_bus" not in found  # nothing says how uncertain it is
    (plot,) = Overview.of(result.system, trace.columns)._bands({})
    assert plot.contents == ["/controller/mpc/x_s", "/above/controller/mpc/x_s", "/below/controller/mpc/x_s"]


def test_the_blueprint_is_embedded_and_the_log_is_in_it(synthetic_run, tmp_path):
    reader = rr.chunk.RrdReader(RerunSink().write(synthetic_run(), tmp_path))
    assert len(list(reader.blueprints())) == 1
    texts = []
    for chunk in reader.stream():
        if chunk.entity_path == "/log":
            texts += [row[0] for row in chunk.to_record_batch()["TextLog:text"].to_pylist()]
    assert texts[0].endswith("three-phase fault at bus HV (R = 0.02, X = 0 pu)")
    assert len(texts) == 3


def test_a_run_that_ended_at_once_is_recorded(synthetic_run, tmp_path):
    result = synthetic_run()
    first = {path: samples[:1] for path, samples in result.trace.columns.items()}
    result = replace(result, trace=Trace(result.trace.t[:1], first, result.trace.units))
    assert len(read_back(RerunSink().write(result, tmp_path))["/unit/G2/v_t"][0]) == 1


def test_frames_keep_both_sides_of_events(synthetic_run):
    trace = synthetic_run().trace
    shown = frames(trace)
    assert len(shown) < len(trace.t) / 3
    for k in np.flatnonzero(np.diff(trace.t) == 0):
        assert {k, k + 1} <= set(shown)
    assert shown[-1] == len(trace.t) - 1


def test_a_live_view_without_a_viewer_takes_everything(synthetic_run):
    result = synthetic_run()
    trace = result.trace
    with serve(result.title, result.system, tuple(trace.columns), port=0) as view:
        for start in range(0, len(trace.t), 100):
            part = slice(start, start + 100)
            view.send(Trace(trace.t[part], {k: v[part] for k, v in trace.columns.items()}, trace.units))


def test_a_taken_port_is_left_to_whoever_has_it(synthetic_run):
    result = synthetic_run()
    with serve("one", result.system, ("unit.G2.v_t",), port=0) as one:
        taken = int(one.url.split(":")[2].split("/")[0])
        with serve("two", result.system, ("unit.G2.v_t",), port=taken) as two:
            assert two.url != one.url


def test_a_paced_run_shows_its_histograms(synthetic_run, tmp_path):
    result = synthetic_run(mpc=True)
    n = 100
    ms = {phase: np.full(n, 1.0 + k) for k, phase in enumerate(PHASES)}
    timing = Timing(0.05, 0.05, 0.05, 0.05 * np.arange(n), ms, 0, (), ())
    path = RerunSink().write(timed(result, timing), tmp_path)
    charts, series = {}, read_back(path)
    for chunk in rr.chunk.RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if "BarChart:values" in batch.schema.names:
            charts[chunk.entity_path] = batch
    assert set(charts) == {f"/histogram/{phase}" for phase in PHASES}
    np.testing.assert_array_equal(series["/realtime/work_ms"][2][:10], 4.0)
