"""Storage: a comparison as a folder, and back.

::

    DIR/comparison.json         scores with units and protocol, states of the runs, settings, environment
    DIR/sequence.npz            truth, true landmarks, detections and instants
    DIR/recognition.json, recognised/STAMP.jpg
                                recognition of landmarks in sonar images, and the pictures that the report shows
    DIR/runs/NAME/trajectory.tum, causal.tum, landmarks.csv
                                the estimates, for other tools; absent when the run failed
    DIR/runs/NAME/map.toml      the landmarks with their joint covariance, for `--map` of another run
    DIR/runs/NAME/series.npz    everything as arrays, with covariances
    DIR/result.mcap             all of it for viewers, with layouts for Foxglove and RViz beside it

All files change together, when all are written (`sonar_graph.files`): those of an earlier comparison stay until then.
In npz files the fields of one object share a prefix: ``causal.stamps_ns``, ``causal.positions``, ...; an
absent object has no fields.
"""

import io
import zipfile
from collections.abc import Iterable
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import TypeAdapter

from sonar_graph.calibration import Calibration
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.results import (
    ByName,
    Comparison,
    ErrorSeries,
    Kind,
    MapSoFar,
    RunResult,
    Score,
    gathered,
)
from sonar_graph.files import (
    COMPARISON,
    as_path,
    read_json,
    regular,
    replacing,
    result_written,
    write_json,
)
from sonar_graph.logs import Picture, write_landmarks_csv, write_result, write_tum
from sonar_graph.map_file import write_map
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.settings import parse
from sonar_graph.states import (
    DetectionLog,
    LandmarkMap,
    Outcome,
    Refusal,
    RefusedRow,
    Trajectory,
)

Arrays = dict[str, np.ndarray]
T = TypeVar("T")
KINDS: tuple[Kind, Kind] = ("causal", "smoothed")
FORMAT = "sonar_graph comparison 1"
INDEX = "comparison.json"
SEQUENCE = "sequence.npz"
RUNS = "runs"
SERIES = "series.npz"
RESULT_LOG = "result.mcap"
PAGE = "report.html"
# as `sonar_graph.recognition` names them, which is loaded where something was recognised
RECOGNITION = "recognition.json"
PICTURE_FOLDER = "recognised"
ESTIMATES = ("trajectory.tum", "causal.tum", "landmarks.csv", "map.toml")
# blocks of a sequence that are stored; of IMU and Doppler log the first and last rows, as all others are in the log
IN_ARRAYS: dict[str, type[Any]] = {
    "imu": Imu,
    "dvl": Dvl,
    "detections": LandmarkDetections,
    "truth": Trajectory,
    "true_landmarks": LandmarkMap,
}
# the same of a run
IN_SERIES: dict[str, type[Any]] = {
    "causal": Trajectory,
    "smoothed": Trajectory,
    "landmarks": LandmarkMap,
    "detections": DetectionLog,
}
# types of what people may have edited in ``comparison.json``
_SCORE = TypeAdapter(Score)
_TEXTS = TypeAdapter(dict[str, str])
_STATUS: TypeAdapter[Literal["ok", "failed"]] = TypeAdapter(Literal["ok", "failed"])


def result_names(estimators: Iterable[str]) -> list[str]:
    """Names that a comparison of these estimators may write; pictures are named by their stamps."""
    of_runs = [
        f"{RUNS}/{name}/{file}" for name in estimators for file in (*ESTIMATES, SERIES)
    ]
    layouts = ("result.foxglove.json", "result.rviz")
    return [
        INDEX,
        SEQUENCE,
        RECOGNITION,
        f"{PICTURE_FOLDER}/0.jpg",
        RESULT_LOG,
        *layouts,
        *of_runs,
    ]


