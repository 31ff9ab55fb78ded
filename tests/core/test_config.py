"""Scenarios: what a file says, what it is merged with, and everything that can be wrong with it."""

import math
from pathlib import Path

import pytest

from pgexcite import ConfigError, load
from pgexcite.core.config import from_data, json_schema, merge, remarks
from pgexcite.core.errors import Problem
from pgexcite.core.trace import Ending

CONFIGS = Path(__file__).parents[2] / "configs"
SMIB = CONFIGS / "smib"


def scenario():
    """A small valid scenario as plain data."""
    return {
        "simulation": {"t_end": 2.0},
        "system": {"S_base": 100.0, "f_n": 50.0},
        "bus": {"A": {}, "B": {}},
        "line": {"L1": {"from": "A", "to": "B", "X": 0.1}},
        "infinite_bus": {"grid": {"bus": "B", "V": 1.0}},
        "unit": {"G1": {"bus": "A", "S_n": 100.0, "P": 80.0, "V": 1.02, "machine": {"model": "salient_pole"}}},
    }


def _fault(t, duration):
    ends = {} if duration is None else {"duration": duration}
    return {"type": "fault", "t": t, "bus": "A", **ends}


def problems(data):
    with pytest.raises(ConfigError) as caught:
        from_data(data)
    return {problem.path: str(problem) for problem in caught.value.problems}


@pytest.mark.parametrize("path", sorted(SMIB.glob("*.toml")), ids=lambda path: path.stem)
def test_resolved_configuration_resolves_to_itself(path):
    found = load(path)
    again = from_data(found.resolved)
    assert again.resolved == found.resolved
    assert (again.system, again.settings, again.changes, again.controllers) == (
        found.system,
        found.settings,
        found.changes,
        found.controllers,
    )


def test_defaults_and_units():
    data = scenario()
    data["infinite_bus"]["grid"]["angle_deg"] = 30.0
    data["load"] = {"home": {"bus": "A", "P": 20.0, "Q": 5.0}}
    found = from_data(data)
    unit = found.system.device("unit.G1")
    assert (found.settings.h, found.settings.rule, found.expect) == (0.005, "tr_bdf2", "completed")
    assert set(unit.components) == {"machine", "exciter", "governor"}
    assert (unit.schedule.P, unit.schedule.V, unit.schedule.Q, unit.schedule.angle) == (80.0, 1.02, None, None)
    assert (unit.schedule.Q_min, unit.schedule.Q_max) == (-math.inf, math.inf)
    assert found.system.device("infinite_bus.grid").schedule.angle == pytest.approx(math.pi / 6)
    demand = found.system.device("load.home")
    assert (demand.schedule.P, demand.schedule.Q, demand.S_n) == (-20.0, -5.0, 100.0)
    assert found.resolved["load"]["home"]["model"] == "constant_impedance"
    assert found.resolved["unit"]["G1"]["machine"]["H"] == 2.9


def test_events_become_changes_in_order_of_time():
    data = scenario()
    data["event"] = [
        {"type": "line_trip", "t": 1.0, "name": "L1", "reclose_after": 0.5},
        {"type": "fault", "t": 0.5, "bus": "A", "duration": 0.1},
        {"type": "setpoint", "t": 0.2, "path": "unit.G1.exciter.e_fd_ref", "step": 0.1},
    ]
    found = from_data(data)
    assert [change.t for change in found.changes] == pytest.approx([0.2, 0.5, 0.6, 1.0, 1.5])


def test_includes_lie_underneath(tmp_path):
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "base.toml").write_text('title = "base"\n[unit.G]\nP = 1\nS_n = 5\n[[event]]\nt = 1\n')
    (tmp_path / "top.toml").write_text(
        'include = "below/base.toml"\n[unit.G]\nP = 2\n[[event]]\nt = 2\n[[event]]\nt = 3\n'
    )
    from pgexcite.core.config import read

    data = read(tmp_path / "top.toml")
    assert data == {"title": "base", "unit": {"G": {"P": 2, "S_n": 5}}, "event": [{"t": 2}, {"t": 3}]}


