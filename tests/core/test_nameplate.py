"""A controller's own model: another parameter where it is said, the same everywhere else, and every wrong override refused."""

from __future__ import annotations

import pytest
from plants import kobbelv, regulated

from pgexcite.core.controller import Surroundings
from pgexcite.core.errors import ConfigError
from pgexcite.core.nameplate import overridden, own_model


def test_overrides_replace_what_they_name_and_nothing_else():
    system = regulated()
    changed = overridden(system, {"line.L1.X": 0.3, "unit.G2.machine.H": 3.5, "unit.G2.exciter.K_A": 150.0}, "model")
    assert changed.lines["L1"].X == 0.3
    assert changed.device("unit.G2").components["machine"].H == 3.5
    assert changed.device("unit.G2").components["exciter"].K_A == 150.0
    assert changed.transformers == system.transformers
    assert changed.device("unit.G2").components["stabiliser"] == system.device("unit.G2").components["stabiliser"]
    assert system.lines["L1"].X == 0.15
    assert overridden(system, {}, "model") is system


def test_the_model_starts_from_a_steady_state_of_its_own():
    system = kobbelv()
    told = Surroundings(0.005, "tr_bdf2", {}, {}, system, (), "never")
    as_configured, _ = own_model(told, {}, "model")
    other, kernel = own_model(told, {"line.L1.X": 0.3}, "model")
    assert other.residual < 1e-9
    y = kernel.outputs(other.state, other.p)
    assert y[other.model.position("y", "unit.G2.v_t")] == pytest.approx(1.0)
    delta = other.model.position("y", "unit.G2.delta")
    assert y[delta] > kernel.outputs(as_configured.state, as_configured.p)[delta] + 0.1


def test_all_wrong_overrides_are_named_at_once():
    with pytest.raises(ConfigError) as caught:
        overridden(kobbelv(), {"line.L1.Y": 0.3, "unit.G2.machine.H": -1.0, "unit.G2.exciter.e_fd_ref": 2.0}, "model")
    found = {problem.path: problem for problem in caught.value.problems}
    assert set(found) == {"model.line.L1.Y", "model.unit.G2.machine.H", "model.unit.G2.exciter.e_fd_ref"}
    assert "line.L1.X" in found["model.line.L1.Y"].hint


def test_values_that_do_not_go_together_are_refused():
    with pytest.raises(ConfigError, match="must not exceed"):
        overridden(kobbelv(), {"unit.G2.machine.Xp_d": 3.0}, "model")
