"""Pictures: power-angle curves and overlaid runs, as PNG files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core.trace import Trace
from pgexcite.studies.power_angle import Curve, EqualArea

DPI = 150
COLOURS = ("#1f77b4", "#d9620f", "#2a9d4a", "#c1272d", "#7b52ab", "#8c6d1f", "#1795a3", "#d0478f")
_INK = "#24292f"
_SOFT = "#8a9199"

PANELS = (
    ("e_fd", "E_fd", r"$E_\mathrm{fd}$ [pu]"),
    ("v_t", "V_t", r"$V_\mathrm{t}$ [pu]"),
    ("delta", "δ", r"$\delta$ [deg]"),
    ("omega", "ω", r"$\omega$ [pu]"),
)
"""Signals of a comparison from top to bottom: signal, name in a legend of several units, label of the axis."""
SIGNALS = tuple(panel[0] for panel in PANELS)


def figure(width: float, height: float, rows: int = 1) -> tuple[Any, Any]:
    """A figure without a window, in the project's style: size in inches, ``rows`` axes that share the horizontal one."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(drawn)
    axes = drawn.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["left", "bottom"]].set_color(_SOFT)
        ax.tick_params(colors=_INK, labelsize=9)
        ax.grid(visible=True, color="#e6e8eb", linewidth=0.7)
        ax.set_axisbelow(True)
    return drawn, axes


