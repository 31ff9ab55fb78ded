"""Plants the kernel's tests run on, built from the shipped components."""

from __future__ import annotations

import numpy as np

from pgexcite.core.component import Component
from pgexcite.core.mpc import ControlProblem
from pgexcite.core.network import Bus, Line, Transformer
from pgexcite.core.simulate import Simulation
from pgexcite.core.system import Device, Schedule, System
from pgexcite.plugins.exciters.constant import ConstantField
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.governors.constant import ConstantTorque
from pgexcite.plugins.loads.zip import ConstantImpedance
from pgexcite.plugins.machines.genrou import GENROU
from pgexcite.plugins.machines.salient_pole import SalientPole
from pgexcite.plugins.sources.infinite_bus import InfiniteBus
from pgexcite.plugins.stabilisers.kundur import KundurPSS

REGULATED: dict[str, Component] = {
    "exciter": ST1A(T_R=0.02, K_A=200.0, V_RMIN=-3.85, V_RMAX=3.85),
    "stabiliser": KundurPSS(K_STAB=9.5, T_W=1.4, T_1=0.154, T_2=0.033, V_SMAX=0.2, V_SMIN=-0.2),
}
"""Static exciter with stabiliser, tuned as in Kundur's example 12.5, ceiling twice the field voltage of rated load."""


def kobbelv(reference: str = "auto", S_base: float = 175.0, **slots: Component) -> System:
    """The paper's plant: 175 MVA hydro unit, transformer, line, infinite bus whose voltage follows from P, Q and V_t = 1."""
    components: dict[str, Component] = {
        "machine": SalientPole(),
        "exciter": ConstantField(),
        "governor": ConstantTorque(),
    }
    z = S_base / 175.0
    return System(
        S_base=S_base,
        f_n=50.0,
        buses={"G2": Bus(), "HV": Bus(), "INF": Bus()},
        lines={"L1": Line(**{"from": "HV", "to": "INF"}, X=0.15 * z)},
        transformers={"T1": Transformer(**{"from": "G2", "to": "HV"}, X=0.12 * z)},
        devices=(
            Device("unit.G2", "G2", 175.0, components | slots, Schedule(P=0.86 * 175, Q=0.51 * 175, V=1.0)),
            Device("infinite_bus.grid", "INF", S_base, {"": InfiniteBus()}, Schedule(angle=0.0)),
        ),
        reference=reference,
    )


def regulated(**slots: Component) -> System:
    """The same plant under ST1A with a stabiliser."""
    return kobbelv(**(REGULATED | slots))


def two_units(
    reference: str = "auto", *, grid: bool = True, load: Component | None = None, exciter: Component | None = None
) -> System:
    """A round-rotor and a salient-pole unit that feed a load, and an infinite bus over two lines where ``grid``.

    Without the infinite bus the first unit is the slack of the power flow.
    """
    ends = {"L1": ("A", "L"), "L2": ("B", "L")} | ({"L3": ("L", "INF"), "L4": ("L", "INF")} if grid else {})
    demand = load or ConstantImpedance(P=150.0, Q=30.0)
    first: dict[str, Component] = {"machine": GENROU(), "exciter": SEXS(), "governor": ConstantTorque()}
    regulator = exciter or ST1A(K_A=50.0)
    second: dict[str, Component] = {"machine": SalientPole(), "exciter": regulator, "governor": ConstantTorque()}
    devices = [
        Device("unit.G1", "A", 100.0, first, Schedule(P=70.0, V=1.02) if grid else Schedule(V=1.02, angle=0.0)),
        Device("unit.G2", "B", 175.0, second, Schedule(P=90.0, V=1.01)),
        Device("load.L", "L", 100.0, {"": demand}, Schedule(P=-150.0, Q=-30.0)),
    ]
    if grid:
        devices.append(Device("infinite_bus.grid", "INF", 100.0, {"": InfiniteBus()}, Schedule(V=1.0, angle=0.0)))
    return System(
        S_base=100.0,
        f_n=50.0,
        buses={name: Bus() for name in ("A", "B", "L", *(["INF"] if grid else []))},
        lines={name: Line(**{"from": a, "to": b}, R=0.01, X=0.1, B=0.02) for name, (a, b) in ends.items()},
        devices=tuple(devices),
        reference=reference,
    )


def push(simulation: Simulation, state: str, by: float) -> None:
    """Move one state of a simulation; the algebraic unknowns follow."""
    x = simulation.state.x.copy()
    x[simulation.model.position("x", state)] += by
    settled = simulation.kernel.settle(simulation.state.with_(x=x), simulation.p)
    assert settled is not None
    simulation.state = settled


def voltage_problem(command: str, **changes: object) -> ControlProblem:
    """The paper's problem for unit G2 with three moves, in terms of one command; ``changes`` are its fields."""
    values: dict[str, object] = {
        "dt": 0.05,
        "N_p": 5,
        "blocks": (1, 1, 1),
        "commands": (command,),
        "voltages": ("unit.G2.v_t",),
        "speeds": ("unit.G2.omega",),
        "Q": np.array([300.0]),
        "P": np.array([5.0]),
        "R": np.array([0.01]),
        "u_min": np.array([-3.2]),
        "u_max": np.array([3.2]),
        "du_max": np.array([np.inf]),
        "V_ref": np.array([1.0]),
    }
    return ControlProblem(**(values | changes))
