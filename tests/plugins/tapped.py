"""A load behind a transformer with a tap changer, fed from a source whose voltage events change."""

from __future__ import annotations

from pgexcite.core.events import ParameterStep
from pgexcite.core.network import Bus, Line, Transformer
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.loads.zip import ConstantCurrent
from pgexcite.plugins.sources.infinite_bus import InfiniteBus


def plant(tap_changer, *, tap=1.0, V=1.02, P=40.0, load=None):
    """A source, a line, a transformer whose tap changer holds the voltage of a load (of constant current, unless given)."""
    at = "LV" if tap_changer.regulates == "to" else "HV"
    return System(
        S_base=100.0,
        f_n=50.0,
        buses={"INF": Bus(), "HV": Bus(), "LV": Bus()},
        lines={"L1": Line(**{"from": "INF", "to": "HV"}, X=0.1)},
        transformers={"T1": Transformer(**{"from": "HV", "to": "LV"}, X=0.1, tap=tap)},
        devices=(
            Device("transformer.T1", at, 100.0, {"tap_changer": tap_changer}, Schedule(P=0.0, Q=0.0)),
            Device("infinite_bus.grid", "INF", 100.0, {"": InfiniteBus()}, Schedule(V=V, angle=0.0)),
            Device("load.L", "LV", 100.0, {"": load or ConstantCurrent(P=P)}, Schedule(P=-P, Q=0.0)),
        ),
    )


def source(t, v):
    return ParameterStep(type="set", t=t, path="infinite_bus.grid.v", value=v)
