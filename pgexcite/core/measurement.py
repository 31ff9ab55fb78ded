"""What a controller's instruments make of a signal: noise, delay, lost samples. Seeded, and reproducible from any sample on."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from pgexcite.core.declare import par

Array = NDArray[np.float64]


class Measurement(BaseModel):
    """Imperfections of a controller's measurements.

    Noise is white and Gaussian. The speed has its own: one per cent of 1 pu would be fifty times what a machine ever swings.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    noise: float = par(0.0, "pu", "standard deviation of voltages, currents and powers", ge=0)
    noise_omega: float = par(0.0, "pu", "standard deviation of speeds", ge=0)
    delay: int = par(0, "-", "samples between the signal and the controller", ge=0)
    loss: float = par(0.0, "-", "probability that a sample is lost; the controller is then told NaN", ge=0, lt=1)
    seed: int = Field(default=1, description="seed of noise and losses", ge=0)

    @property
    def random(self) -> bool:
        """Whether what is told depends on the seed."""
        return self.noise > 0 or self.noise_omega > 0 or self.loss > 0


class Instruments:
    """The measurements of one controller in one run.

    The random numbers of sample ``k`` depend on the seed, the signals and ``k`` alone (a counter-based generator), so a resumed
    run draws the same; only the delayed samples are remembered.

    Args:
        settings: the imperfections.
        paths: the signals; set-points among them are read back exactly.
        setpoints: which of them are set-points, shape ``(n,)``.
    """

    def __init__(self, settings: Measurement, paths: tuple[str, ...], setpoints: NDArray[np.bool_]) -> None:
        self._settings, self._paths = settings, paths
        speed = np.array([path.endswith(".omega") for path in paths], dtype=bool)
        self._deviation = np.where(setpoints, 0.0, np.where(speed, settings.noise_omega, settings.noise))
        # Controllers of one seed that measure different signals draw different numbers.
        self._key = np.array([settings.seed, zlib.crc32("\0".join(paths).encode())], dtype=np.uint64)
        self._past = np.empty((0, len(paths)))

    def read(self, k: int, values: Array) -> dict[str, float]:
        """What the controller is told at its sample ``k``, by path; ``values`` are the true signals in order of the paths."""
        settings = self._settings
        generator = np.random.Generator(np.random.Philox(key=self._key, counter=[0, 0, 0, k]))
        seen = values + self._deviation * generator.standard_normal(values.size)
        if generator.random() < settings.loss:
            seen = np.full_like(seen, np.nan)
        if not self._past.size:
            self._past = np.tile(seen if np.isfinite(seen).all() else values, (settings.delay, 1))
        queue = np.vstack((self._past, seen))
        self._past = queue[1:] if settings.delay else queue[:0]
        return dict(zip(self._paths, queue[0], strict=True))

    def memory(self) -> Array:
        """Samples under way, shape ``(delay, n)``."""
        return self._past.copy()

    def recall(self, past: Array) -> None:
        """Take up where ``memory`` left off."""
        self._past = past.copy()
