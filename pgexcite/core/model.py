"""``Model`` and ``State``: the compiled equations of a system, and a point in them. Both are frozen; a step is a pure function."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from zipfile import BadZipFile

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.errors import AssemblyError, SnapshotError
from pgexcite.core.system import System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """The equations of a system as one CasADi function, with the names of everything in it.

        mass(p) x' = f(x, z, d, u, p)    lower <= x <= upper    0 = g(x, z, d, u, p)
        d+ = renew(x_0, z_0, x, z, d, u, p, h)           y = h(x, z, d, u, p)

    Attributes:
        system: what was assembled.
        dae: ``(x, z, d, u, p) -> (f, mass, lower, upper, g, y)``, all column vectors of the sizes of the names below.
        renew: the discrete states after a step of ``h`` seconds from ``x_0, z_0`` (after an event there) to ``x, z``.
        x_names, z_names, d_names, u_names, p_names, y_names: paths of states, algebraic unknowns, discrete states, commands
            (set-points), parameters and outputs.
        p_0: parameters of the system as configured, shape ``(n_p,)``; constants of the initial point are NaN until initialised.
        d_0: initial discrete states, shape ``(n_d,)``.
        limited: for each state whether it has a non-windup limit, shape ``(n_x,)``.
        inert: states whose right-hand side is identically zero (the angle of the reference itself), shape ``(n_x,)``.
        units: path -> unit.
        reference: path of what rotor angles are measured against.
    """

    system: System
    dae: ca.Function
    renew: ca.Function
    x_names: tuple[str, ...]
    z_names: tuple[str, ...]
    d_names: tuple[str, ...]
    u_names: tuple[str, ...]
    p_names: tuple[str, ...]
    y_names: tuple[str, ...]
    p_0: Array
    d_0: Array
    limited: NDArray[np.bool_]
    inert: NDArray[np.bool_]
    units: Mapping[str, str]
    reference: str

    @cached_property
    def index(self) -> dict[str, dict[str, int]]:
        """Positions by path, for each of ``x z d u p y``."""
        groups = {
            "x": self.x_names,
            "z": self.z_names,
            "d": self.d_names,
            "u": self.u_names,
            "p": self.p_names,
            "y": self.y_names,
        }
        return {key: {name: k for k, name in enumerate(names)} for key, names in groups.items()}

    def position(self, group: str, path: str) -> int:
        """Position of a path within ``x``, ``z``, ``d``, ``u``, ``p`` or ``y``.

        Raises:
            KeyError: there is no such path; the message names the nearest.
        """
        try:
            return self.index[group][path]
        except KeyError:
            near = get_close_matches(path, self.index[group], n=3)
            raise KeyError(f"no {path!r} in this model; nearest: {', '.join(near) or 'none'}") from None

    def nearest(self, path: str) -> str:
        """A hint for a path that is no output, command or parameter: those that resemble it, or ``""``."""
        near = get_close_matches(path, (*self.u_names, *self.p_names, *self.y_names), n=3)
        return f"nearest: {', '.join(near)}" if near else ""

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the equations and the names; a snapshot belongs to the model of the same fingerprint."""
        names = "\n".join((*self.x_names, *self.z_names, *self.d_names, *self.u_names, *self.p_names))
        return hashlib.sha256((names + self.dae.serialize() + self.renew.serialize()).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class State:
    """A point of a run: all that is needed to go on from it bit for bit, together with the parameters.

    Attributes:
        k: step boundary, counted from the start of the run.
        t: time, s (``k * h``).
        x, z, d, u: states, algebraic unknowns, discrete states and commands, read-only, shapes ``(n_x,)`` and so on.
        startup: backward-Euler steps still to be taken after the last discontinuity (trapezoidal rule only).
    """

    k: int
    t: float
    x: Array
    z: Array
    d: Array
    u: Array
    startup: int = 0

    def __post_init__(self) -> None:
        for name in ("x", "z", "d", "u"):
            value = np.array(getattr(self, name), dtype=float)
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def with_(self, **changes: object) -> State:
        """A copy with some fields replaced."""
        return replace(self, **changes)  # type: ignore[arg-type]

    def save(self, path: Path, model: Model, p: Array, memory: Mapping[str, Array]) -> None:
        """Write the state, the parameters and further named arrays to an ``.npz`` file that any process can read back."""
        content = {key: np.asarray(getattr(self, key)) for key in ("k", "t", "startup", "x", "z", "d", "u")}
        content |= {"fingerprint": np.asarray(model.fingerprint), "p": p}
        content |= {f"memory:{key}": value for key, value in memory.items()}
        with path.open("wb") as file:
            np.savez(file, **content)  # type: ignore[arg-type]

    @staticmethod
    def load(path: Path, model: Model) -> tuple[State, Array, dict[str, Array]]:
        """Read a state, its parameters and the further arrays back.

        Raises:
            SnapshotError: the file cannot be read or belongs to another model.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                content = {key: data[key] for key in data.files}
        except (OSError, ValueError, EOFError, BadZipFile) as cause:
            # NumPy takes whatever is no archive for pickled objects, which is no news to who named the wrong file.
            reason = (
                cause.strerror
                if isinstance(cause, OSError) and cause.strerror
                else "not an archive of arrays, or cut short"
            )
            raise SnapshotError(f"{path}: not a snapshot that can be read ({reason})") from cause
        missing = {"fingerprint", "k", "t", "startup", "x", "z", "d", "u", "p"} - content.keys()
        if missing:
            raise SnapshotError(f"{path}: not a snapshot, {', '.join(sorted(missing))} missing")
        if str(content["fingerprint"]) != model.fingerprint:
            raise SnapshotError(
                f"{path}: this snapshot was taken of another model; use the configuration and the version it was taken with"
            )
        state = State(
            int(content["k"]),
            float(content["t"]),
            content["x"],
            content["z"],
            content["d"],
            content["u"],
            int(content["startup"]),
        )
        start = "memory:"
        memory = {key.removeprefix(start): value for key, value in content.items() if key.startswith(start)}
        return state, content["p"], memory


def require(condition: bool, message: str) -> None:
    """Raise an ``AssemblyError`` with this message unless the condition holds."""
    if not condition:
        raise AssemblyError(message)