def test_another_model_takes_no_parameters_over():
    under = {"exciter": {"model": "constant_field", "E_MAX": 3.0}}
    assert merge(under, {"exciter": {"model": "st1a", "K_A": 5.0}})["exciter"] == {"model": "st1a", "K_A": 5.0}
    assert merge(under, {"exciter": {"E_MIN": 0.0}})["exciter"] == {
        "model": "constant_field",
        "E_MAX": 3.0,
        "E_MIN": 0.0,
    }


def test_overrides():
    found = load(
        SMIB / "fault_st1a.toml",
        [
            "unit.G2.exciter.K_A=150",
            "event.0.R=0.05",
            "title=another",
            "record.sinks=['summary']",
            "simulation.rule=trapezoidal",
        ],
    )
    assert found.system.device("unit.G2").components["exciter"].K_A == 150.0
    assert found.changes[0].values["bus.HV.fault_R"] == 0.05
    assert (found.title, found.sinks, found.settings.rule) == ("another", ("summary",), "trapezoidal")
    assert load(SMIB / "fault_st1a.toml", ["unit.G2.exciter.model=sexs"]).resolved["unit"]["G2"]["exciter"]["K"] > 0


@pytest.mark.parametrize(
    ("override", "path", "expected"),
    [
        ("unit.G3.P=1", "unit.G3", "there is no such table; did you mean 'G2'?"),
        ("units.G2.P=1", "units", "did you mean 'unit'?"),
        ("event.4.R=1", "event.4", "there is no such entry; entries 0 to 0 exist"),
        ("unit.G2.P.x=1", "unit.G2.P.x", "leads into a value"),
        ("simulation.h", "--set", "should be path=value"),
        ("unit.G2.exciter.KA=1", "unit.G2.exciter.KA", "did you mean 'K_A'?"),
        ("simulation.t_end=long", "simulation.t_end", "should be a valid number (got 'long')"),
    ],
)
def test_an_override_that_leads_nowhere(override, path, expected):
    with pytest.raises(ConfigError) as caught:
        load(SMIB / "fault_st1a.toml", [override])
    (problem,) = caught.value.problems
    assert problem.path == path
    assert expected in str(problem)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("noise=nan", "noise: should be a finite number (got nan); it is the standard deviation of voltages, currents"),
        ("noise=-1", "noise: should be greater than or equal to 0 (got -1); it is the standard deviation of voltages"),
        ("nois=1", "nois: unknown key (got 1); did you mean 'noise'?"),
    ],
)
def test_keys_of_a_table_in_a_table_are_told_by_their_own_names(override, expected):
    with pytest.raises(ConfigError) as caught:
        load(SMIB / "fault_equivalent.toml", [f"controller.mpc.measurement.{override}"])
    (problem,) = caught.value.problems
    assert str(problem).startswith(f"controller.mpc.measurement.{expected}")


def test_a_long_value_does_not_bury_its_message():
    text = str(Problem("unit", "should be a number", {f"key {k}": k for k in range(1000)}, "remove it"))
    assert text.startswith("unit: should be a number (got {'key 0': 0, ")
    assert text.endswith(" ...); remove it")
    assert len(text) < 200


