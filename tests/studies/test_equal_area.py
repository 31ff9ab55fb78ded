import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pgexcite.core.config import load
from pgexcite.core.events import Change
from pgexcite.studies.equal_area import EqualAreaError, equal_area
from pgexcite.studies.power_angle import lossless_critical_angle

CASE = Path(__file__).parents[1] / "validation" / "kundur_ex13_1"
CONFIGS = Path(__file__).parents[2] / "configs" / "smib"


@pytest.fixture(scope="module")
def kundur():
    return load(CASE / "scenario.toml")


@pytest.fixture(scope="module")
def expected():
    return json.loads((CASE / "expected.json").read_text())


def test_kundur_example_13_1(kundur, expected):
    found = equal_area(kundur).as_dict()
    for name, tolerance in (
        ("e_prime", 5e-5),  # measured 2e-5
        ("v_infinite", 5e-5),
        ("delta_0_deg", 5e-3),
        ("p_max_before", 5e-4),
        ("p_max_after", 5e-5),
        ("delta_crit_deg", 5e-3),
        ("delta_limit_deg", 5e-3),
        ("t_crit", 5e-6),
    ):
        assert found[name] == pytest.approx(expected[name], abs=tolerance), name
    assert found["p_max_during"] == pytest.approx(0.0, abs=1e-12)


def test_kundur_example_13_1_largest_angles(kundur, expected):
    area = equal_area(kundur).area
    for clearing, angle in expected["delta_max_deg"].items():
        assert math.degrees(area.delta_max(float(clearing))) == pytest.approx(angle, abs=5e-3)
    assert area.delta_max(0.0869) is None


def test_closed_form_without_losses(kundur):
    area = equal_area(kundur).area
    assert lossless_critical_angle(area) == pytest.approx(area.delta_crit, abs=1e-9)


def test_the_reduced_network_gives_the_power_that_the_full_one_takes():
    """Kron reduction against solving all buses for an arbitrary angle, with arc resistance, loads left out."""
    study = equal_area(load(CONFIGS / "clearing_arc.toml"))
    for delta in (0.3, 1.0, 2.0):
        e = study.e_prime * np.exp(1j * delta)
        to_machine, to_grid, arc = 1 / 0.47j, 1 / 0.15j, 1 / 0.02
        v = (e * to_machine + study.v_infinite * to_grid) / (to_machine + to_grid + arc)
        power = (e * np.conj((e - v) * to_machine)).real
        assert study.area.during(delta) == pytest.approx(power, abs=1e-12)


def test_resistance_and_loads_are_in_the_curves(kundur):
    line = kundur.system.lines["C1"].model_copy(update={"R": 0.05})
    lossy = replace(kundur, system=replace(kundur.system, lines={**kundur.system.lines, "C1": line}))
    area = equal_area(lossy).area
    assert area.before.offset > 0.01
    assert area.before(area.delta_0) == pytest.approx(area.p_m)


def test_powers_are_on_the_unit_s_base(kundur):
    """The same plant on another system base is the same machine."""
    ratio = 100.0 / 2220.0

    def rebased(table):
        return {k: v.model_copy(update={"X": v.X * ratio}) for k, v in table.items()}

    system = kundur.system
    other = replace(system, S_base=100.0, lines=rebased(system.lines), transformers=rebased(system.transformers))
    assert equal_area(replace(kundur, system=other)).area.t_crit == pytest.approx(0.08683, abs=5e-6)


def test_a_fault_that_is_never_cleared_has_a_critical_time_but_no_largest_angle(kundur):
    study = equal_area(replace(kundur, changes=kundur.changes[:1]))
    assert study.clearing is None
    assert study.delta_max is None
    assert study.area.r_2 == pytest.approx(1.0)


def test_a_distant_fault_is_ridden_through(kundur):
    far = Change(1.0, {"bus.HT.fault_status": 1.0, "bus.HT.fault_R": 0.0, "bus.HT.fault_X": 5.0}, "fault")
    study = equal_area(replace(kundur, changes=(far,)))
    assert study.area.always_stable
    assert study.area.delta_crit is None
    assert "rides through" in str(study.rows())


def test_a_network_left_too_weak_is_lost_at_once(kundur):
    trips = (*kundur.changes, Change(kundur.changes[-1].t, {"line.C1.status": 0.0}, "line C1 trips"))
    study = equal_area(replace(kundur, changes=trips))
    assert study.area.delta_limit is None
    assert not study.area.always_stable
    assert "unstable at once" in str(study.rows())


def test_reclosing_later_is_not_part_of_the_construction(kundur):
    later = (*kundur.changes, Change(2.0, {"line.C2.status": 1.0}, "line C2 closes"))
    assert equal_area(replace(kundur, changes=later)).area == equal_area(kundur).area


def test_the_picture_is_drawn(kundur, tmp_path):
    path = equal_area(kundur).figure(tmp_path / "deep" / "figure.png")
    assert path.read_bytes().startswith(b"\x89PNG")


class TestWhatCannotBeShown:
    def test_no_fault(self, kundur):
        with pytest.raises(EqualAreaError, match="needs one fault; this scenario has 0"):
            equal_area(replace(kundur, changes=()))

    def test_two_machines(self, kundur):
        unit = kundur.system.device("unit.G")
        twice = replace(kundur.system, devices=(*kundur.system.devices, replace(unit, path="unit.H")))
        with pytest.raises(EqualAreaError, match=r"one machine and one infinite bus; here are"):
            equal_area(replace(kundur, system=twice))

    def test_something_else_before_the_clearing(self, kundur):
        early = Change(0.5, {"line.C1.status": 0.0}, "line C1 trips")
        with pytest.raises(EqualAreaError, match="line C1 trips"):
            equal_area(replace(kundur, changes=(early, *kundur.changes)))

    def test_a_command_at_the_fault(self, kundur):
        command = Change(1.0, {"unit.G.exciter.e_fd_ref": 2.0}, "field steps")
        with pytest.raises(EqualAreaError, match=r"unit\.G\.exciter\.e_fd_ref"):
            equal_area(replace(kundur, changes=(*kundur.changes, command)))

    def test_a_bolted_fault_at_the_infinite_bus(self, kundur):
        fault = Change(1.0, {"bus.EB.fault_status": 1.0}, "fault")
        with pytest.raises(EqualAreaError, match=r"bus\.EB"):
            equal_area(replace(kundur, changes=(fault,)))
