"""The mismatch study: plant and model apart, per backend, against static exciter and stabiliser."""

from __future__ import annotations

import pytest

from pgexcite.studies.sweep import NOMINAL, run_study

# One worker runs the study for all of them.
pytestmark = [pytest.mark.slow, pytest.mark.mismatch, pytest.mark.xdist_group("mismatch")]

PREDICTIVE = tuple(f"{name}{weights}" for name in ("nmpc", "linear", "equivalent") for weights in ("", "_damped"))


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
def test_every_swing_is_damped_and_with_the_published_weights_less_than_by_the_stabiliser(figures, variant, least):
    """Least damping of the grid, all at x_s x 2: measured 0.039, 0.050 and 0.031."""
    found = {factor: figures[variant, factor]["damping"] for factor in factors(figures)}
    assert min(found.values()) > least, found
    assert all(figures["st1a_pss", factor]["damping"] > value for factor, value in found.items())


def not_below(figures, variant, figure, tolerance=0.0):
    """Factors at which a figure of a variant is below that of static exciter and stabiliser; ``None`` is infinite."""
    found = []
    for factor in factors(figures):
        own, other = (figures[name, factor][figure] for name in (variant, "st1a_pss"))
        if own is not None and (other is None or own < other - tolerance):
            found.append(factor)
    return found


@pytest.mark.parametrize("variant", ["equivalent", "equivalent_damped"])
def test_the_estimating_controller_bears_faults_as_long_as_the_classical_one(figures, variant):
    """Critical clearing times, to the width of the bracket."""
    assert not not_below(figures, variant, "t_crit", 0.0025)


def test_with_weights_that_damp_the_estimating_controller_damps_as_well_as_the_stabiliser(figures):
    worse = not_below(figures, "equivalent_damped", "damping")
    assert worse == ["delay of one sample"]  # measured 0.108 against 0.139: nothing makes up for the delay


def test_a_wrong_model_costs_the_others_clearing_time(figures):
    """Measured: 8 ms of 139 at x_s x 2, 15 ms of 246 at X'_d +30 %."""
    assert not_below(figures, "nmpc_damped", "t_crit", 0.0025) == ["x_s x 2", "X'_d +30 %"]
    assert not_below(figures, "linear_damped", "t_crit", 0.0025) == ["x_s x 2"]


def test_the_estimating_controller_restores_the_voltage_better_nearly_everywhere(figures):
    """Integral of the voltage error against static exciter and stabiliser: worse at x_s x 2, published weights, only."""
    for variant, expected in (("equivalent", ["x_s x 2"]), ("equivalent_damped", [])):
        worse = [f for f in factors(figures) if figures[variant, f]["v_t_iae"] > figures["st1a_pss", f]["v_t_iae"]]
        assert worse == expected


def test_a_perfect_state_does_not_make_up_for_a_wrong_model(figures):
    """The nmpc has no offset correction: with a wrong reactance it leaves the voltage off, the other two do not."""
    for factor in ("x_s x 0.5", "x_s x 1.5", "X'_d -30 %", "X'_d +30 %"):
        assert figures["nmpc", factor]["recovery_1"] is None
        assert figures["equivalent", factor]["recovery_1"] is not None
        assert figures["linear", factor]["recovery_1"] is not None
    assert figures["nmpc", NOMINAL]["recovery_1"] < 0.4  # measured 0.29


def test_measurements_that_are_noisy_late_or_lost_cost_little(figures):
    for variant, most in (("linear", 1.25), ("equivalent", 1.3)):
        nominal = figures[variant, NOMINAL]["v_t_iae"]
        for factor in ("noise 1 %", "delay of one sample", "10 % of samples lost"):
            assert figures[variant, factor]["v_t_iae"] < most * nominal  # measured 1.17 (noise) and 1.22 (loss) at most
