"""Failures, words and errors of all estimators on logs in which one sensor has a fault.

    python benchmarks/validation/sensor_faults.py [--quick] [--only REGULAR_EXPRESSION]

The logs: a simulated mission (``mission``), a vehicle at sea with landmarks simulated along its reference (``akit``,
trajectory 1, with the Doppler log's noise that fits this reference: `akit_landmarks`), a robot with its own detections
(``mrclam``, data set 6, robot 1). Each fault of `row_faults.py` is put into the messages of the log, which is written,
read and compared as the command line does it.

``named``: the terminal names the fault, in the words that `row_faults.py` expects and that it does not print for the
sound log; by ``compare``, or only by ``inspect``. ``excess``: position error (root mean square, causal, not aligned)
over its bound, which follows from the size of the fault::

    bound = 1.25 error + 0.05 m + shift + turn * distance

with the error on the log without the faulty rows (or the sound log), the displacement and the turn that the fault
implies, and the largest distance from the start. A fault that nobody can repair has no bound; it has to be named.
``slow``: a run that takes longer than `SLOW` times that on the sound log and `SLOW_S`, in time of the processor.
"""

import re
import signal
import sys
import tempfile
import time
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from io import StringIO
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import typer

sys.path.append(str(Path(__file__).resolve().parents[1]))
from akit_landmarks import SIGMA_AGAINST_REFERENCE_M_S
from common import conclude, in_parallel, make_parser, note, print_table, recording
from rich.console import Console
from row_faults import FAULTS, NS, Effect, Fault

from sonar_graph.cli.arguments import ReadingOptions
from sonar_graph.cli.compare import compare_prepared, prepared_log
from sonar_graph.cli.inspect_log import inspect
from sonar_graph.cli.recognise import RecogniserOptions
from sonar_graph.errors import SonarGraphError
from sonar_graph.logs import METADATA, detection_messages
from sonar_graph.logs.convert import read_akit, read_mrclam
from sonar_graph.logs.mcap import Outgoing, write_recording
from sonar_graph.logs.roles import TF
from sonar_graph.logs.vehicle_setup import encode_mountings
from sonar_graph.logs.writing import (
    depth_messages,
    dvl_messages,
    imu_messages,
    landmark_map_message,
    odometry_messages,
    static_message,
)
from sonar_graph.report import summary
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import (
    LandmarkOptions,
    MissionOptions,
    add_landmarks,
    simulate_mission,
)

ESTIMATORS = ["ekf-slam", "invariant-ekf", "isam2", "dead-reckoning"]
SENSORS = ("imu", "dvl", "depth", "detections")
FACTOR, ROUNDING_M = 1.25, 0.05
SLOW, SLOW_S, HUNG_S = 5.0, 5.0, 60.0
DURATION_S = 90.0
EPOCH_NS = 1_400_000_000 * NS
SOUND_LANDMARKS = LandmarkOptions(
    spacing_m=10.0, wrong_id_rate=0.0, false_detections_per_frame=0.0
)
QUICK = 12
"""Every so many of the cases."""


def log_of(data: Path, base: str) -> Sequence:
    """One of the sound logs."""
    if base == "mission":
        return simulate_mission(
            MissionOptions(duration_s=DURATION_S, frame_rate_hz=1.0)
        )
    archive, folder, read = {
        "akit": ("akit_1-7.tar.xz", "akit", read_akit),
        "mrclam": ("mrclam_ds6.tar.xz", "MRCLAM_Dataset6", read_mrclam),
    }[base]
    with recording(data, archive, folder) as where:
        whole = read(where, 1)
    ends = whole.start_ns - NS, whole.start_ns + round(DURATION_S * NS)
    blocks: dict[str, Any] = {
        name: block.between(*ends)
        for name in SENSORS
        if (block := getattr(whole, name))
    }
    blocks["truth"] = whole.truth
    if (
        base == "akit"
    ):  # whose stamps begin at 0, which in a log means that there is none
        blocks = {
            name: replace(block, stamps_ns=block.stamps_ns + EPOCH_NS)
            for name, block in blocks.items()
        }
    short = replace(whole, **blocks)
    if base != "akit":
        return short
    # along the reference, whose positions are not the sum of velocities
    seen = add_landmarks(short, SOUND_LANDMARKS)
    dvl = seen.calibration.dvl.model_copy(
        update={"velocity_sigma_m_s": SIGMA_AGAINST_REFERENCE_M_S}
    )
    return replace(seen, calibration=seen.calibration.model_copy(update={"dvl": dvl}))


