"""Numbers of a control problem that may be one for all signals, or a list with one for each."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator

Values = float | tuple[float, ...]


def _numbers(lowest: float, *, above: bool, meaning: str) -> Callable[[Any], Values]:
    def validated(value: Any) -> Values:
        numbers = value if isinstance(value, list | tuple) else [value]
        sound = [_is_number(n) and (n > lowest if above else n >= lowest) for n in numbers]
        if not numbers or not all(sound):
            raise ValueError(f"should be a {meaning}, or a list of them with one for each signal")
        return tuple(float(n) for n in numbers) if isinstance(value, list | tuple) else float(value)

    return validated


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


Number = Annotated[Values, BeforeValidator(_numbers(-math.inf, above=False, meaning="number"))]
NotNegative = Annotated[Values, BeforeValidator(_numbers(0.0, above=False, meaning="number that is not negative"))]
Positive = Annotated[Values, BeforeValidator(_numbers(0.0, above=True, meaning="positive number"))]


def each(values: Values, n: int) -> NDArray[np.float64]:
    """One number for each of ``n`` signals, shape ``(n,)``.

    Raises:
        ValueError: a list of another length.
    """
    if isinstance(values, tuple) and len(values) != n:
        raise ValueError(f"{list(values)} has {len(values)} numbers for {n}; give one for all of them, or one for each")
    return np.array(values) if isinstance(values, tuple) else np.full(n, values)
