"""The command: what it prints, how it exits, and that bad input gives a message, never a traceback or half a record."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from pgexcite.cli import main

CONFIGS = Path(__file__).parents[1] / "configs"
SMIB = CONFIGS / "smib"
SHORT = ["--set", "simulation.t_end=1.5", "--set", "record.sinks=['config', 'summary', 'parquet']"]


def call(*arguments):
    return CliRunner().invoke(main, [str(item) for item in arguments])


def figures(*arguments):
    result = call(*arguments, "--json")
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


@pytest.fixture
def scenario(tmp_path):
    """A function that writes a scenario over the one-machine network and returns its path."""

    def write(text, base="kobbelv_smib.toml"):
        path = tmp_path / "scenario.toml"
        path.write_text(f'include = "{(CONFIGS / "cases" / base).as_posix()}"\n{text}')
        return path

    return write


FAULT = '[[event]]\ntype = "fault"\nt = 0.5\nbus = "HV"\nR = 0.02\nduration = 0.1\n'
MPC = '[controller.mpc]\nmodel = "mpc"\nunit = "G2"\n'

BAD = {
    "misspelt key": (
        '[unit.G2.exciter]\nmodel = "st1a"\nK_AA = 200.0\n',
        3,
        ["unit.G2.exciter.K_AA: unknown key (got 200.0); did you mean 'K_A'?"],
    ),
    "negative inertia": (
        "[unit.G2.machine]\nH = -2.9\n",
        3,
        [
            "unit.G2.machine.H: should be greater than 0 (got -2.9); it is the inertia constant on the machine's base [s]"
        ],
    ),
    "unknown model": (
        '[unit.G2.exciter]\nmodel = "st1b"\n',
        3,
        ["unit.G2.exciter.model: there is no such exciter (got 'st1b'); did you mean 'st1a'?"],
    ),
    "unknown bus": (
        '[line.L1]\nto = "IMF"\n',
        3,
        ["line.L1.to: there is no such bus (got 'IMF'); did you mean 'INF'?"],
    ),
    "duplicate name": (
        '[line.L2]\nfrom = "HV"\nto = "INF"\nX = 0.3\n[line.L2]\nX = 0.4\n',
        3,
        ["is not valid TOML: Cannot declare ('line', 'L2') twice (at line 6", "a name is used twice at that line"],
    ),
    "fault at no bus": (
        FAULT.replace("HV", "HW"),
        3,
        ["event.0.bus: there is no such bus (got 'HW'); did you mean 'HV'?"],
    ),
    "sample time": (
        MPC + "dt = 0.013\n",
        3,
        ["controller.mpc.dt: must be a whole multiple of the step simulation.h = 0.005 s (got 0.013); 0.015 would do"],
    ),
    "ceiling": (
        '[unit.G2.exciter]\nmodel = "st1a"\nV_RMAX = 1.5\n',
        4,
        ["the initial operating point cannot be reached", "unit.G2.exciter", "needs 1.9246", "limit 1.5"],
    ),
    "islanded network": (
        "[line.L1]\nstatus = 0.0\n",
        3,
        ["bus.G2: the island of bus G2, HV has no infinite bus and no slack unit; connect it by a line"],
    ),
    "all at once": (
        '[unit.G2.machine]\nH = -1\n[unit.G2.exciter]\nmodel = "st1b"\n[line.L1]\nto = "IMF"\n' + MPC + "dt = -1\n",
        3,
        ["unit.G2.machine.H", "unit.G2.exciter.model", "line.L1.to", "controller.mpc.dt"],
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_gives_its_message_and_exit_code_and_leaves_nothing(name, scenario, tmp_path):
    text, code, expected = BAD[name]
    config = scenario(text)
    result = call("run", config, "--out", tmp_path / "out")
    assert result.exit_code == code, result.output
    for part in expected:
        assert part in result.stderr
    assert "Traceback" not in result.output
    assert isinstance(result.exception, SystemExit)
    assert [path.name for path in tmp_path.iterdir()] == ["scenario.toml"]


@pytest.mark.parametrize(("file", "code"), [("absent.toml", 3), (".", 2)])
def test_a_file_that_is_not_there(tmp_path, file, code):
    result = call("run", tmp_path / file, "--out", tmp_path / "out")
    assert result.exit_code == code
    assert not list(tmp_path.iterdir())


def test_a_power_flow_without_a_solution(scenario, tmp_path):
    text = """
        [simulation]
        t_end = 1.0
        [bus.INF]
        [line.L1]
        from = "G2"
        to = "INF"
        X = 0.3
        [infinite_bus.grid]
        bus = "INF"
        V = 1.0
        [unit.G2]
        P = 1500.0
        V = 1.0
    """
    result = call("run", scenario(text, base="kobbelv_g2.toml"), "--out", tmp_path / "out")
    assert result.exit_code == 4
    assert "the power flow failed" in result.stderr
    assert "G2" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_real_process_exits_alike(scenario, tmp_path):
    command = [
        sys.executable,
        "-m",
        "pgexcite",
        "run",
        scenario("[unit.G2.machine]\nH = -2.9\n"),
        "--out",
        tmp_path / "out",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    assert done.returncode == 3
    assert done.stdout == ""
    assert done.stderr.startswith("error: the configuration is not valid:\n  - unit.G2.machine.H")


def test_classical_machine_without_inertia_is_an_infinite_bus(scenario, tmp_path):
    other = """
        [bus.far]
        [line.L2]
        from = "INF"
        to = "far"
        X = 0.2
        [unit.grid2]
        bus = "far"
        S_n = 1000.0
        slack = true
        V = 0.9
        [unit.grid2.machine]
        model = "classical"
        H = 0.0
    """
    found = figures("run", scenario(other + FAULT), *SHORT, "--out", tmp_path / "out")
    assert found["outcome"] == "completed"
    assert found["units"]["grid2"]["omega_max"] == pytest.approx(1.0, abs=1e-12)


def test_run_writes_a_record_and_its_figures(tmp_path):
    out = tmp_path / "deep" / "out"
    found = figures("run", SMIB / "fault_st1a.toml", *SHORT, "--out", out)
    assert {path.name for path in out.iterdir()} == {"config.toml", "summary.json", "trace.parquet"}
    summary = json.loads((out / "summary.json").read_text())
    assert found["outcome"] == summary["outcome"] == "completed"
    assert found["units"] == summary["units"]
    assert found["t_end"] == pytest.approx(1.5)
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_the_resolved_configuration_runs_to_the_same_figures(tmp_path):
    first = figures("run", SMIB / "fault_st1a.toml", *SHORT, "--out", tmp_path / "first")
    second = figures("run", tmp_path / "first" / "config.toml", "--out", tmp_path / "second")
    assert second["units"] == first["units"]


def test_an_unexpected_outcome_has_its_own_exit_code_and_keeps_the_record(tmp_path):
    arguments = [
        "run",
        SMIB / "clearing_arc.toml",
        "--set",
        "event.0.duration=0.5",
        *SHORT[2:],
        "--out",
        tmp_path / "out",
    ]
    result = call(*arguments)
    assert result.exit_code == 5
    assert "ended as lost_synchronism, the scenario expects completed" in result.stderr
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["outcome"] == "lost_synchronism"
    assert call(*arguments, "--set", "expect=lost_synchronism").exit_code == 0


def test_a_directory_that_is_no_record_is_left_alone(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years of work")
    result = call("run", SMIB / "fault_constant.toml", *SHORT, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "is not the record of a run" in result.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]


def test_a_snapshot_is_kept_and_goes_on_bit_for_bit(tmp_path):
    from pgexcite.core.record import read_trace

    common = ["run", SMIB / "fault_nmpc.toml", *SHORT]
    figures(*common, "--snapshot-at", "1.05", "--out", tmp_path / "whole")
    snapshot = tmp_path / "whole" / "snapshot-1.05.npz"
    figures(*common, "--resume", snapshot, "--out", tmp_path / "rest")
    whole, rest = read_trace(tmp_path / "whole"), read_trace(tmp_path / "rest")
    assert rest.t[0] == pytest.approx(1.05)
    for path in ("unit.G2.machine.delta", "unit.G2.v_t", "unit.G2.e_fd"):
        assert (whole[path][whole.t > 1.0501] == rest[path][rest.t > 1.0501]).all()


def test_a_snapshot_of_another_model_is_refused(tmp_path):
    figures("run", SMIB / "fault_constant.toml", *SHORT, "--snapshot-at", "1", "--out", tmp_path / "a")
    result = call(
        "run", SMIB / "fault_st1a.toml", *SHORT, "--resume", tmp_path / "a" / "snapshot-1.npz", "--out", tmp_path / "b"
    )
    assert result.exit_code == 1
    assert "another model" in result.stderr
    assert not (tmp_path / "b").exists()


def test_realtime_writes_the_record_of_a_run_and_what_it_measured(tmp_path):
    paced = ["realtime", SMIB / "fault_nmpc.toml", "--period", "0.002", "--gc", "frozen", "--deadline", "500"]
    out = tmp_path / "out"
    found = figures(*paced, "--steps", "25", "--out", out)
    assert {path.name for path in out.iterdir()} == {"config.toml", "summary.json", "trace.parquet", "run.rrd"}
    summary = json.loads((out / "summary.json").read_text())
    assert summary["realtime"]["steps"] == found["realtime"]["steps"] == 25
    assert summary["t_end"] == pytest.approx(25 * 0.05)
    assert summary["realtime"]["options"] == {"garbage": {"granted": True, "detail": "frozen"}}
    assert "deadline_ms = 500.0" in (out / "config.toml").read_text()
    shown = call(*paced, *SHORT[2:], "--steps", "2", "--out", out).stdout
    assert "2 periods of 2 ms (50 ms simulated)" in shown


def test_realtime_needs_a_controller(tmp_path):
    result = call("realtime", SMIB / "fault_st1a.toml", "--out", tmp_path / "out")
    assert result.exit_code == 3
    assert "needs a controller" in result.stderr
    assert not (tmp_path / "out").exists()


def test_export_writes_a_controller(tmp_path):
    found = figures("export-c", SMIB / "fault_nmpc.toml", tmp_path / "c", *SHORT)
    assert found["files"] == ["CMakeLists.txt", "mpc.c", "mpc.h", "mpc_replay.c", "replay.txt"]
    assert found["samples"] == 30
    assert "30 samples to replay" in call("export-c", SMIB / "fault_nmpc.toml", tmp_path / "c", *SHORT).stdout
    assert call("export-c", SMIB / "fault_nmpc.toml", tmp_path / "c", "--controller", "other").exit_code == 3


def test_a_live_run_ends_without_a_viewer(tmp_path):
    result = call("run", SMIB / "fault_st1a.toml", *SHORT, "--live", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    assert "live view: rerun rerun+http://127.0.0.1:" in result.stderr
    assert (tmp_path / "out" / "summary.json").exists()


@pytest.mark.parametrize("command", ["check", "run"])
def test_what_is_valid_and_odd_is_remarked(scenario, tmp_path, command):
    late = FAULT.replace("t = 0.5", "t = 1.45")
    out = ["--out", tmp_path / "out"] if command == "run" else []
    result = call(command, scenario(f"{late}[line.L1]\nX = -0.01\n"), *SHORT, *out)
    assert result.exit_code == 0, result.stderr
    notes = [line for line in result.stderr.splitlines() if line.startswith("note: ")]
    assert notes == [
        "note: line.L1.X = -0.01 is negative, as that of a series capacitor",
        "note: the run ends at 1.5 s, before fault at bus HV cleared (t = 1.55 s)",
    ]
    assert "note" not in call("check", SMIB / "fault_st1a.toml").stderr


def test_check_prints_the_operating_point():
    found = figures("check", SMIB / "fault_constant.toml")
    buses = {row["bus"]: row for row in found["buses"]}
    assert found["residual"] < 1e-9
    assert buses["INF"]["V [pu]"] == pytest.approx(0.893, abs=5e-4)
    assert "is valid" in call("check", SMIB / "fault_constant.toml").stdout
    assert call("check", SMIB / "fault_constant.toml", "--set", "unit.G2.machine.H=-1").exit_code == 3


def test_eig_prints_modes():
    modes = figures("eig", SMIB / "fault_constant.toml")["modes"]
    assert [set(mode) for mode in modes] == [{"re", "im", "damping", "frequency_hz", "participation"}] * len(modes)
    swing = next(mode for mode in modes if mode["im"] > 1)
    assert (swing["re"], swing["im"]) == pytest.approx((-0.657, 8.493), rel=0.01)
    assert swing["frequency_hz"] == pytest.approx(swing["im"] / 6.283185, rel=1e-6)
    assert sum(swing["participation"].values()) == pytest.approx(1.0)
    assert "unit.G2.machine.delta" in call("eig", SMIB / "fault_constant.toml").stdout


def test_cct_brackets_the_critical_time():
    found = figures("cct", SMIB / "clearing_arc.toml", "--tolerance", "1e-3")
    low, high = found["bracket"]
    assert low < found["t_crit"] < high
    assert high - low <= 1.001e-3
    assert found["t_crit"] == pytest.approx(0.2805, abs=1.5e-3)
    assert 90 < found["delta_crit_deg"] < 100


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("event=[]", "needs exactly one fault"),
        ("event.0.R=100.0", "no critical clearing time"),
    ],
)
def test_cct_says_why_there_is_none(setting, expected):
    result = call("cct", SMIB / "clearing_arc.toml", "--tolerance", "1e-3", "--set", setting)
    assert result.exit_code == 1
    assert expected in result.stderr


def test_equal_area(tmp_path):
    found = figures("equal-area", SMIB / "clearing_arc.toml", "--figure", tmp_path / "area.png")
    assert found["delta_crit_deg"] > found["delta_0_deg"]
    assert (tmp_path / "area.png").read_bytes().startswith(b"\x89PNG")
    assert "critical clearing angle" in call("equal-area", SMIB / "clearing_arc.toml").stdout


def test_compare(tmp_path):
    for name in ("constant", "st1a"):
        figures("run", SMIB / f"fault_{name}.toml", *SHORT, "--out", tmp_path / name)
    found = figures("compare", tmp_path / "constant", tmp_path / "st1a", "--out", tmp_path / "both")
    assert [row["label"] for row in found["rows"]] == ["constant", "st1a"]
    assert Path(found["picture"]).exists()
    assert Path(found["recording"]).exists()
    shown = call("compare", tmp_path / "constant", tmp_path / "st1a", "--out", tmp_path / "both").stdout
    assert "delta_max_deg" in shown
    assert "recording:" in shown


def test_list_and_describe():
    listed = {(item["role"], item["name"]): item for item in figures("list")}
    assert listed["exciter", "st1a"]["error"] == ""
    assert {role for role, _ in listed} > {"machine", "load", "sink"}
    described = figures("describe", "st1a")
    gain = next(item for item in described["parameters"] if item["name"] == "K_A")
    assert (gain["unit"], gain["default"], gain["bounds"]) == ("pu", 200.0, "> 0")
    assert "421.5" in described["source"]
    assert {"e_fd", "v_ref", "v_t"} <= {item["name"] for item in described["variables"]}
    for item in listed.values():
        assert call("describe", f"{item['role']}.{item['name']}").exit_code == 0


def test_describe_offers_the_nearest():
    result = call("describe", "kundur_psss")
    assert result.exit_code == 3
    assert "did you mean 'kundur_pss'?" in result.stderr
    assert call("list", "--role", "exciters").exit_code == 3


def test_schema_is_json():
    assert json.loads(call("schema").stdout)["title"] == "Document"


@pytest.mark.parametrize("statement", ["import pgexcite", "import pgexcite.cli"])
def test_importing_pulls_in_nothing_heavy(statement):
    heavy = ["casadi", "numpy", "pydantic", "rerun", "matplotlib", "scipy", "pyarrow", "rich"]
    code = f"{statement}; import sys; print([name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_are_there():
    import pgexcite

    for name in pgexcite.__all__:
        assert getattr(pgexcite, name).__module__.startswith("pgexcite.core")
    assert set(pgexcite.__all__) <= set(dir(pgexcite))
    with pytest.raises(AttributeError, match="no attribute 'Simulator'"):
        _ = pgexcite.Simulator
