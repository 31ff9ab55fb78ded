"""Studies: every case once, keyed by what it resolves to, resumed, and not lost with a dying worker."""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from click.testing import CliRunner

from pgexcite.cli import main
from pgexcite.core.errors import ConfigError
from pgexcite.studies import sweep

STUDY = """
title = "Two exciters under two circumstances"
unit = "G2"
common = ["simulation.t_end=2", "simulation.compile='never'"]

[variant.constant]
base = "{configs}/smib/fault_constant.toml"

[variant.st1a]
base = "{configs}/smib/fault_st1a.toml"
set = ["unit.G2.exciter.K_A=150"]

[[factor]]
name = "longer line"
set = ["line.L1.X=0.2"]

[[factor]]
name = "never cleared"
set = ['event=[{{type="fault",t=1.0,bus="HV",R=0.02}}]']
only = {{ "st1*" = ["unit.G2.exciter.K_A=100"] }}
"""


@pytest.fixture
def study_file(tmp_path, pytestconfig):
    path = tmp_path / "study.toml"
    path.write_text(STUDY.format(configs=pytestconfig.rootpath / "configs"))
    return path


def test_cases_are_variants_times_factors_with_their_overrides(study_file):
    title, cases = sweep.cases(study_file)
    assert title == "Two exciters under two circumstances"
    assert [(c.variant, c.factor) for c in cases] == [
        (variant, factor) for factor in ("nominal", "longer line", "never cleared") for variant in ("constant", "st1a")
    ]
    assert len({c.key for c in cases}) == 6
    assert cases[-1].overrides[-1] == "unit.G2.exciter.K_A=100"


def test_a_study_runs_and_resumes(study_file, tmp_path, monkeypatch):
    with ThreadPoolExecutor(1) as pool:
        first = sweep.run_study(study_file, tmp_path / "out", executor=pool)
    outcomes = {(row["variant"], row["factor"]): row["outcome"] for row in first.rows}
    assert outcomes["st1a", "longer line"] == "completed"
    assert outcomes["constant", "never cleared"] == "lost_synchronism"
    assert all(row["first_swing_deg"] > 45 for row in first.rows if row["factor"] != "never cleared")
    (tmp_path / "out" / f"{sweep.cases(study_file)[1][2].key}.json").unlink()
    ran = []
    monkeypatch.setattr(sweep, "run_case", lambda case, run=sweep.run_case: ran.append(case.factor) or run(case))
    with ThreadPoolExecutor(1) as pool:
        second = sweep.run_study(study_file, tmp_path / "out", executor=pool)
    assert ran == ["longer line"]  # only what was missing
    assert second.rows == first.rows


def test_a_mistake_anywhere_stops_the_study_before_it_runs(study_file, tmp_path):
    study_file.write_text(study_file.read_text().replace("K_A=150", "K_a=150").replace('"st1*"', "st1b"))
    with pytest.raises(ConfigError) as caught:
        sweep.run_study(study_file, tmp_path / "out")
    text = str(caught.value)
    assert "st1a/nominal: unit.G2.exciter.K_a" in text
    assert "there is no variant 'st1b'" in text
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            'unit = "G2"',
            'unti = "G2"',
            ["unti: unknown key (got 'G2'); did you mean 'unit'?", "unit: is required: unit"],
        ),
        ('unit = "G2"', 'unit = "G3"', ["unit: there is no such unit in", "(got 'G3'); did you mean 'G2'?"]),
        (
            'base = "',
            'bse = "',
            ["variant.st1a.bse: unknown key", "did you mean 'base'?", "base: is required: scenario"],
        ),
        ("[variant", "[vary", ["variant: is required: what is compared", "vary: unknown key"]),
    ],
)
def test_mistakes_of_a_study_are_told_as_those_of_a_scenario(study_file, tmp_path, old, new, expected):
    study_file.write_text(study_file.read_text().replace(old, new))
    result = CliRunner().invoke(main, ["study", str(study_file), "--out", str(tmp_path / "out")])
    assert result.exit_code == 3
    for text in expected:
        assert text in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_scenario_is_told_from_a_study(pytestconfig, tmp_path):
    scenario = pytestconfig.rootpath / "configs" / "smib" / "fault_nmpc.toml"
    with pytest.raises(ConfigError, match="is a scenario, not a study; run it with `pgexcite run`"):
        sweep.run_study(scenario, tmp_path / "out")


def test_a_case_that_cannot_be_run_is_an_exit_code_too(study_file, tmp_path):
    text = study_file.read_text().split("[[factor]]")[0]
    study_file.write_text(text.replace("K_A=150", "V_RMAX=1.0"))
    result = CliRunner().invoke(main, ["study", str(study_file), "--out", str(tmp_path / "out"), "--workers", "1"])
    assert result.exit_code == 1
    assert "the initial operating point cannot be reached" in result.stdout
    assert "1 of 2 cases could not be run" in result.stderr


def die_in_one_case(case):
    """Stands in for a case that takes its process with it."""
    if (case.variant, case.factor) == ("st1a", "longer line"):
        os._exit(9)
    return {"outcome": "completed"}


def test_a_dying_worker_costs_one_case(study_file, tmp_path, monkeypatch):
    monkeypatch.setattr(sweep, "run_case", die_in_one_case)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))
    found = sweep.run_study(study_file, tmp_path / "out", workers=2)
    errors = [(row["variant"], row["factor"]) for row in found.rows if "error" in row]
    assert errors == [("st1a", "longer line")]
    assert "died" in json.dumps(found.rows)
    assert sum(row.get("outcome") == "completed" for row in found.rows) == 5


def test_critical_clearing_times_are_found_where_wanted(study_file, tmp_path):
    text = study_file.read_text().replace(
        "[variant.constant]",
        """[clearing]
tolerance = 0.02
set = ["simulation.h=0.02"]

[variant.constant]""",
    )
    study_file.write_text(text)
    with ThreadPoolExecutor(1) as pool:
        found = sweep.run_study(study_file, tmp_path / "out", executor=pool)
    times = {(row["variant"], row["factor"]): row["t_crit"] for row in found.rows}
    assert times["constant", "nominal"] == pytest.approx(0.281, abs=0.02)
    assert times["constant", "longer line"] < times["constant", "nominal"]
