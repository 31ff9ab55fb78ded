import json

import numpy as np
import pytest

from pgexcite.core.record import RecordError, is_record, read_record, read_trace, write_record, write_trace


class Failing:
    def write(self, result, directory):
        (directory / "half").write_text("written")
        raise OSError(28, "No space left on device")


class Tracing:
    def write(self, result, directory):
        write_trace(result, directory / "trace.parquet")
        return directory / "trace.parquet"


def test_a_trace_comes_back_bit_for_bit(synthetic_run, tmp_path):
    result = synthetic_run()
    write_trace(result, tmp_path / "trace.parquet")
    trace = read_trace(tmp_path / "trace.parquet")
    np.testing.assert_array_equal(trace.t, result.trace.t)
    assert trace.columns.keys() == result.trace.columns.keys()
    for path, samples in result.trace.columns.items():
        np.testing.assert_array_equal(trace[path], samples, strict=True)
    assert trace.units == result.trace.units
    assert trace.log == result.trace.log


def test_both_sides_of_an_event_are_kept(synthetic_run, tmp_path):
    write_trace(synthetic_run(), tmp_path / "trace.parquet")
    trace = read_trace(tmp_path)
    at = np.flatnonzero(np.diff(trace.t) == 0)
    np.testing.assert_allclose(trace.t[at], [0.5, 0.6])
    assert trace["unit.G2.v_t"][at[0]] == pytest.approx(1.0, abs=1e-4)
    assert trace["unit.G2.v_t"][at[0] + 1] < 0.5


def test_units_and_description_are_in_the_metadata(synthetic_run, tmp_path):
    import pyarrow.parquet as pq

    write_trace(synthetic_run(title="a run"), tmp_path / "trace.parquet")
    schema = pq.read_schema(tmp_path / "trace.parquet")
    assert schema.field("t").metadata[b"unit"] == b"s"
    assert schema.field("unit.G2.delta").metadata[b"unit"] == b"rad"
    assert json.loads(schema.metadata[b"title"]) == "a run"
    assert json.loads(schema.metadata[b"outcome"])["ending"] == "completed"
    assert json.loads(schema.metadata[b"log"])[0]["kind"] == "event"


def test_a_record_comes_back(synthetic_run, tmp_path):
    result = synthetic_run(title="a run")
    directory = write_record(result, tmp_path / "deep" / "run", [Tracing()])
    record = read_record(directory)
    assert record.title == "a run"
    assert record.outcome == result.outcome
    assert record.config == result.config
    assert record.summary["units"]["G2"]["v_t_min"] < 0.5


def test_the_summary_is_written_whatever_the_sinks(synthetic_run, tmp_path):
    assert is_record(write_record(synthetic_run(), tmp_path / "run", []))


def test_a_record_is_replaced_as_a_whole(synthetic_run, tmp_path):
    write_record(synthetic_run(), tmp_path / "run", [Tracing()])
    write_record(synthetic_run(), tmp_path / "run", [])
    assert [item.name for item in (tmp_path / "run").iterdir()] == ["summary.json"]
    assert [item.name for item in tmp_path.iterdir()] == ["run"]


def test_an_empty_directory_may_be_used(synthetic_run, tmp_path):
    (tmp_path / "run").mkdir()
    assert is_record(write_record(synthetic_run(), tmp_path / "run", []))


@pytest.mark.parametrize("content", [{"notes.txt": "mine"}, {"summary.json": "{}"}, {"summary.json": "not json"}])
def test_what_is_not_a_record_is_left_alone(content, synthetic_run, tmp_path):
    (tmp_path / "run").mkdir()
    for name, text in content.items():
        (tmp_path / "run" / name).write_text(text)
    with pytest.raises(RecordError, match="not the record of a run"):
        write_record(synthetic_run(), tmp_path / "run", [])
    assert {p.name: p.read_text() for p in (tmp_path / "run").iterdir()} == content


def test_a_file_is_left_alone(synthetic_run, tmp_path):
    (tmp_path / "run").write_text("mine")
    with pytest.raises(RecordError, match="a file that is not"):
        write_record(synthetic_run(), tmp_path / "run", [])


def test_a_sink_that_fails_leaves_the_earlier_record_and_nothing_else(synthetic_run, tmp_path):
    write_record(synthetic_run(), tmp_path / "run", [Tracing()])
    with pytest.raises(RecordError, match="No space left"):
        write_record(synthetic_run(), tmp_path / "run", [Failing()])
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["run", "summary.json", "trace.parquet"]


def test_reading_what_is_not_a_record_says_so(tmp_path):
    with pytest.raises(RecordError, match="not the record"):
        read_record(tmp_path)
    with pytest.raises(RecordError, match=r"trace\.parquet"):
        read_trace(tmp_path)


def test_a_foreign_parquet_file_is_refused(tmp_path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({"a": [1]}), tmp_path / "other.parquet")
    with pytest.raises(RecordError, match="not the trace of a run"):
        read_trace(tmp_path / "other.parquet")
