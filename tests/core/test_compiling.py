"""Generated C: optional, cached by content, and refused loudly only where it was asked for."""

from __future__ import annotations

import gc
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest
from plants import kobbelv, regulated

from pgexcite.core import compiling
from pgexcite.core.codegen import CompilationError
from pgexcite.core.compiling import build, cache_directory, compiler
from pgexcite.core.events import Fault
from pgexcite.core.initialise import initialise
from pgexcite.core.settings import Settings
from pgexcite.core.simulate import Simulation
from pgexcite.core.step import Kernel
from pgexcite.plugins.controllers.mpc import MPC
from pgexcite.plugins.machines.salient_pole import SalientPole

FAULT = Fault(type="fault", t=0.05, bus="HV", R=0.02, duration=0.1).changes()


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """An empty cache of this test's own."""
    monkeypatch.setenv("PGEXCITE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def simulation(compile, system=None):
    return Simulation(system or kobbelv(), Settings(0.2, 0.005, compile=compile), FAULT)


def libraries(cache):
    return sorted(path.name for path in cache.glob("*.so")) if cache.exists() else []


def without_compiler(monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "/nonexistent")


def with_broken_compiler(monkeypatch, tmp_path):
    broken = tmp_path / "broken-cc"
    broken.write_text("#!/bin/sh\necho 'no such instruction' >&2\nexit 1\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("CC", str(broken))


def test_without_a_compiler_it_is_slower_never_broken(monkeypatch, cache):
    compiled = simulation("always")
    compiled.run()
    without_compiler(monkeypatch)
    assert compiler() is None
    assert not simulation("wait").kernel.compiled
    plain = simulation("auto")
    assert not plain.kernel.compiled
    assert plain.run().ending.value == "completed"
    assert np.array_equal(plain.state.x, compiled.state.x)


def test_auto_leaves_a_large_model_to_the_virtual_machine_and_wait_does_not(monkeypatch, cache):
    monkeypatch.setattr("pgexcite.core.step.COMPILED_BY_DEFAULT", 10)
    assert not simulation("auto").kernel.compiled
    assert libraries(cache) == []
    assert simulation("wait").kernel.compiled
    assert simulation("auto").kernel.compiled  # it is there now


def test_auto_waits_for_no_large_prediction_either(monkeypatch, cache):
    """The plant's library is there from another run; that is no reason to wait for the plans'."""
    controlled = {"mpc": MPC(unit="G2")}
    simulation("wait")
    monkeypatch.setattr("pgexcite.core.step.COMPILED_BY_DEFAULT", 10)
    run = Simulation(kobbelv(), Settings(0.2, 0.005, compile="auto"), FAULT, controlled)
    assert run.kernel.compiled
    run.run()
    assert len(libraries(cache)) == 1
    Simulation(kobbelv(), Settings(0.2, 0.005, compile="wait"), FAULT, controlled).run()
    assert len(libraries(cache)) > 1


def test_without_a_compiler_always_is_an_error_that_says_what_to_do(monkeypatch):
    without_compiler(monkeypatch)
    with pytest.raises(CompilationError, match='install one, set CC, or use compile = "auto"'):
        simulation("always")


def test_a_compiler_that_fails(monkeypatch, tmp_path, cache):
    with_broken_compiler(monkeypatch, tmp_path)
    assert not simulation("auto").kernel.compiled
    with pytest.raises(CompilationError, match="broken-cc failed: no such instruction"):
        simulation("always")
    assert list(cache.iterdir()) == []  # nothing half-built is left behind


def test_a_cache_that_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("PGEXCITE_CACHE", str(tmp_path / "file"))
    assert not simulation("auto").kernel.compiled
    with pytest.raises(CompilationError, match="the C code could not be compiled in"):
        simulation("always")


def test_without_a_home_there_is_no_cache(monkeypatch):
    for name in ("PGEXCITE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(compiling.Path, "home", homeless)
    assert not simulation("auto").kernel.compiled
    with pytest.raises(CompilationError, match="set PGEXCITE_CACHE: Could not determine home directory"):
        simulation("always")


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="the system does not tell what a process has mapped")
def test_libraries_are_let_go_with_the_runs_that_used_them(cache):
    def mapped():
        return sum(
            name in line for line in Path("/proc/self/maps").read_text().splitlines() for name in libraries(cache)
        )

    sim = Simulation(kobbelv(), Settings(0.1, 0.005, compile="always"), FAULT, {"mpc": MPC(unit="G2")})
    sim.run()
    few = mapped()
    assert few > 0
    for _ in range(3):
        sim.restart()
        sim.run()
    gc.collect()
    assert mapped() <= few
    del sim
    gc.collect()
    assert mapped() == 0


def test_a_library_that_must_not_be_loaded(monkeypatch):
    """Where temporary files may not be executed the loader refuses them."""

    def refused(path):
        raise OSError(f"{path}: failed to map segment from shared object")

    monkeypatch.setattr(compiling.ctypes, "CDLL", refused)
    assert not simulation("auto").kernel.compiled
    with pytest.raises(CompilationError, match=r"could not be loaded: .*failed to map segment"):
        simulation("always")


@pytest.mark.parametrize("backend", ["nmpc", "linear", "equivalent"])
def test_a_compiler_that_knows_no_lanes(monkeypatch, tmp_path, backend):
    """It compiles the plant and not the predictions: those are slower, never broken."""
    cc = tmp_path / "plain-cc"
    real = shutil.which("cc") or shutil.which("gcc")
    cc.write_text(f'#!/bin/sh\nfor a; do case $a in *.c) grep -q lanes "$a" && exit 1;; esac; done\nexec {real} "$@"\n')
    cc.chmod(cc.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("CC", str(cc))

    def run(compile):
        controlled = {"mpc": MPC(unit="G2", backend=backend)}
        return Simulation(kobbelv(), Settings(0.1, 0.005, compile=compile), FAULT, controlled)

    sim = run("auto")
    assert sim.kernel.compiled
    assert sim.run().ending.value == "completed"
    with pytest.raises(CompilationError, match="plain-cc failed"):
        run("always").run()


def test_never_compiles_nothing(cache):
    assert not simulation("never").kernel.compiled
    assert libraries(cache) == []


def test_a_library_is_compiled_once_for_any_parameters(monkeypatch, cache):
    """Parameters are symbols: another reactance or gain finds the same library, another component another one."""
    simulation("always")
    assert len(libraries(cache)) == 1
    calls = []
    real = compiling.subprocess.run
    monkeypatch.setattr(compiling.subprocess, "run", lambda *a, **k: calls.append(a) or real(*a, **k))
    again = simulation("always", kobbelv(machine=SalientPole(H=4.0)))
    assert again.kernel.compiled
    assert calls == []
    simulation("always", regulated())
    assert len(calls) == 1
    assert len(libraries(cache)) == 2


def test_another_compiler_is_another_library(monkeypatch, tmp_path, cache):
    simulation("always")
    other = tmp_path / "other-cc"
    other.write_text(f'#!/bin/sh\nexec {shutil.which("cc") or shutil.which("gcc")} "$@"\n')
    other.chmod(other.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("CC", str(other))
    simulation("always")
    assert len(libraries(cache)) == 2


def test_only_cached_compiles_nothing(cache):
    source = "int pgexcite_advance(void) { return 0; }"
    assert build(source, only_cached=True) is None
    path = build(source)
    assert path is not None
    assert build(source, only_cached=True) == path
    assert path.parent == cache_directory()


def test_two_kernels_of_one_model_share_no_work_arrays():
    initial = initialise(kobbelv())
    kernels = [Kernel(initial.model, initial.state, initial.p, "always") for _ in range(2)]
    other = initial.p.copy()
    other[initial.model.position("p", "unit.G2.machine.H")] = 1.0
    faulted = initial.p.copy()
    faulted[initial.model.position("p", "bus.HV.fault_status")] = 1.0
    alone = kernels[0].advance(initial.state, faulted, "tr_bdf2", 0.005, 10)
    kernels[1].advance(initial.state, other, "trapezoidal", 0.01, 3)
    interleaved = kernels[0].advance(initial.state, faulted, "tr_bdf2", 0.005, 10)
    assert np.array_equal(alone.x, interleaved.x)
    assert np.array_equal(alone.y, interleaved.y)


def test_a_step_that_fails_in_c_is_rescued_as_in_the_virtual_machine(monkeypatch):
    """With two iterations many steps give up; shorter inner steps take over, and both ways end at the same point."""
    monkeypatch.setattr("pgexcite.core.step.MAX_ITERATIONS", 2)
    ends = []
    for compile in ("never", "always"):
        sim = Simulation(kobbelv(), Settings(0.5, 0.02, compile=compile), FAULT)
        assert sim.run().ending.value == "completed"
        assert any(entry.kind == "solver" for entry in sim.trace().log)
        ends.append(sim.state.x)
    assert np.abs(ends[0] - ends[1]).max() < 1e-9
