"""Kundur's two-area system against Dynawo's power flow, published and computed modes, and a trajectory of ANDES."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pgexcite.core.config import load
from pgexcite.core.initialise import initialise
from pgexcite.core.linearise import linearise
from pgexcite.core.simulate import Simulation

HERE = Path(__file__).parent
CONFIGS = HERE.parents[2] / "configs" / "two_area"

DYNAWO = {
    "1": (1.03, 20.2), "2": (1.01, 10.433), "3": (1.03, -6.885), "4": (1.01, -17.074), "5": (1.006, 13.737),
    "6": (0.978, 3.651), "7": (0.961, -4.759), "8": (0.949, -18.633), "9": (0.971, -32.234), "10": (0.983, -23.819),
    "11": (1.008, -13.511),
}  # fmt: skip
DYNAWO_UNITS = {"G1": 700.105 + 185.067j, "G2": 700 + 234.676j, "G3": 719 + 175.986j, "G4": 700 + 202.071j}


@cache
def initial(name, *overrides):
    return initialise(load(CONFIGS / f"{name}.toml", overrides).system)


@cache
def modes(name, *overrides):
    """Electromechanical modes: inter-area first, then the two local ones by frequency."""
    start = initial(name, *overrides)
    return electromechanical(linearise(start.model, start.state, start.p).modes())


def electromechanical(found):
    return sorted(
        (m.eigenvalue for m in found if 2.5 < m.eigenvalue.imag < 10 and m.damping < 0.5), key=lambda z: z.imag
    )


def test_power_flow():
    flow = initial("manual").flow
    for bus, (V, angle) in DYNAWO.items():
        assert np.degrees(np.angle(flow.v[bus])) == pytest.approx(angle, abs=2e-3)  # printed to 1e-3 deg; measured 5e-4
        assert abs(flow.v[bus]) == pytest.approx(V, abs=1e-3)  # printed to three decimals; measured 5e-4
    for unit, s in DYNAWO_UNITS.items():
        assert abs(flow.s[f"unit.{unit}"] * 100 - s) < 5e-3  # measured 1e-3 MVA


@pytest.mark.parametrize("name", ["manual", "dc", "thyristor", "thyristor_tgr", "thyristor_pss"])
def test_initial_point_is_at_rest(name):
    assert initial(name).residual < 1e-9


def test_manual_excitation():
    """Kundur, table E12.3 (transcribed): -0.111 +- j3.43, local -0.492 +- j6.82, -0.506 +- j7.02. RAMSES -0.114 +- j3.417 and
    ANDES -0.119 +- j3.412 with saturation. Their spread is that of the damper and saturation conventions."""
    inter, *local = modes("manual")
    assert -0.13 < inter.real < -0.10  # measured -0.1183
    assert 3.40 < inter.imag < 3.44  # measured 3.4186
    for mode in local:
        assert 6.6 < mode.imag < 7.0  # measured 6.741, 6.934
        assert -0.62 < mode.real < -0.48  # measured -0.582, -0.591


def test_thyristor_exciter_is_unstable_without_stabiliser():
    """TR18: +0.006 +- j3.84 (PSS/E), +0.022 +- j3.82 (PacDyn). Kundur's figure, read off: +0.031 +- j3.84. ANDES with saturation
    +0.029 +- j3.820, RAMSES +0.076 +- j3.796."""
    inter, *local = modes("thyristor")
    assert 0.0 < inter.real < 0.06  # measured +0.0292
    assert 3.80 < inter.imag < 3.84  # measured 3.8304
    for mode in local:
        assert -0.70 < mode.real < -0.48  # PSS/E -0.66, Kundur -0.49; measured -0.623, -0.625
        assert 7.0 < mode.imag < 7.4  # measured 7.073, 7.272


def test_transient_gain_reduction_makes_it_worse():
    """ANDES +0.107 +- j3.456 and RAMSES +0.089 +- j3.417 with saturation, +0.125 and +0.112 without; Kundur's +0.123 +- j3.46 is
    from memory, unverified."""
    inter = modes("thyristor_tgr")[0]
    assert 0.10 < inter.real < 0.13  # measured +0.1077
    assert 3.41 < inter.imag < 3.465  # measured 3.4632, 0.1 % above the highest of the other tools


def test_stabilisers_damp_it():
    """With PSS/E's machines, as configured. RAMSES -0.489 +- j3.836 with saturation, -0.480 +- j3.797 without; its machines
    are others, see test_ramses.py. Kundur's -0.501 +- j3.77 is from memory, unverified."""
    inter, *local = modes("thyristor_pss")
    assert inter.real == pytest.approx(-0.5271, abs=1e-3)
    assert inter.imag == pytest.approx(3.84, abs=0.04)  # measured 3.866
    for mode in local:
        assert 0.22 < -mode.real / abs(mode) < 0.29  # measured 0.234, 0.234; RAMSES 0.241, 0.233 with saturation


