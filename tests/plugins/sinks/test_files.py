"""The sinks that write plain files."""

import json
import tomllib

from pgexcite.core.record import read_trace
from pgexcite.core.summary import summarise
from pgexcite.plugins.sinks.config import ConfigSink
from pgexcite.plugins.sinks.parquet import ParquetSink
from pgexcite.plugins.sinks.summary import SummarySink


def test_parquet_writes_the_trace(synthetic_run, tmp_path):
    result = synthetic_run()
    assert read_trace(ParquetSink().write(result, tmp_path)).columns.keys() == result.trace.columns.keys()


def test_summary_is_that_of_the_run_and_marks_the_record(synthetic_run, tmp_path):
    result = synthetic_run(mpc=True)
    content = json.loads(SummarySink().write(result, tmp_path).read_text())
    assert content.pop("format") == "pgexcite-run-1"
    assert content == summarise(result)


def test_config_is_toml_that_reads_back(synthetic_run, tmp_path):
    result = synthetic_run(title="räksmörgås")
    path = ConfigSink().write(result, tmp_path)
    assert tomllib.loads(path.read_text(encoding="utf-8")) == result.config
