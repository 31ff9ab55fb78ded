"""Inter-area damping: predictive control of the excitation against static exciters with stabilisers.

From two sides: modes of the linearised loop (of the plant with stabilisers; of the map over a sample where a controller closes the
loop once a sample), and the matrix pencil on trajectories. The figures are those of docs/inter_area.md.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plants import push

from pgexcite.core.config import load
from pgexcite.core.linearise import linearise
from pgexcite.studies.ringdown import mode_near, ringdown_modes
from pgexcite.studies.sampled_modes import sampled_modes

CONFIGS = Path(__file__).parents[3] / "configs" / "two_area"
INTER_AREA = (0.25, 0.9)  # Hz
REST = ("event=[]", "controller.mpc.V_ref_steps=[]", "simulation.t_end=30.0")
ONE_MOVE = ("controller.mpc.N_c=1",)
UNITS = (1, 2, 3, 4)


def simulation(name, *overrides):
    scenario = load(CONFIGS / f"{name}.toml", overrides)
    return scenario.simulation()


def run(name, *overrides):
    sim = simulation(name, *overrides)
    return sim, sim.run().ending.value


def between_areas(trace, t):
    return np.interp(t, trace.t, trace["unit.G1.delta"] - trace["unit.G3.delta"])


def inter_area(sim, begin=1.5, end=10.0):
    """The inter-area mode in the angle between the areas."""
    t = np.arange(begin, end - 0.1, 0.05)
    return mode_near(ringdown_modes(t, between_areas(sim.trace(), t)), INTER_AREA)


def swing(sim, begin, end):
    """Range of the angle between the areas, deg."""
    return np.degrees(np.ptp(between_areas(sim.trace(), np.arange(begin, end, 0.01))))


def lightly_damped(modes):
    return next(m for m in modes if INTER_AREA[0] < m.frequency_hz < INTER_AREA[1] and m.damping < 0.9)


def of_each(units=UNITS, **values):
    return tuple(f"controller.G{k}.{name}={value}" for k in units for name, value in values.items())


# The linearised loop


def test_stabilisers_damp_as_the_linearised_system_says():
    sim = simulation("thyristor_pss", "event=[]")
    expected = lightly_damped(linearise(sim.model, sim.state, sim.p).modes())
    assert expected.damping == pytest.approx(0.1351, abs=5e-4)
    push(sim, "unit.G1.machine.delta", 1e-3)
    sim.run()
    assert inter_area(sim).eigenvalue == pytest.approx(expected.eigenvalue, abs=5e-4)  # measured 5e-5


@pytest.mark.parametrize(("gain", "damping"), [(50.0, 0.351), (80.0, 0.563)])
def test_stabilisers_of_more_gain_damp_more(gain, damping):
    """The shipped gain of 20 is Kundur's; no other mode then has less than 0.355."""
    sim = simulation("thyristor_pss", "event=[]", *(f"unit.G{k}.stabiliser.K_STAB={gain}" for k in UNITS))
    modes = linearise(sim.model, sim.state, sim.p).modes()
    assert lightly_damped(modes).damping == pytest.approx(damping, abs=2e-3)
    assert min(m.damping for m in modes if m.frequency_hz > INTER_AREA[1]) > 0.35


MAPS = {
    "nmpc, one move": ("step_nmpc", (*ONE_MOVE, "controller.mpc.options={tolerance=1e-9}"), -0.4091 + 3.1088j),
    "nmpc": ("step_nmpc", ("controller.mpc.options={tolerance=1e-9}",), -2.1897 + 2.2154j),
    "linear, one move": ("step_linear", ONE_MOVE, -0.4091 + 3.1088j),
    "linear": ("step_linear", (), -2.1896 + 2.2154j),
    "secondary, one move": ("step_linear_secondary", ONE_MOVE, -0.3002 + 2.6725j),
    "secondary": ("step_linear_secondary", (), -3.4933 + 2.1213j),
}
"""The loop as configured, and its inter-area mode. With a right model the linear controller's is that of the NMPC, which knows the
state: a filter adds modes of its own and leaves those of the plant where they are."""


@pytest.mark.slow
@pytest.mark.parametrize("loop", [key for key in MAPS if key != "secondary, one move"])
def test_map_over_a_sample(loop):
    check_map(*MAPS[loop])


def test_map_over_a_sample_and_the_swing_it_says():
    name, overrides, expected = MAPS["secondary, one move"]
    sim = check_map(name, overrides, expected)
    assert swung(sim).eigenvalue == pytest.approx(expected, abs=1e-3)  # measured 8e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loop", "within"), [("nmpc, one move", 1e-3), ("linear, one move", 1e-3), ("nmpc", 0.05), ("linear", 0.2)]
)
def test_a_small_push_swings_as_the_map_says(loop, within):
    """A mode of damping ratio 0.7 is over before a matrix pencil has seen a period of it: what is left are the filter's."""
    name, overrides, expected = MAPS[loop]
    found = swung(at_rest(name, overrides))
    assert found.eigenvalue == pytest.approx(expected, abs=within)  # measured 6e-5, 1e-4, 0.016, 0.09


