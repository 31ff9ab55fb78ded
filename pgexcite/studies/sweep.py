"""Studies of many runs: variants of a scenario under factors, in a pool of processes, resumable.

A study file names scenarios and what is varied:

    title = "Model mismatch on the single machine"
    unit = "G2"
    common = ["simulation.t_end=8"]           # overrides of every case

    [variant.st1a]                            # what is compared
    base = "../smib/fault_st1a.toml"

    [variant.nmpc]
    base = "../smib/fault_nmpc.toml"
    set = ["controller.mpc.N_p=10"]

    [[factor]]                                # under what: one case per variant and factor
    name = "x_s x 2"
    set = ["line.L1.X=0.3"]
    only = { "nmpc*" = ["controller.mpc.options.mismatch={...}"] }   # further overrides of variants whose names match

    [clearing]                                # where wanted: the critical clearing time of every case, too
    tolerance = 0.0025
    set = ["simulation.t_end=5"]

Every case is keyed by the hash of its resolved configuration: a study resumes where it stopped, and a case that stands in two
studies is the same case. A worker that dies costs its case, not the study.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from pgexcite.core.config import load, read
from pgexcite.core.config.validate import Collector
from pgexcite.core.errors import ConfigError, PgexciteError, Problem
from pgexcite.core.registry import nearest
from pgexcite.core.summary import summarise
from pgexcite.studies.cct import critical_clearing_time
from pgexcite.studies.measures import swing_figures

NOMINAL = "nominal"
"""Name of the factor that changes nothing; every study has it."""


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class Variant(_Table):
    """A scenario that takes part in a comparison."""

    base: str = Field(description="scenario file, relative to the study's")
    overrides: tuple[str, ...] = Field((), alias="set", description="overrides, as on the command line")


class Factor(_Table):
    """A circumstance all variants are put under."""

    name: str = Field(description="name of the circumstance")
    overrides: tuple[str, ...] = Field((), alias="set", description="overrides of every variant")
    only: Mapping[str, tuple[str, ...]] = Field(
        default_factory=dict, description="further overrides by variant, or by pattern (nmpc*)"
    )


class Clearing(_Table):
    """How critical clearing times are found."""

    tolerance: float = Field(1e-3, gt=0, description="width of the final bracket, s")
    overrides: tuple[str, ...] = Field((), alias="set", description="overrides of the runs of the search")


class StudyFile(_Table):
    """A study as written in a file."""

    title: str = Field("", description="what it shows, in a line")
    unit: str = Field(description="unit whose figures are taken")
    common: tuple[str, ...] = Field((), description="overrides of every case")
    variant: Mapping[str, Variant] = Field(min_length=1, description="what is compared, each as [variant.NAME]")
    factor: tuple[Factor, ...] = Field((), description="what the variants are put under, each as [[factor]]")
    clearing: Clearing | None = Field(None, description="search for critical clearing times, where wanted")


@dataclass(frozen=True)
class Case:
    """One run of a study: a scenario file, its overrides, and the hash of what they resolve to."""

    variant: str
    factor: str
    path: Path
    overrides: tuple[str, ...]
    unit: str
    key: str
    clearing: Clearing | None = None


@dataclass(frozen=True)
class Study:
    """A finished study.

    Attributes:
        title: of the study.
        rows: one per case: ``variant``, ``factor``, ``outcome``, the unit's figures and the controllers'; a case that could not be
            run has ``error`` instead.
        directory: where the cases' figures are kept.
    """

    title: str
    rows: list[dict[str, Any]]
    directory: Path


def cases(path: Path) -> tuple[str, list[Case]]:
    """Title and cases of a study file.

    Raises:
        ConfigError: with every problem of the study and of its scenarios.
    """
    data = read(path)
    if "simulation" in data and "variant" not in data:
        raise ConfigError(
            [
                Problem(
                    str(path),
                    "is a scenario, not a study",
                    hint="run it with `pgexcite run`, or name it as the base of a variant",
                )
            ]
        )
    collect = Collector()
    study = collect.validate(StudyFile, data, "", strict=None)
    if study is None:
        raise ConfigError(collect.problems)
    found: list[Case] = []
    problems: list[Problem] = []
    for factor in (Factor.model_validate({"name": NOMINAL}), *study.factor):
        # A pattern may match nothing: studies of different variants include the same factors.
        unknown = {name for name in factor.only if "*" not in name} - set(study.variant)
        problems += [Problem(f"factor.{factor.name}.only", f"there is no variant {name!r}") for name in sorted(unknown)]
        for name, variant in study.variant.items():
            own = [text for pattern, more in factor.only.items() if fnmatchcase(name, pattern) for text in more]
            overrides = (*study.common, *variant.overrides, *factor.overrides, *own)
            scenario = path.parent / variant.base
            try:
                loaded = load(scenario, overrides)
            except ConfigError as error:
                problems += [
                    Problem(f"{name}/{factor.name}: {p.path}", p.message, p.value, p.hint) for p in error.problems
                ]
                continue
            units = [item.path.removeprefix("unit.") for item in loaded.system.devices if item.path.startswith("unit.")]
            if study.unit not in units:
                hint = nearest(study.unit, units)
                problems.append(Problem("unit", f"there is no such unit in {variant.base}", study.unit, hint))
                continue
            search = study.clearing.model_dump() if study.clearing else None
            content = json.dumps([loaded.resolved, study.unit, search], sort_keys=True, default=str)
            key = hashlib.sha256(content.encode()).hexdigest()[:16]
            found.append(Case(name, factor.name, scenario.resolve(), overrides, study.unit, key, study.clearing))
    if problems:
        raise ConfigError(problems)
    return study.title or path.stem, found


def run_case(case: Case) -> dict[str, Any]:
    """Run a case and take its figures; what goes wrong by itself is a figure too (``error``)."""
    try:
        scenario = load(case.path, case.overrides)
        simulation = scenario.simulation()
        simulation.run()
    except PgexciteError as error:
        return {"error": str(error)}
    result = simulation.result(scenario.title, scenario.resolved)
    summary = summarise(result)
    controllers = summary["controllers"].values()
    return {
        "outcome": summary["outcome"],
        "t_end": summary["t_end"],
        **summary["units"][case.unit],
        **swing_figures(result.trace, case.unit),
        "cost": sum(item["cost"] for item in controllers),
        "fallbacks": sum(item["fallbacks"] for item in controllers),
        **clearing_figures(case),
    }


def clearing_figures(case: Case) -> dict[str, Any]:
    """``t_crit`` [s] of a case, where it is wanted; where there is none, ``None`` and ``t_crit_note``."""
    if case.clearing is None:
        return {}
    try:
        scenario = load(case.path, (*case.overrides, *case.clearing.overrides))
        return {"t_crit": critical_clearing_time(scenario, case.clearing.tolerance).t_crit}
    except PgexciteError as error:
        return {"t_crit": None, "t_crit_note": str(error)}


def run_study(
    path: Path | str,
    out: Path | str,
    *,
    workers: int = 2,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Run the cases that have not been run yet.

    Args:
        path: the study file.
        out: directory of the study: one JSON file per case, by key.
        workers: processes of the local pool.
        executor: runs the cases instead of the local pool (a ``dask.distributed`` client's ``get_executor()``).
        progress: called with the number of finished cases and of all.

    Raises:
        ConfigError: the study or one of its scenarios is not valid; nothing is run then.
    """
    title, wanted = cases(Path(path))
    directory = Path(out)
    directory.mkdir(parents=True, exist_ok=True)
    missing = {case.key: case for case in wanted if not _file(directory, case).exists()}
    total = len({case.key for case in wanted})
    done = total - len(missing)

    def keep(case: Case, figures: Mapping[str, Any]) -> None:
        nonlocal done
        partial = _file(directory, case).with_suffix(".partial")
        partial.write_text(json.dumps(figures, indent=2) + "\n")
        partial.replace(_file(directory, case))
        done += 1
        if progress is not None:
            progress(done, total)

    if executor is not None:
        _collect({executor.submit(run_case, case): case for case in missing.values()}, keep)
    else:
        _run_locally(list(missing.values()), workers, keep)
    rows = [
        {"variant": case.variant, "factor": case.factor, **json.loads(_file(directory, case).read_text())}
        for case in wanted
    ]
    return Study(title, rows, directory)