WRONG = [
    (lambda d: d.update(titel="x"), "titel", "unknown key (got 'x'); did you mean 'title'?"),
    (lambda d: d.update(expect="victory"), "expect", "should be 'completed', 'lost_synchronism'"),
    (lambda d: d.update(unit=5), "unit", "should be a valid dictionary"),
    (lambda d: d["unit"].update(G9=5), "unit.G9", "should be a valid dictionary"),
    (lambda d: d["unit"].update({"a.b": dict(d["unit"]["G1"])}), "unit.a.b", "a name may hold letters"),
    (lambda d: d["simulation"].pop("t_end"), "simulation.t_end", "is required: simulated time, s"),
    (lambda d: d["simulation"].update(h=0), "simulation.h", "should be greater than 0 (got 0)"),
    (lambda d: d["simulation"].update(h="0.005"), "simulation.h", "should be a valid number (got '0.005')"),
    (lambda d: d["simulation"].update(rule="heun"), "simulation.rule", "should be 'tr_bdf2', 'trapezoidal' or"),
    (lambda d: d["simulation"].update(reference="G2"), "simulation.reference", "did you mean 'G1'?"),
    (lambda d: d.pop("system"), "system.S_base", "is required: system base, MVA"),
    (lambda d: d["bus"].clear(), "bus", "there is no bus"),
    (lambda d: d["line"]["L1"].update(to="C"), "line.L1.to", "there is no such bus (got 'C'); known: A, B"),
    (lambda d: d["line"]["L1"].update(to="A"), "line.L1", "both ends are at bus 'A'"),
    (lambda d: d["line"]["L1"].update(X=0), "line.L1", "R and X are both zero"),
    (lambda d: d["line"]["L1"].update(status=0), "bus.A", "the island of bus A has no infinite bus and no slack unit"),
    (lambda d: d["infinite_bus"]["grid"].update(bus="b"), "infinite_bus.grid.bus", "did you mean 'B'?"),
    (lambda d: d["infinite_bus"]["grid"].update(voltage=1), "infinite_bus.grid.voltage", "unknown key"),
    (
        lambda d: d["infinite_bus"]["grid"].pop("V"),
        "bus.A",
        "as many of these as of those; give V to infinite_bus.grid, or Q beside P and V to a unit",
    ),
    (
        lambda d: d["unit"]["G1"].update(Q=3.0),
        "bus.A",
        "with all of P, Q and V: unit.G1; there must be as many of these as of those; leave Q or V out at unit.G1",
    ),
    (lambda d: d["unit"]["G1"].pop("P"), "unit.G1.P", "is required of a unit that is no slack"),
    (lambda d: d["unit"]["G1"].pop("V"), "unit.G1.V", "V (pu) or Q (Mvar) is required"),
    (lambda d: d["unit"]["G1"].update(slack=True), "unit.G1.P", "a slack's power follows from the power flow"),
    (lambda d: d["unit"]["G1"].update(angle_deg=3), "unit.G1.angle_deg", "only a slack's angle can be given"),
    (lambda d: d["unit"]["G1"].update(Q_min=5, Q_max=1), "unit.G1.Q_min", "must not exceed Q_max = 1 Mvar (got 5"),
    (lambda d: d["unit"]["G1"].update(exiter={}), "unit.G1.exiter", "unknown key (got {}); did you mean 'exciter'?"),
    (
        lambda d: d["unit"]["G1"].update(exciter="st1a"),
        "unit.G1.exciter",
        "should be a valid dictionary|should be a table",
    ),
    (lambda d: d["unit"]["G1"].pop("machine"), "unit.G1.machine.model", "is required; known: classical"),
    (
        lambda d: d["unit"]["G1"]["machine"].update(H=-3),
        "unit.G1.machine.H",
        "should be greater than 0 (got -3); it is the inertia",
    ),
    (lambda d: d["unit"]["G1"]["machine"].update(H=math.nan), "unit.G1.machine.H", "finite number"),
    (lambda d: d["unit"]["G1"]["machine"].update(Xp_d=2.0), "unit.G1.machine", "X_d"),
    (
        lambda d: d["unit"]["G1"]["machine"].update(model="salient_pol"),
        "unit.G1.machine.model",
        "did you mean 'salient_pole'?",
    ),
    (lambda d: d.update(load={"x": {"bus": "A", "P": 1, "model": "zap"}}), "load.x.model", "did you mean 'zip'?"),
    (lambda d: d.update(load={"x": {"bus": "A"}}), "load.x.P", "is required"),
    (lambda d: d.update(event=[{"t": 1}]), "event.0.type", "is required; one of fault, line_trip"),
    (lambda d: d.update(event=[{"t": 1, "type": "falt"}]), "event.0.type", "did you mean 'fault'?"),
    (lambda d: d.update(event=[{"t": 1, "type": "fault"}]), "event.0.bus", "is required"),
    (
        lambda d: d.update(event=[{"t": 1, "type": "fault", "bus": "D"}]),
        "event.0.bus",
        "there is no such bus (got 'D')",
    ),
    (lambda d: d.update(event=[{"t": 1, "type": "line_trip", "name": "L2"}]), "event.0.name", "did you mean 'L1'?"),
    (lambda d: d.update(event=[{"t": 1, "type": "load_step", "load": "x"}]), "event.0.load", "there is no such load"),
    (
        lambda d: d.update(event=[{"t": 1, "type": "hand_over", "controller": "x", "to": "classical"}]),
        "event.0.controller",
        "there is no such controller",
    ),
    (
        lambda d: d.update(event=[{"t": 1, "type": "set", "path": "unit.G1.machine.h", "value": 1}]),
        "event.0.path",
        "there is no such parameter or set-point (got 'unit.G1.machine.h'); did you mean 'unit.G1.machine.H'?",
    ),
    (
        lambda d: d.update(event=[{"t": 1, "type": "set", "path": "unit.G1.machine.H", "value": -1}]),
        "event.0.value",
        "unit.G1.machine.H should be greater than 0",
    ),
    (
        lambda d: d.update(event=[{"t": 1, "type": "set", "path": "line.L1.X"}]),
        "event.0",
        "exactly one of value and step",
    ),
    (
        lambda d: d.update(event=[{"t": 1.001, "type": "fault", "bus": "A", "duration": 0.003}]),
        "event.0.duration",
        "ends on the step boundary it begins on",
    ),
    (
        lambda d: d.update(event=[{"t": 1, "type": "line_trip", "name": "L1", "reclose_after": 1e-9}]),
        "event.0.reclose_after",
        "ends on the step boundary it begins on",
    ),
    (
        lambda d: d.update(event=[_fault(1.0, 0.1), _fault(1.05, 0.15)]),
        "event.1.t",
        "bus A is still faulted then by event.0",
    ),
    (lambda d: d.update(event=[_fault(1.0, 0.1), _fault(0.5, None)]), "event.0.t", "still faulted then by event.1"),
    (lambda d: d.update(event=[_fault(1.0, 0.1), _fault(1.1, 0.1)]), "event.1.t", "let it begin a step later"),
    (lambda d: d.update(controller={"c": {"model": "pid"}}), "controller.c.model", "there is no such controller"),
    (lambda d: d.update(controller={"c": {"model": "mpc", "unit": "G2"}}), "controller.c.unit", "did you mean 'G1'?"),
    (
        lambda d: d.update(controller={"c": {"model": "mpc", "unit": "G1", "dt": 0.013}}),
        "controller.c.dt",
        "must be a whole multiple of the step simulation.h = 0.005 s (got 0.013); 0.015 would do",
    ),
    (
        lambda d: d.update(controller={"c": {"model": "mpc", "unit": "G1", "backend": "nmcp"}}),
        "controller.c.backend",
        "did you mean 'nmpc'?",
    ),
    (lambda d: d.update(record={"sinks": ["parket"]}), "record.sinks", "did you mean 'parquet'?"),
]