def at_rest(name, overrides):
    sim = simulation(name, *REST, *overrides)
    sim.run(until=8.0)
    return sim


def check_map(name, overrides, expected):
    sim = at_rest(name, overrides)
    mode = lightly_damped(sampled_modes(sim, 0.1).modes())
    assert mode.eigenvalue == pytest.approx(expected, abs=1e-3)  # measured 5e-5
    return sim


def swung(sim):
    """The inter-area mode after a push at 8 s."""
    push(sim, "unit.G1.machine.delta", 1e-3)
    sim.run(until=18.0)
    return inter_area(sim, 9.0, 18.0)


# TR18's steps of the voltage references, +3, -1, -3, +1 %


STEPS = {
    "stabilisers": ("thyristor_pss", (), 0.1316),
    "nmpc": ("step_nmpc", (), 0.702),
    "nmpc, one move": ("step_nmpc", ONE_MOVE, 0.1286),
    "linear": ("step_linear", (), 0.813),
    "linear, one move": ("step_linear", ONE_MOVE, 0.1318),
    "secondary": ("step_linear_secondary", (), 0.844),
    "secondary, one move": ("step_linear_secondary", ONE_MOVE, 0.102),
}
"""Damping ratio of the inter-area mode from 1.5 s on, by the matrix pencil."""


@pytest.mark.slow
@pytest.mark.parametrize("case", STEPS)
def test_damping_after_steps_of_the_references(case):
    name, overrides, damping = STEPS[case]
    sim, ending = run(name, *overrides)
    assert ending == "completed"
    assert inter_area(sim).damping == pytest.approx(damping, abs=0.01 + 0.05 * damping)
    assert sum(statistics.fallbacks for statistics in sim.result().controllers.values()) == 0


# The fault

KNOWN = ("controller.mpc.disturbance_known=true",)
LOST = {
    "stabilisers": ("fault_thyristor_pss", (), 2.57),
    "linear": ("fault_linear", (), 7.23),
    "linear, one move": ("fault_linear", ONE_MOVE, 2.29),
    "linear that is told the event, one move": ("fault_linear", (*KNOWN, *ONE_MOVE), 3.43),
    "secondary": ("fault_linear_secondary", (), 2.48),
    "secondary, one move": ("fault_linear_secondary", ONE_MOVE, 2.39),
}
"""Bolted fault at bus 7 for 0.1 s, cleared by opening a circuit 7-8: when synchronism is lost, s."""


@pytest.mark.slow
@pytest.mark.parametrize("case", LOST)
def test_who_loses_synchronism(case):
    name, overrides, when = LOST[case]
    sim, ending = run(name, *overrides)
    assert ending == "lost_synchronism"
    assert sim.outcome.t == pytest.approx(when, abs=0.05)


KEPT = {
    "nmpc": ("fault_nmpc", (), 62.4, 1e-3),
    "nmpc, one move": ("fault_nmpc", ONE_MOVE, 36.5, 0.86),
    "linear that is told the event": ("fault_linear", KNOWN, 39.6, 1.9),
}
"""Who keeps it, and by how many degrees the areas swing against one another from 1 to 3 s and from 8 to 10 s."""


@pytest.mark.slow
@pytest.mark.parametrize("case", KEPT)
def test_who_keeps_synchronism(case):
    name, overrides, early, late = KEPT[case]
    sim, ending = run(name, *overrides)
    assert ending == "completed"
    assert swing(sim, 1.0, 3.0) == pytest.approx(early, rel=0.1)
    assert swing(sim, 8.0, 10.0) == pytest.approx(late, rel=0.3, abs=5e-3)
    trace = sim.trace()
    assert max(trace[f"unit.G{k}.e_fd"].max() for k in UNITS) <= 4.0 + 1e-9


FROM_THE_TERMINALS = tuple(f"unit.G{k}.transfer.ceiling='rectifier'" for k in UNITS)
INDEPENDENT = tuple(
    f"unit.G{k}.exciter={{model='sexs', T_R=0.01, K=200.0, T_A=0.0, T_B=0.0, T_E=0.0, E_MIN=-4.0, E_MAX=4.0}}"
    for k in UNITS
)
WIDE = tuple(f"unit.G{k}.stabiliser.{limit}" for k in UNITS for limit in ("V_SMAX=0.2", "V_SMIN=-0.2"))
OTHER_SUPPLY = {
    "stabilisers": ("fault_thyristor_pss", INDEPENDENT, None),
    "stabilisers with wide limits, from the terminals": ("fault_thyristor_pss", WIDE, 2.56),
    "nmpc": ("fault_nmpc", FROM_THE_TERMINALS, 2.67),
    "nmpc, one move": ("fault_nmpc", (*FROM_THE_TERMINALS, *ONE_MOVE), 3.45),
    "secondary": ("fault_linear_secondary", INDEPENDENT, None),
    "secondary, one move": ("fault_linear_secondary", (*INDEPENDENT, *ONE_MOVE), 4.44),
    "linear": ("fault_linear", FROM_THE_TERMINALS, 6.79),
    "linear that is told the event": ("fault_linear", (*FROM_THE_TERMINALS, *KNOWN), None),
}
"""The fault with the fields fed the other way: when synchronism is lost, s, or ``None``."""


