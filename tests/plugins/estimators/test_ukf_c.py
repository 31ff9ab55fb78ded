"""The filter as C against the filter in Python, on what it was fed in closed loop and on worse."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pgexcite.core import codegen
from pgexcite.core.compiling import compiler
from pgexcite.core.config import load
from pgexcite.plugins.estimators.ukf import UKF

CONFIGS = Path(__file__).parents[3] / "configs" / "smib"
DT = 0.05
DECISIONS = ("network_change", "network_held")

MACHINES = {
    "genrou": '{model="genrou", H=2.9, X_d=1.24, X_q=1.18, Xp_d=0.35, Xp_q=0.5, Xpp_d=0.24, Tp_d0=6.5}',
    "one_axis": '{model="one_axis", H=2.9, X_d=1.24, X_q=0.70, Xp_d=0.35, Tp_d0=6.5, D=1.0}',
}

pytestmark = pytest.mark.compiler

PROGRAM = """
#include <string.h>
{functions}
{sizes}
static double work[SZ_W], *results[SZ_RES];
static casadi_int iwork[SZ_IW];
static const double *args[SZ_ARG];
{filter}
void reset(void) {{ estimator_reset(); }}
int observe(const double *terminals, double e_fd, double *value, double *told, double *P) {{
    int sound = estimator_observe(terminals, e_fd);
    memcpy(value, estimator_value, sizeof estimator_value);
    memcpy(told, estimator_told, sizeof estimator_told);
    memcpy(P, ukf_P, sizeof ukf_P);
    return sound;
}}
"""


class Filters:
    """One filter in both languages, and what it was fed in a run."""

    def __init__(self, name, folder, *overrides):
        scenario = load(CONFIGS / f"{name}.toml", ["simulation.t_end=4", *overrides])
        simulation = scenario.simulation()
        solver = simulation.sessions["mpc"].solver
        self.equivalent, observer = solver._equivalent, solver._observer
        self.written, self.fed = observer.written(), []
        observe = observer.observe

        def recorded(terminals, e_fd):
            self.fed.append((terminals, e_fd))
            return observe(terminals, e_fd)

        observer.observe = recorded
        simulation.run()
        self.library = self.compiled(folder)

    def compiled(self, folder):
        written = self.written
        sizes = {
            key: max(1, *(getattr(f, key)() for f in written.functions))
            for key in ("sz_arg", "sz_res", "sz_iw", "sz_w")
        }
        arrays = "\n".join(codegen.array(name, values) for name, values in written.arrays.items())
        program = PROGRAM.format(
            functions=codegen.write_functions(written.functions),
            sizes=codegen.define(sizes | dict(written.constants)) + arrays,
            filter=codegen.loop("dense.c") + written.text,
        )
        (folder / "filter.c").write_text(program)
        strict = [
            "-std=c99",
            "-O1",
            "-ffp-contract=off",
            "-Wall",
            "-Wextra",
            "-Werror",
            "-Wpedantic",
            "-Wno-unused-function",
        ]
        command = [compiler(), *strict, "-fPIC", "-shared", "filter.c", "-o", "filter.so", "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        library = ctypes.CDLL(str(folder / "filter.so"))
        library.observe.argtypes = [ctypes.c_void_p, ctypes.c_double, *([ctypes.c_void_p] * 3)]
        return library

    def compared(self, samples):
        """The same samples through both, with the same decisions; how often each was made."""
        self.library.reset()
        observer = UKF().start(self.equivalent, DT, "auto")
        n = self.equivalent.layout.size
        value, told, P = np.zeros(n), np.zeros(len(self.written.told)), np.zeros((n, n))
        worst, decided = np.zeros(3), {"unsound": 0, "held": 0, -1.0: 0, 0.0: 0, 1.0: 0, 2.0: 0}
        for terminals, e_fd in samples:
            estimate = observer.observe(terminals, e_fd)
            at = None if terminals is None else np.ascontiguousarray(terminals)
            address = None if at is None else at.ctypes.data
            sound = self.library.observe(address, e_fd, *(a.ctypes.data for a in (value, told, P)))
            assert sound == estimate.sound
            mine = dict(zip(self.written.told, told, strict=True))
            theirs = {key: estimate.diagnostics[key] for key in mine}
            for key in DECISIONS:
                assert mine.pop(key) == theirs.pop(key)
            nis, expected = mine.pop("nis"), theirs.pop("nis")
            assert np.isnan(nis) == np.isnan(expected)
            gaps = [abs(mine[key] - theirs[key]) for key in mine]
            worst = np.fmax(
                worst,
                [
                    max(np.abs(value - estimate.value).max(), *gaps),
                    np.abs(P - observer._kalman.P).max(),
                    abs(nis - expected) / (1 + abs(expected)),
                ],
            )
            decided["unsound"] += not sound
            decided["held"] += estimate.diagnostics["network_held"] > 0
            decided[estimate.diagnostics["network_change"]] += 1
        assert worst[0] < 1e-9  # measured 3e-13 to 1e-12
        assert worst[1] < 1e-9  # measured 1e-14 to 2e-12
        assert worst[2] < 1e-7  # measured 1e-11 to 3e-10
        return decided


@pytest.fixture(scope="module", params=["fault_equivalent", "line_trip_equivalent"])
def filters(request, tmp_path_factory):
    return Filters(request.param, tmp_path_factory.mktemp("filter"))


def test_estimates_and_decisions_are_those_of_python(filters):
    assert len(filters.fed) == 80
    decided = filters.compared(filters.fed)
    assert decided[1.0] >= 1  # the fault's clearing, the trip
    assert 0 < decided["held"] < 80


def test_with_lost_samples(filters):
    lost = np.random.default_rng(2).random(80) < 0.3
    filters.compared([(None if gone else z, e_fd) for (z, e_fd), gone in zip(filters.fed, lost, strict=True)])


@pytest.mark.parametrize("at", [10, 40])
def test_with_a_wild_sample(filters, at):
    samples = list(filters.fed)
    samples[at] = (samples[at][0] * [2.0, 1.0, 1.0, 1.0], samples[at][1])
    filters.compared(samples)


@pytest.mark.parametrize("nonsense", ["noise", "contradictory", "unphysical"])
def test_through_divergence_and_restart(filters, nonsense):
    rng, samples = np.random.default_rng(7), filters.fed[:30]
    for k in range(60):
        wrong = {
            "noise": rng.normal(1.0, 0.5, size=4),
            "contradictory": np.array([1.0, 0.2, -0.8, 1.004 if k % 2 else 0.996]),
            "unphysical": np.array([1.0, -30.0, 40.0, 1.0]),
        }[nonsense]
        samples = [*samples, (wrong, 1.92)]
    decided = filters.compared([*samples, *[filters.fed[79]] * 100])
    assert decided["unsound"] > 30
    assert decided[-1.0] > 10


def test_without_measurements_and_back_from_where_no_machine_is(filters):
    """A field voltage no exciter has drives the estimate away; both start anew at the same samples."""
    decided = filters.compared([*[(None, 1e6)] * 15, *filters.fed, *[(None, 3.0)] * 400])
    assert decided["unsound"] > 0


@pytest.mark.parametrize("machine", MACHINES)
def test_with_another_machine(machine, tmp_path):
    filters = Filters("fault_equivalent", tmp_path, f"unit.G2.machine={MACHINES[machine]}")
    filters.compared(filters.fed)
