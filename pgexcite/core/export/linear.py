"""Linear predictions and the offset-free filter as C: what ``local.c``, ``kalman.c`` and ``offset_free.c`` are to know."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pgexcite.core.horizons import Horizons
from pgexcite.core.initialise import Initial
from pgexcite.core.offset_free import LARGEST, OffsetFreeFilter
from pgexcite.core.sensitivity import write_sensitivities
from pgexcite.core.settings import Rule
from pgexcite.core.step import RULES, Kernel
from pgexcite.core.written import Numbers, Predictions, horizon

Array = NDArray[np.float64]


def predictions(
    kernel: Kernel, initial: Initial, horizons: Horizons, outputs: Sequence[str], rule: Rule
) -> Predictions:
    """Functions, constants and arrays of linear predictions of these outputs around points of a model."""
    model, problem = kernel.model, horizons.problem
    commands = np.array([model.position("u", path) for path in problem.commands], dtype=np.int32)
    selected = np.array([model.position("y", path) for path in outputs], dtype=np.int32)
    columns = len(model.x_names) + commands.size
    of_horizon, arrays = horizon(horizons)
    # Intervals that grow are all of different lengths; a known change makes two pieces of one, and other transitions after it. What
    # is not kept is made again: many changes far apart need not all be kept.
    lengths, known = (1 if problem.growth == 1 else problem.N_p), len(problem.known)
    constants: dict[str, object] = {
        "n_commands": commands.size,
        "n_columns": columns,
        "n_selected": selected.size,
        "transition": 1,
        "rule": RULES.index(rule),
        "n_kept": min(lengths * (known + 1) + 2 * known, 3 * problem.N_p),
    }
    arrays |= {"COMMANDS": commands, "U_START": initial.state.u, "P_START": initial.p}
    sensitivities = write_sensitivities(kernel, commands, selected)
    return Predictions(
        functions=[*kernel.stepping(), *sensitivities.functions()],
        along=sensitivities.along(),
        constants=kernel.constants() | sensitivities.constants() | constants | of_horizon,
        arrays=arrays,
    )


def filtering(observer: OffsetFreeFilter) -> tuple[dict[str, object], dict[str, Numbers]]:
    """Constants and arrays of the observer."""
    disturbances, noise = observer.disturbances, observer.noise
    constants: dict[str, object] = {
        "n_mean": observer.start.x.size,
        "n_seen": observer.rows.size,
        "n_shifts": disturbances.outputs.shape[1],
        "n_pushes": disturbances.pushing.shape[1],
        "n_torques": disturbances.torques.shape[1],
        "command_noise": noise.command,
        "torque_noise": noise.torque,
        "largest": LARGEST,
    }
    arrays: dict[str, Numbers] = {
        "SEEN_ROW": observer.rows.astype(np.int32),
        "ON_OUTPUTS": disturbances.outputs,
        "TORQUES": disturbances.torques,
        "VARIANCE": noise.measured**2,
        "WALK": observer.walk,
        "START": observer.start.x,
    }
    return constants, arrays