@cache
def andes():
    header, *_ = (HERE / "andes_fault7.csv").read_text().splitlines()
    return dict(zip(header.split(","), np.loadtxt(HERE / "andes_fault7.csv", delimiter=",", skiprows=1).T, strict=True))


def test_modes_of_the_andes_case():
    """All 52 eigenvalues: machines, exciters, governors, loads and network are the same equations."""
    scenario = load(HERE / "andes_fault7.toml")
    start = initialise(scenario.system)
    ours = linearise(start.model, start.state, start.p).eigenvalues()
    theirs = np.loadtxt(HERE / "andes_fault7_modes.csv", delimiter=",", skiprows=1) @ (1, 1j)
    assert len(ours) == 2 * np.sum(theirs.imag > 0) + np.sum(theirs.imag == 0)
    for value in theirs[np.abs(theirs) > 1e-6]:
        assert np.abs(ours - value).min() < 1e-5  # measured 3.0e-6, and 1.5e-6 at the inter-area mode


@pytest.mark.parametrize("rule", ["tr_bdf2", "trapezoidal"])
def test_trajectory_of_the_andes_case(rule):
    """Fault of 0.1 s at bus 7. What differed at first, and is now modelled as ANDES does: E_fd = speed times the exciter's voltage
    (modes), and regulator limits that do not follow the terminal voltage (2.5 deg). What is left is its step: ANDES differs from
    itself by 0.15 deg between 1/120 and 1/240 s, ours by 0.002 deg (TR-BDF2) and 0.03 deg (trapezoidal) between 1/240 and 1/960 s.
    It shifts its grid by 1e-4 s at each event; a fault longer by 2.8e-4 s takes away half of the difference."""
    scenario = load(HERE / "andes_fault7.toml", [f"simulation.rule={rule}"])
    simulation = Simulation(scenario.system, scenario.settings, scenario.changes)
    assert simulation.run().ending.value == "completed"
    trace, reference = simulation.trace(), andes()
    t = reference["t"]
    away = (
        np.min(np.abs(t[:, None] - (1.0, 1.1)), axis=1) > 0.006
    )  # samples within 1e-4 s of a jump are on either side of it

    def ours(path):
        return np.interp(t, trace.t, trace[path])

    for k in (2, 3, 4):
        angle = ours(f"unit.G{k}.delta") - ours("unit.G1.delta")
        error = np.degrees(np.abs(angle - (reference[f"G{k}.delta"] - reference["G1.delta"])))[away]
        assert error.max() < 0.2  # measured 0.192 deg with tr_bdf2, 0.156 with the trapezoidal rule
    for k in range(1, 11):
        assert np.abs(ours(f"bus.{k}.v") - reference[f"bus{k}.v"])[away].max() < 2e-3  # measured 1.0e-3
    for k in range(1, 5):
        error = np.abs(ours(f"unit.G{k}.e_fd") - reference[f"G{k}.e_fd"])[away].max()
        assert error < 0.04  # measured 0.031; ANDES differs from itself by 0.025