@pytest.mark.slow
@pytest.mark.parametrize("case", OTHER_SUPPLY)
def test_the_supply_of_the_fields_decides_who_keeps_the_fault(case):
    name, overrides, lost = OTHER_SUPPLY[case]
    sim, ending = run(name, *overrides)
    assert ending == ("completed" if lost is None else "lost_synchronism")
    assert lost is None or sim.outcome.t == pytest.approx(lost, abs=0.05)


FAULT_ALONE = ("event=[{type='fault', t=0.5, bus='7', duration=0.1}]",)
WITHOUT_TRIP = {
    "stabilisers": ("fault_thyristor_pss", (), 0.136),
    "linear": ("fault_linear", (), 0.70),
    "linear, one move": ("fault_linear", ONE_MOVE, 0.133),
    "secondary": ("fault_linear_secondary", (), 0.68),
    "secondary, one move": ("fault_linear_secondary", ONE_MOVE, 0.112),
}
"""With both circuits back after the fault nobody loses anything: it is the tie they do not know to be open that defeats them."""


@pytest.mark.slow
@pytest.mark.parametrize("case", WITHOUT_TRIP)
def test_without_the_trip_all_keep_it(case):
    name, overrides, damping = WITHOUT_TRIP[case]
    sim, ending = run(name, *overrides, *FAULT_ALONE)
    assert ending == "completed"
    assert inter_area(sim).damping == pytest.approx(damping, abs=0.01 + 0.05 * damping)


# From each unit's own terminals. What is held is what does not hang on details of the estimator.


def alone(unit, V_ref):
    """The controller of ``step_equivalent_one`` at another unit."""
    transfer = f"unit.{unit}.transfer={{model='field_transfer', V_RMIN=-4.0, V_RMAX=4.0}}"
    return transfer, f"controller.mpc.unit='{unit}'", f"controller.mpc.V_ref_steps=[[0.5, {V_ref}]]"


ALONE = {
    "G1": (alone("G1", 1.06), 0.138, 1.3),
    "G2": ((), 0.194, 1.3),
    "G3": (alone("G3", 1.0), 0.146, 1.3),
    "G4": (alone("G4", 1.02), 0.129, 1.3),
    "G2, one move": (ONE_MOVE, 0.113, 1.1),
}
"""Damping ratio after the steps with the controller on its equivalent at one unit and stabilisers at the other three, and a factor
by which it is above that of the three stabilisers and a regulator without one.

The matrix pencil is not what scatters: other windows give the ratio to 1 %, half the step to three digits. It is the estimator's
tuning: each of its random walks and noises doubled or halved, or another first x_s, which it has no cause to leave here, move the
ratio by -13 to +21 %; measurement noise of 1e-3 pu by -13 to +15 %.
"""


@pytest.mark.slow
@pytest.mark.parametrize("case", ALONE)
def test_alone_on_its_equivalent_it_damps_about_as_a_stabiliser(case):
    overrides, measured, factor = ALONE[case]
    sim, ending = run("step_equivalent_one", *overrides)
    assert ending == "completed"
    damping = inter_area(sim).damping
    assert damping == pytest.approx(measured, rel=0.1)
    without = simulation("thyristor_pss", "event=[]", f"unit.{case[:2]}.stabiliser.K_STAB=0.0")
    # measured 0.093, 0.099, 0.090 and 0.091 without: factors of 1.48, 1.96, 1.61, 1.42 and, with one move, 1.14
    assert damping > factor * lightly_damped(linearise(without.model, without.state, without.p).modes()).damping


@pytest.mark.slow
def test_four_on_their_equivalents_keep_moving_each_other():
    """Each takes the others' reaction for a change of the network. The stabilisers leave 0.1 degrees of the swing."""
    sim, ending = run("step_equivalent")
    assert ending == "completed"
    assert swing(sim, 8.0, 10.0) > 0.15  # measured 0.89
    assert (
        sum(sim.trace()[f"controller.G{k}.network_change"].max() > 0 for k in UNITS) >= 1
    )  # measured 1, of 11 changes


@pytest.mark.slow
def test_four_on_their_equivalents_lose_the_fault_the_sooner_the_more_they_chase_the_speed():
    lost = {}
    for P in (1e5, 5.0):
        sim, ending = run("fault_equivalent", *of_each(P=P))
        assert ending == "lost_synchronism"
        lost[P] = sim.outcome.t
    assert lost[1e5] < 3.2  # measured 2.78
    assert lost[5.0] > lost[1e5] + 0.5  # measured 3.77
