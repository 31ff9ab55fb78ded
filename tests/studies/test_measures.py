import math

import numpy as np
import pytest

from pgexcite.core.trace import LogEntry, Trace
from pgexcite.studies.measures import first_swing_max, recovery_time, swing_damping


def swing(zeta, frequency=1.2, drift=0.0, t_end=10.0):
    """A damped oscillation of the rotor, and a voltage that recovers exponentially, behind an event at 1 s."""
    t = np.concatenate([[0.0, 1.0], np.arange(1.0, t_end, 0.005)])
    since = np.maximum(t - 1.0, 0.0)
    omega_n = 2 * math.pi * frequency / math.sqrt(1 - zeta**2)
    delta = 0.7 + 0.3 * np.exp(-zeta * omega_n * since) * np.sin(2 * math.pi * frequency * since) + drift * since
    v_t = np.where(t < 1.0, 1.0, 1.0 - 0.3 * np.exp(-since / 0.4))
    v_t[1] = 1.0
    return Trace(t, {"unit.G.delta": delta, "unit.G.v_t": v_t}, {}, (LogEntry(1.0, "event", "fault cleared"),))


@pytest.mark.parametrize("zeta", [0.02, 0.08, 0.25])
def test_damping_of_a_known_oscillation(zeta):
    assert swing_damping(swing(zeta), "G") == pytest.approx(zeta, rel=0.02)


def test_damping_does_not_care_about_a_drifting_mean():
    assert swing_damping(swing(0.08, drift=0.01), "G") == pytest.approx(0.08, rel=0.05)


def test_a_swing_that_grows_has_negative_damping():
    assert swing_damping(swing(-0.02, t_end=6.0), "G") == pytest.approx(-0.02, rel=0.05)


def test_no_swing_no_damping():
    assert swing_damping(swing(0.9), "G") is None


def test_first_crest():
    trace = swing(0.05)
    assert first_swing_max(trace, "G") == pytest.approx(math.degrees(np.max(trace["unit.G.delta"])))


def test_a_rotor_that_runs_away_has_no_first_swing():
    t = np.linspace(0, 2, 401)
    trace = Trace(t, {"unit.G.delta": 0.7 + t**2}, {}, (LogEntry(0.0, "event", "fault"),))
    assert first_swing_max(trace, "G") is None


@pytest.mark.parametrize("band", [0.05, 0.01])
def test_recovery_of_an_exponential(band):
    assert recovery_time(swing(0.1), "G", band) == pytest.approx(0.4 * math.log(0.3 / band), abs=0.005)


def test_a_voltage_that_stays_low_never_recovers():
    t = np.linspace(0, 2, 401)
    trace = Trace(t, {"unit.G.v_t": np.where(t < 1, 1.0, 0.9)}, {}, (LogEntry(1.0, "event", "trip"),))
    assert recovery_time(trace, "G", 0.05) is None


def test_recovery_counts_from_the_last_step_of_a_controllers_own_reference():
    t = np.linspace(0.0, 10.0, 1001)
    aim = np.where(t < 6.0, 1.0, 1.05)
    v_t = aim - np.where(t < 6.0, 0.0, 0.05 * np.exp(-(t - 6.0) / 0.5))
    columns = {"unit.G.v_t": v_t, "controller.mpc.V_ref_G": aim, "controller.mpc.active": np.ones(1001)}
    assert recovery_time(Trace(t, columns, {}), "G", 0.01) == pytest.approx(0.5 * math.log(0.05 / 0.0105), abs=0.011)
