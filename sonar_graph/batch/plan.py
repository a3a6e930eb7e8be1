"""From a suite to the list of its runs, each with a key that says what it is.

What code a package is, told by its content: a version number says nothing of a checkout that was changed.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import ValidationError

import sonar_graph
from sonar_graph.batch.recorded import ALL_LOGS
from sonar_graph.batch.sources import FILE, FILES, GENERATORS, KINDS, LOG, Stamp, files_below, fingerprint, stamp_of
from sonar_graph.batch.store import PlannedRun
from sonar_graph.batch.suite import EstimatorEntry, LogEntry, Place, SuiteFile
from sonar_graph.calibration import Section
from sonar_graph.errors import BatchError, EstimatorError, SonarGraphError, UnknownEstimatorError
from sonar_graph.estimator import installed_estimators, load_estimator
from sonar_graph.settings import faults_in, field_place, flattened, nested
from sonar_graph.simulation import LandmarkOptions

DIGITS = 16
BYTECODE = "__pycache__"
StampedFile = tuple[str, str, Stamp]
"""Its name within the package, path, and stamp."""


@lru_cache
def source_hash(package: str) -> str:
    """SHA-256 over names and content of the files of a top-level package or module, cut to `DIGITS`.

    Data in the package counts like code; bytecode, hidden files and the place where it is installed do not. Taken once
    in a process, before the first code of it decides a number; `source_hash_now` tells whether it still holds. The
    package is not imported.

    Returns
    -------
    Hexadecimal digits; empty where there is no such package.
    """
    return source_hash_now(package)


def source_hash_now(package: str) -> str:
    """`source_hash` of what is on the disk at this moment; files are read again only where their stamps changed."""
    files = tuple(sorted(_stamped_files(package)))
    return _digest(files) if files else ""


@lru_cache(maxsize=8)
def _digest(files: tuple[StampedFile, ...]) -> str:
    digest = hashlib.sha256()
    for name, path, _ in files:
        _add(digest, name, Path(path))
    return digest.hexdigest()[:DIGITS]


def _stamped_files(package: str) -> Iterator[StampedFile]:
    spec = find_spec(package)
    if spec is None:
        return
    folders = list(spec.submodule_search_locations or ())
    for folder in folders:
        for entry in files_below(folder, _is_no_source):
            yield entry.path[len(folder) + 1 :].replace(os.sep, "/"), entry.path, stamp_of(entry)
    if not folders and spec.origin is not None and (module := Path(spec.origin)).is_file():
        yield module.name, spec.origin, stamp_of(module)


def _is_no_source(name: str) -> bool:
    return name == BYTECODE or name.startswith(".")


def _add(digest: hashlib._Hash, name: str, path: Path) -> None:
    """With lengths, so that no two sets of files give the same bytes."""
    content = path.read_bytes()
    digest.update(f"{len(name.encode())} {name} {len(content)} ".encode())
    digest.update(content)


KEY_DIGITS = 20
DEFAULT_VARIANT = "default"


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
    """All runs of a suite, in its order; the estimators of one log follow each other.

    Raises
    ------
    BatchError
        When the suite names what does not exist or does not fit, or one run twice.
    """
    contestants = [c for n, entry in enumerate(file.suite.estimators) for c in _contestants(file, n, entry)]
    _check_contestants_once(file, contestants)
    _check_reference(file, contestants)
    sources = [s for n, entry in enumerate(file.suite.logs) for s in _sources(file, n, entry)]
    _check_sources_once(file, sources)
    return [
        _planned(file, source, seed, contestant)
        for source in sources
        for seed in source.entry.seed_list()
        for contestant in contestants
    ]


@lru_cache
def versions_of(estimator: str) -> dict[str, str]:
    """Versions that decide the numbers, with that of the package that brings the estimator, and hashes of both sources.

    Raises
    ------
    BatchError
        When this machine does not have the estimator.
    """
    point = _installed(estimator)
    brings = {} if point.dist is None else {point.dist.name: point.dist.version}
    return brings | {
        "sonar_graph": sonar_graph.__version__,
        "gtsam": version("gtsam"),
        "numpy": version("numpy"),
        "scipy": version("scipy"),
        "numba": version("numba"),
        "python": platform.python_version(),
        "estimator_target": point.value,
        "source": source_hash("sonar_graph"),
        "estimator_source": source_hash(_package(point.value)),
    }


def sources_now(target: str) -> dict[str, str]:
    """The hashes of `versions_of` as the disk has them at this moment, of its ``estimator_target``."""
    packages = {"source": "sonar_graph", "estimator_source": _package(target)}
    hashes = {package: source_hash_now(package) for package in set(packages.values())}
    return {name: hashes[package] for name, package in packages.items()}


def _package(target: str) -> str:
    """The top-level package of what an entry point leads to."""
    return target.partition(":")[0].partition(".")[0]


def _installed(estimator: str) -> EntryPoint:
    point = installed_estimators().get(estimator)
    if point is None:
        raise BatchError(f"{platform.node()}: no estimator is called {estimator!r}; install what brings it")
    return point


def _sources(file: SuiteFile, number: int, entry: LogEntry) -> Iterator[_Source]:
    place = ("logs", number)
    _check_source(file, place, entry)
    for chosen in _combinations(file, place, entry.grid, entry.options, "options"):
        values = entry.options | chosen
        if entry.log is not None:
            values = {"log": entry.log, **values}
        for name in FILES:
            if isinstance(values.get(name), str):
                where = (*place, name) if name == "log" else (*place, "options", name)
                values[name] = file.find(where, values[name])
        options = _checked(file, place, chosen, KINDS[entry.kind].options, values)
        try:
            KINDS[entry.kind].check(options)
        except SonarGraphError as error:
            file.refuse((*place, "log" if entry.log is not None else "options"), str(error))
        plain = options.model_dump(mode="json", exclude={"seed"})
        stated = {name: value for name, value in values.items() if name not in FILES}
        yield _Source(place, entry, _label(entry.name, chosen), plain, fingerprint(entry.kind, plain), stated)


def _check_source(file: SuiteFile, place: Place, entry: LogEntry) -> None:
    known = [name for name in KINDS if name != LOG and (name in GENERATORS) == (entry.generator is not None)]
    what = "generator" if entry.generator is not None else "dataset"
    if entry.kind != LOG and entry.kind not in known:
        file.refuse((*place, what), f"there is no {what} {entry.kind!r}; there are: {', '.join(known)}")
    for name in {"seed", "image"} & {*entry.options, *entry.grid}:
        reason = "seeds are given as seeds = [...]" if name == "seed" else "recognise landmarks first, and give the log"
        file.refuse((*place, "options", name), f"cannot be set in a suite: {reason}")
    if not entry.seed_list():
        file.refuse((*place, "seeds"), "has no seeds; give a number from 1 on, or a list of them")
    if entry.landmarks is not None:
        if "seed" in entry.landmarks:
            file.refuse((*place, "landmarks", "seed"), "cannot be set in a suite: seeds are given as seeds = [...]")
        _validated(file, (*place, "landmarks"), LandmarkOptions, entry.landmarks)


def _contestants(file: SuiteFile, number: int, entry: EstimatorEntry) -> Iterator[_Contestant]:
    place: Place = ("estimators", number)
    try:
        params: type[Section] | None = load_estimator(entry.name).Params
    except UnknownEstimatorError as error:
        file.refuse((*place, "name"), str(error))
    except EstimatorError:  # its runs fail with the reason, and the others go on
        params = None
    for chosen in _combinations(file, place, entry.grid, entry.params, "params"):
        given = values = nested(chosen, entry.params)
        if params is not None:
            values = _checked(file, place, chosen, params, given, "params").model_dump(mode="json")
        yield _Contestant(place, entry.name, _label(entry.variant, chosen) or DEFAULT_VARIANT, given, values)


def _combinations(
    file: SuiteFile, place: Place, grid: dict[str, list[Any]], fixed: dict[str, Any], table: str
) -> Iterator[dict[str, Any]]:
    for name, values in grid.items():
        at = (*place, "grid", *name.split("."))
        if name in flattened(fixed):
            file.refuse(at, f"is also in {table}; give it in one of them")
        if not values:
            file.refuse(at, "has no values; give at least one")
        texts = [json.dumps(value, default=str) for value in values]
        if len(set(texts)) < len(texts):
            twice = next(text for text in texts if texts.count(text) > 1)
            file.refuse(at, f"has {twice} more than once; leave one out")
    for chosen in itertools.product(*grid.values()):
        yield dict(zip(grid, chosen, strict=True))


def _checked(
    file: SuiteFile, place: Place, chosen: dict[str, Any], model: type[Section], values: Any, table: str = "options"
) -> Section:
    """Values as their model has them; a fault is told where the suite gives the value."""
    in_grid = {name.split(".")[0] for name in chosen}
    return _validated(
        file, place, model, values, lambda name: "grid" if name in in_grid else "log" if name == "log" else table
    )


def _validated(
    file: SuiteFile, place: Place, model: type[Section], values: Any, table: Callable[[str], str] | None = None
) -> Section:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        at = field_place(model, error.errors()[0]["loc"])
        table_name = (table(str(at[0])),) if table and at else ()
        file.refuse((*place, *table_name, *at), faults_in(error, model))


def _label(name: str, chosen: dict[str, Any]) -> str:
    """A name with what a grid chose."""
    return ", ".join([*([name] if name else []), *(f"{key}={value}" for key, value in chosen.items())])


def _planned(file: SuiteFile, source: _Source, seed: int | None, contestant: _Contestant) -> PlannedRun:
    versions, rate_hz = versions_of(contestant.name), file.suite.rate_hz
    decides = {
        "content": source.content,
        "landmarks": source.entry.landmarks,
        "seed": seed,
        "estimator": contestant.name,
        "params": contestant.params,
        "rate_hz": rate_hz,
        "versions": versions,
    }
    text = json.dumps(decides, sort_keys=True, default=str)
    return PlannedRun(
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
        asked=_asked(source, contestant, rate_hz),
    )


def _asked(source: _Source, contestant: _Contestant, rate_hz: float) -> dict[str, Any]:
    return {
        "generator": source.entry.kind,
        "options": source.stated,
        "files": {name: hashed for name, hashed in source.content.items() if name in (*FILES, FILE)},
        "landmarks": source.entry.landmarks,
        "settings": contestant.overrides,
        "rate_hz": rate_hz,
    }


def _check_reference(file: SuiteFile, contestants: list[_Contestant]) -> None:
    name, _, variant = file.suite.reference.partition("/")
    known = [(c.name, c.variant) for c in contestants]
    if (name, variant or DEFAULT_VARIANT) not in known:
        texts = [name if variant == DEFAULT_VARIANT else f"{name}/{variant}" for name, variant in known]
        file.refuse(("reference",), f"{file.suite.reference!r} does not run here; what does: {', '.join(texts)}")


def _check_contestants_once(file: SuiteFile, contestants: list[_Contestant]) -> None:
    """Refuse two contestants of one name, and one under two names."""
    by_name: dict[str, _Contestant] = {}
    by_settings: dict[str, str] = {}
    for contestant in contestants:
        name = f"{contestant.name}/{contestant.variant}"
        if by_name.setdefault(name, contestant) is not contestant:
            file.refuse(contestant.place, f"{name} is there twice; give variants names that differ, or leave one out")
        settings = json.dumps([contestant.name, contestant.params], sort_keys=True, default=str)
        if (twin := by_settings.setdefault(settings, name)) != name:
            file.refuse(contestant.place, f"{name} and {twin} have the same settings; leave one out")


def _check_sources_once(file: SuiteFile, sources: list[_Source]) -> None:
    """Refuse two logs of one name, and one log, with the same seed, under two names."""
    by_name: dict[str, _Source] = {}
    by_content: dict[str, str] = {}
    for source in sources:
        if source.name == ALL_LOGS:
            file.refuse((*source.place, "name"), f"{ALL_LOGS!r} stands for all logs together; give another name")
        if by_name.setdefault(source.name, source) is not source:
            file.refuse(source.place, f"two logs are called {source.name!r}; give them names that differ")
        for seed in source.entry.seed_list():
            content = json.dumps([source.content, source.entry.landmarks, seed], sort_keys=True, default=str)
            if (twin := by_content.setdefault(content, source.name)) != source.name:
                which = "" if seed is None else f" with seed {seed}"
                file.refuse(source.place, f"{source.name!r} and {twin!r} are the same{which}; leave one out")