def write_comparison(comparison: Comparison, folder: Path) -> None:
    """Write a comparison into a folder, made where it does not exist.

    Files of an earlier comparison are replaced or removed, as far as they are as they were written; all others stay.

    Raises
    ------
    EvaluationError
        When an estimator's name cannot be the name of a folder; another command writes there; or a file would be
        replaced that this package did not write.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from sonar_graph import compare
    >>> from sonar_graph.evaluation import write_comparison
    >>> from sonar_graph.testing import small_world
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_comparison(compare(small_world(), ["dead-reckoning"]), Path(folder))
    ...     sorted(path.name for path in Path(folder).glob("[!.]*"))
    ['comparison.json', 'runs', 'sequence.npz']
    """
    # the name becomes a folder: one with a separator would leave the folder that was given
    names = [run.estimator for run in comparison.runs]
    for name in names:
        if name in ("", ".", "..") or set(name) & set('/\\:*?"<>|'):
            raise EvaluationError(
                f"estimator name {name!r} cannot name a folder; install it under another name"
            )
    folders = (f"{RUNS}/", f"{PICTURE_FOLDER}/")
    with result_written(folder, COMPARISON) as written:
        earlier = (name for name in written.names if name.startswith(folders))
        # a page or a run of an earlier comparison would contradict the new numbers
        written.remove([INDEX, PAGE, RECOGNITION, *earlier])
        _write(comparison, folder)


def _write(comparison: Comparison, folder: Path) -> None:
    sequence = comparison.sequence
    ends = np.array([0, -1])
    instants = comparison.instants_ns
    blocks = {name: getattr(sequence, name) for name in IN_ARRAYS}
    blocks |= {name: blocks[name].rows(ends) for name in ("imu", "dvl")}
    arrays = _packed(blocks | {"instants_ns": instants})
    if sequence.truth is not None and np.isnan(sequence.truth.covariances).all():
        del arrays["truth.covariances"]  # they would be most of the file
    _write_arrays(folder / SEQUENCE, arrays)
    # by name, since tools look up one run
    entries = {}
    for run in comparison.runs:
        _write_run(run, comparison, folder / RUNS / run.estimator)
        scores = comparison.scores.get(run.estimator, {})
        entries[run.estimator] = {
            "status": run.status,
            "reason": run.reason,
            "params": run.params,
            "finish_s": run.finish_s,
            "peak_memory_mb": run.peak_memory_mb,
            "refused": [asdict(rows) for rows in gathered(run.refused)],
            "withheld": run.withheld,
            "scores": {key: asdict(score) for key, score in scores.items()},
        }
    if comparison.recognition is not None:
        from sonar_graph.recognition import write_recognition

        write_recognition(comparison.recognition, folder)
    index = {
        "format": FORMAT,
        "sequence": {
            "name": sequence.name,
            "duration_s": sequence.duration_s,
            "notes": sequence.notes,
            "calibration": sequence.calibration.model_dump(mode="json"),
        },
        "instants": {
            "count": len(instants),
            "first_ns": int(instants[0]),
            "last_ns": int(instants[-1]),
        },
        "environment": comparison.environment,
        "runs": entries,
    }
    write_json(folder / INDEX, index)


def _write_run(run: RunResult, comparison: Comparison, folder: Path) -> None:
    """The files of one run: trajectories and map for other tools, and all arrays."""
    if (estimates := _estimates(run)) is not None:
        causal, smoothed, landmarks = estimates
        write_tum(folder / "trajectory.tum", smoothed)
        write_tum(folder / "causal.tum", causal)
        write_landmarks_csv(folder / "landmarks.csv", landmarks)
    if run.known_map is not None:
        write_map(folder / "map.toml", run.known_map)
    errors = comparison.errors.get(run.estimator, {})
    blocks: dict[str, Any] = {
        name: getattr(run, name) for name in ("update_s", *IN_SERIES)
    }
    blocks |= {f"errors.{kind}": errors.get(kind) for kind in KINDS}
    for number, known in enumerate(run.maps):
        place = f"maps.{number}"
        blocks |= {f"{place}.stamp_ns": known.stamp_ns, place: known.landmarks}
    for name in RefusedRow._fields:
        blocks[f"refused.{name}"] = [getattr(row, name) for row in run.refused]
    _write_arrays(folder / SERIES, _packed(blocks))


def _estimates(run: RunResult) -> tuple[Trajectory, Trajectory, LandmarkMap] | None:
    """Causal path, smoothed path and map; None where one is missing."""
    if run.causal is None or run.smoothed is None or run.landmarks is None:
        return None
    return run.causal, run.smoothed, run.landmarks


