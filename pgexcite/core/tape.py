"""The elementary operations of a function, and the sparse linear system of their derivatives.

An update of Newton's method solves ``J dw = r``. The system here is not the Jacobian's but that of every operation on the way to
``r``: ``dv - (dv/da) da - (dv/db) db = 0`` for each value ``v`` that is computed of ``a`` and ``b``. Eliminating these values
first would be differentiation by the chain rule. Eliminated in whatever order is cheapest, a current that ties many rows to
many states stays an unknown of its own, and less is left to be computed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from pgexcite.core.hoist import hashes
from pgexcite.core.linear_algebra import Entry, Rows

Array = NDArray[np.float64]

Slope = tuple[ca.SX, bool]
"""A derivative, and whether it has to be computed anew in every iteration."""
_ONE, _MINUS_ONE = (ca.SX(1), False), (ca.SX(-1), False)


class _Value(NamedTuple):
    """A value on the tape: its expression, the unknown it is (``None``: it depends on none), whether an iteration computes it."""

    expression: ca.SX
    unknown: int | None
    online: bool


def linear_system(r: ca.SX, w: ca.SX, idle: ca.SX, pairing: NDArray[np.intp], sample: Callable[[ca.SX], Array]) -> Rows:
    """The system that an update of ``w`` solves; its unknowns beyond ``w`` are the values on the way to ``r``.

    Args:
        r: residual, shape ``(n,)``, of the symbols ``w`` and others.
        w: the first ``n`` unknowns.
        idle: symbols that do not change from iteration to iteration.
        pairing: row of ``r`` with which each unknown is eliminated.
        sample: values of a column of expressions at several points, shape ``(n_points, n)``.
    """
    rows, ends = _operations(r, w, idle)
    slopes = [slope for row in rows.values() for slope in row.values()]
    sampled = sample(ca.vertcat(ca.SX(0, 1), *(value for value, _ in slopes)))
    one, samples = np.ones(sampled.shape[0]), iter(sampled.T)
    system: Rows = {}
    for k, row in rows.items():
        system[k] = {k: Entry(ca.SX(1), False, one)}
        for j, (value, online) in row.items():
            system[k][j] = Entry(-value, online, -next(samples))
    for k, i in enumerate(pairing):
        end = ends[int(i)]
        system[k] = {} if end is None else {end: Entry(ca.SX(1), False, one)}
    return system


def _operations(r: ca.SX, w: ca.SX, idle: ca.SX) -> tuple[dict[int, dict[int, Slope]], dict[int, int | None]]:
    """Slopes of each value that depends on ``w``, by unknown; and the unknown that each row of ``r`` is."""
    free = ca.symvar(r)
    tape = ca.Function("tape", free, [r], {"cse": True})
    unknown_of = {symbol.element_hash(): k for k, symbol in enumerate(ca.vertsplit(w))}
    resting = hashes(idle)
    values: dict[int, _Value] = {}
    ends: dict[int, int | None] = {}
    rows: dict[int, dict[int, Slope]] = {}
    for k in range(tape.n_instructions()):
        operation, to, of = tape.instruction_id(k), tape.instruction_output(k), tape.instruction_input(k)
        if operation == ca.OP_CONST:
            values[to[0]] = _Value(ca.SX(tape.instruction_constant(k)), None, False)
        elif operation == ca.OP_INPUT:
            symbol = free[of[0]]
            name = symbol.element_hash()
            values[to[0]] = _Value(symbol, unknown_of.get(name), name not in resting)
        elif operation == ca.OP_OUTPUT:
            ends[to[1]] = values[of[0]].unknown
        else:
            operands = [values[i] for i in of]
            expression = apply(operation, [operand.expression for operand in operands])
            row: dict[int, Slope] = {}
            for operand, (slope, online) in zip(operands, _slopes(operation, operands, expression), strict=True):
                j = operand.unknown
                if j is not None and not slope.is_zero():
                    row[j] = (row[j][0] + slope, row[j][1] or online) if j in row else (slope, online)
            unknown = len(unknown_of) + len(rows) if row else None
            if unknown is not None:
                rows[unknown] = row
            values[to[0]] = _Value(expression, unknown, any(operand.online for operand in operands))
    return rows, ends


def apply(operation: int, operands: list[ca.SX]) -> ca.SX:
    """One of CasADi's elementary operations by its number."""
    return ca.SX.unary(operation, *operands) if len(operands) == 1 else ca.SX.binary(operation, *operands)


def _slopes(operation: int, operands: list[_Value], value: ca.SX) -> list[Slope]:
    """Derivatives of an operation to its operands; CasADi is asked, once each, for those that are rare on a tape."""
    a, b = operands[0], operands[-1]
    if operation == ca.OP_ADD:
        return [_ONE, _ONE]
    if operation == ca.OP_SUB:
        return [_ONE, _MINUS_ONE]
    if operation == ca.OP_NEG:
        return [_MINUS_ONE]
    if operation == ca.OP_MUL:
        return [(b.expression, b.online), (a.expression, a.online)]
    if operation == ca.OP_SQ:
        return [(2 * a.expression, a.online)]
    if operation == ca.OP_DIV:
        inverse = 1 / b.expression
        return [(inverse, b.online), (-value * inverse, a.online or b.online)]
    if operation not in _DERIVATIVES:
        symbols = [ca.SX.sym("a") for _ in operands]
        result = apply(operation, symbols)
        slopes = [ca.densify(ca.jacobian(result, symbol)) for symbol in symbols]
        _DERIVATIVES[operation] = ca.Function("slopes", symbols, slopes)
    slopes = _DERIVATIVES[operation].call([operand.expression for operand in operands], True, False)
    online = any(operand.online for operand in operands)
    return [(slope, online and not slope.is_constant()) for slope in slopes]


_DERIVATIVES: dict[int, ca.Function] = {}
