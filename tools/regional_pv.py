"""P-V curves of the regional system with its regulators and limiters at work: the picture and the table of docs/regional.md.

Run: python tools/regional_pv.py [OUT]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from regional import CONFIGS, run

from pgexcite.core.config import from_data, read
from pgexcite.core.config.files import merge, override
from pgexcite.studies import figures
from pgexcite.studies.pv_ramp import Ramp, pv_by_ramp

NOSE = CONFIGS.parent / "cases" / "regional_nose.toml"
RAISED = ("unit.A2G1.V=1.05", "unit.A2G2.V=1.05")
NO_LIMITERS = tuple(f"unit.{unit}.limiter.T_LIM=1e9" for unit in ("A2G1", "A3G1"))
CURVES: dict[str, tuple[str, tuple[str, ...]]] = {
    "with the link": ("link_loss", ("event=[]",)),
    "without it": ("link_loss", ()),
    "without it, no limiters": ("link_loss", NO_LIMITERS),
    "both units of area 2 regulated": ("link_loss_classical", ()),
    "both at 1.05 pu": ("link_loss_classical", RAISED),
    "both at 1.05 pu, no limiters": (
        "link_loss_classical",
        (*RAISED, *NO_LIMITERS, "unit.A2G2.limiter.T_LIM=1e9"),
    ),
}


def curve(name: str, overrides: Sequence[str] = ()) -> Ramp:
    """The curve at the tap changer's primary of a configuration, after its events."""
    path = CONFIGS / f"{name}.toml"
    data = override(merge(read(path), read(NOSE)), overrides)
    for event in data["event"]:
        event["t"] = 60.0
    scenario = from_data(data, path)
    return pv_by_ramp(scenario.system, scenario.settings, "Balsfjord", scenario.changes)


def main(out: Path) -> None:
    """Curves, the run of figure 12 over them, and their table on standard output."""
    drawn, (ax,) = figures.figure(8.6, 5.6)
    print("| curve | nose: MW, pu | limiters take over at |\n|---|---|---|")
    for k, (label, what) in enumerate(CURVES.items()):
        found = curve(*what)
        P, V = found.nose
        acted = "; ".join(f"{path}: {p:.0f} MW, {v:.3f}" for path, (p, v) in found.acted.items()) or "-"
        print(f"| {label} | {P:.0f}, {V:.3f} | {acted} |", flush=True)
        colour = figures.COLOURS[k % len(figures.COLOURS)]
        dashes = (0, (5, 2)) if "no limiters" in label else "-"
        ax.plot(found.P, found.V, color=colour, linestyle=dashes, linewidth=1.5, label=label)
        ax.plot(P, V, "o", color=colour, markersize=4)
    _, trace = run("link_loss", ("simulation.collapse_below=0.0",))
    power = 100 * trace["transformer.OLTC.p_from"]
    ax.plot(power, trace["bus.Balsfjord.v"], color="#24292f", linewidth=0.8, label="the run of figure 12")
    ax.axvline(read(NOSE)["load"]["Balsfjord"]["P"], color="#8a9199", linewidth=0.8, linestyle=":", label="demand")
    ax.axhline(0.7, color="#8a9199", linewidth=0.8, linestyle=(0, (1, 3)))
    ax.set_xlabel("P at the tap changer's primary [MW]")
    ax.set_ylabel("voltage there [pu]")
    drawn.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8.5)
    drawn.suptitle("P-V curves of the regional system with regulators and limiters at work", fontsize=11)
    figures.save(drawn, out / "pv.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("runs/regional"))
