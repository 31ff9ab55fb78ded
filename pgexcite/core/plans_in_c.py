"""Plans by shooting in C: the whole of a sample's iteration, or of its preparation, in one call.

It is the C that is exported (``shooting.c``), which does what ``pgexcite.core.plans_in_python`` does. It answers for programs with
nothing but a box, which both solve by pivoting, and where it iterates as Python does. What it does not do is to rescue a step:
where the fixed order of elimination fails on the way to the next sample, nothing is prepared for it, and with computing delay there
is no plan.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from string import Template

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.codegen import array, define, generate, loop
from pgexcite.core.condensed import Condensed
from pgexcite.core.horizons import Horizons
from pgexcite.core.iteration import ShootingOptions
from pgexcite.core.model import State
from pgexcite.core.mpc import Solution, Status
from pgexcite.core.prediction import Predictor
from pgexcite.core.written import Predictions, planning, program

Array = NDArray[np.float64]

LOOPS = ("step.c", "advance.c", "rollout.c", "chain.c")
"""What ``shooting.c`` goes below."""
_TEXTS = ("dense.c", "qp.c", "condensed.c", "horizon.c", "shooting.c", "prepare.c", "plans.c")
_STATUS = (Status.CONVERGED, Status.ITERATED, Status.PREDICTION_FAILED, Status.STATE_UNKNOWN, Status.QP_FAILED)
_NAME = "PLANS"


def plans_in_c(
    predictor: Predictor, condensed: Condensed, horizons: Horizons, options: ShootingOptions
) -> PlansInC | None:
    """Plans in C, where they can be had and are those of Python."""
    same = not condensed.rows and not options.candidates and predictor.rule != "trapezoidal"
    if not (predictor.kernel.compiled and same and (condensed.problem.R > 0).all()):
        return None
    of_plans = planning(predictor, condensed, horizons, options, exported=False)
    library = predictor.kernel.library(lambda: _source(condensed, of_plans), of_plans.functions)
    return None if library is None else PlansInC(library, predictor, condensed)


class PlansInC:
    """A library of its own for one controller; it remembers the plan and what was prepared.

    Args:
        library: a copy of one's own.
        predictor, condensed: of the plans, see ``pgexcite.core.shooting.Shooting``.
    """

    def __init__(self, library: ctypes.CDLL, predictor: Predictor, condensed: Condensed) -> None:
        problem, kernel = condensed.problem, predictor.kernel
        self._library = library
        n_x = kernel.x.size if predictor.transitions else 0
        self._moves, n_y = (problem.N_c, len(problem.commands)), len(condensed.outputs())
        self._shape_G = (problem.N_p, n_x + condensed.n, n_y)
        sizes = (kernel.x.size, kernel.z.size, kernel.d.size, kernel.u.size, kernel.p.size, len(problem.commands))
        self._given = [np.zeros(n) for n in sizes]
        self._found, self._cost_and_change, self._iterations = np.zeros(self._moves), np.zeros(2), ctypes.c_int(0)
        self._prepared_command = np.zeros(len(problem.commands))
        self._to_library = [
            *(_address(a) for a in (*self._given, self._found, self._cost_and_change)),
            ctypes.byref(self._iterations),
        ]
        self._command_at = _address(self._prepared_command)
        self._kept = [np.zeros((2, *self._moves)), *(np.zeros(sizes[k]) for k in (0, 2, 3, 4))]
        self._kept += [np.zeros((problem.N_p, n_y)), np.zeros(self._shape_G)]
        self._plan = self._library.pgexcite_plan
        self._plan.argtypes = [ctypes.c_double, ctypes.c_int, *[ctypes.c_void_p] * 9]
        self._prepare = self._library.pgexcite_prepare
        self._prepare.argtypes = [ctypes.c_void_p]

    def plan(self, state: State, t: float, p: Array, u_last: Array) -> Solution:
        """The plan from this state on."""
        for to, values in zip(self._given, (state.x, state.z, state.d, state.u, p, u_last), strict=True):
            to[:] = values
        status = self._plan(t, state.startup, *self._to_library)
        cost, change = self._cost_and_change.tolist()
        return Solution(_STATUS[status], self._found.copy(), cost, self._iterations.value, change)

    def lost(self) -> None:
        """There is no state at this sample."""
        self._library.pgexcite_lost()

    def prepare(self, u: Array) -> None:
        """Linearise around the plan the next sample will start from."""
        self._prepared_command[:] = u
        self._prepare(self._command_at)

    def memory(self) -> Mapping[str, Array]:
        """The plan and what was prepared, by the names that Python has for them."""
        there = self._library.pgexcite_remember(0, 0, *(_address(a) for a in self._kept))
        kept = [values.copy() for values in self._kept]
        (plan, prepared_plan), x, d, u, p, y, G = kept
        found = {"plan": plan} if there & 1 else {}
        if there & 2:
            n_x = G.shape[1] - plan.size
            G_x, G = (np.ascontiguousarray(part.transpose(0, 2, 1)) for part in (G[:, :n_x], G[:, n_x:]))
            prepared = {"plan": prepared_plan, "x": x, "d": d, "u": u, "p": p, "y": y, "G": G, "G_x": G_x}
            found |= {f"prepared:{name}": value for name, value in prepared.items()}
        return found

    def recall(self, memory: Mapping[str, Array]) -> None:
        """Take up where ``memory`` left off."""
        plans, x, d, u, p, y, G = self._kept
        there = 0
        if "plan" in memory:
            there, plans[0] = 1, memory["plan"]
        if "prepared:plan" in memory:
            there += 2
            plans[1] = memory["prepared:plan"]
            for to, name in zip((x, d, u, p, y), ("x", "d", "u", "p", "y"), strict=True):
                to[:] = memory[f"prepared:{name}"]
            n_x = G.shape[1] - plans[1].size
            G[:, :n_x], G[:, n_x:] = (memory[f"prepared:{name}"].transpose(0, 2, 1) for name in ("G_x", "G"))
        self._library.pgexcite_remember(1, there, *(_address(a) for a in self._kept))


def _source(condensed: Condensed, of_plans: Predictions) -> str:
    of_program, numbers = program(condensed)
    constants = {**of_program, **of_plans.constants, "delayed": int(condensed.problem.delayed)}
    words = {"name": _NAME.lower(), "NAME": _NAME}
    parts = [
        generate(of_plans.functions, constants, LOOPS, of_plans.along),
        define({f"{_NAME}_{status.name}": k for k, status in enumerate(_STATUS)}),
        *(array(name, values.ravel()) for name, values in {**numbers, **of_plans.arrays}.items()),
        *(Template(loop(name)).substitute(words) for name in _TEXTS),
    ]
    return "\n".join(parts)


def _address(values: NDArray[np.float64]) -> ctypes.c_void_p:
    return ctypes.c_void_p(values.ctypes.data)