@pytest.mark.parametrize(("spoil", "path", "expected"), WRONG, ids=[f"{n}-{case[1]}" for n, case in enumerate(WRONG)])
def test_a_single_mistake_is_reported_once_with_path_value_and_advice(spoil, path, expected):
    data = scenario()
    spoil(data)
    found = problems(data)
    assert path in found
    assert any(part in found[path] for part in expected.split("|")), found[path]


def test_faults_apart_in_time_or_place_are_sound():
    data = scenario()
    elsewhere = {**_fault(1.05, 0.1), "bus": "B"}
    data["event"] = [_fault(1.0, 0.1), elsewhere, _fault(1.105, 0.005)]
    assert len(from_data(data).changes) == 6


def test_all_problems_come_at_once():
    data = scenario()
    spoilt = {
        "titel": lambda d: d.update(titel="x"),
        "simulation.h": lambda d: d["simulation"].update(h=-1),
        "line.L1.form": lambda d: d["line"]["L1"].update(form="A"),
        "unit.G1.machine.H": lambda d: d["unit"]["G1"]["machine"].update(H=-1),
        "unit.G1.exciter.model": lambda d: d["unit"]["G1"].update(exciter={"model": "st1b"}),
        "event.0.bus": lambda d: d.update(event=[{"t": 1, "type": "fault", "bus": "D"}]),
        "controller.c.dt": lambda d: d.update(controller={"c": {"model": "mpc", "unit": "G1", "dt": -1}}),
    }
    for spoil in spoilt.values():
        spoil(data)
    assert set(problems(data)) == set(spoilt)


