"""The Kobbelv plant as shipped: operating point, modes, critical clearing times, and what another machine model makes of it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from independent import Independent

from pgexcite import Simulation, load
from pgexcite.core.initialise import initialise
from pgexcite.core.linearise import linearise
from pgexcite.plugins.machines.gensal import GENSAL
from pgexcite.plugins.machines.salient_pole import SalientPole
from pgexcite.plugins.sinks.capability import Capability
from pgexcite.studies.cct import critical_clearing_time
from pgexcite.studies.heffron_phillips import heffron_phillips

HERE = Path(__file__).parent
FIGURES = json.loads((HERE / "figures.json").read_text())
SMIB = HERE.parents[2] / "configs" / "smib"
LEAKAGE = GENSAL(H=2.9, X_d=1.24, X_q=0.70, Xp_d=0.35, Xpp_d=0.24, X_l=0.15, Tp_d0=6.5, Tpp_d0=0.05, Tpp_q0=0.10)
"""The same data as PSS/E's salient-pole machine reads them: with a leakage reactance, and ``X''_q = X''_d``."""


def scenario(name, machine=None):
    found = load(SMIB / f"{name}.toml")
    if machine is None:
        return found
    unit = found.system.device("unit.G2")
    other = replace(unit, components={**unit.components, "machine": machine})
    devices = tuple(other if device is unit else device for device in found.system.devices)
    return replace(found, system=replace(found.system, devices=devices))


def modes(machine=None):
    initial = initialise(scenario("clearing_bolted", machine).system)
    found = linearise(initial.model, initial.state, initial.p).eigenvalues()
    return found[found.imag >= 0]


def test_operating_point():
    found = scenario("fault_constant")
    sim = Simulation(found.system, found.settings)
    assert math.degrees(sim.get("unit.G2.delta")) == pytest.approx(FIGURES["delta_0_deg"], abs=0.05)  # measured 0.006
    assert sim.get("bus.INF.v") == pytest.approx(FIGURES["V_inf"], abs=5e-4)  # measured 2e-5
    assert sim.get("unit.G2.e_fd") == pytest.approx(FIGURES["rated_field_voltage"], abs=5e-4)  # measured 4e-4
    assert sim.get("unit.G2.i_fd") == pytest.approx(sim.get("unit.G2.e_fd"), abs=1e-12)


def test_rated_field_current_of_equation_1():
    """It is ``E / x_d`` of a round rotor; on the air-gap-line base that is 1.950, of which saliency takes 0.025."""
    curve = Capability(v_t=1.0, X_d=1.24, X_q=0.70, cos_phi=0.86)
    centre = np.array([0.0, -1 / 1.24])
    radius = np.hypot(*(curve.field() - centre).T)
    assert radius == pytest.approx(FIGURES["rated_field_current_equation_1"], abs=5e-4)  # measured 2e-4
    assert math.hypot(1 / 1.24 + 0.51, 0.86) == pytest.approx(FIGURES["rated_field_current_equation_1"], abs=5e-5)
    assert 1.24 * radius[0] == pytest.approx(FIGURES["rated_field_voltage_round_rotor"], abs=5e-4)


def test_modes():
    expected = np.array([complex(*pair) for pair in FIGURES["modes"]])
    found = modes()
    nearest = [found[np.argmin(np.abs(found - value))] for value in expected]
    assert len(found) == len(expected)
    for value, mode in zip(expected, nearest, strict=True):
        assert abs(mode - value) < 0.01 * abs(value)  # measured 1.3e-4, 8e-4, 4e-4, 1e-4


def test_K1_to_K6():
    found = heffron_phillips(scenario("fault_constant").system)
    values = [getattr(found, f"K{k}") for k in range(1, 7)]
    assert values == pytest.approx(FIGURES["K1_to_K6"], abs=3e-4)  # measured 2e-4


@pytest.mark.parametrize("name", ["clearing_bolted", "clearing_arc"])
def test_critical_clearing_time(name):
    """Below 180 degrees for 3 s after the fault; steps of 0.1 ms."""
    found = scenario(name)
    assert found.settings.t_end - found.changes[0].t == 3.0
    t_crit = critical_clearing_time(found, 1e-4).t_crit
    assert t_crit == pytest.approx(FIGURES["t_crit"][name], abs=1e-3)  # measured 3.5e-4, 4.5e-4
    assert t_crit == pytest.approx(RADAU[name], abs=1e-4)  # measured 3e-5, 1e-5


RADAU = {"clearing_bolted": 0.19012, "clearing_arc": 0.28095}
"""Clearing times that divide stable from unstable for an independent integrator, s, to 1e-5."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["clearing_bolted", "clearing_arc"])
@pytest.mark.parametrize(("offset", "stable"), [(-2e-5, True), (2e-5, False)])
def test_an_independent_integrator_finds_the_same_time(name, offset, stable):
    found = scenario(name)
    initial = initialise(found.system)
    model, healthy, faulted = initial.model, initial.p, initial.p.copy()
    for path, value in found.changes[0].values.items():
        faulted[model.position("p", path)] = value
    clearing = RADAU[name] + offset
    times = clearing + np.arange(1, 61) * 0.05
    pieces = [(clearing, initial.state.u, faulted), (times[-1], initial.state.u, healthy)]
    _, y = Independent(model, initial.state, healthy).run(initial.state, pieces, times, 1e-9)
    delta = y[:, model.position("y", "unit.G2.delta")]
    assert bool(np.abs(delta).max() < np.pi) is stable


def test_what_leakage_changes():
    """GENSAL with X_l = 0.15: same angle, 9 % more damping of the swing, 0.1 and 0.5 ms more clearing time."""
    plain, leaky = modes(), modes(LEAKAGE)
    sim = Simulation(scenario("clearing_bolted", LEAKAGE).system, scenario("clearing_bolted").settings)
    assert math.degrees(sim.get("unit.G2.delta")) == pytest.approx(38.994, abs=1e-3)
    assert leaky == pytest.approx(np.array([-0.2805, -0.7187 + 8.5017j, -17.854, -24.346]), abs=1e-3)
    ratio = leaky.real / plain.real
    assert ratio == pytest.approx([0.982, 1.094, 1.075, 1.019], abs=1e-3)
    # Of the swing's damping it is X''_q = 0.24 in place of 0.28 that makes the difference, not the leakage.
    assert modes(SalientPole(Xpp_q=0.24))[1].real == pytest.approx(-0.7217, abs=1e-3)


@pytest.mark.parametrize(("name", "t_crit"), [("clearing_bolted", 0.19025), ("clearing_arc", 0.28145)])
def test_what_leakage_changes_of_the_clearing_times(name, t_crit):
    found = critical_clearing_time(scenario(name, LEAKAGE), 1e-4).t_crit
    assert found == pytest.approx(t_crit, abs=1e-4)  # 0.1 and 0.5 ms above the machine without leakage
    assert found == pytest.approx(FIGURES["t_crit"][name], abs=1e-3)
