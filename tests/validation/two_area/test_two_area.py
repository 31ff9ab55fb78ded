"""Kundur's two-area system against Dynawo's power flow, published and computed modes, and a trajectory of ANDES."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import root

from pgexcite.core.config import load
from pgexcite.core.initialise import initialise
from pgexcite.core.linearise import linearise
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.machines.kundur_flux import KundurFlux

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
        assert np.degrees(np.angle(flow.v[bus])) == pytest.approx(angle, abs=0.1)  # measured 5e-4 deg
        assert abs(flow.v[bus]) == pytest.approx(V, abs=1e-3)  # printed to three decimals; measured 5e-4
    for unit, s in DYNAWO_UNITS.items():
        assert abs(flow.s[f"unit.{unit}"] * 100 - s) < 0.5  # measured 1e-3 MVA


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
    """RAMSES without saturation, computed once on these data: the complex eigenvalues within 5 %.

    Its machines take the time constants as those of the coupled circuits, ours (and PSS/E's) as those of each circuit alone, which
    makes its local modes 3 % slower (see below). Damping alone differs by up to 14 %; that is not explained by the machines.
    """
    without_saturation = tuple(f"unit.G{k}.machine.saturation=none" for k in range(1, 5))
    found = modes("thyristor_pss", *without_saturation)
    for mode, expected in zip(found, (-0.4795 + 3.797j, -2.1374 + 7.9080j, -2.1895 + 8.2233j), strict=True):
        assert abs(mode - expected) < 0.05 * abs(expected)  # measured 1.9, 3.7, 3.5 %
    inter = modes("thyristor_pss")[0]
    assert inter.real < -0.45  # measured -0.527; Kundur's -0.501 +- j3.77 is from memory, unverified
    assert inter.imag == pytest.approx(3.84, abs=0.04)  # measured 3.866, RAMSES with saturation 3.836


def coupled_circuits(X, Xp, Xpp, X_l, T_1, T_2):
    """``L_1, R_1, L_2, R_2`` of two rotor circuits whose coupled time constants are ``T_1`` and ``T_2``, pu on 60 Hz."""
    omega_0, L_a = 2 * np.pi * 60, X - X_l
    short = L_a * X_l / (L_a + X_l)
    closed = (Xp / X * T_1, Xpp / Xp * T_2)

    def defect(logarithms):
        L_1, R_1, L_2, R_2 = np.exp(logarithms)
        rows = []
        for L, (a, b) in ((L_a, (T_1, T_2)), (short, closed)):
            total = ((L + L_1) / R_1 + (L + L_2) / R_2) / omega_0
            product = ((L + L_1) * (L + L_2) - L * L) / (R_1 * R_2) / omega_0**2
            rows += [total / (a + b) - 1, product / (a * b) - 1]
        return rows

    L_1, L_2 = 1 / (1 / (Xp - X_l) - 1 / L_a), 1 / (1 / (Xpp - X_l) - 1 / (Xp - X_l))
    start = [L_1, (L_a + L_1) / T_1 / omega_0, L_2, (L_2 + Xp - X_l) / T_2 / omega_0]
    found = root(defect, np.log(start), tol=1e-13)
    assert found.success
    return np.exp(found.x)


def test_ramses_machines_are_coupled_circuits():
    """RAMSES's modes with manual excitation, without saturation: reproduced by circuits identified from the time constants."""
    L_fd, R_fd, L_1d, R_1d = coupled_circuits(1.8, 0.3, 0.25, 0.2, 8.0, 0.03)
    L_1q, R_1q, L_2q, R_2q = coupled_circuits(1.7, 0.55, 0.25, 0.2, 0.4, 0.05)
    rotor = {
        "L_fd": L_fd,
        "R_fd": R_fd,
        "L_1d": L_1d,
        "R_1d": R_1d,
        "L_1q": L_1q,
        "R_1q": R_1q,
        "L_2q": L_2q,
        "R_2q": R_2q,
    }
    stator = {"R_a": 0.0025, "L_l": 0.2, "L_adu": 1.6, "L_aqu": 1.5}
    dampers = {"damper_1d": True, "damper_1q": True, "damper_2q": True}

    def circuits(device):
        if "machine" not in device.components:
            return device
        machine = KundurFlux(H=device.components["machine"].H, K_D=0.0, **stator, **rotor, **dampers)
        return replace(device, components={**device.components, "machine": machine})

    system = load(CONFIGS / "manual.toml").system
    start = initialise(replace(system, devices=tuple(circuits(device) for device in system.devices)))
    found = electromechanical(linearise(start.model, start.state, start.p).modes())
    for mode, expected in zip(found, (-0.12506 + 3.41147j, -0.55838 + 6.60441j, -0.57181 + 6.79424j), strict=True):
        assert abs(mode - expected) < 0.002 * abs(expected)  # measured 0.10, 0.08, 0.08 %


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
    itself by 0.15 deg between 1/120 and 1/240 s, and shifts its grid by 1e-4 s at each event."""
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
