"""Plan of a suite: the list of its runs, each with a key.

The key is a hash of everything that decides the numbers of a run, the source code included: a version number does
not identify a checkout that was changed. Decisions: docs/design/0011-batch.md.
"""

import hashlib
import itertools
import json
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sonar_graph.batch.recorded import ALL_LOGS
from sonar_graph.batch.sources import (
    DATASETS,
    FILE,
    FILES,
    GENERATORS,
    KINDS,
    fingerprint,
    hash_of,
)
from sonar_graph.batch.store import PlannedRun
from sonar_graph.batch.suite import LogEntry, Place, SuiteFile
from sonar_graph.calibration import Section
from sonar_graph.errors import (
    BatchError,
    EstimatorError,
    SonarGraphError,
    UnknownEstimatorError,
)
from sonar_graph.estimator import installed_estimators, is_foreign, load_estimator
from sonar_graph.evaluation import LIBRARIES, check_request
from sonar_graph.settings import faults_in, field_place, flattened, nested
from sonar_graph.simulation import LandmarkOptions
from sonar_graph.version import __version__

DIGITS = 16
KEY_DIGITS = 20
BYTECODE = "__pycache__"
DEFAULT_VARIANT = "default"
# options that a suite gives elsewhere, and where
ELSEWHERE = {
    "seed": "seeds are given as seeds = [...]",
    "image": "recognise landmarks first, and give the log",
}


@dataclass(frozen=True)
class _Source:
    place: Place
    entry: LogEntry
    name: str
    options: dict[str, Any]
    content: dict[str, Any]
    stated: dict[str, Any]
    """Options that the suite gives, without those that name files."""


@dataclass(frozen=True)
class _Contestant:
    place: Place
    name: str
    variant: str
    overrides: dict[str, Any]
    params: dict[str, Any]


def plan_runs(file: SuiteFile) -> list[PlannedRun]:
    """Plan all runs of a suite, in its order; the estimators of one log follow each other.

    Raises
    ------
    BatchError
        When the suite names something that does not exist or does not fit, or one run twice.

    Examples
    --------
    >>> from pathlib import Path
    >>> from sonar_graph.batch import plan_runs
    >>> from sonar_graph.batch.suite import EstimatorEntry, LogEntry, Suite, SuiteFile
    >>> basin, alone = LogEntry(name="basin", generator="basin", seeds=2), EstimatorEntry(name="dead-reckoning")
    >>> suite = Suite(name="lap", reference=alone.name, logs=[basin], estimators=[alone])
    >>> len(plan_runs(SuiteFile(Path("lap.toml"), "", suite)))
    2
    """
    contestants = contestants_of(file)
    rate_hz = file.suite.rate_hz
    by_key: dict[str, PlannedRun] = {}
    for source in sources_of(file):
        for seed, contestant in itertools.product(
            source.entry.seed_list(), contestants
        ):
            # equal keys promise equal numbers, also after an update of a library
            versions = versions_of(contestant.name)
            decides = {
                "content": source.content,
                "landmarks": source.entry.landmarks,
                "seed": seed,
                "estimator": contestant.name,
                "params": contestant.params,
                "rate_hz": rate_hz,
                "versions": versions,
            }
            # sorted, so that the order of settings in a suite changes no key
            text = json.dumps(decides, sort_keys=True, default=str)
            hashed = source.content.keys() & {*FILES, FILE}
            asked = {
                "generator": source.entry.kind,
                "options": source.stated,
                "files": {name: source.content[name] for name in hashed},
                "landmarks": source.entry.landmarks,
                "settings": contestant.overrides,
                "rate_hz": rate_hz,
            }
            run = PlannedRun(
                key=hashlib.sha256(text.encode()).hexdigest()[:KEY_DIGITS],
                suite=file.suite.name,
                log=source.name,
                kind=source.entry.kind,
                options=source.options,
                content=source.content,
                landmarks=source.entry.landmarks,
                seed=seed,
                estimator=contestant.name,
                variant=contestant.variant,
                overrides=contestant.overrides,
                params=contestant.params,
                rate_hz=rate_hz,
                versions=versions,
                asked=asked,
            )
            # a run that is there twice would count its seed twice
            twin = by_key.setdefault(run.key, run)
            if twin is not run:
                which = "" if seed is None else f", seed {seed}"
                file.refuse(
                    contestant.place if twin.log == run.log else source.place,
                    f"{run.log!r}, {run.estimator}/{run.variant}{which}: is the same run as {twin.log!r}, "
                    f"{twin.estimator}/{twin.variant}; leave one out",
                )
    return list(by_key.values())


