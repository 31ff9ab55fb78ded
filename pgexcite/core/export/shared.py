"""What ``ladder.c`` is to know, and what the quadratic program in C does not do."""

from __future__ import annotations

from pgexcite.core.condensed import Condensed
from pgexcite.core.errors import Problem
from pgexcite.core.ladder import MOVED, PLAUSIBLE, Ladder
from pgexcite.core.written import Numbers


def objections(where: str, condensed: Condensed) -> list[Problem]:
    """What of a problem the quadratic program in C does not do."""
    if (condensed.problem.R > 0).all():
        return []
    text = "must be positive: the exported QP solver takes strictly convex programs"
    return [Problem(f"{where}.R", text, float(condensed.problem.R.min()))]


def ladder(session: Ladder, measured: int) -> tuple[dict[str, object], dict[str, Numbers]]:
    """Constants and arrays of the ladder; ``measured`` is the number of signals looked at for their age."""
    constants: dict[str, object] = {
        "n_measured": 0 if session.options.perfect else measured,
        "max_reuse": session.options.max_reuse,
        "max_age": session.options.max_age,
        "has_classical": int(session.actuator.has_classical),
        "delayed": int(session.problem.delayed),
        "late": session.problem.late,
        "plausible": PLAUSIBLE,
        "moved_command": MOVED,
    }
    return constants, {"U_0": session.u_0}
