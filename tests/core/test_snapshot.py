"""A snapshot continued in a new process gives the same bits as the run that was never interrupted."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from plants import kobbelv, regulated

from pgexcite.core.errors import SnapshotError
from pgexcite.core.events import Fault
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.plugins.controllers.mpc import MPC

FAULT = Fault(type="fault", t=0.2, bus="HV", R=0.02, duration=0.1)
TESTS = Path(__file__).parent.parent

CONTINUE = """
import sys
import numpy as np
sys.path.insert(0, {tests!r})
from core.test_snapshot import make
sim = make({kind!r}, {compiled!r})
sim.resume(__import__("pathlib").Path(sys.argv[1]))
sim.run()
np.savez(sys.argv[2], x=sim.state.x, z=sim.state.z, u=sim.state.u, k=sim.state.k, startup=sim.state.startup)
"""


def make(kind: str, compiled: str) -> Simulation:
    """One of the runs this is shown on; the new process builds the same."""
    settings = Settings(0.8, 0.005, "trapezoidal" if kind == "st1a" else "tr_bdf2", compiled)
    if kind == "st1a":
        return Simulation(regulated(), settings, FAULT.changes())
    return Simulation(kobbelv(), settings, FAULT.changes(), {"mpc": MPC(unit="G2", N_c=3)})


@pytest.mark.parametrize("kind", ["st1a", "nmpc"])
@pytest.mark.parametrize(
    "t", [0.2, 0.205, 0.3, 0.47]
)  # at the fault, inside it (start-up steps pending), at its end, after
def test_same_bits_in_a_new_process(tmp_path, kind, t):
    whole = make(kind, "never")
    whole.run()
    part = make(kind, "never")
    part.run(until=t)
    part.save(tmp_path / "snapshot.npz")
    code = CONTINUE.format(tests=str(TESTS), kind=kind, compiled="never")
    subprocess.run(
        [sys.executable, "-c", code, tmp_path / "snapshot.npz", tmp_path / "end.npz"], check=True, timeout=120
    )
    end = np.load(tmp_path / "end.npz")
    for name in ("x", "z", "u", "k", "startup"):
        assert np.array_equal(end[name], getattr(whole.state, name)), name


@pytest.mark.parametrize("kind", ["st1a", "nmpc"])
def test_same_bits_at_any_step(tmp_path, kind):
    whole = make(kind, "never")
    whole.run()
    part = make(kind, "never")
    for t in np.arange(1, 160, 7) * 0.005:
        part.restart()
        part.run(until=t)
        part.save(tmp_path / "snapshot.npz")
        part.resume(tmp_path / "snapshot.npz")
        part.run()
        assert np.array_equal(part.state.x, whole.state.x), t


def test_state_branches():
    """A ``State`` is a value: two futures from one point do not disturb each other."""
    sim = make("st1a", "never")
    sim.run(until=0.25)
    point = sim.state
    calm = sim.kernel.advance(point, sim.initial.p, "tr_bdf2", 0.005, 20)
    faulted = sim.kernel.advance(point, sim.p, "tr_bdf2", 0.005, 20)
    again = sim.kernel.advance(point, sim.initial.p, "tr_bdf2", 0.005, 20)
    assert np.array_equal(calm.x, again.x)
    assert not np.array_equal(calm.x, faulted.x)


def test_an_order_given_at_the_point_is_in_the_snapshot(tmp_path):
    """A controller switched by hand at a sampling instant learns of it at its next sample, after a snapshot as well."""
    runs = [make("nmpc", "never") for _ in range(2)]
    runs[0].run(until=0.1)
    runs[0].set("controller.mpc.active", 0.0)
    runs[0].save(tmp_path / "snapshot.npz")
    runs[1].resume(tmp_path / "snapshot.npz")
    assert [run.memory().kept["ordered:mpc"] for run in runs] == [1.0, 1.0]
    for run in runs:
        run.run()
    assert np.array_equal(runs[0].state.x, runs[1].state.x)


def test_a_snapshot_of_another_controller_is_refused(tmp_path):
    sim = make("nmpc", "never")
    sim.save(tmp_path / "snapshot.npz")
    other = Simulation(kobbelv(), sim.settings, FAULT.changes(), {"mpc": MPC(unit="G2", N_c=3, backend="equivalent")})
    with pytest.raises(SnapshotError, match="holds no"):
        other.resume(tmp_path / "snapshot.npz")


@pytest.mark.parametrize("compiled", ["never", "always"])
@pytest.mark.parametrize(
    ("taken", "used"),
    [
        ({"N_c": 1}, {"N_c": 3}),
        ({"N_c": 3}, {"N_c": 1}),
        ({"N_p": 5}, {"N_p": 8}),
        ({"N_p": 1}, {"N_p": 8}),
        ({"backend": "linear"}, {"backend": "linear", "known_delay": 1}),
        ({"backend": "equivalent", "known_delay": 1}, {"backend": "equivalent"}),
    ],
)
def test_a_snapshot_of_another_configuration_is_refused(tmp_path, taken, used, compiled):
    """What broadcasts would be taken up without a word, and a delay not be predicted over."""
    sims = [
        Simulation(kobbelv(), Settings(0.8, 0.005, compile=compiled), (), {"mpc": MPC(unit="G2", **options)})
        for options in (taken, used)
    ]
    sims[0].run(until=0.1)
    sims[0].save(tmp_path / "snapshot.npz")
    with pytest.raises(SnapshotError, match=r"of shape .* use the configuration"):
        sims[1].resume(tmp_path / "snapshot.npz")
    sims[0].resume(tmp_path / "snapshot.npz")


def test_a_snapshot_of_another_model_is_refused(tmp_path):
    sim = make("st1a", "never")
    sim.save(tmp_path / "snapshot.npz")
    with pytest.raises(SnapshotError, match="another model"):
        make("nmpc", "never").resume(tmp_path / "snapshot.npz")


def test_a_file_that_is_no_snapshot_is_refused(tmp_path):
    (tmp_path / "snapshot.npz").write_text("not this")
    with pytest.raises(SnapshotError, match="not a snapshot"):
        make("st1a", "never").resume(tmp_path / "snapshot.npz")


@pytest.mark.parametrize("kept", [0, 30, 3000])
def test_a_snapshot_cut_short_is_refused(tmp_path, kept):
    sim = make("st1a", "never")
    path = tmp_path / "snapshot.npz"
    sim.save(path)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(SnapshotError, match="not a snapshot"):
        sim.resume(path)
