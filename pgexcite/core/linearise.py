"""Small-signal analysis: the equations linearised at a point, with everything algebraic eliminated, and its modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.errors import PgexciteError
from pgexcite.core.model import Model, State

Array = NDArray[np.float64]
_AT_BOUND = 1e-9


@dataclass(frozen=True)
class Mode:
    """A mode of the linearised system.

    Attributes:
        eigenvalue: sigma + j omega, 1/s and rad/s; of a pair the one with omega > 0.
        damping: damping ratio ``-sigma / |lambda|``; 1 or -1 for a real mode.
        frequency_hz: ``omega / (2 pi)``.
        participation: state path -> magnitude of its participation factor, largest first, summing to 1 (Kundur section 12.2.4).
    """

    eigenvalue: complex
    damping: float
    frequency_hz: float
    participation: Mapping[str, float]

    def as_dict(self) -> dict[str, Any]:
        """The mode as plain data: ``re``, ``im``, ``damping``, ``frequency_hz``, ``participation``."""
        return {
            "re": self.eigenvalue.real,
            "im": self.eigenvalue.imag,
            "damping": self.damping,
            "frequency_hz": self.frequency_hz,
            "participation": dict(self.participation),
        }


@dataclass(frozen=True)
class Linearisation:
    """``x' = A x + B u``, ``y = C x + D u`` for deviations from a point.

    Attributes:
        A, B, C, D: shapes ``(n, n)``, ``(n, n_u)``, ``(n_y, n)``, ``(n_y, n_u)``.
        x_names: paths of the ``n`` states that are left: those with a time constant, not held at a limit, and not at rest
            whatever happens (the angle of the reference itself).
        u_names, y_names: paths of commands and outputs.
        held: states held at a limit at this point.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    x_names: tuple[str, ...]
    u_names: tuple[str, ...]
    y_names: tuple[str, ...]
    held: tuple[str, ...]

    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues of ``A``, least damped first by real part, shape ``(n,)``."""
        values = np.linalg.eigvals(self.A).astype(complex)
        return values[np.lexsort((-values.imag, -values.real))]

    def modes(self) -> list[Mode]:
        """Modes with damping and participation, real part descending; of a complex pair the one with positive frequency."""
        if not self.x_names:
            return []
        values, right = np.linalg.eig(self.A)
        return modes_of(values, np.linalg.pinv(right), right, self.x_names)


def modes_of(
    values: NDArray[np.complexfloating],
    left: NDArray[np.complexfloating],
    right: NDArray[np.complexfloating],
    names: Sequence[str],
) -> list[Mode]:
    """Modes from eigenvalues and eigenvectors, real part descending; of a complex pair the one with positive frequency.

    Args:
        values: eigenvalues in continuous time, 1/s, shape ``(m,)``.
        left: left eigenvectors, in rows, shape ``(m, n)``.
        right: right eigenvectors, in columns, shape ``(n, m)``.
        names: paths of the states.
    """
    modes = []
    for k in np.lexsort((-values.imag, -values.real)):
        value = complex(values[k])
        if value.imag < 0:
            continue
        factors = np.abs(right[:, k] * left[k, :])
        factors = factors / factors.sum()
        order = np.argsort(-factors, kind="stable")
        share = {names[i]: float(factors[i]) for i in order}
        size = abs(value)
        modes.append(Mode(value, -value.real / size if size > 0 else 1.0, value.imag / (2 * np.pi), share))
    return modes


def linearise(model: Model, state: State, p: Array) -> Linearisation:
    """Linearise at a point, with exact derivatives.

    Zero-mass rows and states at a non-windup limit count as algebraic.

    Args:
        model: the equations.
        state: the point, normally a steady state.
        p: parameters, shape ``(n_p,)``.

    Raises:
        PgexciteError: the algebraic equations are singular at this point.
    """
    f, mass, lower, upper, derivatives = _derivatives(model, state, p)
    n_x = len(model.x_names)
    at_upper = model.limited & (state.x >= upper - _AT_BOUND) & (f >= -_AT_BOUND) & (mass >= 0)
    at_lower = model.limited & (state.x <= lower + _AT_BOUND) & (f <= _AT_BOUND)
    rows_f = derivatives["f"].copy()
    unit = np.zeros(rows_f.shape)
    unit[np.arange(n_x), np.arange(n_x)] = 1.0
    for at, bound in ((at_upper, "upper"), (at_lower, "lower")):
        rows_f[at] = unit[at] - derivatives[bound][at]
    algebraic = at_upper | at_lower | (mass == 0)
    dynamic = ~algebraic & ~model.inert & ~_at_rest(f, derivatives["f"])
    n_w = n_x + len(model.z_names)
    solved = np.concatenate((algebraic, np.ones(n_w - n_x, dtype=bool)))
    moving = np.concatenate((dynamic, np.zeros(n_w - n_x, dtype=bool)))
    g = np.vstack((rows_f[algebraic], derivatives["g"]))
    g_moving, g_solved, g_u = g[:, :n_w][:, moving], g[:, :n_w][:, solved], g[:, n_w:]
    try:
        response = -np.linalg.solve(g_solved, np.hstack((g_moving, g_u)))
    except np.linalg.LinAlgError:
        raise PgexciteError(
            "the algebraic equations are singular at this point: there is nothing to linearise"
        ) from None
    n = int(dynamic.sum())

    def eliminate(rows: Array) -> tuple[Array, Array]:
        total = np.hstack((rows[:, :n_w][:, moving], rows[:, n_w:])) + rows[:, :n_w][:, solved] @ response
        return total[:, :n], total[:, n:]

    scale = 1.0 / mass[dynamic][:, None]
    A, B = eliminate(rows_f[dynamic] * scale)
    C, D = eliminate(derivatives["y"])
    names = np.array(model.x_names, dtype=object)
    return Linearisation(
        A, B, C, D, tuple(names[dynamic]), model.u_names, model.y_names, tuple(names[at_upper | at_lower])
    )


def _at_rest(f: Array, rows: Array) -> NDArray[np.bool_]:
    """States that nothing moves though their rows do not vanish symbolically: speed and angle of a machine with ``H = 0``.

    A row may depend on states that are at rest themselves.
    """
    n_x = f.size
    found = np.zeros(n_x, dtype=bool)
    while True:
        moving = rows.copy()
        moving[:, :n_x][:, found] = 0.0
        more = (f == 0) & ~moving.any(axis=1)
        if np.array_equal(more, found):
            return found
        found = more


def _derivatives(model: Model, state: State, p: Array) -> tuple[Array, Array, Array, Array, dict[str, Array]]:
    x, z, u = (
        ca.SX.sym(name, len(names))
        for name, names in (("x", model.x_names), ("z", model.z_names), ("u", model.u_names))
    )
    d, q = ca.SX.sym("d", len(model.d_names)), ca.SX.sym("p", p.size)
    f, mass, lower, upper, g, y = model.dae(x, z, d, u, q)
    point = ca.vertcat(x, z, u)
    # A bound that does not exist is infinite; its derivative is zero, not NaN.
    rows = {"f": f, "g": g, "y": y, "lower": lower, "upper": upper}
    function = ca.Function(
        "derivatives", [x, z, d, u, q], [f, mass, lower, upper, *(ca.jacobian(row, point) for row in rows.values())]
    )
    values = [np.array(v.full()) for v in function(state.x, state.z, state.d, state.u, p)]
    jacobians = dict(zip(rows, values[4:], strict=True))
    return values[0].ravel(), values[1].ravel(), values[2].ravel(), values[3].ravel(), jacobians