def write_viewer_files(comparison: Comparison, folder: Path) -> None:
    """Write ``result.mcap``, ``result.foxglove.json`` and ``result.rviz`` beside the files of `write_comparison`.

    Versions, date and command are in the metadata of ``result.mcap``.

    Raises
    ------
    LogError
        When a file cannot be written, or a stamp does not fit into a ROS 2 message.
    """
    estimates = {
        run.estimator: known
        for run in comparison.runs
        if (known := _estimates(run)) is not None
    }
    # viewers show the pictures along the time of the run
    drawn = comparison.recognition.pictures if comparison.recognition else []
    pictures = [Picture(picture.stamp_ns, picture.jpeg) for picture in drawn]
    with result_written(folder, COMPARISON):
        write_result(
            folder / RESULT_LOG,
            comparison.sequence,
            estimates,
            comparison.environment,
            pictures=pictures,
        )


def read_comparison(folder: str | Path) -> Comparison:
    """The comparison in a folder. Its sequence has start, end, truth and notes, but not the measurements.

    Raises
    ------
    EvaluationError
        When the folder holds no complete comparison, naming the file at fault.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from sonar_graph import compare
    >>> from sonar_graph.evaluation import read_comparison, write_comparison
    >>> from sonar_graph.testing import small_world
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_comparison(compare(small_world(), ["dead-reckoning"]), Path(folder))
    ...     [run.estimator for run in read_comparison(Path(folder)).runs]
    ['dead-reckoning']
    """
    folder = as_path(folder, "read_comparison(folder)")
    if not (folder / INDEX).is_file():
        raise EvaluationError(
            f"{folder}: no {INDEX} in it; it needs a folder that a comparison was written to"
        )
    index = read_json(folder / INDEX)
    # another format may have the same keys with other meanings
    if index.get("format") != FORMAT:
        raise EvaluationError(
            f"{folder / INDEX}: format is {index.get('format')!r}, expected {FORMAT!r}; compare anew"
        )
    try:
        return _restore(index, folder)
    # people edit JSON: a wrong value must name the file and not end in a traceback
    except (KeyError, TypeError, ValueError) as error:
        raise EvaluationError(
            f"{folder}: incomplete, {error} is missing or not as written; compare anew"
        ) from error


def _restore(index: dict[str, Any], folder: Path) -> Comparison:
    """The comparison that ``comparison.json`` and the arrays describe."""
    of_sequence = _read_arrays(folder / SEQUENCE)
    runs: list[RunResult] = []
    scores: dict[str, dict[str, Score]] = ByName()
    errors: dict[str, dict[Kind, ErrorSeries]] = {}
    for name, entry in index["runs"].items():
        arrays = _read_arrays(folder / RUNS / name / SERIES)
        runs.append(_restore_run(name, entry, arrays))
        # JSON has no NaN, which was written as null
        scores[name] = ByName()
        for key, score in entry["scores"].items():
            if score["value"] is None:
                score["value"] = np.nan
            scores[name][key] = _SCORE.validate_python(score)
        # without a truth no run has errors, not even none
        if len(of_sequence.get("truth.stamps_ns", ())):
            errors[name] = {
                kind: series
                for kind in KINDS
                if (series := _unpack(f"errors.{kind}", ErrorSeries, arrays))
            }
    recognition = None
    if (folder / RECOGNITION).is_file():
        from sonar_graph.recognition import read_recognition

        recognition = read_recognition(folder)
    entry = index["sequence"]
    calibration = parse(Calibration, entry["calibration"], str(folder / INDEX))
    return Comparison(
        sequence=_restore_sequence(
            entry["name"],
            calibration,
            _TEXTS.validate_python(entry["notes"]),
            of_sequence,
        ),
        instants_ns=of_sequence["instants_ns"],
        runs=runs,
        scores=scores,
        errors=errors,
        environment=_TEXTS.validate_python(index["environment"]),
        recognition=recognition,
    )


def _write_arrays(path: Path, arrays: Arrays) -> None:
    """Write named arrays, whole or not at all; not compressed, since noise in every digit hardly gets smaller.

    The archive is built in memory: writing it goes back to the head of each of many small entries.
    """
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]  # the stubs take the arrays for its flags
    with replacing(path) as partial:
        partial.write_bytes(content.getbuffer())


