"""The mismatch study: plant and model apart, per backend, against static exciter and stabiliser."""

from __future__ import annotations

import pytest

from pgexcite.studies.sweep import NOMINAL, run_study

pytestmark = [pytest.mark.slow, pytest.mark.mismatch]

PREDICTIVE = ("nmpc", "linear", "equivalent")


@pytest.fixture(scope="module")
def figures(pytestconfig, tmp_path_factory):
    """Figures of the study by variant and factor."""
    study = run_study(
        pytestconfig.rootpath / "configs" / "studies" / "mismatch.toml", tmp_path_factory.mktemp("mismatch")
    )
    assert not [row for row in study.rows if "error" in row]
    return {(row["variant"], row["factor"]): row for row in study.rows}


def factors(figures):
    return [factor for variant, factor in figures if variant == "st1a_pss"]


@pytest.mark.parametrize("variant", PREDICTIVE)
def test_no_controller_loses_synchronism_where_the_classical_one_keeps_it(figures, variant):
    for factor in factors(figures):
        assert figures["st1a_pss", factor]["outcome"] == "completed", factor
        assert figures[variant, factor]["outcome"] == "completed", factor


@pytest.mark.parametrize(("variant", "least"), [("equivalent", 0.03), ("nmpc", 0.04), ("linear", 0.025)])
def test_every_swing_is_damped(figures, variant, least):
    """Least damping of the grid, all at x_s x 2: measured 0.039, 0.050 and 0.031. The stabiliser damps better everywhere."""
    found = {factor: figures[variant, factor]["damping"] for factor in factors(figures)}
    assert min(found.values()) > least, found
    assert all(figures["st1a_pss", factor]["damping"] > value for factor, value in found.items())


def test_the_estimating_controller_restores_the_voltage_better_nearly_everywhere(figures):
    """Integral of the voltage error, the equivalent against static exciter and stabiliser; measured worse at x_s x 2 only."""
    worse = [f for f in factors(figures) if figures["equivalent", f]["v_t_iae"] > figures["st1a_pss", f]["v_t_iae"]]
    assert worse == ["x_s x 2"]


def test_a_perfect_state_does_not_make_up_for_a_wrong_model(figures):
    """The nmpc has no offset correction: with a wrong reactance it leaves the voltage off, the other two do not."""
    for factor in ("x_s x 0.5", "x_s x 1.5", "X'_d -30 %", "X'_d +30 %"):
        assert figures["nmpc", factor]["recovery_1"] is None
        assert figures["equivalent", factor]["recovery_1"] is not None
        assert figures["linear", factor]["recovery_1"] is not None
    assert figures["nmpc", NOMINAL]["recovery_1"] < 0.4  # measured 0.29


def test_measurements_that_are_noisy_late_or_lost_cost_little(figures):
    for variant, most in (("linear", 1.25), ("equivalent", 1.2)):
        nominal = figures[variant, NOMINAL]["v_t_iae"]
        for factor in ("noise 1 %", "delay of one sample", "10 % of samples lost"):
            assert figures[variant, factor]["v_t_iae"] < most * nominal  # measured 1.17 (noise) and 1.11 (loss) at most
