"""The tab of a run paced by the wall clock: each phase of the periods against time, and its histogram."""

from __future__ import annotations

from typing import Any

import numpy as np

from pgexcite.core import recording
from pgexcite.core.recording import colour, entity, entity_of
from pgexcite.core.timing import PHASES, Timing, histogram


def signal(phase: str) -> str:
    """Path of a phase in the trace."""
    return f"realtime.{phase}_ms"


def tab() -> Any:
    """The layout: the phases against time above, a histogram of each below."""
    import rerun.blueprint as rrb

    curves = recording.plot("Time taken in each period [ms]", [entity(signal(phase)) for phase in PHASES])
    bars = [
        rrb.BarChartView(origin=_bars(phase), name=f"{phase.replace('_', '-')} [periods, over log10 of ms]")
        for phase in PHASES
    ]
    return rrb.Vertical(curves, rrb.Grid(*bars, grid_columns=2), row_shares=[1, 2], name="Real time")


def draw(stream: Any, timing: Timing) -> None:
    """Send the names of the curves, and the histograms."""
    import rerun as rr

    for k, phase in enumerate(PHASES):
        recording.style(stream, entity(signal(phase)), phase.replace("_", "-"), colour(k))
        if timing.ms[phase].size:
            edges, counts = histogram(timing.ms[phase])
            exponents = np.log10(edges)
            middles, widths = (exponents[:-1] + exponents[1:]) / 2, np.diff(exponents)
            chart = rr.BarChart(counts, color=colour(k), abscissa=middles, widths=widths)
            stream.log(_bars(phase), chart, static=True)


def _bars(phase: str) -> str:
    return entity_of("histogram", phase)