def _read_arrays(path: Path) -> Arrays:
    """The arrays of a file by name.

    Raises `EvaluationError` when the file is missing or damaged.
    """
    try:
        with (
            regular(path).open("rb") as file,
            np.load(file, allow_pickle=False) as archive,
        ):
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise EvaluationError(
            f"{path}: cannot be read as arrays ({error}); write the comparison anew"
        ) from error


def _restore_sequence(
    name: str, calibration: Calibration, notes: dict[str, str], arrays: Arrays
) -> Sequence:
    """A sequence with its start, end, detections and truth, but without its motion's measurements."""
    if "truth.stamps_ns" in arrays:
        unknown = np.full((len(arrays["truth.stamps_ns"]), 6, 6), np.nan)
        arrays = {"truth.covariances": unknown} | arrays
    blocks = _unpack_all(IN_ARRAYS, arrays)
    # start and end of the sequence are those of these rows
    if blocks["imu"] is None or blocks["dvl"] is None:
        raise EvaluationError(
            "sequence.npz: the first and last rows of imu and dvl are missing"
        )
    return Sequence(name, calibration, **blocks, notes=notes)


def _restore_run(name: str, entry: dict[str, Any], arrays: Arrays) -> RunResult:
    """A run from its entry in ``comparison.json`` and its arrays."""
    maps: list[MapSoFar] = []
    # maps are numbered from 0 without a gap
    while (landmarks := _unpack(f"maps.{len(maps)}", LandmarkMap, arrays)) is not None:
        maps.append(MapSoFar(int(arrays[f"maps.{len(maps)}.stamp_ns"]), landmarks))
    refused = zip(
        *(arrays[f"refused.{field}"].tolist() for field in RefusedRow._fields),
        strict=True,
    )
    # null on systems without a high-water mark
    memory = entry["peak_memory_mb"]
    return RunResult(
        name,
        entry["params"],
        _STATUS.validate_python(entry["status"]),
        str(entry["reason"]),
        **_unpack_all(IN_SERIES, arrays),
        refused=[
            RefusedRow(sensor, at_ns, Refusal(reason), distance)
            for sensor, at_ns, reason, distance in refused
        ],
        withheld=entry.get("withheld", []),
        maps=maps,
        update_s=arrays["update_s"],
        finish_s=entry["finish_s"],
        peak_memory_mb=float("nan") if memory is None else memory,
    )


def _packed(blocks: dict[str, Any]) -> Arrays:
    """Values as arrays, of a dataclass one for each field; nothing for None."""
    arrays: Arrays = {}
    for name, block in blocks.items():
        if is_dataclass(block):
            for field in fields(block):
                arrays[f"{name}.{field.name}"] = np.asarray(getattr(block, field.name))
        elif block is not None:
            arrays[name] = np.asarray(block)
    return arrays


def _unpack_all(kinds: dict[str, type[Any]], arrays: Arrays) -> dict[str, Any]:
    return {name: _unpack(name, kind, arrays) for name, kind in kinds.items()}


def _unpack(prefix: str, kind: type[T], arrays: Arrays) -> T | None:
    """The dataclass whose fields `_packed` stored; None where it was absent.

    Raises `EvaluationError` naming the field that is missing.
    """
    # fields with a default may be missing: an older version did not have them
    values: dict[str, Any] = {}
    missing = []
    for column in fields(kind):  # type: ignore[arg-type]  # every kind here is a dataclass
        array = arrays.get(f"{prefix}.{column.name}")
        if array is not None:
            # numbers were stored as arrays without dimensions
            values[column.name] = array.item() if array.ndim == 0 else array
        elif column.default_factory is MISSING:
            missing.append(column.name)
    if not values:
        return None
    if missing:
        raise EvaluationError(
            f"stored {prefix} lacks {', '.join(missing)}; write the comparison anew"
        )
    # npz has no enumerations: outcomes are stored as texts
    if "outcomes" in values:
        values["outcomes"] = [Outcome(text) for text in values["outcomes"].tolist()]
    return kind(**values)
