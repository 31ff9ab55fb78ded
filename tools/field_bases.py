"""The numbers of docs/field_bases.md, as a Markdown table.

Run: python tools/field_bases.py
"""

from __future__ import annotations

import math
from collections.abc import Iterator

X_D, X_Q = 1.24, 0.70
P, Q, V_T = 0.86, 0.51, 1.0


def short_circuit_base() -> float:
    """Rated field current by the paper's equation (1): E / X_d of a round rotor, pu."""
    return math.hypot(V_T / X_D + Q / V_T, P / V_T)


def round_rotor() -> float:
    """E_fd of a round rotor (X_q = X_d) at rated load, air-gap-line base, pu."""
    return X_D * short_circuit_base()


def salient_pole() -> float:
    """E_fd of the salient-pole machine at rated load without saturation, air-gap-line base, pu."""
    current = complex(P, -Q) / V_T
    e_q = V_T + 1j * X_Q * current
    i_d = -(current * (e_q / abs(e_q)).conjugate()).imag
    return abs(e_q) + (X_D - X_Q) * i_d


def rows() -> Iterator[tuple[str, str, str]]:
    """Quantity, value on the short-circuit base, value on the air-gap-line base."""
    paper, e_round, e_salient = short_circuit_base(), round_rotor(), salient_pole()
    yield "rated load, round rotor (X_q = X_d): equation (1)", f"{paper:.4f}", f"{e_round:.3f}"
    yield "rated load, salient pole (X_q = 0.70)", f"{e_salient / X_D:.4f}", f"{e_salient:.3f}"
    yield "open circuit, rated voltage", f"{1 / X_D:.4f}", "1.000"
    yield "sustained short circuit, rated armature current", "1.0000", f"{X_D:.3f}"
    yield "ceiling of twice rated field: the paper's", "3.20", f"{3.2 * X_D:.2f}"
    yield "ceiling of twice rated field: this plant's", f"{2 * e_salient / X_D:.2f}", f"{2 * e_salient:.2f}"


def table() -> str:
    """The rows as Markdown."""
    head = ["| field at | E/X_d (short-circuit base), pu | E_fd (air-gap-line base), pu |", "|---|---|---|"]
    return "\n".join([*head, *("| " + " | ".join(row) + " |" for row in rows())])


if __name__ == "__main__":
    print(table())