def _file(directory: Path, case: Case) -> Path:
    return directory / f"{case.key}.json"


def _collect(futures: Mapping[Future[dict[str, Any]], Case], keep: Callable[[Case, Mapping[str, Any]], None]) -> None:
    for future in as_completed(futures):
        keep(futures[future], future.result())


@contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    """A pool of fresh processes. Interrupted, it begins no further case: its own way is to run all that wait, first.

    An interrupt from a terminal reaches the processes, too, and ends them at once.
    """
    context, ends = multiprocessing.get_context("spawn"), (signal.SIGINT, signal.SIG_DFL)
    with ProcessPoolExecutor(workers, mp_context=context, initializer=signal.signal, initargs=ends) as pool:
        try:
            yield pool
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _run_locally(pending: Sequence[Case], workers: int, keep: Callable[[Case, Mapping[str, Any]], None]) -> None:
    """A pool of fresh processes. A pool that breaks is replaced; then cases run one at a time, so that the culprit is known."""
    remaining = {case.key: case for case in pending}

    def finished(case: Case, figures: Mapping[str, Any]) -> None:
        del remaining[case.key]
        keep(case, figures)

    try:
        with _pool(workers) as pool:
            _collect({pool.submit(run_case, case): case for case in pending}, finished)
    except BrokenProcessPool:
        for case in list(remaining.values()):
            try:
                with _pool(1) as pool:
                    finished(case, pool.submit(run_case, case).result())
            except BrokenProcessPool:
                finished(case, {"error": "the process that ran this case died"})
