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


FROM_THE_TERMINALS = ("unit.G2.transfer.ceiling=rectifier", "controller.mpc.u_max=3.85")
ON_ITS_OWN_SUPPLY = (
    "unit.G2.exciter={model='sexs', T_R=0.02, K=200.0, T_A=6.5, T_B=22.0, T_E=0.0, E_MIN=-3.2, E_MAX=3.2}",
)
WITHOUT_GAIN_REDUCTION = ("unit.G2.exciter.T_C=0.0", "unit.G2.exciter.T_B=0.0")
EXACT = ("controller.mpc.measurement.noise=0.0", "controller.mpc.measurement.noise_omega=0.0")


@pytest.mark.parametrize(
    ("name", "overrides", "t_crit"),
    [
        ("fault_st1a", (), 0.2769),
        ("fault_st1a", WITHOUT_GAIN_REDUCTION, 0.2769),
        ("fault_st1a", ON_ITS_OWN_SUPPLY, 0.2884),
        pytest.param("fault_nmpc", (), 0.2884, marks=pytest.mark.slow),
        pytest.param("fault_linear", FROM_THE_TERMINALS, 0.2769, marks=pytest.mark.slow),
        pytest.param("fault_equivalent", (*FROM_THE_TERMINALS, *EXACT), 0.2769, marks=pytest.mark.slow),
    ],
)
def test_the_clearing_time_is_that_of_the_fields_supply_whoever_commands_it(name, overrides, t_crit):
    found = critical_clearing_time(load(SMIB / f"{name}.toml", ["simulation.t_end=4.0", *overrides]), 5e-4)
    assert found.t_crit == pytest.approx(t_crit, abs=5e-4)  # measured 0.27685 and 0.28835 to 1e-4, each of them


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