def contestants_of(file: SuiteFile) -> list[_Contestant]:
    """Estimators with their settings, grids multiplied out; no two of one name.

    Raises `BatchError` with file, line and key.
    """
    found: list[_Contestant] = []
    for number, entry in enumerate(file.suite.estimators):
        place: Place = ("estimators", number)
        # settings of a foreign estimator are checked in its own process
        model: type[Section] | None = None
        try:
            if not (foreign := is_foreign(entry.name)):
                model = load_estimator(entry.name).Params
        except UnknownEstimatorError as error:
            file.refuse((*place, "name"), str(error))
        except EstimatorError:  # its runs fail with the reason, and the others go on
            pass
        for chosen in _combinations(file, place, entry.grid, entry.params, "params"):
            given = values = nested(chosen, entry.params)
            if model is not None:
                table = _table_of(chosen, "params")
                params = _validated(file, place, model, given, table)
                values = params.model_dump(mode="json")
            elif foreign:
                try:
                    values = check_request(entry.name, given) or given
                except EstimatorError as error:
                    file.refuse(
                        (*place, "params" if entry.params else "name"), str(error)
                    )
            variant = _label(entry.variant, chosen) or DEFAULT_VARIANT
            found.append(_Contestant(place, entry.name, variant, given, values))
    # two contestants of one name would look the same in tables
    by_name: dict[str, _Contestant] = {}
    for contestant in found:
        name = f"{contestant.name}/{contestant.variant}"
        if by_name.setdefault(name, contestant) is not contestant:
            file.refuse(
                contestant.place,
                f"{name} is there twice; give variants names that differ, or leave one out",
            )
    name, _, variant = file.suite.reference.partition("/")
    if f"{name}/{variant or DEFAULT_VARIANT}" not in by_name:
        known = ", ".join(one.removesuffix(f"/{DEFAULT_VARIANT}") for one in by_name)
        file.refuse(
            ("reference",),
            f"{file.suite.reference!r} does not run here; what does: {known}",
        )
    return found


def sources_of(file: SuiteFile) -> list[_Source]:
    """Logs and simulations, grids multiplied out; no two of one name.

    An entry with `obtain` is left out where its files are absent.

    Raises `BatchError` with file, line and key.
    """
    found: list[_Source] = []
    for number, entry in enumerate(file.suite.logs):
        place: Place = ("logs", number)
        what = "dataset"
        known = DATASETS
        if entry.generator is not None:
            what = "generator"
            known = GENERATORS
        if entry.log is None and entry.kind not in known:
            file.refuse(
                (*place, what),
                f"there is no {what} {entry.kind!r}; there are: {', '.join(known)}",
            )
        for section, given in (
            ("options", {*entry.options, *entry.grid}),
            ("landmarks", {*(entry.landmarks or {})}),
        ):
            for name in given & ELSEWHERE.keys():
                file.refuse(
                    (*place, section, name),
                    f"cannot be set in a suite: {ELSEWHERE[name]}",
                )
        if not entry.seed_list():
            file.refuse(
                (*place, "seeds"),
                "has no seeds; give a number from 1 on, or a list of them",
            )
        if entry.landmarks is not None:
            _validated(file, (*place, "landmarks"), LandmarkOptions, entry.landmarks)
        for chosen in _combinations(file, place, entry.grid, entry.options, "options"):
            of_log = {} if entry.log is None else {"log": entry.log}
            values = of_log | entry.options | chosen
            named = [name for name in FILES if isinstance(values.get(name), str)]
            # a suite that ships must run without the data sets that cannot be shipped
            if entry.obtain and not all(file.holds(values[name]) for name in named):
                continue
            for name in named:
                where = ("log",) if name == "log" else ("options", name)
                values[name] = file.find((*place, *where), values[name])
            kind = KINDS[entry.kind]
            table = _table_of(chosen, "options")
            options = _validated(file, place, kind.options, values, table)
            try:
                kind.check(options)
            except SonarGraphError as error:
                file.refuse((*place, "log" if of_log else "options"), str(error))
            plain = options.model_dump(mode="json", exclude={"seed"})
            content = fingerprint(entry.kind, plain)
            stated = {name: values[name] for name in values if name not in FILES}
            label = _label(entry.name, chosen)
            found.append(_Source(place, entry, label, plain, content, stated))
    if not found:
        file.refuse(
            ("logs",),
            f"no data of any log is here; get {'; '.join(e.obtain for e in file.suite.logs)}",
        )
    # two logs of one name would share a panel
    by_name: dict[str, _Source] = {}
    for source in found:
        if source.name == ALL_LOGS:
            file.refuse(
                (*source.place, "name"),
                f"{ALL_LOGS!r} stands for all logs together; give another name",
            )
        if by_name.setdefault(source.name, source) is not source:
            file.refuse(
                source.place,
                f"two logs are called {source.name!r}; give them names that differ",
            )
    return found


