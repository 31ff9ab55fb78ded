"""Modes of a ring-down by the matrix pencil: frequency and damping taken from a trajectory.

Y. Hua and T. K. Sarkar, "Matrix pencil method for estimating parameters of exponentially damped/undamped sinusoids in noise", IEEE
Trans. ASSP 38 (1990) 814; used on power swings as in the IEEE PES report TR15 (2012), "Identification of Electromechanical Modes".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgexcite.core.errors import PgexciteError
from pgexcite.core.trace import Array


@dataclass(frozen=True)
class RingdownMode:
    """A damped sinusoid in a signal.

    Attributes:
        eigenvalue: sigma + j omega, 1/s and rad/s, ``omega >= 0``.
        amplitude: its size at the first sample, in the signal's unit.
        phase: of its cosine at the first sample, rad.
    """

    eigenvalue: complex
    amplitude: float
    phase: float

    @property
    def damping(self) -> float:
        """Damping ratio."""
        size = abs(self.eigenvalue)
        return -self.eigenvalue.real / size if size > 0 else 1.0

    @property
    def frequency_hz(self) -> float:
        """``omega / (2 pi)``."""
        return self.eigenvalue.imag / (2 * np.pi)


def ringdown_modes(t: Array, samples: Array, *, order: int = 20, floor: float = 1e-4) -> list[RingdownMode]:
    """Damped sinusoids of which a signal consists, largest first.

    Args:
        t: times in equal steps, s, shape ``(n,)``; 100 to 1,000 samples over a few periods are plenty.
        samples: the signal, shape ``(n,)``; its mean is taken off.
        order: number of exponentials at the most (a pair counts two).
        floor: singular values below this part of the largest are noise.

    Raises:
        PgexciteError: too few samples, or steps that are not equal.
    """
    n = len(t)
    if n < 2 * order + 2:
        raise PgexciteError(f"{n} samples are too few for {order} exponentials; take more, or a lower order")
    h = float(t[1] - t[0])
    if np.abs(np.diff(t) - h).max() > 1e-6 * h:
        raise PgexciteError("the samples are not equally spaced; resample the signal first")
    y = samples - samples.mean()
    pencil = n // 2
    hankel = np.lib.stride_tricks.sliding_window_view(y, pencil + 1)
    _, sizes, right = np.linalg.svd(hankel, full_matrices=False)
    kept = min(order, int(np.sum(sizes > floor * sizes[0])))
    if kept == 0:
        return []
    basis = right[:kept].T
    poles = np.linalg.eigvals(np.linalg.pinv(basis[:-1]) @ basis[1:])
    poles = poles[np.abs(poles) > 1e-12]
    vandermonde = poles[None, :] ** np.arange(n)[:, None]
    residues = np.linalg.lstsq(vandermonde, y.astype(complex), rcond=None)[0]
    modes = []
    for pole, residue in zip(poles, residues, strict=True):
        eigenvalue = complex(np.log(pole) / h)
        if eigenvalue.imag < -1e-9:
            continue
        pair = 2.0 if eigenvalue.imag > 1e-9 else 1.0
        modes.append(RingdownMode(eigenvalue, pair * float(abs(residue)), float(np.angle(residue))))
    return sorted(modes, key=lambda mode: -mode.amplitude)


def mode_near(modes: list[RingdownMode], frequency_hz: tuple[float, float]) -> RingdownMode | None:
    """The largest mode with a frequency in this band, Hz."""
    low, high = frequency_hz
    return next((mode for mode in modes if low <= mode.frequency_hz <= high), None)
