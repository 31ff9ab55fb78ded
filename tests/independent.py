"""An integrator that shares nothing with the kernel but the right-hand sides: scipy's Radau on the reduced equations."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from pgexcite.core.model import Model, State


class Independent:
    """The states with a time constant, integrated by Radau; everything algebraic solved inside the right-hand side."""

    def __init__(self, model: Model, state: State, p) -> None:
        self.model = model
        mass = np.array(model.dae(state.x, state.z, state.d, state.u, p)[1]).ravel()
        self.dynamic, self.algebraic = np.flatnonzero(mass > 0), np.flatnonzero(mass == 0)
        self.mass = mass[self.dynamic]
        x, z = ca.SX.sym("x", state.x.size), ca.SX.sym("z", state.z.size)
        u, q = ca.SX.sym("u", state.u.size), ca.SX.sym("p", p.size)
        f, _, _, _, g, y = model.dae(x, z, model.d_0, u, q)
        unknown = ca.vertcat(*[x[int(k)] for k in self.algebraic], z)
        rows = ca.vertcat(*[f[int(k)] for k in self.algebraic], g)
        self.solve = ca.Function("solve", [x, z, u, q], [rows, ca.jacobian(rows, unknown), f])
        self.y = ca.Function("y", [x, z, u, q], [y])

    def algebraic_at(self, x, z, u, p):
        """All of ``x`` and ``z`` from the dynamic states in ``x``, by plain Newton to rounding."""
        x, z, n = x.copy(), z.copy(), self.algebraic.size
        for _ in range(50):
            r, J, _ = (np.array(item) for item in self.solve(x, z, u, p))
            step = np.linalg.solve(J, -r.ravel())
            x[self.algebraic] += step[:n]
            z += step[n:]
            if np.abs(step).max() < 1e-13:
                break
        return x, z, np.array(self.solve(x, z, u, p)[2]).ravel()

    def run(
        self, state: State, pieces: Sequence[tuple[float, np.ndarray, np.ndarray]], times, tolerance: float = 1e-11
    ):
        """Outputs at ``times`` (before an event that falls on one); ``pieces`` are ``(until, u, p)`` in order."""
        x, z, t = state.x.copy(), state.z.copy(), state.t
        rows, stamps = [], []
        for until, u, p in pieces:
            hold = {"z": z}

            def slope(_t, xd, u=u, p=p, x0=x, hold=hold):
                full = x0.copy()
                full[self.dynamic] = xd
                _, hold["z"], f = self.algebraic_at(full, hold["z"], u, p)
                return f[self.dynamic] / self.mass

            wanted = times[(times > t + 1e-9) & (times <= until + 1e-9)]
            reached = np.unique(np.append(np.clip(wanted, t, until), until))
            done = solve_ivp(
                slope,
                (t, until),
                x[self.dynamic],
                "Radau",
                t_eval=reached,
                rtol=tolerance,
                atol=tolerance,
            )
            assert done.success, done.message
            for k in range(reached.size):
                x[self.dynamic] = done.y[:, k]
                x, z, _ = self.algebraic_at(x, z, u, p)
                if k < wanted.size:
                    rows.append(np.array(self.y(x, z, u, p)).ravel())
                    stamps.append(wanted[k])
            t = until
        return np.array(stamps), np.array(rows)
