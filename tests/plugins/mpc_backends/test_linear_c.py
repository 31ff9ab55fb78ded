"""The exported linear controller: Python's commands and estimates, whatever it is told."""

from __future__ import annotations

from pathlib import Path

import exported
import numpy as np
import pytest

from pgexcite.core.config import load
from pgexcite.core.errors import ConfigError
from pgexcite.core.export import export_c

CONFIGS = Path(__file__).parents[3] / "configs"
FAULT, OPEN_CIRCUIT = CONFIGS / "smib" / "fault_linear.toml", CONFIGS / "smib" / "open_circuit_linear.toml"

EVERY, ONCE = 'controller.mpc.options.relinearise="every"', 'controller.mpc.options.relinearise="once"'
LONG = ["controller.mpc.N_p=20", "controller.mpc.N_c=6"]
RATE = "controller.mpc.du_max=0.3"
SOFT = 'controller.mpc.soft=[{signal="i_fd", upper=1.5, weight=10.0}, {signal="v_t", lower=0.95, upper=1.01, weight=100.0}]'
NOISE = "controller.mpc.measurement={noise=0.002, noise_omega=1e-5, loss=0.3}"
LOST = "controller.mpc.measurement={noise=0.002, noise_omega=1e-5, loss=0.7, seed=4}"
IMPATIENT = ["controller.mpc.max_reuse=2", "controller.mpc.max_age=2", "controller.mpc.recover_after=2"]
KNOWN = "controller.mpc.disturbance_known=true"
GROWTH = ["controller.mpc.blocks=[1, 2, 4]", "controller.mpc.N_p=12", "controller.mpc.growth=1.2"]
HANDED_OVER = """event=[{type="fault", t=1.0, bus="HV", R=0.02, duration=0.1},
    {type="hand_over", t=0.5, controller="mpc", to="controller"},
    {type="hand_over", t=2.0, controller="mpc", to="classical"},
    {type="hand_over", t=3.0, controller="mpc", to="controller"}]"""
SECONDARY = [
    f"controller.mpc.{text}" for text in ('command="v_ref"', "u_min=0.8", "u_max=1.2", "R=1.0", "N_p=10", "N_c=3")
]

CASES = {
    "open circuit": (OPEN_CIRCUIT, ["simulation.t_end=10"]),
    "open circuit, delayed, preview": (
        OPEN_CIRCUIT,
        ["controller.mpc.delayed=true", "controller.mpc.V_ref_known=[[3.0, 0.9]]"],
    ),
    "open circuit, most samples lost": (OPEN_CIRCUIT, ["simulation.t_end=10", LOST, *IMPATIENT]),
    "fault": (FAULT, []),
    "fault, daqp": (FAULT, ['controller.mpc.options.solver="daqp"']),
    "fault, linearised once": (FAULT, [ONCE]),
    "fault, linearised in every sample": (FAULT, [EVERY]),
    "fault, its model wrong": (FAULT, ['controller.mpc.options.model={"unit.G2.machine.H"=3.0}']),
    "long": (FAULT, LONG),
    "rate": (FAULT, [*LONG, RATE]),
    "soft bounds": (FAULT, [*LONG, SOFT]),
    "soft bounds, daqp": (FAULT, [*LONG, SOFT, 'controller.mpc.options.solver="daqp"']),
    "soft bounds, rate": (FAULT, [*LONG, SOFT, RATE]),
    "blocks, growth, terminal": (FAULT, [*GROWTH, EVERY, "controller.mpc.terminal=3.0"]),
    "noise, samples lost": (FAULT, [NOISE, "controller.mpc.options.sigma=2e-3"]),
    "most samples lost": (FAULT, ["simulation.t_end=12", LOST, *IMPATIENT]),
    "most samples lost, delayed": (FAULT, ["simulation.t_end=12", LOST, *IMPATIENT, "controller.mpc.delayed=true"]),
    "late and known": (FAULT, ["controller.mpc.measurement.delay=2", "controller.mpc.known_delay=2"]),
    "late and known, delayed, samples lost": (
        FAULT,
        [LOST, "controller.mpc.delayed=true", "controller.mpc.measurement.delay=1", "controller.mpc.known_delay=1"],
    ),
    "known fault, late": (FAULT, [KNOWN, "controller.mpc.N_p=20", "controller.mpc.known_delay=1", EVERY]),
    "known fault": (FAULT, [KNOWN, "controller.mpc.N_p=20"]),
    "known fault, growth": (FAULT, [KNOWN, *GROWTH]),
    "standby and take-over": (FAULT, ["controller.mpc.active=false", HANDED_OVER]),
    "set-point of a regulator": (FAULT, SECONDARY),
    "set-point of a regulator, handed over": (FAULT, [*SECONDARY, HANDED_OVER, "simulation.t_end=5"]),
    "trapezoidal": (FAULT, ["simulation.rule=trapezoidal", EVERY]),
    "four units": (CONFIGS / "two_area" / "fault_nmpc.toml", ["controller.mpc.backend=linear", "simulation.t_end=3"]),
}

