"""The exported controller: compiled without a warning, alone, without allocation; and its commands those of Python."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pgexcite.core import codegen
from pgexcite.core.config import load
from pgexcite.core.errors import ConfigError
from pgexcite.core.export import ExportError, export_c

CONFIGS = Path(__file__).parents[2] / "configs"
NMPC = CONFIGS / "smib" / "fault_nmpc.toml"
STRICT = ["-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-Wpedantic"]

TRANSFER = [
    "controller.mpc.u_max=3.85",
    'unit.G2.exciter={model="st1a", T_R=0.02, K_A=200.0, T_C=6.5, T_B=22.0, V_RMAX=3.85, V_RMIN=-3.85}',
    'unit.G2.transfer={model="field_transfer", V_RMIN=-3.85, V_RMAX=3.85}',
]

CASES = {
    "published": [],
    "long": ["controller.mpc.N_p=20", "controller.mpc.N_c=20"],
    "rate": ["controller.mpc.N_p=10", "controller.mpc.N_c=5", "controller.mpc.du_max=0.3"],
    "blocks, growth, preview": [
        "controller.mpc.N_p=10",
        "controller.mpc.blocks=[1, 2, 4]",
        "controller.mpc.growth=1.3",
        "controller.mpc.terminal=3.0",
        "controller.mpc.V_ref_known=[[2.0, 1.02], [3.0, 0.98]]",
    ],
    "behind a transfer": TRANSFER,
    "backward Euler": ["simulation.rule=backward_euler", "controller.mpc.N_c=2"],
}


def compiler():
    cc = codegen.compiler()
    assert cc is not None, "these tests need a C compiler"
    return cc


def built(directory, name="mpc", *more):
    """The replay program, compiled strictly."""
    cc = compiler()
    for file in (name, f"{name}_replay"):
        subprocess.run([cc, *STRICT, "-c", f"{file}.c", "-o", f"{file}.o"], cwd=directory, check=True)
    subprocess.run([cc, f"{name}.o", f"{name}_replay.o", "-o", "replay", "-lm"], cwd=directory, check=True)
    return directory / "replay"


def replayed(directory, name="mpc"):
    done = subprocess.run(
        [built(directory, name), "replay.txt"], cwd=directory, capture_output=True, text=True, check=False
    )
    figures = dict(re.findall(r"^(\D*?) ([\d.]\S*)", done.stdout, re.MULTILINE))
    return done.returncode, {key: float(value) for key, value in figures.items()}


@pytest.mark.compiler
@pytest.mark.parametrize("case", CASES)
def test_the_replayed_commands_are_those_of_python(case, tmp_path):
    found = export_c(load(NMPC, ["simulation.t_end=4", *CASES[case]]), tmp_path / "out")
    code, figures = replayed(found.directory)
    assert code == 0
    assert figures["samples"] == found.samples == 80
    assert figures["largest difference of a command"] < 1e-6  # measured 3e-9 .. 3e-7, where ProxQP's tolerance puts it
    assert figures["samples with another number of iterations"] == 0


@pytest.mark.compiler
def test_it_stands_alone_and_allocates_nothing(tmp_path):
    export_c(load(NMPC, ["simulation.t_end=1"]), tmp_path)
    built(tmp_path)
    symbols = subprocess.run(["nm", "mpc.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split(
        "\n"
    )
    parts = [line.split()[-2:] for line in symbols if line]
    wanted = {name for kind, name in parts if kind == "U"}
    offered = {name for kind, name in parts if kind in "TDBC"}
    assert offered == {"mpc_reset", "mpc_step", "mpc_prepare"}
    # The mathematical library and block copies of the C library; "_GLOBAL_OFFSET_TABLE_" and the stack guard are the linker's.
    allowed = re.compile(
        r"mem(cpy|set|move)|__stack_chk_fail|_GLOBAL_OFFSET_TABLE_|a?(sin|cos|tan)2?|sincos|sqrt|f(max|min|abs)|exp|log|pow"
    )
    assert {name for name in wanted if not allowed.fullmatch(name)} == set()


class _Library:
    """The controller as a shared library, with the generated types."""

    def __init__(self, directory):
        command = [compiler(), *STRICT, "-fPIC", "-shared", "mpc.c", "-o", "mpc.so", "-lm"]
        subprocess.run(command, cwd=directory, check=True)
        sizes = dict(re.findall(r"MPC_(N_\w+) = (\d+)", (directory / "mpc.h").read_text()))
        n = {key: int(value) for key, value in sizes.items()}
        double = ctypes.c_double

        class Input(ctypes.Structure):
            _fields_ = (
                ("t", double),
                ("startup", ctypes.c_int),
                *((key.lower(), double * max(1, n[f"N_{key}"])) for key in "XZDUP"),
                ("u_last", double * n["N_COMMANDS"]),
            )

        class Output(ctypes.Structure):
            _fields_ = (
                ("command", double * n["N_COMMANDS"]),
                ("level", ctypes.c_int),
                ("status", ctypes.c_int),
                ("iterations", ctypes.c_int),
                ("cost", double),
            )

        self.library, self.n = ctypes.CDLL(str(directory / "mpc.so")), n
        self.input, self.output = Input(), Output()
        self.library.mpc_reset()

    def load(self, line):
        numbers = [float(word) for word in line.split()]
        self.input.t, self.input.startup = numbers[0], int(numbers[1])
        at = 2
        for key in "XZDUP":
            count = self.n[f"N_{key}"]
            getattr(self.input, key.lower())[:count] = numbers[at : at + count]
            at += count
        self.input.u_last[0] = numbers[at]

    def step(self):
        self.library.mpc_step(ctypes.byref(self.input), ctypes.byref(self.output))
        self.library.mpc_prepare(self.output.command)
        return self.output


@pytest.mark.compiler
def test_whatever_it_is_told_its_command_is_finite_and_within_its_bounds(tmp_path):
    export_c(load(NMPC, ["simulation.t_end=3"]), tmp_path)
    controller, rng = _Library(tmp_path), np.random.default_rng(3)
    lines = (tmp_path / "replay.txt").read_text().splitlines()
    levels = []
    for k in range(3000):
        controller.load(lines[k % len(lines)])
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
    controller = _Library(tmp_path)
    lines = (tmp_path / "replay.txt").read_text().splitlines()
    seen = []
    for k in range(16):
        controller.load(lines[k])
        if 5 <= k < 12:
            controller.input.x[0] = np.nan
        out = controller.step()
        seen.append((out.level, out.status))
    assert seen == [(0, 1)] * 5 + [(1, 3)] * 3 + [(2, 3)] * 4 + [(0, 1)] * 4 or {
        s for level, s in seen if level == 0
    } <= {0, 1}
    assert [level for level, _ in seen] == [0] * 5 + [1] * 3 + [2] * 4 + [0] * 4
    assert {status for level, status in seen if level} == {3}


QP = """
#define N_V {n}
#define N_COMMANDS {m}
#define RATE {rate}
{text}
int solve_qp(const double *H, const double *g, const double *l, const double *u, const double *a, const double *b, double *x) {{
    return qp_solve(H, g, l, u, a, b, x);
}}
"""


def qp_library(folder, n, m, rate):
    name = f"qp_{n}_{m}_{rate}"
    (folder / f"{name}.c").write_text(
        QP.format(n=n, m=m, rate=rate, text=codegen.loop("dense.c") + codegen.loop("qp.c"))
    )
    command = [compiler(), "-O1", "-fPIC", "-shared", f"{name}.c", "-o", f"{name}.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / f"{name}.so")).solve_qp


def kkt_error(H, g, lower, upper, rows, low, high, x):
    """Largest violation of the optimality conditions, by a nonnegative least-squares fit of the multipliers at active bounds."""
    from scipy.optimize import nnls

    stacked = np.vstack((np.eye(x.size), rows))
    value, floor, ceiling = stacked @ x, np.concatenate((lower, low)), np.concatenate((upper, high))
    outside = max(np.max(floor - value, initial=0.0), np.max(value - ceiling, initial=0.0))
    at_floor, at_ceiling = value - floor < 1e-10, ceiling - value < 1e-10
    normals = np.vstack((stacked[at_floor], -stacked[at_ceiling])).T
    gradient = H @ x + g
    left = nnls(normals, gradient)[1] if normals.shape[1] else np.linalg.norm(gradient)
    return max(outside, left / max(1.0, np.abs(g).max()))


@pytest.mark.compiler
@pytest.mark.parametrize(("n", "m", "rate"), [(1, 1, 0), (1, 1, 1), (5, 1, 0), (5, 1, 1), (20, 1, 1), (12, 3, 1)])
def test_its_quadratic_programs_are_solved_exactly(n, m, rate, tmp_path):
    solve, rng = qp_library(tmp_path, n, m, rate), np.random.default_rng(n)
    rows = np.eye(n) - np.eye(n, k=-m)
    pointer = ctypes.POINTER(ctypes.c_double)
    worst, active = 0.0, 0
    for _ in range(300):
        J = rng.standard_normal((2 * n, n)) * np.exp(rng.uniform(-3, 3, (2 * n, 1)))
        H = J.T @ J + 0.02 * rows.T @ rows
        g = rng.standard_normal(n) * np.exp(rng.uniform(0, 5))
        lower, upper = -rng.exponential(1.0, n), rng.exponential(1.0, n)
        pinned = rng.random(n) < 0.05
        lower[pinned] = upper[pinned] = 0.0
        low, high = (
            (-rng.exponential(0.5, n), rng.exponential(0.5, n)) if rate else (-np.full(n, np.inf), np.full(n, np.inf))
        )
        x = np.zeros(n)
        arrays = [np.ascontiguousarray(a) for a in (H, g, lower, upper, low, high, x)]
        assert solve(*(a.ctypes.data_as(pointer) for a in arrays)) == 1
        worst = max(worst, kkt_error(H, g, lower, upper, rows, low, high, arrays[-1]))
        at_bound = np.abs(arrays[-1] - np.clip(arrays[-1], lower + 1e-12, upper - 1e-12)) > 0
        active += int(at_bound.sum())
    assert worst < 1e-9  # measured 1e-12
    assert active > 50


@pytest.mark.compiler
def test_a_program_without_a_solution_is_refused(tmp_path):
    solve = qp_library(tmp_path, 2, 1, 1)
    pointer = ctypes.POINTER(ctypes.c_double)

    def attempt(**changes):
        values = {"H": np.eye(2), "g": np.ones(2), "l": -np.ones(2), "u": np.ones(2), "a": -np.ones(2), "b": np.ones(2)}
        arrays = [np.ascontiguousarray(a, dtype=float) for a in [*(values | changes).values(), np.zeros(2)]]
        return solve(*(a.ctypes.data_as(pointer) for a in arrays))

    assert attempt() == 1
    assert attempt(l=np.array([2.0, -1.0]), u=np.array([1.0, 1.0])) == 0
    assert (
        attempt(a=np.array([-1.0, 3.0]), b=np.array([1.0, 4.0])) == 0
    )  # the bounds leave the second move no more than 2
    assert attempt(H=-np.eye(2)) == 0
    assert attempt(g=np.array([np.nan, 0.0])) == 0
    assert attempt(H=np.full((2, 2), np.nan)) == 0


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (["controller.mpc.delayed=true"], "computing delay"),
        (["controller.mpc.disturbance_known=true"], "known disturbances"),
        (["controller.mpc.R=0.0"], "must be positive"),
        (['controller.mpc.soft=[{signal="i_fd", upper=2.0, weight=1.0}]'], "soft bounds"),
        (['controller.mpc.options={mode="converged"}'], "only mode"),
        (["simulation.rule=trapezoidal"], "must be another"),
    ],
)
def test_what_it_does_not_do_is_refused(setting, expected, tmp_path):
    with pytest.raises(ConfigError, match=expected):
        export_c(load(NMPC, setting), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_which_controller(tmp_path):
    with pytest.raises(ConfigError, match="there is no controller 'mpk'"):
        export_c(load(NMPC), tmp_path / "out", "mpk")
    with pytest.raises(ConfigError, match="which of the controllers"):
        export_c(load(CONFIGS / "smib" / "fault_st1a.toml"), tmp_path / "out")


def test_other_files_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ExportError, match=r"thesis\.tex"):
        export_c(load(NMPC, ["simulation.t_end=1"]), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
