"""One function at many points in one call: as generated C where there is a compiler, else by CasADi's own map."""

from __future__ import annotations

import ctypes

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.bound import bind
from pgexcite.core.codegen import define, loop, write_functions
from pgexcite.core.compiling import library
from pgexcite.core.settings import Compile

Array = NDArray[np.float64]


class Mapped:
    """``function(point, common) -> value`` at ``count`` points at once.

    Args:
        function: of two vectors, with one vector as its result.
        count: number of points.
        compile: whether it runs as generated C.

    Attributes:
        points: shape ``(count, n_in)``, to be filled before a call.
        common: shape ``(n_common,)``, likewise.
        values: shape ``(count, n_out)``, renewed by a call.
    """

    def __init__(self, function: ca.Function, count: int, compile: Compile = "auto") -> None:
        self.points = np.zeros((count, function.numel_in(0)))
        self.common = np.zeros(function.numel_in(1))
        self.values = np.zeros((count, function.numel_out(0)))
        self._library = _compiled(function, compile)
        if self._library is None:
            mapped = function.map(f"{function.name()}_{count}", "serial", count, [1], [])
            self._bound = bind(mapped, [self.points.reshape(-1), self.common], [self.values.reshape(-1)])
        else:
            arrays = (self.points, self.common, self.values)
            self._arguments = (ctypes.c_int(count), *(ctypes.c_void_p(a.ctypes.data) for a in arrays))

    @property
    def compiled(self) -> bool:
        """Whether it runs as C."""
        return self._library is not None

    def __call__(self) -> Array:
        """Evaluate; the array returned is ``values`` itself."""
        if self._library is None:
            self._bound.trigger()
        else:
            self._library.pgexcite_map(*self._arguments)
        return self.values


def _compiled(function: ca.Function, choice: Compile) -> ctypes.CDLL | None:
    sizes = {"n_in": function.numel_in(0), "n_out": function.numel_out(0), "function": function.name()}
    sizes |= {key: max(1, getattr(function, key)()) for key in ("sz_arg", "sz_res", "sz_iw", "sz_w")}
    return library(lambda: "\n".join([write_functions([function]), define(sizes), loop("mapped.c")]), choice)
