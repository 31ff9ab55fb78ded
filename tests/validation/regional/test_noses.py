"""The P-V curves of docs/regional.md: what the grid without its link can carry against what the tap changer asks for."""

from __future__ import annotations

from pathlib import Path

import pytest

from pgexcite.core.config import from_data, read
from pgexcite.core.config.files import merge
from pgexcite.studies.pv_ramp import pv_by_ramp

CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.mark.parametrize(
    ("name", "link", "P", "V"),
    [
        ("link_loss", True, 982.0, 0.705),
        ("link_loss", False, 708.0, 0.774),
        ("link_loss_classical", False, 755.0, 0.739),
    ],
)
def test_noses(name, link, P, V):
    """The demand is 752 MW."""
    path = CONFIGS / "regional" / f"{name}.toml"
    data = merge(read(path), read(CONFIGS / "cases" / "regional_nose.toml"))
    data["event"] = [] if link else [data["event"][0] | {"t": 60.0}]
    scenario = from_data(data, path)
    found = pv_by_ramp(scenario.system, scenario.settings, "Balsfjord", scenario.changes)
    assert found.nose == (pytest.approx(P, abs=3.0), pytest.approx(V, abs=0.01))
    assert next(iter(found.acted)) == "unit.A2G1.limiter"
    assert "lost synchronism" in found.ended  # far down the lower branch
