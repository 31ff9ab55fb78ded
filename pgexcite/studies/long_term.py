"""Long-term voltage stability: the figures of a run with tap changers and field-current limits, and pictures of its voltages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core.controller import Controller
from pgexcite.core.trace import Outcome, Trace
from pgexcite.studies import figures


@dataclass(frozen=True)
class Watched:
    """What the figures are taken of.

    Attributes:
        load: bus behind the tap changer.
        primary: bus in front of it.
        tap_changer: path of the tap changer.
        rated: field current at rated load by unit, pu on the air-gap line; time above it is overload.
        commands: set-points whose changes count as control moves.
    """

    load: str
    primary: str
    tap_changer: str
    rated: Mapping[str, float]
    commands: Sequence[str] = ()


def long_term_figures(outcome: Outcome, trace: Trace, watched: Watched) -> dict[str, Any]:
    """Figures of one run.

    ``outcome``, ``t_end`` [s]; lowest and last voltage [pu] of both buses (``load_min``, ``load_end``, ``primary_min``,
    ``primary_end``); ``primary_error``: integral of ``|1 - v|`` of the bus in front of the tap changer over the run's time [pu s];
    ``taps``: taps made, and ``position`` in the end; ``overload`` [s]: time a field current was above its rated value, summed over
    the units; ``moves``: total change of the commands [pu] and ``changes``: how many of them moved by more than 1e-4 pu.
    """
    load, primary = trace[f"bus.{watched.load}.v"], trace[f"bus.{watched.primary}.v"]
    position = trace[f"{watched.tap_changer}.position"]
    overload = 0.0
    for unit, limit in watched.rated.items():
        above = trace[f"unit.{unit}.i_fd"] > limit
        overload += float(np.sum(np.diff(trace.t)[above[1:]]))
    steps = [np.abs(np.diff(trace[path])) for path in watched.commands if path in trace.columns]
    return {
        "outcome": outcome.ending.value,
        "t_end": float(outcome.t),
        "load_min": float(load.min()),
        "load_end": float(load[-1]),
        "primary_min": float(primary.min()),
        "primary_end": float(primary[-1]),
        "primary_error": float(np.trapezoid(np.abs(1.0 - primary), trace.t)),
        "taps": int(np.sum(np.abs(np.diff(position)))),
        "position": int(position[-1]),
        "overload": overload,
        "moves": float(sum(step.sum() for step in steps)),
        "changes": int(sum(np.count_nonzero(step > 1e-4) for step in steps)),
    }


def commands_of(controllers: Mapping[str, Controller], setpoints: Mapping[str, float]) -> tuple[str, ...]:
    """Paths commanded by model predictive controllers."""
    found = [getattr(controller, "actuator", None) for controller in controllers.values()]
    return tuple(path for actuator in found if actuator is not None for path in actuator(setpoints).setpoints)


def ended(trace: Trace) -> bool:
    """Whether the run ended before its time."""
    return bool(trace.log) and trace.log[-1].kind == "outcome"


def draw_voltages(
    runs: Mapping[str, Trace], panels: Sequence[tuple[str, Sequence[str]]], path: Path, title: str
) -> Path:
    """Signals of several runs over time; a cross marks where a run ended before its time.

    Args:
        runs: label -> trace; each has a colour.
        panels: label of the axis and the signals in it, from top to bottom; several signals differ by their dashes.
        path: of the PNG.
        title: above it.
    """
    drawn, axes = figures.figure(8.6, 1.1 + 2.3 * len(panels), len(panels))
    dashes = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))
    for ax, (label, signals) in zip(axes, panels, strict=True):
        for k, (name, trace) in enumerate(runs.items()):
            for j, signal in enumerate(s for s in signals if s in trace.columns):
                ax.plot(
                    trace.t,
                    trace[signal],
                    color=figures.COLOURS[k % len(figures.COLOURS)],
                    linestyle=dashes[j % len(dashes)],
                    linewidth=1.4,
                    label=name if j == 0 else None,
                )
            if ended(trace) and signals[0] in trace.columns:
                ax.plot(trace.t[-1], trace[signals[0]][-1], "x", color=figures.COLOURS[k % len(figures.COLOURS)])
        ax.set_ylabel(label)
        ax.margins(x=0.0, y=0.08)
        if len(signals) > 1:
            key = "   ".join(f"{mark} {s}" for mark, s in zip(("solid:", "dashed:", "dotted:"), signals, strict=False))
            ax.annotate(key, xy=(0.01, 0.03), xycoords="axes fraction", fontsize=7.5, color="#8a9199")
    axes[-1].set_xlabel("time [s]")
    drawn.align_ylabels(axes)
    drawn.suptitle(title, fontsize=11)
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=8.5)
    return figures.save(drawn, path)