def save(drawn: Any, path: Path) -> Path:
    """Write a figure as PNG; returns the path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=DPI, format="png")
    return path


def draw_runs(
    runs: Mapping[str, Trace],
    units: Sequence[str],
    path: Path,
    title: str,
    window: tuple[float, float] | None = None,
    signals: Sequence[str] = SIGNALS,
) -> Path:
    """Overlay runs: field voltage, terminal voltage, rotor angle and speed below one another, events marked.

    Args:
        runs: label -> trace.
        units: names of the units to draw.
        path: of the PNG.
        title: above it.
        window: times to show, s; all of them, where left out.
        signals: which of ``PANELS`` to draw.
    """
    panels = [panel for panel in PANELS if panel[0] in signals]
    shown = [p for p in panels if any(f"unit.{u}.{p[0]}" in trace.columns for trace in runs.values() for u in units)]
    drawn, axes = figure(8.6, 1.0 + 2.05 * len(shown), len(shown))
    dashes = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))
    for ax, (signal, _, axis_label) in zip(axes, shown, strict=True):
        for k, (label, trace) in enumerate(runs.items()):
            for j, unit in enumerate(units):
                samples = trace.columns.get(f"unit.{unit}.{signal}")
                if samples is None:
                    continue
                values = np.degrees(samples) if signal == "delta" else samples
                name = label if len(units) == 1 else f"{label}: {unit}"
                ax.plot(
                    trace.t,
                    values,
                    color=COLOURS[k % len(COLOURS)],
                    linestyle=dashes[j % len(dashes)],
                    linewidth=1.5,
                    label=name,
                )
        ax.set_ylabel(axis_label, color=_INK)
        ax.margins(x=0.0, y=0.08)
    if window:
        axes[-1].set_xlim(*window)
    _mark_events(axes, runs)
    axes[-1].set_xlabel("time [s]", color=_INK)
    drawn.align_ylabels(axes)
    drawn.suptitle(title, fontsize=12, color=_INK)
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4), frameon=False, fontsize=9)
    return save(drawn, path)


def _mark_events(axes: Any, runs: Mapping[str, Trace]) -> None:
    """A line at every event of any run; its text above the topmost axes, staggered so that neighbours do not collide."""
    texts: dict[float, list[str]] = {}
    for trace in runs.values():
        for entry in trace.log:
            if entry.kind == "event" and entry.text not in texts.setdefault(round(entry.t, 6), []):
                texts[round(entry.t, 6)].append(entry.text)
    left, right = axes[-1].get_xlim()
    inside = [t for t in sorted(texts) if left <= t <= right]
    few = len(inside) <= 6
    for k, t in enumerate(inside):
        for ax in axes:
            ax.axvline(t, color=_SOFT, linewidth=0.8, linestyle=(0, (2, 2)), zorder=0.5)
        if few:
            axes[0].annotate(
                "; ".join(texts[t]),
                xy=(t, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(4, 4 + 11 * (len(inside) - 1 - k)),
                textcoords="offset points",
                fontsize=7.5,
                color=_SOFT,
                annotation_clip=False,
            )


def draw_equal_area(area: EqualArea, path: Path, title: str) -> Path:
    """The power-angle picture: three curves, P_m, and the two equal areas of the critical clearing."""
    drawn, axes = figure(8.0, 5.2)
    ax = axes[0]
    degrees = np.linspace(0.0, 180.0, 721)
    for curve, label, colour in (
        (area.before, f"before the fault, $P_\\mathrm{{max}}$ = {area.before.peak:.3f} pu", COLOURS[0]),
        (area.after, f"after it, $r_2$ = {area.r_2:.3f}", COLOURS[2]),
        (area.during, f"during it, $r_1$ = {area.r_1:.3f}", COLOURS[3]),
    ):
        style = (0, (6, 3)) if curve is area.after and _same(area.before, area.after) else "-"
        ax.plot(degrees, _values(curve, degrees), color=colour, linewidth=1.8, linestyle=style, label=label)
    ax.axhline(area.p_m, color=_INK, linewidth=1.1)
    ax.annotate(
        f"$P_\\mathrm{{m}}$ = {area.p_m:.3f} pu", xy=(1.0, area.p_m), xycoords=("axes fraction", "data"), xytext=(-2, 4),
        textcoords="offset points", ha="right", fontsize=9, color=_INK,
    )  # fmt: skip
    marks = (
        ("\\delta_0", area.delta_0, "right"),
        ("\\delta_\\mathrm{crit}", area.delta_crit, "left"),
        ("\\delta_\\mathrm{limit}", area.delta_limit, "left"),
    )
    if area.delta_crit is not None and area.delta_limit is not None:
        _shade(ax, area.during, area, area.delta_0, area.delta_crit, COLOURS[3], "accelerating area $A_1$")
        _shade(ax, area.after, area, area.delta_crit, area.delta_limit, COLOURS[2], "decelerating area $A_2 = A_1$")
    top = 1.12 * max(float(np.max(_values(curve, degrees))) for curve in (area.before, area.during, area.after))
    for name, angle, side in marks:
        if angle is not None:
            at = math.degrees(angle)
            ax.plot([at, at], [0.0, area.p_m], color=_SOFT, linewidth=0.9, linestyle=(0, (2, 2)))
            ax.annotate(f"${name}$ = {at:.1f}°", xy=(at, 0.0), xytext=(-4 if side == "right" else 4, 5),
                        textcoords="offset points", ha=side, fontsize=9, color=_INK)  # fmt: skip
    ax.set_xlim(0.0, 180.0)
    ax.set_ylim(0.0, top)
    ax.set_xticks(range(0, 181, 30))
    ax.set_xlabel("angle δ between the internal voltage and the infinite bus [deg]", color=_INK)
    ax.set_ylabel("electrical power $P_\\mathrm{e}$ [pu of the machine]", color=_INK)
    verdict = "" if area.t_crit is None else f": critical clearing time {1e3 * area.t_crit:.1f} ms"
    ax.set_title(f"{title}\nequal-area construction{verdict}", fontsize=11, color=_INK)
    drawn.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return save(drawn, path)


def _values(curve: Curve, degrees: Any) -> Any:
    return curve.offset + curve.peak * np.sin(np.radians(degrees) - curve.shift)


def _same(one: Curve, other: Curve) -> bool:
    return math.isclose(one.peak, other.peak, rel_tol=1e-9) and math.isclose(one.shift, other.shift, abs_tol=1e-9)


def _shade(ax: Any, curve: Curve, area: EqualArea, start: float, end: float, colour: str, label: str) -> None:
    degrees = np.linspace(math.degrees(start), math.degrees(end), 181)
    ax.fill_between(degrees, _values(curve, degrees), area.p_m, color=colour, alpha=0.22, linewidth=0, label=label)