pytestmark = pytest.mark.compiler


def scenario(config=FAULT, *overrides, t_end=4.0):
    return load(config, [f"simulation.t_end={t_end}", *overrides])


@pytest.mark.parametrize("case", CASES)
def test_its_commands_and_estimates_are_those_of_python(case, tmp_path):
    config, overrides = CASES[case]
    found = export_c(scenario(config, *overrides), tmp_path / "out")
    assert found.samples >= 30
    figures = exported.replay_alike(found.directory, found.samples)  # measured 1e-14 .. 4e-12; estimates 2e-14 .. 2e-12
    assert figures["samples with another number of iterations"] == 0


@pytest.mark.parametrize(
    "overrides",
    [[], ["controller.mpc.delayed=true"], ["controller.mpc.known_delay=1"], [EVERY, SOFT, "controller.mpc.N_p=10"]],
)
def test_in_whatever_trouble_it_does_what_python_does(overrides, tmp_path):
    """Through losses, hanging transmitters, wild samples, restarts and changes of who is in charge."""
    case = scenario(FAULT, *overrides)
    export_c(case, tmp_path)
    levels = exported.record_trouble(case, tmp_path, ["unit.G2.v_t", "unit.G2.p_e", "unit.G2.omega"], 600)
    assert min(levels.count(level) for level in (0, 1, 2)) > 20
    exported.replay_alike(tmp_path, 600)  # measured 2e-12 .. 2e-11; estimates 3e-13 .. 1e-12


def test_it_stands_alone_and_allocates_nothing(tmp_path):
    export_c(scenario(t_end=1.0), tmp_path)
    exported.stands_alone(tmp_path)


def test_whatever_it_is_told_its_command_is_finite_and_within_its_bounds(tmp_path):
    export_c(scenario(FAULT, EVERY), tmp_path)
    controller, rng = exported.Library(tmp_path), np.random.default_rng(3)
    levels, n = [], len(controller.input.measured)
    for k in range(3000):
        controller.load(k % len(controller.lines))
        for _ in range(int(rng.integers(4)) if k % 100 > 50 else 0):
            if rng.random() < 0.8:
                controller.input.measured[int(rng.integers(n))] = float(rng.choice(exported.GARBAGE))
            else:
                controller.input.u_last[0], controller.input.t = rng.choice(exported.GARBAGE, 2)
        out = controller.step()
        assert -3.2 <= out.command[0] <= 3.2
        assert np.isfinite(list(out.estimate)[:-1]).all()
        levels.append(out.level)
    assert set(levels) == {0, 1, 2}


def test_nothing_measured_for_long(tmp_path):
    """Plans go on for as long as the age allows, then the old plan, then the last command; and back with the first measurement."""
    export_c(scenario(FAULT), tmp_path)
    controller = exported.Library(tmp_path)
    seen = []
    for k in range(60):
        controller.load(k)
        if 5 <= k < 45:
            controller.input.measured[:] = [np.nan] * len(controller.input.measured)
        out = controller.step()
        seen.append((out.level, out.status))
    found, stale = (0, 0), 5
    assert seen[:8] == [found] * 8
    assert seen[8:11] == [(1, stale)] * 3
    assert seen[11:45] == [(2, stale)] * 34
    assert seen[45:] == [found] * 15


def test_garbage_breaks_no_rule_of_the_language(tmp_path):
    """The same under the sanitizers of addresses and of undefined behaviour."""
    export_c(scenario(FAULT, EVERY, KNOWN), tmp_path)
    printed = exported.replay_garbage(tmp_path, width=9)
    if not printed:
        pytest.skip("the compiler has no sanitizers")
    assert printed.startswith("samples 800")


def test_what_it_does_not_do_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="strictly convex"):
        export_c(scenario(FAULT, "controller.mpc.R=0.0"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
