"""The Heffron-Phillips constants K1 to K6 of a machine against an infinite bus (Kundur, sections 12.3 and 12.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pgexcite.core import registry
from pgexcite.core.errors import PgexciteError
from pgexcite.core.initialise import Initial, initialise
from pgexcite.core.linearise import Linearisation, linearise
from pgexcite.core.system import Device, System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeffronPhillips:
    """The block diagram of Kundur's figure 12.9, on the machine's base, at constant field voltage.

        dT_e = K1 d_delta + K2 d_psi        d_psi = K3 / (1 + s T3) (dE_fd - K4 d_delta)        dV_t = K5 d_delta + K6 d_psi

    ``psi`` is the machine's field state, and K2, K3, K4 and K6 are in its terms: ``E'_q`` (K2 to K4 then are those of Heffron and
    Phillips and of DeMello and Concordia), or Kundur's field flux linkage ``psi_fd``.

    Attributes:
        K1, K4, K5: pu per rad.
        K2, K3, K6: pu per pu; ``E_fd`` on the air-gap-line base.
        T3: time constant of the field circuit, s.
        H: inertia constant, s.
        omega_0: nominal angular frequency, rad/s.
    """

    K1: float
    K2: float
    K3: float
    K4: float
    K5: float
    K6: float
    T3: float
    H: float
    omega_0: float

    def torque(self, omega: float, exciter: complex = 0.0) -> tuple[float, float]:
        """Synchronising and damping torque that the field circuit contributes, ``dT_e = (K_S + j K_D omega / omega_0) d_delta``.

        The whole synchronising torque is ``K1 + K_S`` (Kundur, section 12.4, table 12.1).

        Args:
            omega: frequency of the oscillation, rad/s.
            exciter: transfer function at ``j omega`` from ``-dV_t`` to ``dE_fd``; 0 is a constant field.

        Returns:
            K_S in pu per rad, K_D in pu torque per pu speed.
        """
        lag = 1 + 1j * omega * self.T3 + self.K3 * self.K6 * exciter
        flux = -self.K3 * (self.K4 + self.K5 * exciter) / lag
        torque = self.K2 * flux
        return torque.real, torque.imag * self.omega_0 / omega


def heffron_phillips(system: System) -> HeffronPhillips:
    """K1 to K6 and T3 of a system's one machine, from its linearisation at the initial operating point.

    The loop is opened: exciter, stabiliser and limiters make way for a constant field voltage. Damper circuits follow without lag.

    Args:
        system: one generating unit and an infinite bus.

    Raises:
        PgexciteError: there is not exactly one unit, or its machine has no field circuit.
    """
    units = [device for device in system.devices if "machine" in device.components]
    if len(units) != 1:
        raise PgexciteError(
            f"K1 to K6 are constants of one machine against an infinite bus; this system has {len(units)} units"
        )
    initial = initialise(_at_constant_field(system, units[0]))
    return _constants(initial, units[0].path)


def _at_constant_field(system: System, unit: Device) -> System:
    kept = {slot: unit.components[slot] for slot in ("machine", "governor") if slot in unit.components}
    bare = replace(unit, components=kept | {"exciter": registry.find("exciter", "constant_field")()})
    return replace(system, devices=tuple(bare if device is unit else device for device in system.devices))


def _constants(initial: Initial, unit: str) -> HeffronPhillips:
    model, p = initial.model, initial.p
    lin = linearise(model, initial.state, p)
    command = lin.u_names.index(f"{unit}.exciter.e_fd_ref")
    own = (f"{unit}.machine.delta", f"{unit}.machine.omega")
    field = [k for k, name in enumerate(lin.x_names) if lin.B[k, command] != 0 and name not in own]
    if len(field) != 1:
        raise PgexciteError(f"{unit}: its machine has no field circuit, so there is no K2 to K6; use one that has")
    A, B, C = _without_lag(lin, (*(lin.x_names.index(name) for name in own), field[0]))
    H = float(p[model.position("p", f"{unit}.machine.H")])
    v_t = lin.y_names.index(f"{unit}.v_t")
    T3 = -1 / float(A[2, 2])
    K3 = T3 * float(B[2, command])
    return HeffronPhillips(
        K1=-2 * H * float(A[1, 0]),
        K2=-2 * H * float(A[1, 2]),
        K3=K3,
        K4=-T3 * float(A[2, 0]) / K3,
        K5=float(C[v_t, 0]),
        K6=float(C[v_t, 2]),
        T3=T3,
        H=H,
        omega_0=2 * np.pi * float(p[model.position("p", "system.f_n")]),
    )


def _without_lag(lin: Linearisation, kept: Sequence[int]) -> tuple[Array, Array, Array]:
    """A, B, C in the kept states, all others at rest."""
    rest = [k for k in range(len(lin.x_names)) if k not in kept]
    slow = list(kept)
    if not rest:
        return lin.A[np.ix_(slow, slow)], lin.B[slow], lin.C[:, slow]
    A_rs = lin.A[np.ix_(slow, rest)]
    gain = np.linalg.solve(lin.A[np.ix_(rest, rest)], np.hstack((lin.A[np.ix_(rest, slow)], lin.B[rest])))
    n = len(slow)
    A = lin.A[np.ix_(slow, slow)] - A_rs @ gain[:, :n]
    B = lin.B[slow] - A_rs @ gain[:, n:]
    return A, B, lin.C[:, slow] - lin.C[:, rest] @ gain[:, :n]
