"""Moving work out of a loop: what depends on parameters only is computed when they change, not in every iteration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

_EXTRACTION = {"extract_trivial": True, "prefix": "q_"}


@dataclass(frozen=True)
class Hoisted:
    """Expressions rewritten in terms of what was taken out of them.

    Attributes:
        expressions: the expressions, now of the variables and of ``q``.
        q: symbols of the values taken out, shape ``(n_q,)``.
        values: these values, as expressions of the parameters, shape ``(n_q,)``.
    """

    expressions: list[ca.SX]
    q: ca.SX
    values: ca.SX

    def finished(self, expression: ca.SX) -> list[bool]:
        """For each entry of a column whether nothing of it is left to be computed in the loop."""
        q = hashes(self.q)
        entries = ca.vertsplit(expression) if expression.numel() else []
        return [e.is_constant() or (e.is_symbolic() and e.element_hash() in q) for e in entries]


def hoist(expressions: Sequence[ca.SX], parameters: Sequence[ca.SX]) -> Hoisted:
    """Take the largest parts that depend on these parameters only out of the expressions; sparsity is kept."""
    # The type hints know no lists here.
    extract: Any = ca.extract_parametric
    rewritten, symbols, values = extract(ca.cse(list(expressions)), [ca.vertcat(*parameters)], _EXTRACTION)
    nothing = ca.SX(0, 1)
    return Hoisted(rewritten, ca.vertcat(nothing, *symbols), ca.vertcat(nothing, *values))


def hashes(symbols: ca.SX) -> set[int]:
    """What tells symbols apart, of each entry of a column of them."""
    return {symbol.element_hash() for symbol in ca.vertsplit(symbols)} if symbols.numel() else set()


def jacobian(rows: ca.SX, w: ca.SX) -> ca.SX:
    """Jacobian in reverse mode, which takes less arithmetic than CasADi's choice where rows are short."""
    return ca.jacobian(rows, w, {"helper_options": {"ad_weight": 1.0, "ad_weight_sp": 1.0}})


def gather(rows: ca.SX, w: ca.SX, parameters: Sequence[ca.SX]) -> ca.SX:
    """The same rows with each variable in which a row is linear gathered into one term, coefficient times variable.

    A sum over the branches at a bus becomes a row of an admittance matrix, the coefficients of which can be taken out of the loop.

    Args:
        rows: shape ``(n,)``.
        w: variables.
        parameters: everything else that coefficients may depend on.
    """
    J = jacobian(rows, w)
    entries: list[ca.SX] = ca.vertsplit(J.nz[:]) if J.nnz() else []
    hoisted = hoist([ca.vertcat(ca.SX(0, 1), *entries)], parameters)
    constant = hoisted.finished(ca.densify(hoisted.expressions[0]))
    linear: dict[int, list[tuple[int, ca.SX]]] = {}
    for i, j, entry, is_constant in zip(*J.sparsity().get_triplet(), entries, constant, strict=True):
        if is_constant:
            linear.setdefault(i, []).append((j, entry))
    gathered = []
    for i in range(rows.numel()):
        row, terms = rows[i], linear.get(i, [])
        if terms:
            variables = ca.vertcat(*(w[j] for j, _ in terms))
            row = ca.densify(ca.substitute(row, variables, ca.SX.zeros(len(terms), 1)))
            for j, coefficient in terms:
                row = row + coefficient * w[j]
        gathered.append(row)
    return ca.vertcat(ca.SX(0, 1), *gathered)
