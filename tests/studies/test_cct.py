"""Critical clearing times of the one-machine plant, and what the search makes of odd scenarios."""

from pathlib import Path

import pytest

from pgexcite import PgexciteError, load
from pgexcite.studies.cct import critical_clearing_time

SMIB = Path(__file__).parents[2] / "configs" / "smib"


@pytest.mark.parametrize(
    ("name", "t_crit", "delta_deg"),
    [("clearing_bolted", 0.1898, 87.09), ("clearing_arc", 0.2805, 95.28)],
)
def test_the_plants_clearing_times(name, t_crit, delta_deg):
    found = critical_clearing_time(load(SMIB / f"{name}.toml"), 1e-4)
    assert found.t_crit == pytest.approx(t_crit, abs=1e-3)  # measured 0.19015 and 0.28095
    assert found.delta_crit_deg == pytest.approx(delta_deg, abs=0.3)  # measured 87.25 and 95.45
    assert found.bracket[1] - found.bracket[0] == pytest.approx(1e-4)
    assert (found.unit, found.outcome) == ("unit.G2", "lost_synchronism")


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["tr_bdf2", "trapezoidal"])
def test_the_clearing_time_does_not_depend_on_step_or_rule(rule):
    overrides = [f"simulation.rule={rule}"]
    coarse = critical_clearing_time(load(SMIB / "clearing_arc.toml", overrides), 1e-3)
    fine = critical_clearing_time(load(SMIB / "clearing_arc.toml", overrides), 1e-5)
    assert coarse.t_crit == pytest.approx(fine.t_crit, abs=1e-3)
    assert fine.t_crit == pytest.approx(0.28095, abs=5e-5)  # measured 0.280955 by both rules


def test_a_fault_that_never_clears_is_searched_all_the_same():
    scenario = load(SMIB / "clearing_arc.toml", ['event=[{type="fault", t=1.0, bus="HV", R=0.02}]'])
    assert critical_clearing_time(scenario, 1e-3).t_crit == pytest.approx(0.281, abs=1e-3)


def test_a_line_that_trips_when_the_fault_clears_moves_with_it():
    trip = 'event=[{type="fault", t=1.0, bus="HV", duration=0.1}, {type="line_trip", t=1.1, name="L2"}]'
    parallel = ["line.L1.X=0.3"]
    data = load(SMIB / "clearing_bolted.toml", parallel).resolved
    from pgexcite.core.config import from_data
    from pgexcite.core.config.files import override

    data = {**data, "line": dict.fromkeys(("L1", "L2"), data["line"]["L1"])}
    tripped = critical_clearing_time(from_data(override(data, [trip])), 1e-3)
    kept = critical_clearing_time(from_data(data), 1e-3)
    assert 0.02 < tripped.t_crit < kept.t_crit


def test_no_clearing_is_fast_enough():
    scenario = load(SMIB / "clearing_arc.toml", ["simulation.delta_max_deg=30"])
    with pytest.raises(
        PgexciteError, match=r"even a fault of 0\.001 s ends as lost_synchronism: no clearing is fast enough"
    ):
        critical_clearing_time(scenario, 1e-3)
