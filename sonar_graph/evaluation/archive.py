"""The arrays behind a report, in npz files, so that it can be drawn again without running anything.

Fields of one object share a prefix: ``causal.stamps_ns``, ``causal.positions``, ... An object that is absent has none.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import EvaluationError
from sonar_graph.evaluation.atomic import replacing
from sonar_graph.evaluation.results import ErrorSeries, Kind, MapSoFar, RunResult
from sonar_graph.measurements import Dvl, Imu, LandmarkDetections
from sonar_graph.sequence import Sequence
from sonar_graph.states import DetectionLog, LandmarkMap, Outcome, Refusal, RefusedRow, Trajectory

Arrays = dict[str, np.ndarray]
T = TypeVar("T")
KINDS: tuple[Kind, Kind] = ("causal", "smoothed")


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write named arrays, whole or not at all; not compressed, since noise in every digit hardly gets smaller.

    In memory first: an archive goes back to the head of each entry, and there are many small ones.
    """
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
    with replacing(path) as partial:
        partial.write_bytes(content.getbuffer())


def read_arrays(path: Path) -> Arrays:
    """The arrays of a file by name.

    Raises
    ------
    EvaluationError
        When the file is missing or damaged.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise EvaluationError(f"{path}: cannot be read as arrays ({error}); write the comparison anew") from error


def sequence_arrays(sequence: Sequence) -> Arrays:
    """Truth and detections, and of IMU and Doppler log the first and last row: what they measured is in the log."""
    ends = np.array([0, -1])
    arrays = _pack("imu", sequence.imu.rows(ends)) | _pack("dvl", sequence.dvl.rows(ends))
    arrays |= _pack_truth(sequence.truth) | _pack("true_landmarks", sequence.true_landmarks)
    return arrays | _pack("detections", sequence.detections)


def restore_sequence(name: str, calibration: Calibration, notes: dict[str, str], arrays: Arrays) -> Sequence:
    """A sequence with its start, end, detections and truth, but without its motion's measurements."""
    imu, dvl = _unpack("imu", Imu, arrays), _unpack("dvl", Dvl, arrays)
    if imu is None or dvl is None:
        raise EvaluationError("sequence.npz: the first and last rows of imu and dvl are missing")
    truth = _unpack_truth(arrays)
    true_landmarks = _unpack("true_landmarks", LandmarkMap, arrays)
    detections = _unpack("detections", LandmarkDetections, arrays)
    return Sequence(
        name, calibration, imu, dvl, detections=detections, truth=truth, true_landmarks=true_landmarks, notes=notes
    )


def _pack_truth(truth: Trajectory | None) -> Arrays:
    """Without covariances where none is known: they would be most of the file."""
    arrays = _pack("truth", truth)
    if truth is not None and np.isnan(truth.covariances).all():
        del arrays["truth.covariances"]
    return arrays


def _unpack_truth(arrays: Arrays) -> Trajectory | None:
    stamps_ns = arrays.get("truth.stamps_ns")
    if stamps_ns is None or "truth.covariances" in arrays:
        return _unpack("truth", Trajectory, arrays)
    unknown = np.full((len(stamps_ns), 6, 6), np.nan)
    return _unpack("truth", Trajectory, arrays | {"truth.covariances": unknown})


def run_arrays(run: RunResult, errors: dict[Kind, ErrorSeries]) -> Arrays:
    """All arrays of one run, and its errors."""
    arrays = {"update_s": run.update_s}
    for kind in KINDS:
        arrays |= _pack(kind, getattr(run, kind)) | _pack(f"errors.{kind}", errors.get(kind))
    for number, known in enumerate(run.maps):
        arrays |= {f"maps.{number}.stamp_ns": np.asarray(known.stamp_ns)} | _pack(f"maps.{number}", known.landmarks)
    arrays |= {f"refused.{name}": np.array([getattr(row, name) for row in run.refused]) for name in RefusedRow._fields}
    return arrays | _pack("landmarks", run.landmarks) | _pack("detections", run.detections)


def restore_run(run: RunResult, arrays: Arrays) -> RunResult:
    """A run with its arrays put back."""
    return RunResult(
        run.estimator,
        run.params,
        run.status,
        run.reason,
        causal=_unpack("causal", Trajectory, arrays),
        smoothed=_unpack("smoothed", Trajectory, arrays),
        landmarks=_unpack("landmarks", LandmarkMap, arrays),
        detections=_unpack("detections", DetectionLog, arrays),
        refused=_restore_refused(arrays),
        withheld=run.withheld,
        maps=_restore_maps(arrays),
        update_s=arrays["update_s"],
        finish_s=run.finish_s,
        peak_memory_mb=run.peak_memory_mb,
    )


def _restore_maps(arrays: Arrays) -> list[MapSoFar]:
    """The maps of a run in order."""
    maps: list[MapSoFar] = []
    while (landmarks := _unpack(f"maps.{len(maps)}", LandmarkMap, arrays)) is not None:
        maps.append(MapSoFar(int(arrays[f"maps.{len(maps)}.stamp_ns"]), landmarks))
    return maps


def _restore_refused(arrays: Arrays) -> list[RefusedRow]:
    columns = [arrays[f"refused.{name}"].tolist() for name in RefusedRow._fields]
    rows = zip(*columns, strict=True)
    return [RefusedRow(sensor, stamp_ns, Refusal(reason), distance) for sensor, stamp_ns, reason, distance in rows]


def restore_errors(arrays: Arrays) -> dict[Kind, ErrorSeries]:
    """The errors of one run."""
    found = {kind: _unpack(f"errors.{kind}", ErrorSeries, arrays) for kind in KINDS}
    return {kind: series for kind, series in found.items() if series is not None}


def _pack(prefix: str, record: Any) -> Arrays:
    """The fields of a dataclass as arrays; nothing for None."""
    if record is None:
        return {}
    return {f"{prefix}.{field.name}": np.asarray(getattr(record, field.name)) for field in fields(record)}


def _unpack(prefix: str, kind: type[T], arrays: Arrays) -> T | None:
    """The dataclass that `_pack` took apart; None where it was absent.

    Raises
    ------
    EvaluationError
        Naming the field that is missing.
    """
    columns = fields(kind)  # type: ignore[arg-type]  # every kind here is a dataclass
    stored = [column.name for column in columns if f"{prefix}.{column.name}" in arrays]
    if not stored:
        return None
    missing = [c.name for c in columns if c.name not in stored and c.default_factory is MISSING]
    if missing:
        raise EvaluationError(f"stored {prefix} lacks {', '.join(missing)}; write the comparison anew")
    return kind(**{name: _plain(name, arrays[f"{prefix}.{name}"]) for name in stored})


def _plain(name: str, array: np.ndarray) -> Any:
    """What a field held before it became an array."""
    if name == "outcomes":
        return [Outcome(text) for text in array.tolist()]
    return array.item() if array.ndim == 0 else array
