"""The regional system: pictures like figures 12 to 15 of the paper, and the tables of docs/regional.md.

Run: python tools/regional.py [OUT] [--only figures|tables|mismatch]
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pgexcite.core.config import from_data, read
from pgexcite.core.config.files import override
from pgexcite.core.trace import Outcome, Trace
from pgexcite.studies.long_term import Watched, commands_of, draw_voltages, long_term_figures

CONFIGS = Path(__file__).parents[1] / "configs" / "regional"
RATED = {"A2G1": 1.925, "A2G2": 1.925, "A3G1": 1.811}
RATED_SATURATED = {"A2G1": 2.284, "A2G2": 2.284, "A3G1": 2.129}
LOAD, PRIMARY, TAPS = "Load", "Balsfjord", "transformer.OLTC.tap_changer"
COLUMNS = {
    "outcome": "{}", "t_end": "{:.1f}", "load_min": "{:.3f}", "load_end": "{:.3f}", "primary_min": "{:.3f}",
    "primary_end": "{:.3f}", "primary_error": "{:.1f}", "taps": "{}", "position": "{:+d}", "overload": "{:.0f}",
    "moves": "{:.3f}", "changes": "{}", "solve_ms": "{:.1f}",
}  # fmt: skip

VOLTAGES = (
    ("load bus [pu]", ["bus.Load.v"]),
    ("tap changer's primary [pu]", ["bus.Balsfjord.v"]),
    ("tap position", [f"{TAPS}.position"]),
)
FIELDS = (r"$i_\mathrm{fd}$, A2 G1 and G2 [pu]", ["unit.A2G1.i_fd", "unit.A2G2.i_fd"])
REFERENCES = (r"$V_\mathrm{ref}$ [pu]", ["unit.A2G1.exciter.v_ref", "unit.A2G2.exciter.v_ref"])

MPC = "controller.mpc"
BOUNDED = f'{MPC}.soft=[{{signal="i_fd",upper=1.95,weight=3000.0}}]'
UNKNOWN = f"{MPC}.disturbance_known=false"
MOVES = f"{MPC}.blocks=[2,3,7]"
CANDIDATES = f"{MPC}.options.candidates=16"
# In C the sensitivities to every state, which the linear backend wants, take gcc minutes to compile.
LINEAR = (f'{MPC}.backend="linear"', f"{MPC}.options={{}}", 'simulation.compile="never"')
EQUIVALENT = (f'{MPC}.backend="equivalent"', f"{MPC}.options={{}}")
LONG = (f"{MPC}.N_p=12", f"{MPC}.growth=1.4")

HORIZONS = {
    "dt 0.1 s, N_p 10": (f"{MPC}.dt=0.1", f"{MPC}.N_p=10"),
    "dt 0.1 s growing by 1.4, N_p 15 to 39 s": (f"{MPC}.dt=0.1", f"{MPC}.N_p=15", f"{MPC}.growth=1.4"),
    "dt 0.2 s, N_p 10": (f"{MPC}.dt=0.2", f"{MPC}.N_p=10"),
    "dt 0.2 s growing by 1.4, N_p 12 to 28 s": (f"{MPC}.dt=0.2", f"{MPC}.N_p=12", f"{MPC}.growth=1.4"),
    "dt 0.5 s, N_p 10": (f"{MPC}.dt=0.5", f"{MPC}.N_p=10"),
    "dt 1 s, N_p 5": (f"{MPC}.dt=1.0", f"{MPC}.N_p=5"),
}

Row = dict[str, Any]


def run(name: str, overrides: Sequence[str] = (), mismatch: Mapping[str, float] | None = None) -> tuple[Row, Trace]:
    """One run and its figures."""
    path = CONFIGS / f"{name}.toml"
    data = override(read(path), overrides)
    if mismatch is not None:
        mpc = data["controller"]["mpc"]
        mpc["options"]["mismatch" if mpc["backend"] == "nmpc" else "model"] = dict(mismatch)
    scenario = from_data(data, path)
    simulation = scenario.simulation()
    outcome: Outcome = simulation.run()
    result = simulation.result()
    u = dict(zip(simulation.model.u_names, simulation.initial.state.u, strict=True))
    saturated = scenario.resolved["unit"]["A2G1"]["machine"]["saturation"] != "none"
    rated = RATED_SATURATED if saturated else RATED
    watched = Watched(LOAD, PRIMARY, TAPS, rated, commands_of(scenario.controllers, u))
    row = long_term_figures(outcome, result.trace, watched)
    for statistics in result.controllers.values():
        row["solve_ms"] = float(np.median(statistics.solve_ms))
    return row, result.trace


def table(rows: Mapping[str, Row]) -> str:
    """Rows as Markdown."""
    lines = ["| run | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, row in rows.items():
        cells = [form.format(row[key]) if key in row else "-" for key, form in COLUMNS.items()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


BACKENDS = {
    "linear, primary": ("link_loss_nmpc_primary", LINEAR),
    "linear, primary of the tap changer's voltage": ("link_loss_nmpc_primary_oltc", LINEAR),
    "linear, secondary": ("link_loss_nmpc_secondary", LINEAR),
    "linear, limit": ("link_loss_nmpc_secondary_limit", LINEAR),
    **{
        f"equivalent, primary, {said}": ("link_loss_nmpc_primary", (*EQUIVALENT, *horizon))
        for said, horizon in HORIZONS.items()
    },
    "linear, figure 14, disturbance known": ("link_loss_nmpc_secondary_fig14", LINEAR),
    "linear, figure 14, unknown": ("link_loss_nmpc_secondary_fig14", (*LINEAR, UNKNOWN)),
    "linear, figure 15, disturbance known": ("link_loss_nmpc_secondary_fig15", LINEAR),
    "linear, figure 15, unknown": ("link_loss_nmpc_secondary_fig15", (*LINEAR, UNKNOWN)),
    **{
        f"{said}, primary, event of figure {n}": (f"link_loss_nmpc_primary_fig{n}", overrides)
        for n in (14, 15)
        for said, overrides in {
            "nmpc": (),
            "linear": LINEAR,
            **{f"equivalent, {said}": (*EQUIVALENT, *horizon) for said, horizon in HORIZONS.items()},
        }.items()
    },
}
FIGURES: dict[str, tuple[str, dict[str, tuple[str, tuple[str, ...]]], tuple[Any, ...]]] = {
    "figure_12": (
        "Loss of the link, with and without control of the tap changer",
        {
            "tap changer blocked": ("link_loss_no_oltc", ()),
            "tap changer at work, not ended at 0.7 pu": ("link_loss", ("simulation.collapse_below=0.0",)),
            "tap changer at work": ("link_loss", ()),
            "both machines of area 2 under classical control": ("link_loss_classical", ()),
        },
        (*VOLTAGES, FIELDS),
    ),
    "figure_13": (
        "Predictive control of the field voltage of area 2 G2",
        {
            "classical control of G2": ("link_loss_classical", ()),
            "NMPC of its terminals, dt 1 s, N_p 5": ("link_loss_nmpc_primary", ()),
            "NMPC of its terminals, dt 1 s, N_p 1": ("link_loss_nmpc_primary", (f"{MPC}.N_p=1",)),
            "NMPC of its terminals, dt 0.2 s, N_p 10": ("link_loss_nmpc_primary", (f"{MPC}.dt=0.2", f"{MPC}.N_p=10")),
            "NMPC of its terminals, dt 1 s, N_p 12 to 139 s": ("link_loss_nmpc_primary", LONG),
            "NMPC of its terminals, field current bounded": ("link_loss_nmpc_primary", (BOUNDED,)),
            "NMPC of the tap changer's primary, dt 1 s, N_p 5": ("link_loss_nmpc_primary_oltc", ()),
        },
        (*VOLTAGES, FIELDS),
    ),
    "figure_14": (
        "Link out at 10 s, back at 40 s; set-points of area 2 moved every 10 s, N_p 1",
        {
            "classical": ("link_loss_nmpc_secondary_fig14", (f"{MPC}.active=false",)),
            "set-points by NMPC": ("link_loss_nmpc_secondary_fig14", ()),
            "set-points by NMPC, disturbance unknown": ("link_loss_nmpc_secondary_fig14", (UNKNOWN,)),
        },
        (*VOLTAGES, REFERENCES),
    ),
    "figure_15": (
        "Link out at 30 s; set-points of area 2 moved every 2 s, N_p 10",
        {
            "classical": ("link_loss_nmpc_secondary_fig15", (f"{MPC}.active=false",)),
            "set-points by NMPC": ("link_loss_nmpc_secondary_fig15", ()),
            "set-points by NMPC, disturbance unknown": ("link_loss_nmpc_secondary_fig15", (UNKNOWN,)),
        },
        (*VOLTAGES, REFERENCES),
    ),
    "limit": (
        "At 755 MW: set-points at their bound run into the limiters, NMPC that knows the limit does not",
        {
            "classical": ("link_loss_classical", ("load.Load.P=755.0",)),
            "set-points raised to 1.05 by hand": ("link_loss_raised_755", ()),
            "NMPC without a bound on the field current": ("link_loss_nmpc_secondary", ("load.Load.P=755.0",)),
            "NMPC with a soft bound on the field current": ("link_loss_nmpc_secondary_limit", ()),
        },
        (*VOLTAGES, REFERENCES, FIELDS),
    ),
    "island": (
        "Without the line South, at 700 MW, with governors",
        {
            "tap changer blocked": ("link_loss_island", (f"{TAPS}.blocked=1.0",)),
            "tap changer at work": ("link_loss_island", ()),
            "both set-points of area 2 by NMPC": ("link_loss_island_nmpc_secondary", ()),
        },
        (*VOLTAGES, ("speed of A3 G1 [pu]", ["unit.A3G1.omega"])),
    ),
}
FURTHER = {
    "set-points raised to 1.05 by hand": ("link_loss_raised", ()),
    "NMPC secondary, dt 2 s, N_p 10": ("link_loss_nmpc_secondary", ()),
    "NMPC secondary, dt 10 s, N_p 1": ("link_loss_nmpc_secondary", (f"{MPC}.dt=10.0", f"{MPC}.N_p=1")),
    "NMPC secondary, dt 2 s, N_p 12 to 278 s": ("link_loss_nmpc_secondary", LONG),
    "NMPC secondary with limit, disturbance known": (
        "link_loss_nmpc_secondary_limit",
        (f"{MPC}.disturbance_known=true",),
    ),
    "governors, tap changer at work": ("link_loss_governors", ()),
    "limit, horizon of 278 s, one move": ("link_loss_nmpc_secondary_limit", LONG),
    "limit, horizon of 278 s, one move, 16 candidates": ("link_loss_nmpc_secondary_limit", (*LONG, CANDIDATES)),
    "limit, horizon of 278 s, three moves": ("link_loss_nmpc_secondary_limit", (*LONG, MOVES)),
    "limit, horizon of 278 s, three moves, 16 candidates": (
        "link_loss_nmpc_secondary_limit",
        (*LONG, MOVES, CANDIDATES),
    ),
}

TRUE = {
    "load.Load.alpha_s": 0.7, "load.Load.beta_s": 0.7, "load.Load.alpha_t": 2.0, "load.Load.beta_t": 2.0,
    "load.Load.T_p": 30.0, "load.Load.T_q": 30.0, "line.Link.X": 0.04, "line.South.X": 0.1,
    f"{TAPS}.T_first": 20.0, f"{TAPS}.T_next": 10.0,
}  # fmt: skip
WRONG = {
    "steady load exponents": ("load.Load.alpha_s", "load.Load.beta_s"),
    "transient load exponents": ("load.Load.alpha_t", "load.Load.beta_t"),
    "recovery times": ("load.Load.T_p", "load.Load.T_q"),
    "reactance of the link": ("line.Link.X",),
    "reactance of South": ("line.South.X",),
    "delays of the tap changer": (f"{TAPS}.T_first", f"{TAPS}.T_next"),
    "all of them": tuple(TRUE),
}
MISMATCHED = {
    "primary": ("link_loss_nmpc_primary", ()),
    "primary of Balsfjord": ("link_loss_nmpc_primary_oltc", ()),
    "secondary": ("link_loss_nmpc_secondary", ()),
    "limit": ("link_loss_nmpc_secondary_limit", ()),
    "limit, horizon of 278 s, one move": ("link_loss_nmpc_secondary_limit", LONG),
    "limit, horizon of 278 s, three moves": ("link_loss_nmpc_secondary_limit", (*LONG, MOVES)),
    "figure 14": ("link_loss_nmpc_secondary_fig14", ()),
    "figure 14, 0.94 pu to be held": ("link_loss_nmpc_secondary_fig14", (f"{MPC}.V_ref=0.94",)),
    "limit, link back": ("link_loss_nmpc_secondary_limit_back", ()),
    "linear, primary": ("link_loss_nmpc_primary", LINEAR),
    "linear, secondary": ("link_loss_nmpc_secondary", LINEAR),
    "linear, limit": ("link_loss_nmpc_secondary_limit", LINEAR),
    "linear, figure 14, disturbance known": ("link_loss_nmpc_secondary_fig14", LINEAR),
    "linear, limit, link back": ("link_loss_nmpc_secondary_limit_back", LINEAR),
}


def draw(out: Path) -> None:
    """All pictures, and their table on standard output."""
    for name, (title, runs, panels) in FIGURES.items():
        found = {label: run(config, overrides) for label, (config, overrides) in runs.items()}
        draw_voltages({label: trace for label, (_, trace) in found.items()}, panels, out / f"{name}.png", title)
        print(f"\n{name}\n\n{table({label: row for label, (row, _) in found.items()})}", flush=True)


def tables() -> None:
    """Other backends, other horizons."""
    print("\nbackends\n\n" + table({label: run(*what)[0] for label, what in BACKENDS.items()}), flush=True)
    print("\nfurther\n\n" + table({label: run(*what)[0] for label, what in FURTHER.items()}), flush=True)


def mismatch() -> None:
    """What happens when the controller's model is wrong."""
    for label, (config, overrides) in MISMATCHED.items():
        rows = {"model right": run(config, overrides)[0]}
        for what, paths in WRONG.items():
            for factor in (0.5, 0.8, 1.2, 1.5):
                values = {path: factor * TRUE[path] for path in paths}
                rows[f"{what} x {factor:g}"] = run(config, overrides, values)[0]
        print(f"\n{label}\n\n{table(rows)}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", nargs="?", type=Path, default=Path("runs/regional"))
    parser.add_argument("--only", choices=("figures", "tables", "mismatch"))
    arguments = parser.parse_args()
    for part, work in (("figures", lambda: draw(arguments.out)), ("tables", tables), ("mismatch", mismatch)):
        if arguments.only in (None, part):
            work()
