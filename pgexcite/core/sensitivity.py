"""Derivatives of stages, slopes and outputs along directions of the state and the commands.

A derivative is linear in its direction. So it is split: what depends on the point is computed once, the factors of the linearised
equations among it, and what is left for each direction are a few multiplications, the same for all. Generated C does them for
several directions at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.hoist import hashes, hoist, jacobian
from pgexcite.core.step import Kernel
from pgexcite.core.tape import apply

_OPTIONS = {"cse": True}


@dataclass(frozen=True)
class Along:
    """A derivative along any direction.

    Attributes:
        at: what it takes from the point, the vector ``factors`` last among its results.
        column: ``(factors, s, s_c) -> derivative`` of one direction.
    """

    at: ca.Function
    column: ca.Function

    @property
    def size(self) -> int:
        """Number of factors."""
        return int(self.column.numel_in(0))

    def of(self, columns: int) -> Any:
        """``column`` for so many directions, as columns of matrices."""
        return self.column.map(self.column.name(), "serial", columns, [0], [], {})


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives of a stage, of the slope and of selected outputs along directions; ``s_c`` has an entry for each command.

    Attributes:
        prepare: ``(c, d, u, p) -> q``, what depends on parameters only.
        stage: at ``(w, b, q)``, along ``s_b`` (of ``b``): of ``w``.
        slope: at ``(w, q)``, along ``s_w``: of the slope.
        output: at ``(w, q, d)``, which gives the outputs too, along ``s_w``: of the outputs.
        commanded: ``(c, d, u, p) -> (values of the kernel's q, values of q)``, those that depend on the commands.
        of_kernel, of_own: where these values stand in the kernel's ``q`` and in ``q``.
        commands_mass: whether the coefficients of the derivatives depend on the commands too.
    """

    prepare: ca.Function
    stage: Along
    slope: Along
    output: Along
    commanded: ca.Function
    of_kernel: NDArray[np.int32]
    of_own: NDArray[np.int32]
    commands_mass: bool

    def functions(self) -> list[ca.Function]:
        """What ``rollout.c`` calls with pointers."""
        return [self.prepare, self.commanded, *(each.at for each in (self.stage, self.slope, self.output))]

    def along(self) -> list[ca.Function]:
        """What it calls with several directions at a time."""
        return [each.column for each in (self.stage, self.slope, self.output)]

    def constants(self) -> dict[str, object]:
        """What it needs to know of them."""
        sizes: dict[str, object] = {
            "n_sense_hoisted": self.prepare.numel_out(0),
            "commands_mass": int(self.commands_mass),
        }
        sizes |= {"n_stage_factors": self.stage.size, "n_slope_factors": self.slope.size}
        sizes |= {"n_output_factors": self.output.size}
        for name, at in (("commanded", self.of_kernel), ("sense_commanded", self.of_own)):
            sizes |= {f"n_{name}": at.size, name: "{" + (", ".join(map(str, at.tolist())) or "0") + "}"}
        return sizes


