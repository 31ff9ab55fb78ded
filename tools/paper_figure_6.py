"""The numbers of docs/paper_figure_6.md: what the figure's delta_0, delta_crit and t_crit ask for, as a Markdown table.

Run: python tools/paper_figure_6.py
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from scipy.optimize import brentq

from pgexcite.studies.power_angle import EqualArea, lossless

H, F_N = 2.9, 50.0
P_M = 1.0
DELTA_0, DELTA_CRIT, T_CRIT = math.radians(39.0), math.radians(122.0), 0.28


def area(r_1: float, r_2: float) -> EqualArea:
    """The figure's construction: P_m = 1 pu, delta_0 = 39 degrees, pure sine curves."""
    return lossless(P_M, DELTA_0, r_1, r_2, H, F_N)


def r_1_for_angle() -> float:
    """r_1 that makes 122 degrees critical when the network is restored (r_2 = 1)."""
    return float(brentq(lambda r: area(r, 1.0).surplus(DELTA_CRIT), 0.0, 1.0))


def r_1_for_time() -> float:
    """r_1 that makes 0.28 s critical when the network is restored."""

    def error(r: float) -> float:
        t = area(r, 1.0).t_crit
        return (10.0 if t is None else t) - T_CRIT

    return float(brentq(error, 0.0, 0.6))


def both() -> tuple[float, float]:
    """r_1 that takes the rotor from 39 to 122 degrees in 0.28 s, and r_2 that makes this critical."""

    def error(r: float) -> float:
        t = area(r, 1.0).time_to(DELTA_CRIT)
        return (10.0 if t is None else t) - T_CRIT

    r_1 = float(brentq(error, 0.0, 0.6))
    return r_1, float(brentq(lambda r: area(r_1, r).surplus(DELTA_CRIT), 0.8, 10.0))


def r_2_for_largest_angle() -> float:
    """r_2 whose curve meets P_m at 122 degrees, the farthest angle a stable swing can reach."""
    return math.sin(DELTA_0) / math.sin(DELTA_CRIT)


def rows() -> Iterator[tuple[str, str]]:
    """What is asked, and the answer."""
    bolted = area(0.0, 1.0)
    yield "P_max that P_m = 1 and δ0 = 39° imply", f"{bolted.before.peak:.3f} pu"
    yield (
        "critical angle and time for r1 = 0, r2 = 1",
        f"{math.degrees(bolted.delta_crit or 0):.1f}°, {bolted.t_crit:.4f} s",
    )
    yield "time from 39° to 122° at r1 = 0", f"{bolted.time_to(DELTA_CRIT):.4f} s"
    without = math.sqrt(2 * H * DELTA_CRIT / (math.pi * F_N * P_M))
    yield "√(2 H δ_crit / (π f P_m)) with δ_crit = 122°, δ0 left out", f"{without:.4f} s"
    r_1 = r_1_for_angle()
    yield "δ_crit = 122° with r2 = 1 needs", f"r1 = {r_1:.3f}, and then t_crit = {area(r_1, 1.0).t_crit:.2f} s"
    r_1 = r_1_for_time()
    angle = area(r_1, 1.0).delta_crit or 0.0
    yield "t_crit = 0.28 s with r2 = 1 needs", f"r1 = {r_1:.3f}, and then δ_crit = {math.degrees(angle):.1f}°"
    r_1, r_2 = both()
    yield "both together need", f"r1 = {r_1:.3f} and r2 = {r_2:.2f}"
    yield "122° as the largest angle of a stable swing needs", f"r2 = {r_2_for_largest_angle():.3f}"


def table() -> str:
    """The rows as Markdown."""
    return "\n".join(
        ["| question | answer |", "|---|---|", *(f"| {question} | {answer} |" for question, answer in rows())]
    )


if __name__ == "__main__":
    print(table())
