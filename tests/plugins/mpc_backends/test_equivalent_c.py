"""The exported controller on an estimated equivalent: Python's commands and estimates, whatever it is told."""

from __future__ import annotations

from pathlib import Path

import exported
import numpy as np
import pytest

from pgexcite.core.config import load
from pgexcite.core.errors import ConfigError
from pgexcite.core.export import export_c

SMIB = Path(__file__).parents[3] / "configs" / "smib"
FAULT, LINE_TRIP = SMIB / "fault_equivalent.toml", SMIB / "line_trip_equivalent.toml"

LOST = "controller.mpc.measurement.loss=0.3"
SOFT = 'controller.mpc.soft=[{signal="i_fd", upper=1.8, weight=100.0}]'
HANDED_OVER = """event=[{type="fault", t=1.0, bus="HV", R=0.02, duration=0.1},
    {type="hand_over", t=1.5, controller="mpc", to="controller"},
    {type="hand_over", t=2.5, controller="mpc", to="classical"},
    {type="hand_over", t=3.0, controller="mpc", to="controller"}]"""
NO_PATIENCE = ["controller.mpc.max_reuse=0", "controller.mpc.max_age=1"]
TWO_AREAS = """controller.mpc={model="mpc", unit="G1", backend="equivalent", N_p=8, N_c=2, u_min=-4.0, u_max=4.0, \
V_ref_steps=[[2.0, 1.02]], measurement={noise=0.01, noise_omega=1e-4}}"""
GENROU = '{model="genrou", H=2.9, X_d=1.24, X_q=1.18, Xp_d=0.35, Xp_q=0.5, Xpp_d=0.24, Tp_d0=6.5}'
ONE_AXIS = '{model="one_axis", H=2.9, X_d=1.24, X_q=0.70, Xp_d=0.35, Tp_d0=6.5, D=1.0}'

CASES = {
    "fault, until all is calm": (FAULT, ["simulation.t_end=12"]),
    "fault, without noise": (FAULT, ["controller.mpc.measurement={}"]),
    "fault, samples lost": (FAULT, [LOST]),
    "line trip": (LINE_TRIP, []),
    "line trip, samples lost": (LINE_TRIP, [LOST]),
    "soft bound": (FAULT, [SOFT]),
    "long, rate": (FAULT, ["controller.mpc.N_p=10", "controller.mpc.N_c=5", "controller.mpc.du_max=0.5"]),
    "many moves": (FAULT, ["controller.mpc.N_p=12", "controller.mpc.N_c=12"]),
    "standby and take-over": (FAULT, ["controller.mpc.active=false", HANDED_OVER]),
    "delayed, samples lost": (LINE_TRIP, ["controller.mpc.delayed=true", LOST]),
    "late and known": (FAULT, ["controller.mpc.measurement.delay=2", "controller.mpc.known_delay=2"]),
    "late and known, delayed, samples lost": (
        LINE_TRIP,
        ["controller.mpc.delayed=true", LOST, "controller.mpc.measurement.delay=1", "controller.mpc.known_delay=1"],
    ),
    "nobody behind it, most samples lost": (
        SMIB / "fault_nmpc.toml",
        ["controller.mpc.backend=equivalent", "controller.mpc.measurement={loss=0.6}", *NO_PATIENCE],
    ),
    "two areas, reference steps": (SMIB.parent / "two_area" / "fault_nmpc.toml", [TWO_AREAS]),
    "another belief": (FAULT, ['controller.mpc.options={model={"unit.G2.machine.X_d"=1.36}, estimation={x_s=0.4}}']),
    "genrou": (FAULT, [f"unit.G2.machine={GENROU}"]),
    "one_axis": (LINE_TRIP, [f"unit.G2.machine={ONE_AXIS}"]),
}

pytestmark = pytest.mark.compiler


def scenario(config=FAULT, *overrides, t_end=4.0):
    return load(config, [f"simulation.t_end={t_end}", *overrides])


@pytest.mark.parametrize("case", CASES)
def test_its_commands_and_estimates_are_those_of_python(case, tmp_path):
    config, overrides = CASES[case]
    found = export_c(scenario(config, *overrides), tmp_path / "out")
    assert found.samples >= 50  # the two areas lose synchronism after 2.7 s
    figures = exported.replay_alike(found.directory, found.samples)  # measured 2e-12 .. 2e-11; estimates 6e-12 .. 2e-11
    assert figures["samples with another number of iterations"] == 0


@pytest.mark.parametrize("more", ["delayed=false", "delayed=true", "known_delay=2"])
def test_in_whatever_trouble_it_does_what_python_does(more, tmp_path):
    """Through losses, hanging transmitters, wild samples, restarts and changes of who is in charge."""
    case = scenario(FAULT, f"controller.mpc.{more}")
    export_c(case, tmp_path)
    levels = exported.record_trouble(case, tmp_path, ["unit.G2.v_t", "unit.G2.p_e"], 600)
    assert min(levels.count(level) for level in (0, 1, 2)) > 20
    exported.replay_alike(tmp_path, 600)  # measured 3e-11 and 5e-11; estimates 1e-11


def test_it_stands_alone_and_allocates_nothing(tmp_path):
    export_c(scenario(t_end=1.0), tmp_path)
    exported.stands_alone(tmp_path)


def test_whatever_it_is_told_its_command_is_finite_and_within_its_bounds(tmp_path):
    export_c(scenario(), tmp_path)
    controller, rng = exported.Library(tmp_path), np.random.default_rng(3)
    levels = []
    for k in range(3000):
        controller.load(k % len(controller.lines))
        for _ in range(int(rng.integers(4)) if k % 100 > 50 else 0):
            if rng.random() < 0.8:
                controller.input.measured[int(rng.integers(5))] = float(rng.choice(exported.GARBAGE))
            else:
                controller.input.u_last[0], controller.input.t = rng.choice(exported.GARBAGE, 2)
        out = controller.step()
        assert -3.2 <= out.command[0] <= 3.2
        # The estimate stays one: x_s and v_bus within their bounds, with deviations.
        assert 0.02 <= out.estimate[0] <= 2.0
        assert 0.05 - 1e-12 <= out.estimate[2] <= 1.5 + 1e-12
        assert np.isfinite(list(out.estimate)[:6]).all()
        levels.append(out.level)
    assert set(levels) == {0, 1, 2}


def test_garbage_breaks_no_rule_of_the_language(tmp_path):
    """The same under the sanitizers of addresses and of undefined behaviour."""
    export_c(scenario(), tmp_path)
    printed = exported.replay_garbage(tmp_path, width=8)
    if not printed:
        pytest.skip("the compiler has no sanitizers")
    assert printed.startswith("samples 800")


def test_what_cannot_be_exported_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="must be positive"):
        export_c(scenario(FAULT, "controller.mpc.R=0.0"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    solver = exported.session_of(scenario()).solver
    solver._observer = object()
    with pytest.raises(ConfigError, match="this estimator offers no C"):
        solver.parts("controller.mpc", ())
