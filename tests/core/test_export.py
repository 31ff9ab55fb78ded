"""The exported controller: compiled without a warning, alone, without allocation; and its commands those of Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import exported
import numpy as np
import pytest

from pgexcite.core.config import load
from pgexcite.core.errors import ConfigError
from pgexcite.core.export import ExportError, export_c

CONFIGS = Path(__file__).parents[2] / "configs"
NMPC = CONFIGS / "smib" / "fault_nmpc.toml"

TRANSFER = [
    "controller.mpc.u_max=3.85",
    'unit.G2.exciter={model="st1a", T_R=0.02, K_A=200.0, T_C=6.5, T_B=22.0, V_RMAX=3.85, V_RMIN=-3.85}',
    'unit.G2.transfer={model="field_transfer", V_RMIN=-3.85, V_RMAX=3.85}',
]

SOFT = 'controller.mpc.soft=[{signal="i_fd", upper=1.5, weight=10.0}, {signal="v_t", lower=0.95, upper=1.01, weight=100.0}]'

STEPS = """event=[{type="set", path="unit.G2.governor.p_m", t=1.03, step=-0.1},
    {type="set", path="infinite_bus.grid.v", t=1.5, value=0.92},
    {type="fault", t=2.0, bus="HV", R=0.02, duration=0.1}]"""

CASES = {
    "published": [],
    "coarse steps, more iterations": [
        "controller.mpc.N_p=10",
        "controller.mpc.N_c=10",
        "controller.mpc.options={step=0.025, jump_iterations=5, jump_tolerance=1e-4}",
    ],
    "long": ["controller.mpc.N_p=20", "controller.mpc.N_c=20"],
    "rate": ["controller.mpc.N_p=10", "controller.mpc.N_c=5", "controller.mpc.du_max=0.3"],
    "blocks, growth, preview": [
        "controller.mpc.N_p=10",
        "controller.mpc.blocks=[1, 2, 4]",
        "controller.mpc.growth=1.3",
        "controller.mpc.terminal=3.0",
        "controller.mpc.V_ref_known=[[2.0, 1.02], [3.0, 0.98]]",
    ],
    "soft bound": ["controller.mpc.N_p=10", "controller.mpc.N_c=3", SOFT],
    "soft bound, rate": ["controller.mpc.N_p=10", "controller.mpc.N_c=5", "controller.mpc.du_max=0.3", SOFT],
    "reference steps": ["controller.mpc.V_ref_known=[[2.0, 1.02]]", "controller.mpc.V_ref_steps=[[2.5, 0.98]]"],
    "behind a transfer": TRANSFER,
    "delayed": ["controller.mpc.delayed=true"],
    "known": ["controller.mpc.disturbance_known=true", "controller.mpc.N_p=10"],
    "known, delayed, growing": [
        "controller.mpc.disturbance_known=true",
        "controller.mpc.delayed=true",
        "controller.mpc.N_p=10",
        "controller.mpc.growth=1.3",
    ],
    "known set-points, within samples, delayed": [
        "controller.mpc.disturbance_known=true",
        "controller.mpc.delayed=true",
        "controller.mpc.N_p=10",
        "controller.mpc.N_c=3",
        STEPS,
    ],
    "backward Euler": ["simulation.rule=backward_euler", "controller.mpc.N_c=2"],
}


@pytest.mark.compiler
@pytest.mark.parametrize("case", CASES)
def test_the_replayed_commands_are_those_of_python(case, tmp_path):
    found = export_c(load(NMPC, ["simulation.t_end=4", *CASES[case]]), tmp_path / "out")
    assert found.samples == 80
    figures = exported.replay_alike(found.directory, found.samples)  # measured 2e-14 .. 6e-13
    assert figures["samples with another number of iterations"] == 0


CONVERGED = {
    "published": [],
    "moves without transitions": ["controller.mpc.N_c=2"],
    "long": ["controller.mpc.N_p=20", "controller.mpc.N_c=20"],
    "delayed, rate": ["controller.mpc.delayed=true", "controller.mpc.du_max=0.3"],
    "soft bound": ["controller.mpc.N_p=10", "controller.mpc.N_c=3", SOFT],
}


@pytest.mark.compiler
@pytest.mark.parametrize("case", CONVERGED)
def test_converged_plans_are_those_of_python(case, tmp_path):
    settings = ["simulation.t_end=4", 'controller.mpc.options={mode="converged"}', *CONVERGED[case]]
    export_c(load(NMPC, settings), tmp_path / "out")
    code, figures = exported.replay(tmp_path / "out")
    assert code == 0
    assert figures["samples"] == 80
    # Measured 4e-13; with soft bounds 1.5e-6, where rounding of the cost ends an iteration one program sooner or later.
    assert figures["largest difference of a command"] < (1e-5 if "soft" in case else 1e-9)
    assert "soft" in case or figures["samples with another number of iterations"] == 0
    assert figures["samples on another level"] == 0


@pytest.mark.compiler
def test_it_stands_alone_and_allocates_nothing(tmp_path):
    export_c(load(NMPC, ["simulation.t_end=1"]), tmp_path)
    exported.stands_alone(tmp_path)


@pytest.mark.compiler
@pytest.mark.parametrize("name", ["ladder", "one", "2nd", "G 2"])
def test_a_name_that_c_has_otherwise_is_made_another(name, tmp_path):
    """``ladder_reset`` and ``one_step`` are functions of the controller's own."""
    case = load(NMPC, ["simulation.t_end=1"])
    found = export_c(replace(case, controllers={name: case.controllers["mpc"]}), tmp_path)
    code, figures = exported.replay(tmp_path, found.name)
    assert code == 0
    assert figures["samples"] == 20


