import numpy as np
import pytest
import rerun as rr

from pgexcite.core.record import RecordError, write_record
from pgexcite.plugins.sinks.parquet import ParquetSink
from pgexcite.studies.compare import CompareError, compare


@pytest.fixture(scope="module")
def runs(synthetic_run, tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    for name, gain in (("constant", 0.0), ("st1a", 30.0), ("nmpc", 80.0)):
        write_record(synthetic_run(title=name, gain=gain, mpc=name == "nmpc"), root / name, [ParquetSink()])
    return root


def test_one_row_per_run_with_all_figures(runs, tmp_path):
    rows = compare([runs / "constant", runs / "st1a", runs / "nmpc"], tmp_path).rows
    assert [row["label"] for row in rows] == ["constant", "st1a", "nmpc"]
    first = rows[0]
    assert first["outcome"] == "completed"
    assert first["first_swing_deg"] == pytest.approx(first["delta_max_deg"])
    assert 0.05 < first["damping"] < 0.1  # D = 8 at 2H = 5.8 s and 9 rad/s: 0.076
    assert first["recovery_5"] <= first["recovery_1"]
    assert rows[2]["fallbacks"] == 1
    assert rows[2]["solve_ms_p99"] == pytest.approx(8.86)


def test_the_picture_has_the_colours_of_all_runs(runs, tmp_path):
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread

    from pgexcite.studies.figures import COLOURS

    image = imread(compare([runs / "constant", runs / "st1a", runs / "nmpc"], tmp_path).picture)[:, :, :3]
    for colour in COLOURS[:3]:
        assert np.sum(np.max(np.abs(image - to_rgb(colour)), axis=2) < 0.03) > 500


def test_the_recording_holds_every_run(runs, tmp_path):
    reader = rr.chunk.RrdReader(compare([runs / "constant", runs / "st1a"], tmp_path).recording)
    paths = {chunk.entity_path for chunk in reader.stream()}
    assert {"/runs/constant/unit/G2/v_t", "/runs/st1a/unit/G2/v_t", "/degrees/st1a/unit/G2/delta"} <= paths
    assert {"/log/constant", "/log/st1a"} <= paths
    assert len(list(reader.blueprints())) == 1


def test_runs_of_one_name_get_labels_of_their_own(runs, tmp_path):
    rows = compare([runs / "constant", runs / "constant"], tmp_path).rows
    assert [row["label"] for row in rows] == ["constant", "constant (2)"]


def test_labels_can_be_given(runs, tmp_path):
    assert compare([runs / "constant"], tmp_path, labels=["no control"]).rows[0]["label"] == "no control"
    with pytest.raises(CompareError, match="as many different labels"):
        compare([runs / "constant"], tmp_path, labels=["a", "b"])


def test_what_is_not_a_run_is_named(runs, tmp_path):
    with pytest.raises(RecordError, match="not the record of a run"):
        compare([runs / "constant", tmp_path], tmp_path)
    with pytest.raises(CompareError, match="no run was given"):
        compare([], tmp_path)
