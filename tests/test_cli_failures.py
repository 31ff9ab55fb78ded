"""What the system or the person at the terminal refuses: a message and an exit code, no traceback, nothing half written."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from pgexcite.cli import main

CONFIGS = Path(__file__).parents[1] / "configs"
SMIB = CONFIGS / "smib"


def call(*arguments):
    return CliRunner().invoke(main, [str(item) for item in arguments])


@pytest.mark.parametrize(
    "arguments",
    [
        ("export-c", SMIB / "fault_nmpc.toml"),
        ("study", CONFIGS / "studies" / "mismatch.toml", "--out"),
        ("equal-area", SMIB / "clearing_arc.toml", "--figure"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_what_cannot_be_written_is_named(arguments, tmp_path):
    (tmp_path / "file").write_text("not a directory")
    result = call(*arguments, tmp_path / "file" / "below")
    assert result.exit_code == 1, result.output
    assert result.stderr.startswith(f"error: {tmp_path / 'file'}")
    assert isinstance(result.exception, SystemExit)


@pytest.mark.parametrize(
    ("time", "reason"),
    [
        ("11", "11 s is after the end of the run at 10 s"),
        ("-1", "not in the range"),
        ("nan", "nan is not a finite number"),
    ],
)
def test_a_snapshot_at_a_time_outside_the_run_is_refused(time, reason, tmp_path):
    result = call("run", SMIB / "fault_constant.toml", "--snapshot-at", time, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert reason in result.stderr
    assert not (tmp_path / "out").exists()


def test_what_is_no_snapshot_is_refused(tmp_path):
    (tmp_path / "text.npz").write_text("no archive")
    for name, reason in (("text.npz", "not an archive of arrays"), ("absent.npz", "No such file or directory")):
        result = call("run", SMIB / "fault_constant.toml", "--resume", tmp_path / name, "--out", tmp_path / "out")
        assert result.exit_code == 1
        assert f"{name}: not a snapshot that can be read ({reason}" in result.stderr


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("u_max=1.0", "its initial value is outside u_min = -3.2 .. u_max = 1 (got 1.9246)"),
        ("voltages=['unit.G2.vt']", "measures unit.G2.vt, which does not exist; nearest: unit.G2.v_t"),
        ("unit=[]", "controller.mpc.unit: should name the unit"),
        ("options.mod='rti'", "controller.mpc: options.mod: unknown key (got 'rti'); did you mean 'mode'?"),
        ("options.mode='rtj'", "controller.mpc: options.mode: should be"),
    ],
)
def test_check_finds_what_a_run_would_refuse_of_its_controllers(override, expected):
    result = call("check", SMIB / "fault_nmpc.toml", "--set", f"controller.mpc.{override}")
    assert result.exit_code == 3, result.output
    assert expected in result.stderr


def test_latencies_without_a_compiler_are_remarked(tmp_path, monkeypatch):
    monkeypatch.setattr("pgexcite.core.compiling.compiler", lambda: None)
    result = call("realtime", SMIB / "fault_nmpc.toml", "--steps", 2, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "note: no C compiler was found" in result.stderr


def interrupted(program, ready, *arguments):
    """What is said on standard error by a program that is interrupted once it has made this file."""
    command = [
        sys.executable,
        "-c",
        f"import pathlib, sys\nready = pathlib.Path({str(ready)!r})\n{program}",
        *arguments,
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not ready.exists() and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    return stderr.strip()


RUN = """
from pgexcite.cli import main, running
run = running.Simulation.run
running.Simulation.run = lambda *a, **k: (ready.touch(), run(*a, **k))[1]
main(sys.argv[1:])
"""
PACED = """
from pgexcite.cli import main
from pgexcite.core import realtime
sleep, begun = realtime._sleep_until, []
def noted(instant):
    begun.append(instant)
    if len(begun) > 5:
        ready.touch()
    sleep(instant)
realtime._sleep_until = noted
main(sys.argv[1:])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_an_interrupted_run_says_so_and_leaves_nothing(tmp_path):
    endless = ["run", SMIB / "fault_nmpc.toml", "--set", "simulation.t_end=1e6", "--out", tmp_path / "out"]
    assert interrupted(RUN, tmp_path / "ready", *endless) == "interrupted: no record was written"
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_an_interrupted_paced_run_leaves_a_record_of_what_ran(tmp_path):
    endless = ["realtime", SMIB / "fault_nmpc.toml", "--set", "simulation.t_end=1e4", "--out", tmp_path / "out"]
    said = interrupted(PACED, tmp_path / "ready", *endless)
    assert said.endswith("interrupted: the record holds what ran")
    timing = json.loads((tmp_path / "out" / "summary.json").read_text())["realtime"]
    assert timing["interrupted"]
    assert 5 <= timing["steps"] < 1000


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_an_interrupted_study_ends_at_once(tmp_path):
    """And not once the cases that wait have been run: these would take hours."""
    text = (
        f'unit = "G2"\n[variant.nmpc]\nbase = "{(SMIB / "fault_nmpc.toml").as_posix()}"\nset = ["simulation.t_end=1"]\n'
    )
    long = (f'[[factor]]\nname = "{k}"\nset = ["simulation.t_end=1e7", "unit.G2.Q={k}"]\n' for k in (86, 87, 88, 89))
    (tmp_path / "study.toml").write_text(text + "".join(long))
    command = [sys.executable, "-m", "pgexcite", "study", tmp_path / "study.toml", "--out", tmp_path / "out"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        while not list((tmp_path / "out").glob("*.json")) and process.poll() is None:
            time.sleep(0.05)
        time.sleep(1.0)  # the process that ran the short case is in a long one now
        os.killpg(process.pid, signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
        assert process.returncode == 130, stderr
        assert "interrupted: the cases that are done are kept" in stderr
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
