"""Pictures of P-V curves: voltage over power, and the surface several power factors span."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.studies.figures import COLOURS, figure, save
from pgexcite.studies.pv import PVCurve

_SURFACE = 3
"""Curves from which on a surface is drawn beside them."""
_ALONG = 160
"""Points along each curve of the surface."""


def draw_pv(curves: Sequence[tuple[str, PVCurve]], bus: str, path: Path, title: str, *, per_unit: bool = False) -> Path:
    """Draw curves of one bus, noses marked and joined; from three on also the surface over P and Q (the onion surface).

    Args:
        curves: label and curve; for the surface in the order of their power factors.
        bus: whose voltage.
        path: where the PNG goes.
        title: heading.
        per_unit: powers over ``S_base`` instead of in MW and Mvar.
    """
    if per_unit:
        curves = [(label, _normalised(curve)) for label, curve in curves]
    units = ("pu", "pu") if per_unit else ("MW", "Mvar")
    surface = len(curves) >= _SURFACE
    drawn, (ax,) = figure(12.0 if surface else 7.0, 5.2)
    if surface:
        drawn.delaxes(ax)
        grid = drawn.add_gridspec(1, 2, width_ratios=(1.0, 1.15))
        ax = drawn.add_subplot(grid[0])
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(visible=True, color="#e6e8eb", linewidth=0.7)
        _draw_surface(drawn.add_subplot(grid[1], projection="3d"), curves, bus, units)
    for k, (label, curve) in enumerate(curves):
        nose = (curve.P_max, float(curve.V[bus][curve.nose]))
        said = f"{label}: {nose[0]:.5g} {units[0]}, {nose[1]:.5g} pu"
        ax.plot(curve.P, curve.V[bus], color=COLOURS[k % len(COLOURS)], label=said, linewidth=1.6)
        ax.plot(*nose, "o", color=COLOURS[k % len(COLOURS)], markersize=4)
    noses = [(curve.P_max, curve.V[bus][curve.nose]) for _, curve in curves]
    if len(noses) > 1:
        ax.plot(*zip(*noses, strict=True), "--", color="#24292f", linewidth=1.0)
    ax.set_xlabel(f"P of the scaled loads [{units[0]}]")
    ax.set_ylabel(f"voltage at bus {bus} [pu]")
    ax.set_ylim(bottom=0.0)
    ax.legend(frameon=False, fontsize=8.5, title="noses" if len(curves) > 1 else "nose", title_fontsize=8.5)
    drawn.suptitle(title)
    return save(drawn, path)


def _normalised(curve: PVCurve) -> PVCurve:
    """The curve with its powers in per unit."""
    return replace(curve, P=curve.P / curve.S_base, Q=curve.Q / curve.S_base)


def _draw_surface(plot: Any, curves: Sequence[tuple[str, PVCurve]], bus: str, units: tuple[str, str]) -> None:
    """The surface as wires along the curves and across them at equal shares of their length."""
    rows = [_even(curve, bus) for _, curve in curves]
    P, Q, V = (np.array([row[k] for row in rows]) for k in range(3))
    plot.plot_surface(P, Q, V, cmap="viridis", alpha=0.65, linewidth=0, rcount=len(curves), ccount=_ALONG)
    for k, row in enumerate(rows):
        plot.plot(*row, color=COLOURS[k % len(COLOURS)], linewidth=1.4)
    noses = np.array([(c.P_max, float(c.Q[c.nose]), c.V[bus][c.nose]) for _, c in curves]).T
    plot.plot(*noses, "--", color="#24292f", linewidth=1.2)
    plot.set_xlabel(f"P [{units[0]}]")
    plot.set_ylabel(f"Q [{units[1]}]")
    plot.set_zlabel(f"V at {bus} [pu]")
    plot.view_init(elev=24, azim=-128)


def _even(curve: PVCurve, bus: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P, Q and V at equal distances along the curve, as many before the nose as after it."""
    share = np.linspace(0.0, 1.0, _ALONG // 2)
    pieces = []
    for part in (slice(0, curve.nose + 1), slice(curve.nose, None)):
        x, y, v = curve.P[part], curve.Q[part], curve.V[bus][part]
        scale = max(curve.P_max, 1e-9)
        length = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x) / scale, np.diff(v)))))
        at = share * length[-1]
        pieces.append([np.interp(at, length, item) for item in (x, y, v)])
    first, second = pieces
    P, Q, V = (np.concatenate(pair) for pair in zip(first, second, strict=True))
    return P, Q, V