@pytest.mark.compiler
def test_whatever_it_is_told_its_command_is_finite_and_within_its_bounds(tmp_path):
    export_c(load(NMPC, ["simulation.t_end=3"]), tmp_path)
    controller, rng = exported.Library(tmp_path), np.random.default_rng(3)
    levels = []
    for k in range(3000):
        controller.load(k % len(controller.lines))
        if rng.random() < 0.5:
            for _ in range(rng.integers(1, 4)):
                part = getattr(controller.input, rng.choice(["x", "z", "u", "p", "u_last"]))
                part[int(rng.integers(len(part)))] = float(rng.choice([np.nan, np.inf, -np.inf, 1e12, -1e12, 0.0]))
        out = controller.step()
        assert -3.2 <= out.command[0] <= 3.2
        levels.append(out.level)
    assert set(levels) == {0, 1, 2}


@pytest.mark.compiler
def test_the_levels_of_the_ladder(tmp_path):
    """An unknown state: the last plan for three samples, then the last command; and back with the first plan that is good."""
    export_c(load(NMPC, ["simulation.t_end=2", "controller.mpc.N_c=3"]), tmp_path)
    controller = exported.Library(tmp_path)
    seen = []
    for k in range(16):
        controller.load(k)
        if 5 <= k < 12:
            controller.input.x[0] = np.nan
        out = controller.step()
        seen.append((out.level, out.status))
    assert [level for level, _ in seen] == [0] * 5 + [1] * 3 + [2] * 4 + [0] * 4
    assert {status for level, status in seen if level} == {3}


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (["controller.mpc.R=0.0"], "must be positive"),
        (["controller.mpc.options={candidates=3}"], "candidate plans"),
        (['controller.mpc.options={mismatch={"unit.G2.machine.H"=3.0}}'], "wrong on purpose"),
        (["simulation.rule=trapezoidal"], "must be another"),
    ],
)
def test_what_it_does_not_do_is_refused(setting, expected, tmp_path):
    with pytest.raises(ConfigError, match=expected):
        export_c(load(NMPC, setting), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_which_controller(tmp_path):
    with pytest.raises(ConfigError, match=r"there is no such controller \(got 'mpk'\); did you mean 'mpc'"):
        export_c(load(NMPC), tmp_path / "out", "mpk")
    with pytest.raises(ConfigError, match="there is none to export"):
        export_c(load(CONFIGS / "smib" / "fault_st1a.toml"), tmp_path / "out")
    with pytest.raises(ConfigError, match=r"there are several: \w+, .*; choose one with --controller"):
        export_c(load(CONFIGS / "two_area" / "fault_equivalent.toml"), tmp_path / "out")


def test_other_files_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ExportError, match=r"thesis\.tex"):
        export_c(load(NMPC, ["simulation.t_end=1"]), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