def _combinations(
    file: SuiteFile,
    place: Place,
    grid: dict[str, list[Any]],
    fixed: dict[str, Any],
    table: str,
) -> Iterator[dict[str, Any]]:
    """Every combination of a grid's values.

    Raises `BatchError` when a name is also fixed, has no values, or has a value twice.
    """
    for name, values in grid.items():
        at = (*place, "grid", *name.split("."))
        if name in flattened(fixed):
            file.refuse(at, f"is also in {table}; give it in one of them")
        if not values:
            file.refuse(at, "has no values; give at least one")
        # values may be lists, which cannot be compared by a set
        texts = [json.dumps(value, default=str) for value in values]
        if len(set(texts)) < len(texts):
            twice = next(text for text in texts if texts.count(text) > 1)
            file.refuse(at, f"has {twice} more than once; leave one out")
    for chosen in itertools.product(*grid.values()):
        yield dict(zip(grid, chosen, strict=True))


def _table_of(chosen: dict[str, Any], table: str) -> Callable[[str], str]:
    """Table of a suite's entry in which a setting is given."""
    in_grid = {name.split(".")[0] for name in chosen}
    return lambda name: "grid" if name in in_grid else "log" if name == "log" else table


def _validated(
    file: SuiteFile,
    place: Place,
    model: type[Section],
    values: Any,
    table: Callable[[str], str] | None = None,
) -> Section:
    """Values as their model; a fault is reported where the suite gives the value."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        at = field_place(model, error.errors()[0]["loc"])
        table_name = (table(str(at[0])),) if table and at else ()
        file.refuse((*place, *table_name, *at), faults_in(error, model))


def _label(name: str, chosen: dict[str, Any]) -> str:
    """Name with the values that a grid chose."""
    parts = [name, *(f"{key}={value}" for key, value in chosen.items())]
    return ", ".join(filter(None, parts))


@lru_cache
def versions_of(estimator: str) -> dict[str, str]:
    """Versions that decide the numbers, with that of the package that brings the estimator, and hashes of both sources.

    Raises `BatchError` when this machine does not have the estimator.
    """
    point = installed_estimators().get(estimator)
    if point is None:
        raise BatchError(
            f"{platform.node()}: no estimator is called {estimator!r}; install what brings it"
        )
    # a target that is no name of Python is refused where the estimator is loaded
    module = point.value.partition(":")[0]
    brings = {} if point.dist is None else {point.dist.name: point.dist.version}
    return brings | {
        "sonar_graph": __version__,
        **{library: version(library) for library in LIBRARIES},
        "python": platform.python_version(),
        "estimator_target": point.value,
        "source": source_hash("sonar_graph"),
        "estimator_source": source_hash(module.partition(".")[0]),
    }


@lru_cache
def source_hash(package: str) -> str:
    """SHA-256 over names and content of the files of a top-level package or module, cut to `DIGITS`.

    Data in the package counts like code; bytecode, hidden files and the place of installation do not. The hash is taken
    once in a process, before the first code of the package decides a number. The package is not imported.

    Returns hexadecimal digits; empty if there is no such package.
    """
    spec = find_spec(package)
    if spec is None:
        return ""
    # a namespace package has several folders, a module none
    places = spec.submodule_search_locations or filter(None, [spec.origin])
    return "-".join(
        hash_of(Path(place), _is_no_source)[:DIGITS]
        for place in places
        if Path(place).exists()
    )


def _is_no_source(name: str) -> bool:
    return name == BYTECODE or name.startswith(".")