def test_what_does_not_validate_is_not_blamed_twice():
    data = scenario()
    data["unit"]["G1"]["machine"]["H"] = -1
    data["event"] = [{"t": 1, "type": "set", "path": "unit.G1.machine.H", "value": 3}]
    assert set(problems(data)) == {"unit.G1.machine.H"}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("[bus.A]\n[bus.B]\n[bus.A]\n", "Cannot declare ('bus', 'A') twice (at line 3"),
        ("title = text\n", "is not valid TOML: Invalid value (at line 1"),
        ('include = "absent.toml"\n', "absent.toml"),
        ('include = "scenario.toml"\n', "a file includes itself"),
        ("include = 3\n", "should be a file name or a list of file names (got 3)"),
    ],
)
def test_files_that_cannot_be_read(tmp_path, content, expected):
    path = tmp_path / "scenario.toml"
    path.write_text(content)
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert expected in str(caught.value)


def test_a_file_that_is_not_text(tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="is not UTF-8 text"):
        load(path)


def test_limiters_take_one_slot_or_named_ones():
    data = scenario()
    data["unit"]["G1"]["limiter"] = {"model": "no_such"}
    assert set(problems(data)) == {"unit.G1.limiter.model"}
    data["unit"]["G1"]["limiter"] = {"over": {"model": "no_such"}, "under": {"model": "none_such"}}
    assert set(problems(data)) == {"unit.G1.limiter.over.model", "unit.G1.limiter.under.model"}


def test_expectations_are_the_kernels_endings():
    from typing import get_args

    from pgexcite.core.config.tables import Expectation

    assert set(get_args(Expectation)) == {ending.value for ending in Ending}


def test_schema_knows_every_model():
    schema = json_schema()
    machine = schema["$defs"]["machine.salient_pole"]
    assert machine["properties"]["H"]["exclusiveMinimum"] == 0
    assert machine["properties"]["H"]["unit"] == "s"
    assert machine["properties"]["model"] == {"const": "salient_pole"}
    assert machine["additionalProperties"] is False
    assert schema["$defs"]["load.zip"]["required"] == ["bus", "P"]
    assert {"exciter.st1a", "controller.mpc", "source.infinite_bus"} <= set(schema["$defs"])


def transforming(**tap_changer):
    data = scenario()
    data["bus"]["C"] = {}
    changer = {"model": "oltc", **tap_changer}
    data["transformer"] = {"T": {"from": "A", "to": "C", "X": 0.1, "tap": 0.95, "tap_changer": changer}}
    return data


@pytest.mark.parametrize("model", ["oltc", "continuous"])
def test_a_ratio_beyond_its_tap_changer_is_refused(model):
    """An automaton that starts below its lowest ratio would be stuck there without a word."""
    data = transforming(model=model, tap_min=0.97)
    assert "0.97 .. 1.2 (got 0.95)" in problems(data)["transformer.T.tap"]


def test_a_dead_band_narrower_than_a_step_is_remarked():
    assert remarks(from_data(transforming())) == []
    told = "transformer.T.tap_changer: a dead band of +-0.004 pu is narrower than a step of 0.01 pu: taps may hunt"
    assert remarks(from_data(transforming(half_deadband=0.004))) == [told]


def test_an_event_that_the_step_moves_is_remarked():
    assert remarks(load(SMIB / "fault_st1a.toml")) == []
    moved = remarks(load(SMIB / "fault_st1a.toml", ["simulation.h=0.03"]))
    assert [text.partition(" takes place ")[2] for text in moved] == [
        "at 1.02 s, the next whole step of simulation.h = 0.03 s, and not at 1 s",
        "at 1.11 s, the next whole step of simulation.h = 0.03 s, and not at 1.1 s",
    ]
