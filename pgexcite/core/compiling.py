"""Generated C compiled: once, cached by content, and only where it can be had.

No compiler means slower, never broken: the caller then keeps to CasADi's virtual machine.
"""

from __future__ import annotations

import _ctypes
import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.codegen import CompilationError
from pgexcite.core.settings import Compile

Array = NDArray[np.float64]

FLAGS = ("-O1", "-fPIC", "-shared", "-ffp-contract=off", "-w")
"""Without contraction into fused multiply-adds the numbers are those of the virtual machine, with whatever vectors there are."""


def compiler() -> str | None:
    """The C compiler: ``$CC``, ``cc`` or ``gcc``, whichever is there first; ``None`` without one."""
    for name in (os.environ.get("CC"), "cc", "gcc", "clang"):
        if name and shutil.which(name):
            return shutil.which(name)
    return None


@cache
def processor() -> tuple[tuple[str, ...], str]:
    """Flags for this processor's own vectors, and what tells it from others: a library with them must not run elsewhere."""
    known = Path("/proc/cpuinfo")
    if platform.machine() not in ("x86_64", "AMD64") or not known.exists():
        return (), ""
    features = next((line for line in known.read_text(errors="replace").splitlines() if line.startswith("flags")), "")
    return ("-march=native",), features


def cache_directory() -> Path:
    """Where compiled libraries are kept: ``$PGEXCITE_CACHE``, else the user's cache directory.

    Raises:
        CompilationError: the user has no home.
    """
    chosen = os.environ.get("PGEXCITE_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "pgexcite"
    except RuntimeError as cause:
        raise CompilationError(f"there is no place to keep libraries, set PGEXCITE_CACHE: {cause}") from cause


def library(write: Callable[[], str], choice: Compile, *, only_cached: bool = False) -> ctypes.CDLL | None:
    """The library of a source, a copy of one's own; ``None`` where it is not to be had and was not insisted on.

    Args:
        write: writes the source.
        choice: ``"never"`` compiles nothing, ``"always"`` insists.
        only_cached: do not compile.

    Raises:
        CompilationError: with ``"always"``: part of the source cannot be written, there is no compiler, it failed, or the library
            cannot be loaded.
    """
    if choice == "never" or (choice != "always" and compiler() is None):
        return None
    try:
        built = build(write(), only_cached=only_cached)
        return None if built is None else load(built)
    except CompilationError:
        if choice == "always":
            raise
        return None


def build(source: str, *, only_cached: bool = False) -> Path | None:
    """Compile a source, or take the library compiled from the same source before.

    Args:
        only_cached: do not compile; ``None`` where there is no library yet.

    Raises:
        CompilationError: no compiler, or it failed.
    """
    cc, (native, features) = compiler(), processor()
    key = hashlib.sha256("\0".join((source, *FLAGS, *native, features, cc or "")).encode()).hexdigest()[:24]
    target = cache_directory() / f"{key}.so"
    try:
        if target.exists():
            return target
        if only_cached:
            return None
        if cc is None:
            raise CompilationError('no C compiler was found: install one, set CC, or use compile = "auto"')
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as folder:
            unit = Path(folder) / "stage.c"
            unit.write_text(source)
            built = Path(folder) / target.name
            done = subprocess.run(
                [cc, *FLAGS, *native, str(unit), "-o", str(built), "-lm"], capture_output=True, text=True, check=False
            )
            if done.returncode != 0:
                raise CompilationError(f"{cc} failed: {done.stderr.strip()[:500]}")
            built.replace(target)
    except OSError as cause:
        raise CompilationError(f"the C code could not be compiled in {target.parent}: {cause}") from cause
    return target


def load(library: Path) -> ctypes.CDLL:
    """Load a copy of a library of one's own: its work arrays are static, and two kernels of one model must not share them.

    Raises:
        CompilationError: it cannot be loaded (nothing may be run from the directory for temporary files, say).
    """
    try:
        with tempfile.TemporaryDirectory() as folder:
            own = Path(folder) / library.name
            shutil.copyfile(library, own)
            loaded = ctypes.CDLL(str(own))
    except OSError as cause:
        raise CompilationError(f"the library {library} could not be loaded: {cause}") from cause
    if sys.platform != "win32":
        # A study makes thousands of simulations, and a process may map only so many files. Its functions keep a library alive.
        weakref.finalize(loaded, _ctypes.dlclose, loaded._handle).atexit = False
    return loaded


class CompiledLoop:
    """The stepping loop of a compiled library."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._advance = library.pgexcite_advance
        self._advance.restype = ctypes.c_int
        pointer = ctypes.c_void_p
        self._advance.argtypes = [ctypes.c_int, ctypes.c_double, ctypes.c_int, pointer, *([pointer] * 9)]

    def advance(self, rule: int, h: float, n: int, startup: int, arrays: Sequence[Array]) -> tuple[int, int]:
        """Take up to ``n`` steps; returns how many were taken and the startup steps left.

        Args:
            arrays: ``x, z, d, u, p`` (renewed in place) and the rows of ``x, z, d, y`` to record into, contiguous float64.
        """
        left = ctypes.c_int(startup)
        done = self._advance(rule, h, n, ctypes.addressof(left), *(array.ctypes.data for array in arrays))
        return int(done), int(left.value)