def write_sensitivities(kernel: Kernel, commands: NDArray[np.int32], outputs: NDArray[np.int32]) -> Sensitivities:
    """Derivatives to these commands, and to the states; by the implicit function theorem with the kernel's own factors."""
    stage, n_x, solver = kernel.stage, kernel.x.size, kernel.functions.factors
    assert solver is not None, "too large to be written out"
    s_w, s_b, s_c = ca.SX.sym("s_w", stage.w.numel()), ca.SX.sym("s_b", n_x), ca.SX.sym("s_c", commands.size)
    moved = stage.u[commands.tolist()]
    # The commands act through what is hoisted.
    by_command = ca.jacobian(stage.values, moved)
    acting = sorted(set(by_command.sparsity().row()))

    def by_commands(expression: ca.SX) -> ca.SX:
        return ca.mtimes(ca.mtimes(ca.jacobian(expression, stage.q[acting]), by_command[acting, :]), s_c)

    def along(expression: ca.SX) -> ca.SX:
        return ca.densify(ca.mtimes(jacobian(expression, stage.w), s_w) + by_commands(expression))

    y = stage.y[outputs.tolist()]
    rhs = ca.mtimes(ca.jacobian(stage.r, stage.b), s_b) + by_commands(stage.r)
    solved = -ca.densify(solver.solve(rhs, kernel.functions.pairing))
    fixed = [stage.q, stage.c, stage.d[np.flatnonzero(stage.switching).tolist()], stage.u, stage.p]
    hoisted = hoist([solved, along(stage.slope), y, along(y)], fixed)
    s_next, s_slope, y, s_y = hoisted.expressions
    w, b, q = stage.w, stage.b, hoisted.q
    values = stage.in_parameters([hoisted.values])[0]

    def split(name: str, derivative: ca.SX, point: list[ca.SX], direction: ca.SX, beside: list[ca.SX]) -> Along:
        multiplied, inverse, inverses = _without_division(derivative, ca.vertcat(direction, s_c))
        own = hoist([multiplied], [*point, inverse])
        factors = ca.substitute([own.values], [inverse], [inverses])[0]
        at = ca.Function(f"{name}_factors", point, [*beside, factors], _OPTIONS)
        return Along(at, ca.Function(f"{name}_along", [own.q, direction, s_c], own.expressions, _OPTIONS))

    of_kernel, mass, reach = kernel.functions.prepare.call(stage.parameters, True, False)
    at_kernel, at_own = _depending(of_kernel, moved), _depending(values, moved)
    changed = [of_kernel[at_kernel.tolist()], values[at_own.tolist()]]
    return Sensitivities(
        prepare=ca.Function("prepare_sensitivity", stage.parameters, [values], _OPTIONS),
        stage=split("stage", s_next, [w, b, q], s_b, []),
        slope=split("slope", s_slope, [w, q], s_w, []),
        output=split("output", s_y, [w, q, stage.d], s_w, [y]),
        commanded=ca.Function("prepare_commanded", stage.parameters, changed, _OPTIONS),
        of_kernel=at_kernel,
        of_own=at_own,
        commands_mass=_depending(ca.vertcat(mass, reach), moved).size > 0,
    )


def _without_division(derivative: ca.SX, direction: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
    """The same with products in place of quotients, for what directions are divided by is the same for all.

    Returns:
        The derivative in symbols of the inverses, these symbols, and the inverses.
    """
    free, directions = ca.symvar(derivative), hashes(direction)
    tape = ca.Function("tape", free, [derivative], _OPTIONS)
    values: dict[int, tuple[ca.SX, bool]] = {}
    # By the divisor's address, so the divisor is kept as well.
    inverse: dict[int, tuple[ca.SX, ca.SX, ca.SX]] = {}
    written = ca.SX.zeros(derivative.numel())
    for k in range(tape.n_instructions()):
        operation, to, of = tape.instruction_id(k), tape.instruction_output(k), tape.instruction_input(k)
        if operation == ca.OP_CONST:
            values[to[0]] = ca.SX(tape.instruction_constant(k)), False
        elif operation == ca.OP_INPUT:
            values[to[0]] = free[of[0]], free[of[0]].element_hash() in directions
        elif operation == ca.OP_OUTPUT:
            written[to[1]] = values[of[0]][0]
        else:
            operands, moves = [values[i][0] for i in of], [values[i][1] for i in of]
            if operation == ca.OP_DIV and moves[0]:
                # CasADi would make a quotient of a product with an expression that is an inverse.
                divisor = operands[1]
                made = ca.SX.sym("inverse"), 1 / divisor, divisor
                result = operands[0] * inverse.setdefault(divisor.element_hash(), made)[0]
            else:
                result = apply(operation, operands)
            values[to[0]] = result, any(moves)
    nothing = ca.SX(0, 1)
    symbols, inverses = (ca.vertcat(nothing, *(each[k] for each in inverse.values())) for k in (0, 1))
    return written, symbols, inverses


def _depending(values: ca.SX, on: ca.SX) -> NDArray[np.int32]:
    """Entries of a column that depend on these symbols."""
    rows = ca.jacobian_sparsity(values, on).row() if values.numel() else []
    return np.array(sorted(set(rows)), dtype=np.int32)
