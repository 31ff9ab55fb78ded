"""Numbers printed in docs/ are those the code gives."""

import importlib.util
import math
from pathlib import Path

import pytest

from pgexcite.core.config import load
from pgexcite.studies.equal_area import equal_area

ROOT = Path(__file__).parents[2]


def tool(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["paper_figure_6", "field_bases"])
def test_the_table_in_the_docs_is_the_tool_s(name):
    assert tool(name).table() in (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def test_figure_6_cannot_have_both_its_critical_angle_and_its_critical_time():
    _, r_2 = tool("paper_figure_6").both()
    assert r_2 > 1


def test_field_bases():
    bases = tool("field_bases")
    assert bases.short_circuit_base() == pytest.approx(1.5725, abs=5e-5)
    assert bases.salient_pole() == pytest.approx(1.9246, abs=5e-5)


@pytest.mark.parametrize(
    ("config", "delta_crit", "t_crit"), [("clearing_arc", 91.5, 0.292), ("clearing_bolted", 80.4, 0.195)]
)
def test_equal_areas_of_the_paper_s_plant(config, delta_crit, t_crit):
    study = equal_area(load(ROOT / "configs" / "smib" / f"{config}.toml"))
    assert math.degrees(study.delta_q) == pytest.approx(39.0, abs=0.05)
    assert math.degrees(study.area.delta_0) == pytest.approx(29.4, abs=0.05)
    assert math.degrees(study.area.delta_crit) == pytest.approx(delta_crit, abs=0.05)
    assert study.area.t_crit == pytest.approx(t_crit, abs=5e-4)