@dataclass
class Rows:
    """Rows of the sensors as a faulty log has them, and the instants at which they are recorded."""

    sequence: Sequence
    sensors: dict[str, SimpleNamespace]

    @classmethod
    def of(cls, sequence: Sequence) -> "Rows":
        found = {}
        for name in SENSORS:
            if (block := getattr(sequence, name)) is not None:
                columns = {
                    column.name: getattr(block, column.name).copy()
                    for column in fields(block)
                }
                found[name] = SimpleNamespace(
                    **columns, recorded_ns=block.stamps_ns.copy()
                )
        return cls(sequence, found)

    def write(self, path: Path) -> None:
        """Write the log; headers have the stamps, which may be wrong, messages the instants of recording."""
        sequence, first_ns = self.sequence, self.sequence.start_ns
        messages = [
            static_message(
                "/tf_static", TF, first_ns, encode_mountings(sequence.calibration)
            )
        ]
        if sequence.true_landmarks is not None:
            messages.append(
                landmark_map_message(
                    "/ground_truth/landmarks", sequence.true_landmarks, first_ns
                )
            )
        if sequence.truth is not None:
            messages.append(odometry_messages("/ground_truth/odometry", sequence.truth))
        for name, topic in {
            "imu": "/imu/data",
            "dvl": "/dvl/data",
            "depth": "/depth/pose",
        }.items():
            if name in self.sensors:
                make: Any = {
                    "imu": imu_messages,
                    "dvl": dvl_messages,
                    "depth": depth_messages,
                }[name]
                messages.append(self._stamped(name, make(topic, self._recorded(name))))
        if "detections" in self.sensors:
            frames = detection_messages(
                "/sonar/landmarks", self._recorded("detections")
            )
            messages += [self._stamped("detections", entry) for entry in frames]
        record = {
            "name": path.stem,
            "calibration": sequence.calibration.model_dump_json(),
            "notes": "{}",
        }
        write_recording(path, messages, {METADATA: record})

    def _recorded(self, name: str) -> Any:
        """Rows as if stamped when recorded."""
        return Columns(
            **{**vars(self.sensors[name]), "stamps_ns": self.sensors[name].recorded_ns}
        )

    def _stamped(self, name: str, entry: Outgoing) -> Outgoing:
        """Messages with the sensor's stamps in their headers."""
        rows = self.sensors[name]
        if name == "detections":  # one message a frame
            stamps_ns = rows.stamps_ns[
                np.searchsorted(rows.recorded_ns, entry.log_times_ns)
            ]
        else:
            stamps_ns = rows.stamps_ns
        stamp = np.column_stack(np.divmod(stamps_ns, NS)).astype("<u4")
        payloads = entry.payloads.copy()
        payloads[:, 4:12] = stamp.view(np.uint8)
        return replace(entry, payloads=payloads)


class Columns(SimpleNamespace):
    """Rows without the checks of a block."""

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True)
class Outcome:
    """What became of a log."""

    refused: str
    """Why it was not read; empty: it was."""
    failed: dict[str, str]
    error_m: dict[str, float]
    seconds: dict[str, float]
    said: str


def inspected(path: Path) -> str:
    """Print of `inspect`."""
    told = StringIO()
    try:
        # exit code 3: the log is doubtful, which the answer says too
        with redirect_stdout(told), suppress(typer.Exit):
            inspect.__wrapped__(path, ReadingOptions())  # type: ignore[attr-defined]
    except SonarGraphError as error:
        told.write(str(error))
    return told.getvalue()


def outcome(path: Path) -> Outcome:
    """Compare estimators on a log."""
    try:
        with patch(
            "time.perf_counter", time.process_time
        ):  # other processes do not count
            sequence, recognition = prepared_log(
                path, ReadingOptions(), RecogniserOptions()
            )
            comparison = compare_prepared(
                sequence, recognition, ESTIMATORS, {}, rate_hz=None
            )
    except SonarGraphError as error:
        return Outcome(str(error), {}, {}, {}, str(error))
    told = StringIO()
    Console(file=told, width=10_000).print(summary(comparison))
    errors, seconds, failed = {}, {}, {}
    for run in comparison.runs:
        scores = comparison.scores[run.estimator]
        errors[run.estimator] = (
            scores["causal.ate_raw_m"].value if "causal.ate_raw_m" in scores else inf
        )
        seconds[run.estimator] = float(run.update_s.sum() + run.finish_s)
        if run.status == "failed":
            failed[run.estimator] = run.reason
    return Outcome("", failed, errors, seconds, told.getvalue())


def hung(*_: object) -> None:
    raise TimeoutError(f"no end after {HUNG_S} s of processor time")


@dataclass(frozen=True)
class Case:
    """A fault in a log."""

    base: str
    number: int
    """In `FAULTS`."""

    @property
    def fault(self) -> Fault:
        return FAULTS[self.number]

    def __str__(self) -> str:
        return f"{self.base}: {self.fault.sensor} {self.fault.name}"


@lru_cache
def sound(data: Path, base: str) -> tuple[Sequence, Outcome, str]:
    """A sound log, what becomes of it, and what `inspect` says of it."""
    sequence = log_of(data, base)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{base}.mcap"
        Rows.of(sequence).write(path)
        outcome(path)  # the second is timed: compiled
        return sequence, outcome(path), inspected(path)


