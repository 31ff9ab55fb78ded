"""A network reduced to the internal voltages of one machine and one infinite bus."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgexcite.core import powerflow
from pgexcite.core.errors import PgexciteError
from pgexcite.core.system import Device, System

TABLES = {"bus": "buses", "line": "lines", "transformer": "transformers", "shunt": "shunts"}
"""Kind in a parameter's path -> table of a system."""


class EqualAreaError(PgexciteError):
    """The equal-area construction does not apply to this scenario."""


def with_changes(system: System, values: Mapping[str, float]) -> System:
    """The system with parameters of its network replaced."""
    tables: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        kind, name, parameter = path.split(".", 2)
        table = tables.setdefault(TABLES[kind], dict(getattr(system, TABLES[kind])))
        table[name] = table[name].model_copy(update={parameter: value})
    return replace(system, **tables)  # type: ignore[arg-type]


def source_impedance(infinite: Device, system: System) -> complex:
    """Impedance behind which an infinite bus holds its voltage, pu of the system base."""
    if "machine" in infinite.components:
        machine = infinite.components["machine"]
        base = system.S_base / infinite.S_n
        return complex(getattr(machine, "R_a", 0.0), getattr(machine, "Xp_d", 0.0)) * base
    source = next(iter(infinite.components.values()))
    return complex(getattr(source, "R", 0.0), getattr(source, "X", 0.0))


def transfer(
    system: System, loads: Mapping[str, complex], machine: tuple[Device, complex], infinite: tuple[Device, complex]
) -> tuple[complex, complex]:
    """Driving-point and transfer admittance between the two internal voltages, pu of the system base (Kron reduction)."""
    names = list(system.buses)
    n = len(names)
    y: NDArray[np.complex128] = np.zeros((n + 2, n + 2), dtype=complex)
    y[:n, :n] = powerflow.admittance_matrix(system).toarray()
    for device in system.devices:
        if device.path in loads:
            y[names.index(device.bus), names.index(device.bus)] += loads[device.path]
    outer = []
    for node, (device, z) in ((n, machine), (n + 1, infinite)):
        k = names.index(device.bus)
        outer.append(node if z != 0 else k)  # an ideal source is the voltage of its bus
        if z != 0:
            y[[k, node], [k, node]] += 1.0 / z
            y[[k, node], [node, k]] -= 1.0 / z
    earthed = []
    for k, (name, bus) in enumerate(system.buses.items()):
        z = complex(bus.fault_R, bus.fault_X)
        if bus.fault_status > 0 and z == 0:
            if k in outer:
                raise EqualAreaError(
                    f"bus.{name}: a bolted fault at an ideal source has no solution; give the fault an impedance"
                )
            earthed.append(k)
        elif bus.fault_status > 0:
            y[k, k] += 1.0 / z
    inner = [k for k in range(n) if k not in earthed and k not in outer]
    try:
        passed_on = np.linalg.solve(y[np.ix_(inner, inner)], y[np.ix_(inner, outer)])
    except np.linalg.LinAlgError as error:
        raise EqualAreaError(
            "a bus is cut off from everything else after the fault; the network cannot be reduced"
        ) from error
    reduced = y[np.ix_(outer, outer)] - y[np.ix_(outer, inner)] @ passed_on
    return complex(reduced[0, 0]), complex(reduced[0, 1])
