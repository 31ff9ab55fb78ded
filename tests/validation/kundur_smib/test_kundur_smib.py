"""Kundur's single-machine examples, from the scenario files that ship, through power flow, initialisation and linearisation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pgexcite import Simulation, load
from pgexcite.core.initialise import initialise
from pgexcite.core.linearise import linearise
from pgexcite.studies.cct import critical_clearing_time
from pgexcite.studies.heffron_phillips import HeffronPhillips, heffron_phillips

FIGURES = json.loads((Path(__file__).parent / "figures.json").read_text())
CONFIGS = Path(__file__).parents[3] / "configs" / "kundur"


def example(number, *overrides):
    return load(CONFIGS / f"example_{number}.toml", overrides)


def linearised(number, *overrides):
    initial = initialise(example(number, *overrides).system)
    return linearise(initial.model, initial.state, initial.p)


def oscillatory(lin):
    values = lin.eigenvalues()
    return sorted(values[values.imag > 1e-9], key=lambda value: -value.real)


def real(lin):
    values = lin.eigenvalues()
    return np.sort(values[np.abs(values.imag) < 1e-9].real)[::-1]


@pytest.mark.parametrize("K_D", ["0", "10"])
def test_example_12_2(K_D):
    lin, figures = linearised("12_2", f"unit.G.machine.D={K_D}.0"), FIGURES["example_12_2"]
    assert oscillatory(lin)[0] == pytest.approx(complex(*figures["modes"][K_D]), abs=5e-3)  # measured 3.5e-3
    row, column = (lin.x_names.index(f"unit.G.machine.{name}") for name in ("omega", "delta"))
    assert -2 * 3.5 * lin.A[row, column] == pytest.approx(figures["K_S"], abs=5e-4)  # measured 3.7e-4


def test_example_12_2_initial_point():
    sim = Simulation(example("12_2").system, example("12_2").settings)
    figures = FIGURES["example_12_2"]
    assert sim.get("unit.G.e_fd") == pytest.approx(figures["E_prime"], abs=5e-4)
    assert np.degrees(sim.get("unit.G.delta")) == pytest.approx(figures["delta_0_deg"], abs=5e-3)
    assert sim.get("bus.INF.v") == pytest.approx(figures["V_inf"], abs=5e-4)


def test_example_12_3_initial_point():
    sim = Simulation(example("12_3").system, example("12_3").settings)
    assert np.degrees(sim.get("unit.G.delta")) == pytest.approx(FIGURES["example_12_3"]["delta_0_deg"], abs=5e-3)
    assert sim.get("unit.G.e_fd") == pytest.approx(FIGURES["example_12_3"]["E_fd"], abs=5e-4)


@pytest.mark.parametrize("number", ["12_3", "12_4", "12_5"])
def test_examples_with_a_field_circuit(number):
    lin, figures = linearised(number), FIGURES[f"example_{number}"]
    pairs, roots = oscillatory(lin), real(lin)
    assert pairs[0] == pytest.approx(complex(*figures["mode"]), abs=5e-3)  # measured 1.1e-3, 3.2e-3, 2.1e-3
    if "real" in figures:
        assert roots[: len(figures["real"])] == pytest.approx(figures["real"], abs=1e-3)  # measured 6e-4, 2e-4
    if "real_recomputed" in figures:
        assert roots == pytest.approx(figures["real_recomputed"], abs=1e-3)  # measured 4e-4, 2e-4
    if "mode_recomputed" in figures:
        assert pairs[1] == pytest.approx(complex(*figures["mode_recomputed"]), abs=1e-3)  # measured 6e-4


@pytest.mark.parametrize("number", ["12_3", "12_4", "12_5"])
def test_K1_to_K6_to_four_digits_whatever_regulates(number):
    found, figures = heffron_phillips(example(number).system), FIGURES["example_12_3"]
    for name in ("K1", "K2", "K3", "K4", "K5", "K6"):
        assert getattr(found, name) == pytest.approx(figures[name], abs=5e-5), name  # measured 4.3e-5
    assert abs(found.T3 / figures["T3"] - 1) < 5e-3  # measured 3.7e-3


def test_table_12_1():
    table = FIGURES["table_12_1"]
    constants = {name: table[name] for name in ("K1", "K2", "K3", "K4", "K5", "K6", "T3", "H")}
    diagram = HeffronPhillips(**constants, omega_0=2 * np.pi * 60)
    for K_A, K_S, K_D in zip(table["K_A"], table["K_S"], table["K_D"], strict=True):
        found = diagram.torque(table["omega"], K_A / (1 + 1j * table["omega"] * table["T_R"]))
        assert found[0] == pytest.approx(K_S, abs=5e-4)  # measured 3e-4
        assert found[1] == pytest.approx(K_D, abs=3e-3)  # measured 2.2e-3, at K_A = 0


def test_example_13_1_critical_clearing():
    found, figures = critical_clearing_time(example("13_1")), FIGURES["example_13_1"]["recomputed"]
    assert found.t_crit == pytest.approx(figures["t_crit"], abs=1e-4)  # measured 5e-6
    assert found.delta_crit_deg == pytest.approx(figures["delta_crit_deg"], abs=0.05)  # measured 0.002
    assert found.outcome == "lost_synchronism"


@pytest.mark.parametrize(("clearing", "h"), [("0.07", 0.001), ("0.086", 0.0005)])
def test_example_13_1_largest_angle(clearing, h):
    scenario = example(
        "13_1",
        f"event.0.duration={clearing}",
        f"event.1.t={0.1 + float(clearing)}",
        f"simulation.h={h}",
        "simulation.t_end=1.5",
    )
    sim = Simulation(scenario.system, scenario.settings, scenario.changes)
    figures = FIGURES["example_13_1"]
    assert np.degrees(sim.get("unit.G.delta")) == pytest.approx(figures["delta_0_deg"], abs=5e-3)
    assert sim.get("unit.G.e_fd") == pytest.approx(figures["E_prime"], abs=5e-5)
    assert sim.get("bus.INF.v") == pytest.approx(figures["V_inf"], abs=5e-6)
    assert sim.run().ending.value == scenario.expect
    trace = sim.trace()
    peak = int(np.argmax(trace["unit.G.delta"]))
    expected = figures["recomputed"]["delta_max_deg"][clearing]
    assert np.degrees(trace["unit.G.delta"][peak]) == pytest.approx(expected, abs=2e-3)  # measured 1e-4, 2e-4
    if clearing == "0.07":
        assert trace.t[peak] - 0.1 == pytest.approx(
            figures["recomputed"]["t_max_0.07"], abs=1e-3
        )  # one step; measured below it


def test_no_power_flows_during_the_fault():
    sim = Simulation(example("13_1").system, example("13_1").settings, example("13_1").changes)
    sim.run(until=0.15)
    assert abs(sim.get("unit.G.p_e")) < 1e-10
    assert sim.get("bus.HT.v") < 1e-9