def judged(data: Path, case: Case) -> dict[str, Any]:
    """The verdict on one case."""
    sequence, clean, clean_inspected = sound(data, case.base)
    fault, rows = case.fault, Rows.of(sequence)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{case.base}.mcap"
        effect = fault.change(
            rows.sensors[fault.sensor], np.random.default_rng(case.number)
        )
        rows.write(path)
        signal.signal(signal.SIGVTALRM, hung)
        signal.setitimer(signal.ITIMER_VIRTUAL, HUNG_S)
        found = outcome(path)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        by = "compare" if names(fault, found.said, clean.said) else "-"
        if by == "-" and names(fault, inspected(path), clean_inspected):
            by = "inspect"
        measure = clean
        if effect.rows is not None:
            without = Rows.of(sequence)
            chosen = without.sensors[fault.sensor]
            for name, column in vars(chosen).items():
                setattr(chosen, name, column[~effect.rows])
            without.write(path)
            measure = outcome(path)
    note(
        f"{case}: {by}, {found.failed or {n: round(e, 2) for n, e in found.error_m.items()}} {found.refused}"
    )
    return {
        "case": str(case),
        "named": by,
        "refused": found.refused,
        "failed": found.failed,
        "errors": found.error_m,
        "bounds": {
            name: bound(sequence, effect, error)
            for name, error in measure.error_m.items()
        },
        "slow": {
            n: s
            for n, s in found.seconds.items()
            if s > max(SLOW_S, SLOW * clean.seconds[n])
        },
        "said": found.said,
    }


def names(fault: Fault, text: str, clean: str) -> bool:
    """True where lines that the sound log does not have name the fault."""
    known = set(clean.splitlines())
    return any(
        re.search(fault.named, line) for line in text.splitlines() if line not in known
    )


def bound(sequence: Sequence, effect: Effect, error_m: float) -> float:
    """Largest error that the fault explains."""
    assert sequence.truth is not None
    positions = sequence.truth.positions[sequence.truth.stamps_ns <= sequence.end_ns]
    distance_m = float(np.linalg.norm(positions - positions[0], axis=1).max())
    return (
        FACTOR * error_m
        + ROUNDING_M
        + effect.shift_m
        + min(effect.turn_rad, 2.0) * distance_m
    )


def main() -> None:
    parser = make_parser(__doc__, data=True, workers=True)
    parser.add_argument(
        "--only", default="", help="cases whose name this regular expression finds"
    )
    parser.add_argument(
        "--says",
        action="store_true",
        help="print what compare said of faults that it does not name",
    )
    arguments = parser.parse_args()
    cases = [
        Case(base, k)
        for base in ("mission", "akit", "mrclam")
        for k, f in enumerate(FAULTS)
        if base in f.bases
    ]
    cases = [case for case in cases if re.search(arguments.only, str(case))][
        :: QUICK if arguments.quick else 1
    ]
    cases = [
        case for k in range(arguments.workers) for case in cases[k :: arguments.workers]
    ]
    found = in_parallel(
        partial(judged, arguments.data), cases, arguments.workers, "case"
    )
    rows, unnamed, failed, beyond, slow = [], [], [], [], []
    for one in sorted(found, key=lambda one: one["case"]):
        over = {
            n: e for n, e in one["errors"].items() if not e <= one["bounds"].get(n, inf)
        }
        cells = [
            f"{one['errors'].get(n, inf):.2f}{'!' if n in over else ''}"
            for n in ESTIMATORS
        ]
        limit = max(one["bounds"].values(), default=inf)
        rows.append(
            [
                one["case"],
                one["named"],
                *cells,
                f"{limit:.2f}",
                ", ".join([*one["failed"], *one["slow"]]),
            ]
        )
        unnamed += [one["case"]] * (one["named"] == "-")
        failed += [
            f"{one['case']}: {n}: {reason}" for n, reason in one["failed"].items()
        ]
        failed += [f"{one['case']}: {one['refused']}"] * bool(one["refused"])
        beyond += [
            f"{one['case']}: {n} {e:.2f} > {one['bounds'][n]:.2f}"
            for n, e in over.items()
        ]
        slow += [f"{one['case']}: {n} {s:.1f} s" for n, s in one["slow"].items()]
        if arguments.says and one["named"] == "-":
            note(f"--- {one['case']}\n{one['said']}")
    print_table(["fault", "named by", *ESTIMATORS, "bound", "failed, slow"], rows)
    for fault in (*failed, *beyond, *slow):
        note(fault)
    figures = {
        "cases": len(found),
        "faults": len(FAULTS),
        "failed": len(failed),
        "unnamed": unnamed,
        "beyond_bound": len(beyond),
        "slow": len(slow),
        "passed": not (unnamed or failed or beyond or slow),
    }
    conclude(figures, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
