"""P-V curves against the closed form of a lossless line (Van Cutsem and Vournas 1998, chapter 2)."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pgexcite.cli import main
from pgexcite.core import powerflow
from pgexcite.core.config import load
from pgexcite.core.system import Schedule
from pgexcite.studies.continuation import ContinuationError
from pgexcite.studies.pv import pv_curve

CONFIGS = Path(__file__).parents[2] / "configs"
TWO_BUS = CONFIGS / "cases" / "two_bus.toml"
TWO_AREA = CONFIGS / "two_area" / "manual.toml"


@pytest.mark.parametrize(
    ("tan_phi", "p_max", "v_crit"),
    [
        (0.0, 0.5, 0.7071067811865475),
        (0.2, 0.4099019513592784, 0.6465443602167946),
        (0.4, 0.3385164807134504, 0.6038157067471993),
    ],
)
def test_nose_of_the_published_cases(tan_phi, p_max, v_crit):
    curve = pv_curve(load(TWO_BUS).system, tan_phi=tan_phi)
    assert curve.P_max / 100 == pytest.approx(p_max, abs=1e-9)  # measured 1e-16
    assert curve.V["L"][curve.nose] == pytest.approx(v_crit, abs=1e-9)  # measured 1e-16
    assert curve.weakest == "L"


@pytest.mark.parametrize("tan_phi", [-0.5, 0.0, 0.3, 1.0])
def test_both_branches_and_the_nose_are_the_closed_form(tan_phi):
    curve = pv_curve(load(TWO_BUS).system, tan_phi=tan_phi)
    phi = math.atan(tan_phi)
    assert curve.P_max / 100 == pytest.approx((1 - math.sin(phi)) / (2 * math.cos(phi)), abs=1e-9)
    assert curve.V["L"][curve.nose] == pytest.approx(1 / math.sqrt(2 * (1 + math.sin(phi))), abs=1e-9)
    p, v = curve.P / 100, curve.V["L"]
    # v^4 + (2 p t - 1) v^2 + p^2 (1 + t^2) = 0 holds on both branches, and unlike its solution is not steep at the nose.
    residual = v**4 + (2 * p * tan_phi - 1) * v**2 + p**2 * (1 + tan_phi**2)
    assert np.abs(residual).max() < 1e-9  # measured 1e-12
    assert np.all(np.diff(v[curve.nose :]) < 0)
    assert p[0] == pytest.approx(0.0, abs=1e-12)
    assert v[0] == pytest.approx(1.0, abs=1e-12)
    assert np.abs(curve.Q - tan_phi * curve.P).max() < 1e-9


def test_points_solve_the_power_flow():
    """A point of the two-area curve is the power flow of the system with loads of that size; beyond the nose there is none."""
    system = load(TWO_AREA).system
    curve = pv_curve(system)
    assert curve.weakest == "8"
    assert 1.0 < curve.factor[curve.nose] < 1.2

    def scaled(factor):
        return replace(system, devices=tuple(
            replace(d, schedule=Schedule(P=d.schedule.P * factor, Q=d.schedule.Q * factor)) if d.path.startswith("load.") else d
            for d in system.devices
        ))  # fmt: skip

    k = curve.nose // 2
    flow = powerflow.solve(scaled(curve.factor[k]))
    for bus, v in flow.v.items():
        assert abs(v) == pytest.approx(curve.V[bus][k], abs=1e-9)
    with pytest.raises(powerflow.PowerFlowError):
        powerflow.solve(scaled(curve.factor[curve.nose] * 1.001))


def test_reactive_limits_are_met_exactly_and_shorten_the_curve():
    system = load(TWO_AREA).system
    free = pv_curve(system)
    devices = tuple(
        replace(d, schedule=replace(d.schedule, Q_max=260.0)) if d.path in ("unit.G2", "unit.G4") else d for d in system.devices
    )  # fmt: skip
    curve = pv_curve(replace(system, devices=devices))
    assert {path for _, path in curve.limited} == {"unit.G2", "unit.G4"}
    assert curve.P_max < free.P_max
    first = min(p for p, path in curve.limited if path == "unit.G2")
    P = curve.P[: curve.nose + 1]
    before = (P > 2500.0) & (first - 1e-6 > P)
    assert np.ptp(curve.V["2"][: curve.nose + 1][before]) < 1e-12
    assert curve.V["2"][curve.nose] < 1.01


def test_one_load_of_several():
    curve = pv_curve(load(TWO_AREA).system, ["L9"])
    assert curve.loads == ("load.L9",)
    assert curve.P[curve.nose] == pytest.approx(1767.0 * curve.factor[curve.nose])


def test_what_cannot_be_scaled_is_refused():
    system = load(TWO_AREA).system
    with pytest.raises(ContinuationError, match=r"no load is named L8; loads are L7, L9"):
        pv_curve(system, ["L8"])
    with pytest.raises(ContinuationError, match="nothing to scale"):
        pv_curve(load(TWO_BUS, ["load.L.P=0.0"]).system)


def test_command_draws_curves_and_their_surface(tmp_path):
    pictures = []
    for tangents in (["0.2"], ["-0.2", "0", "0.2"]):
        picture = tmp_path / f"{len(tangents)}.png"
        options = [item for value in tangents for item in ("--tan-phi", value)]
        result = CliRunner().invoke(main, ["pv", str(TWO_BUS), *options, "--figure", str(picture)])
        assert result.exit_code == 0, result.output
        assert "40.99" in result.output
        pictures.append(picture.read_bytes())
    assert all(content.startswith(b"\x89PNG") and len(content) > 20_000 for content in pictures)


def test_command_in_per_unit(tmp_path):
    options = ["--tan-phi", "0", "--per-unit", "--figure", str(tmp_path / "one.png")]
    printed = CliRunner().invoke(main, ["pv", str(TWO_BUS), *options]).output
    assert "P_max [pu]" in printed
    assert "0.5 " in printed
    assert (tmp_path / "one.png").stat().st_size > 20_000


def test_the_curve_turns_by_little_from_point_to_point():
    """What makes its picture smooth: less than 10 degrees between one chord and the next."""
    curve = pv_curve(load(TWO_BUS).system)
    chords = np.diff(curve.factor) + 1j * np.diff(curve.V["L"])
    turns = np.abs(np.degrees(np.angle(chords[1:] / chords[:-1])))
    assert turns.max() < 10.0  # measured 7.7


def test_command_as_json_and_with_a_wrong_bus():
    import json

    found = json.loads(CliRunner().invoke(main, ["pv", str(TWO_BUS), "--json"]).output)
    assert found["curves"][0]["P_max_MW"] == pytest.approx(50.0)
    wrong = CliRunner().invoke(main, ["pv", str(TWO_BUS), "--bus", "M"])
    assert wrong.exit_code == 2
    assert "there is no bus M; buses are E, L" in wrong.output
