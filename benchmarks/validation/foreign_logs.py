"""Logs by another hand: every fault of the table of checks at three sizes, and logs without a fault.

    python benchmarks/validation/foreign_logs.py [--quick] [--seed 1] [--faultless 50] [--coverage 100]
        [--only WORD ...] [--results FILE] [--table docs/theory/foreign_logs.md]

Worlds and files are those of `foreign_world.py`. A log is judged by ``sonar-graph compare``, by its exit code, its
printed lines and the trajectories that it writes:

* ``silent``: the error is over five times that of the log without the fault, and no line names the cause;
* ``warned``: a line names the cause, the error is over five times as large, and the exit code is 0;
* ``misled``: a line asks for a change of a sensor that is right;
* ``unhelpful``: no results, and no line names the cause;
* ``false_alarms``: a log without a fault whose lines ask for a change, or whose exit code is not 0.

Rows that their driver marks as not measured are judged against the log without these rows. ``--coverage`` counts how
often the 95 % intervals of ``sonar-graph inspect --json`` hold the true value on logs without a fault. Each log's
outcome is added to ``--results`` at once; a second run with the same file goes on where the first stopped.
"""

import argparse
import contextlib
import copy
import io
import json
import os
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from foreign_world import EPOCH_S, Floats, Log, Mask, calibration_of, make_log, write

sys.path.append(str(Path(__file__).resolve().parents[1]))
from common import make_parser, note, print_figures, print_table

os.environ.setdefault("COLUMNS", "2000")  # before rich: a warning stays on its line
from sonar_graph import report
from sonar_graph.cli.main import main as main_command
from sonar_graph.evaluation import write_comparison

report.write_report = write_comparison  # the page is not judged, and its figures take half of the time

WORSE = 5.0
"""Ratio of errors above which a fault matters."""
LEAST_ERROR_M = 0.05
BURST_S = 2.0
"""Typical length of a stretch without measurements."""
FAULTLESS = "faultless"
QUANTITIES = ("angular rate", "specific force", "velocity", "depth", "heading", "position", "range", "azimuth")
KINDS = ("stuck", "late", "axes or sense", "unit", "scale", "marked invalid")


# --- faults ------------------------------------------------------------------------------------------------------

Spoil = Callable[[Log, float], None]


@dataclass(frozen=True)
class Fault:
    """A fault, its sizes, and what a line must contain to name its cause."""

    quantity: str
    kind: str
    detail: str
    """What the sizes are."""
    sizes: tuple[float, ...]
    spoil: Spoil
    words: str
    """Regular expression of the cause."""
    roles: frozenset[str]
    """Tables and sections that a line may ask to change."""
    needs: frozenset[str] = frozenset()
    """Sensors beside IMU and Doppler log, without which the fault has no effect or no witness."""

    @property
    def name(self) -> str:
        """Name for the results."""
        return f"{self.quantity}: {self.kind}, {self.detail}"


def stuck(times: str, values: str) -> Spoil:
    """Repeat one value from an instant on."""

    def spoil(log: Log, from_s: float) -> None:
        later = getattr(log, times) >= from_s
        column = getattr(log, values)
        column[later] = column[np.argmax(later)]

    return spoil


def late(times: str) -> Spoil:
    """Add seconds to the stamps."""

    def spoil(log: Log, seconds: float) -> None:
        setattr(log, times, getattr(log, times) + seconds)

    return spoil


def scaled(values: str) -> Spoil:
    """Multiply the values."""

    def spoil(log: Log, factor: float) -> None:
        setattr(log, values, getattr(log, values) * factor)

    return spoil


def turned(values: str, axes: list[list[float]]) -> Spoil:
    """Turn or mirror vectors: new = axes @ old; the size does not matter."""
    matrix = np.array(axes)

    def spoil(log: Log, _: float) -> None:
        setattr(log, values, getattr(log, values) @ matrix.T)

    return spoil


def one_axis_negated(values: str) -> Spoil:
    """Negate the axis that the size numbers."""

    def spoil(log: Log, axis: float) -> None:
        getattr(log, values)[:, int(axis)] *= -1

    return spoil


def added(values: str, factor: float = 1.0) -> Spoil:
    """Add a constant, the size times a factor."""

    def spoil(log: Log, size: float) -> None:
        setattr(log, values, getattr(log, values) + size * factor)

    return spoil


def clockwise(log: Log, _: float) -> None:
    log.yaw_rad = np.pi / 2 - log.yaw_rad


def bias_of_yaw_rate(log: Log, rad_s: float) -> None:
    log.rate[:, 2] += rad_s


def scale_ranges(log: Log, factor: float) -> None:
    log.sightings = [(ids, r * factor, a) for ids, r, a in log.sightings]


def scale_azimuths(log: Log, factor: float) -> None:
    log.sightings = [(ids, r, a * factor) for ids, r, a in log.sightings]


def repeat_frames(log: Log, from_s: float) -> None:
    first = int(np.argmax(log.frame_s >= from_s))
    first = next((k for k in range(first, len(log.frame_s)) if len(log.sightings[k][0])), first)
    log.sightings[first:] = [log.sightings[first]] * (len(log.frame_s) - first)


def hold_azimuths(log: Log, from_s: float) -> None:
    """All landmarks have one azimuth from an instant on."""
    later = np.flatnonzero(log.frame_s >= from_s)
    held = next((float(a[0]) for _, _, a in log.sightings[later[0] :] if len(a)), 0.0)
    for k in later:
        ids, r, _ = log.sightings[k]
        log.sightings[k] = (ids, r, np.full(len(ids), held))


def bursts(times: Floats, share: float) -> Mask:
    """Rows in stretches of some seconds, a share of all; the first five seconds are whole."""
    rng = np.random.default_rng(round(1e3 * share))
    period_s = BURST_S / share
    phase_s = rng.uniform(0.0, period_s)
    return ((times + phase_s) % period_s < BURST_S) & (times > 5.0)


@dataclass(frozen=True)
class Marked:
    """Rows that hold no measurement and are marked by their driver, or are not finite.

    ``without``: the same log as it is where a driver sends nothing instead.
    """

    sensor: str
    times: str
    values: str
    is_finite: bool

    def __call__(self, log: Log, share: float) -> None:
        """Put zeros into marked rows, or NaN."""
        times = getattr(log, self.times)
        rows = bursts(times, share)
        getattr(log, self.values)[rows] = 0.0 if self.is_finite else np.nan
        if self.is_finite:
            log.unmeasured[self.sensor] = rows

    def without(self, log: Log, share: float) -> None:
        """Leave the rows out; of an IMU without forces, the forces."""
        rows = bursts(getattr(log, self.times), share)
        if self.sensor == "force":
            log.force[rows] = np.nan
            return
        of_message = ("rate", "force") if self.sensor == "rate" else (self.values,)
        for name in (self.times, *of_message):
            setattr(log, name, getattr(log, name)[~rows])


@dataclass(frozen=True)
class MarkedSightings:
    """Sightings whose range (1) or azimuth (2) is not finite."""

    column: int

    def __call__(self, log: Log, share: float) -> None:
        """Put NaN into the frames of some stretches."""
        for k in np.flatnonzero(bursts(log.frame_s, share)):
            of_frame = list(log.sightings[k])
            of_frame[self.column] = np.full(len(of_frame[0]), np.nan)
            log.sightings[k] = tuple(of_frame)

    def without(self, log: Log, share: float) -> None:
        """Leave the sightings out."""
        for k in np.flatnonzero(bursts(log.frame_s, share)):
            log.sightings[k] = tuple(part[:0] for part in log.sightings[k])


FROM_S = (15.0, 30.0, 45.0)
SHARES = (0.1, 0.3, 0.5)
AGAIN = (0.0, 1.0, 2.0)
"""Of faults without a size: three worlds."""
DEGREES = float(np.degrees(1.0))
FOOT = 1 / 0.3048
ANY = r"left out|not measured|no velocity|no sample|not finite"


def roles(*names: str) -> frozenset[str]:
    return frozenset(names)


def table() -> Iterator[Fault]:
    """Every fault."""
    imu, dvl = roles("imu"), roles("dvl")
    q = "angular rate"
    gyro = r"angular rate|gyro"
    yield Fault(q, "stuck", "from a second on", FROM_S, stuck("imu_s", "rate"), r"angular rate.*same|gyro", imu)
    yield Fault(q, "late", "seconds, of the whole IMU", (0.5, 1.0, 1.5), late("imu_s"), r"DVL against IMU", roles("imu", "dvl"))
    yield Fault(q, "axes or sense", "axis negated", (0.0, 1.0, 2.0), one_axis_negated("rate"), gyro, imu)
    yield Fault(q, "axes or sense", "x and z exchanged", AGAIN, turned("rate", [[0, 0, 1], [0, 1, 0], [1, 0, 0]]), gyro, imu)
    yield Fault(q, "unit", "degrees", (DEGREES,) * 3, scaled("rate"), r"gyro.*degrees", imu)
    yield Fault(q, "scale", "factor", (1.02, 1.05, 0.95), scaled("rate"), r"angular_velocity_scale", imu, roles("heading"))
    yield Fault(q, "scale", "bias of yaw rate, rad/s", (0.005, 0.01, -0.02), bias_of_yaw_rate, r"gyro bias", imu, roles("heading"))
    yield Fault(q, "marked invalid", "share, -1 in the covariance", SHARES, Marked("rate", "imu_s", "rate", True), ANY, imu)
    yield Fault(q, "marked invalid", "share, NaN", SHARES, Marked("rate", "imu_s", "rate", False), ANY, imu)

    q = "specific force"
    force = r"specific force|accelerometer|gravity"
    yield Fault(q, "stuck", "from a second on", FROM_S, stuck("imu_s", "force"), r"specific force.*same", imu)
    yield Fault(q, "axes or sense", "negated", AGAIN, turned("force", [[-1, 0, 0], [0, -1, 0], [0, 0, -1]]), force, imu)
    yield Fault(q, "axes or sense", "x and z exchanged", AGAIN, turned("force", [[0, 0, 1], [0, 1, 0], [1, 0, 0]]), force, imu)
    yield Fault(q, "axes or sense", "x and y exchanged", AGAIN, turned("force", [[0, 1, 0], [1, 0, 0], [0, 0, 1]]), force, imu)
    yield Fault(q, "unit", "g, mg, cm/s2", (1 / 9.80665, 1e3 / 9.80665, 1e2), scaled("force"), force, imu)
    yield Fault(q, "scale", "factor", (1.05, 1.25, 0.8), scaled("force"), force, imu)
    yield Fault(q, "marked invalid", "share, -1 in the covariance", SHARES, Marked("force", "imu_s", "force", True), ANY, imu)
    yield Fault(q, "marked invalid", "share, NaN", SHARES, Marked("force", "imu_s", "force", False), ANY, imu)

    q = "velocity"
    axes = r"DVL axes"
    scale = r"DVL.*(unit|scale)|Doppler"
    by_scale = roles("dvl", "positions", "detections", "depth")
    yield Fault(q, "stuck", "from a second on", FROM_S, stuck("dvl_s", "velocity"), r"velocity.*same|DVL.*(same|stuck|repeat)", dvl)
    yield Fault(q, "late", "seconds", (0.5, 1.0, 1.5), late("dvl_s"), r"DVL against IMU", dvl)
    yield Fault(q, "axes or sense", "y negated", AGAIN, turned("velocity", [[1, 0, 0], [0, -1, 0], [0, 0, 1]]), axes, dvl)
    yield Fault(q, "axes or sense", "x and y negated", AGAIN, turned("velocity", [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]), axes, dvl)
    yield Fault(q, "axes or sense", "z negated", AGAIN, turned("velocity", [[1, 0, 0], [0, 1, 0], [0, 0, -1]]), axes, dvl)
    yield Fault(q, "axes or sense", "y and z negated", AGAIN, turned("velocity", [[1, 0, 0], [0, -1, 0], [0, 0, -1]]), axes, dvl)
    yield Fault(q, "axes or sense", "negated", AGAIN, turned("velocity", [[-1, 0, 0], [0, -1, 0], [0, 0, -1]]), axes, dvl)
    yield Fault(q, "axes or sense", "turned by 90 degrees", AGAIN, turned("velocity", [[0, -1, 0], [1, 0, 0], [0, 0, 1]]), r"DVL axes|mounting yaw", dvl)
    yield Fault(q, "unit", "mm/s, cm/s, knots", (1e3, 1e2, 1 / 0.5144), scaled("velocity"), scale, by_scale)
    yield Fault(q, "scale", "factor", (1.1, 0.9, 1.2), scaled("velocity"), scale, by_scale)
    yield Fault(q, "marked invalid", "share, huge variance", SHARES, Marked("velocity", "dvl_s", "velocity", True), ANY, dvl)
    yield Fault(q, "marked invalid", "share, NaN", SHARES, Marked("velocity", "dvl_s", "velocity", False), ANY, dvl)

    q = "depth"
    depth = roles("depth", "start")
    needs = roles("depth")
    times = r"depth.*\d times as much|depth.*height begins|depth.*(rises|another sign|times)"
    yield Fault(q, "stuck", "from a second on", FROM_S, stuck("depth_s", "z_m"), r"depth.*(repeat|stuck|same)", depth, needs)
    yield Fault(q, "late", "seconds", (1.0, 2.0, 3.0), late("depth_s"), r"depth.*too late", depth, needs)
    yield Fault(q, "axes or sense", "factor", (-1.0, -FOOT, -100.0), scaled("z_m"), times, depth, needs)
    yield Fault(q, "unit", "feet, cm, decimetres", (FOOT, 100.0, 10.0), scaled("z_m"), times, depth, needs)
    yield Fault(q, "scale", "factor", (1.15, 0.8, 1.25), scaled("z_m"), times, depth, needs)
    yield Fault(q, "scale", "origin, m", (5.0, 20.0, -10.0), added("z_m"), r"depth.*height begins", depth, needs)
    yield Fault(q, "marked invalid", "share, huge variance", SHARES, Marked("depth", "depth_s", "z_m", True), ANY, depth, needs)
    yield Fault(q, "marked invalid", "share, NaN", SHARES, Marked("depth", "depth_s", "z_m", False), ANY, depth, needs)

    q = "heading"
    heading = roles("heading")
    needs = roles("heading")
    yield Fault(q, "stuck", "from a second on", FROM_S, stuck("heading_s", "yaw_rad"), r"heading.*(repeat|stuck|same)", heading, needs)
    yield Fault(q, "late", "seconds", (0.7, 1.5, 2.5), late("heading_s"), r"heading.*too late", heading, needs)
    yield Fault(q, "axes or sense", "clockwise from north", AGAIN, clockwise, r"heading.*(clockwise|height)", heading, needs)
    yield Fault(q, "axes or sense", "turned, degrees", (25.0, 60.0, -90.0), added("yaw_rad", np.pi / 180), r"heading.*towards the positions", roles("heading", "dvl"), needs | {"fixes"})
    yield Fault(q, "unit", "degrees", (DEGREES,) * 3, scaled("yaw_rad"), r"heading.*degrees|heading.*(another|of its changes)|yaw_rad.*degrees", heading, needs)
    yield Fault(q, "scale", "factor", (1.1, 0.9, 1.3), scaled("yaw_rad"), r"heading", roles("heading", "imu"), needs)
    yield Fault(q, "marked invalid", "share, huge sigma or no quaternion", SHARES, Marked("heading", "heading_s", "yaw_rad", True), ANY, heading, needs)
    yield Fault(q, "marked invalid", "share, NaN", SHARES, Marked("heading", "heading_s", "yaw_rad", False), ANY, heading, needs)

    q = "position"
    positions = roles("positions", "start")
    needs = roles("fixes")
    yield Fault(q, "stuck", "from a second on", FROM_S, stuck("fix_s", "fix_m"), r"position.*(repeat|stuck|same)", positions, needs)
    yield Fault(q, "late", "seconds", (1.5, 2.0, 3.0), late("fix_s"), r"position.*too late", positions, needs)
    yield Fault(q, "axes or sense", "x and y exchanged", AGAIN, turned("fix_m", [[0, 1, 0], [1, 0, 0], [0, 0, 1]]), r"position.*(exchanged|begin|of its changes)|towards the positions", positions | {"heading", "dvl"}, needs)
    yield Fault(q, "unit", "mm, feet, cm", (1e3, FOOT, 1e2), scaled("fix_m"), r"position.*(times as much|begin)", positions, needs)
    yield Fault(q, "scale", "factor", (1.1, 0.9, 1.25), scaled("fix_m"), r"position.*(times as much|begin)", positions | {"dvl"}, needs)
    yield Fault(q, "marked invalid", "share, huge variance", SHARES, Marked("fixes", "fix_s", "fix_m", True), ANY, positions, needs)
    yield Fault(q, "marked invalid", "share, NaN", SHARES, Marked("fixes", "fix_s", "fix_m", False), ANY, positions, needs)

    seen = roles("detections", "sonar")
    needs = roles("sonar", "names")
    ranges = r"ranges.*(times as much|grow|hardly)"
    azimuths = r"azimuths?.*(times as much|mirrored|degrees|hardly)"
    q = "range"
    yield Fault(q, "stuck", "frame repeated from a second on", FROM_S, repeat_frames, r"(sonar|landmark|detections).*(same|repeat|hardly)", seen, needs)
    yield Fault(q, "late", "seconds, of the frame", (0.5, 1.0, 2.0), late("frame_s"), r"(sonar|landmark|detections|azimuths|ranges).*late", seen, needs)
    yield Fault(q, "axes or sense", "backwards", AGAIN, lambda log, _: scale_azimuths(log, -1.0), azimuths, seen, needs)
    yield Fault(q, "unit", "mm, cm, feet", (1e3, 1e2, FOOT), scale_ranges, ranges, seen | {"dvl"}, needs)
    yield Fault(q, "scale", "factor", (1.045, 1.1, 0.9), scale_ranges, ranges, seen | {"dvl"}, needs)
    yield Fault(q, "marked invalid", "share, NaN", SHARES, MarkedSightings(1), ANY, seen, needs)
    q = "azimuth"
    yield Fault(q, "stuck", "one value from a second on", FROM_S, hold_azimuths, r"(sonar|landmark|detections).*(same|repeat|hardly)", seen, needs)
    yield Fault(q, "axes or sense", "mirrored", AGAIN, lambda log, _: scale_azimuths(log, -1.0), azimuths, seen, needs)
    yield Fault(q, "unit", "degrees", (DEGREES,) * 3, scale_azimuths, azimuths, seen, needs)
    yield Fault(q, "scale", "factor", (1.1, 0.8, 1.25), scale_azimuths, azimuths, seen, needs)
    yield Fault(q, "marked invalid", "share, NaN", SHARES, MarkedSightings(2), ANY, seen, needs)


# --- judging -----------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What ``compare`` did with a log."""

    code: int
    lines: list[str]
    error_m: float

    def asks_for(self) -> set[str]:
        """Tables and sections that its doubts and warnings ask to change."""
        text = " ".join(line for line in self.lines if line.startswith(("Doubtful", "Warning")))
        asked = set(re.findall(r"under \[(\w+)\]", text))
        return asked | set(re.findall(r"`(\w+)\.[\w.]+ = ", text))

    def names(self, words: str) -> bool:
        """True where a line names a cause."""
        return any(re.search(words, line) for line in self.lines)


@dataclass
class Judgement:
    """One log, for the file of results."""

    fault: str
    size: float
    seed: list[int]
    verdict: str
    is_named: bool
    code: int
    error_m: float
    without_m: float | None
    """Error of the log without the fault, where it decided."""
    world: str
    lines: list[str]


def command(*words: str | Path) -> tuple[int, str]:
    """Exit code and printed text of ``sonar-graph`` with these words, in this process, which is faster."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main_command([str(word) for word in words])
        except SystemExit as end:
            code = int(end.code or 0)
            if "interrupted" in printed.getvalue():
                raise
            return code, printed.getvalue()
    return 0, printed.getvalue()


def outcome_of(log: Log, folder: Path) -> Outcome:
    """Run ``compare`` as the owner of the log would."""
    path = folder / "dive.mcap"
    vehicle = folder / "vehicle.toml"
    results = folder / "results"
    write(log, path)
    vehicle.write_text(calibration_of(log))
    options = ["--calibration", vehicle, "-o", results, "--overwrite", "--estimators", "isam2,ekf-slam"]
    code, text = command("compare", path, *options)
    errors = [0.0]
    for name in ("isam2", "ekf-slam"):
        file = results / "runs" / name / "causal.tum"
        if code in (0, 3) and file.exists():
            rows = np.loadtxt(file)
            seconds = rows[:, 0] - EPOCH_S
            true = np.column_stack([np.interp(seconds, log.truth[:, 0], column) for column in log.truth[:, 1:].T])
            errors.append(float(np.sqrt(np.mean(np.sum((rows[:, 1:4] - true) ** 2, axis=1)))))
    return Outcome(code, text.splitlines(), max(errors))


def judge(fault: Fault, size: float, seed: list[int], folder: Path) -> Judgement:
    """Verdict on a log with a fault; the log without it is only run where it decides."""
    right = make_log(seed, fault.needs)
    log = copy.deepcopy(right)
    fault.spoil(log, size)
    outcome = outcome_of(log, folder)
    is_named = outcome.names(fault.words)
    is_wrong_line = bool(outcome.asks_for() - fault.roles)
    without_m = None
    is_worse = False
    if outcome.code in (0, 3) and not (is_named and outcome.code == 3) and outcome.error_m > LEAST_ERROR_M:
        if isinstance(fault.spoil, Marked | MarkedSightings):
            fault.spoil.without(right, size)
        without_m = outcome_of(right, folder).error_m
        is_worse = outcome.error_m > WORSE * max(without_m, LEAST_ERROR_M / WORSE)
    verdict = "right"
    if outcome.code not in (0, 3):
        verdict = "refused" if is_named else "unhelpful"
    elif is_wrong_line:
        verdict = "misled"
    elif is_worse and not is_named:
        verdict = "silent"
    elif is_worse and outcome.code == 0:
        verdict = "warned"
    return judgement(fault.name, size, seed, verdict, outcome, right, is_named=is_named, without_m=without_m)


def judge_faultless(seed: list[int], folder: Path) -> Judgement:
    """Verdict on a log without a fault."""
    log = make_log(seed)
    outcome = outcome_of(log, folder)
    is_alarm = bool(outcome.asks_for()) or outcome.code != 0
    return judgement(FAULTLESS, float(seed[-1]), seed, "false alarm" if is_alarm else "right", outcome, log)


def judgement(
    fault: str,
    size: float,
    seed: list[int],
    verdict: str,
    outcome: Outcome,
    log: Log,
    *,
    is_named: bool = False,
    without_m: float | None = None,
) -> Judgement:
    """The record of a log."""
    world = log.world
    text = (
        f"{world.style} {world.speed_m_s:.2f} m/s, IMU {world.imu_hz:g} Hz, DVL {world.dvl_hz:g} Hz, noise "
        f"{world.noise:g}, {', '.join(sorted(world.sensors))}, {len(world.gaps_s)} gaps"
        f"{'' if world.is_start_stated else ', start not stated'}"
    )
    lines = [line for line in outcome.lines if line.startswith(("Doubt", "Warn", "sonar", "Log"))]
    return Judgement(fault, size, seed, verdict, is_named, outcome.code, outcome.error_m, without_m, text, lines)


def measure(arguments: argparse.Namespace, folder: Path) -> list[Judgement]:
    """Judge every log that the file of results does not have, one size after the other."""
    file = arguments.results
    done: list[Judgement] = []
    if file is not None and file.exists():
        done = [Judgement(**json.loads(line)) for line in file.read_text().splitlines()]
    known = {(one.fault, tuple(one.seed)) for one in done}
    faults = list(table())
    wanted: list[tuple[Fault | None, float, list[int]]] = []
    for place in range(arguments.sizes):
        for number, fault in enumerate(faults):
            if not arguments.only or any(word in fault.name for word in arguments.only):
                wanted.append((fault, fault.sizes[place], [arguments.seed, number, place]))
    wanted += [(None, 0.0, [arguments.seed, len(faults), place]) for place in range(arguments.faultless)]
    wanted = [one for one in wanted if (one[0].name if one[0] else FAULTLESS, tuple(one[2])) not in known]
    for count, (fault, size, seed) in enumerate(wanted):
        one = judge_faultless(seed, folder) if fault is None else judge(fault, size, seed, folder)
        done.append(one)
        note(f"{count + 1} of {len(wanted)}: {one.fault} {one.size:.4g}: {one.verdict}, {one.error_m:.2f} m")
        if one.verdict not in ("right", "refused"):
            note("\n".join([f"  {one.world}", *(f"  {line[:600]}" for line in one.lines)]))
        if file is not None:
            with file.open("a") as opened:
                opened.write(json.dumps(asdict(one)) + "\n")
    return done


def true_values(log: Log) -> dict[str, float]:
    """What the quantities of ``inspect`` are, by the beginning of their names."""
    arm = log.world.dvl_arm_m - log.world.imu_arm_m
    return {
        "DVL against IMU: time offset": 0.0,
        "DVL mounting yaw": 0.0,
        "DVL scale": 1.0,
        "lever arm from IMU to DVL, x": arm[0],
        "lever arm from IMU to DVL, y": arm[1],
        "lever arm from IMU to DVL, z": arm[2],
        "depth: change over": 1.0,
        "depth against": 0.0,
        "heading: turn over": 1.0,
        "heading against": 0.0,
        "position fixes: change": 1.0,
        "position fixes against": 0.0,
        "ranges to landmarks: change": 1.0,
        "azimuths of landmarks: change": 1.0,
    }


@dataclass
class Coverage:
    """How often the 95 % intervals of a quantity hold the true value."""

    quantity: str
    logs: int
    share: float
    rms: float
    """Of error over sigma."""


def coverage(arguments: argparse.Namespace, folder: Path) -> list[Coverage]:
    """Run ``inspect`` on logs without a fault."""
    ratios: dict[str, list[float]] = {}
    for place in range(arguments.coverage):
        log = make_log([arguments.seed, 10_000, place], roles("depth", "heading", "fixes", "sonar", "names"))
        path = folder / "dive.mcap"
        vehicle = folder / "vehicle.toml"
        write(log, path)
        vehicle.write_text(calibration_of(log))
        _, text = command("inspect", path, "--calibration", vehicle, "--json")
        true = true_values(log)
        for finding in json.loads(text)["sensors"]:
            for name, value in true.items():
                if finding["quantity"].startswith(name) and finding["value"] is not None:
                    ratios.setdefault(name, []).append((finding["value"] - value) / finding["sigma"])
        note(f"coverage: {place + 1} of {arguments.coverage}")
    found = []
    for name, errors in ratios.items():
        held = float(np.mean(np.abs(errors) < 1.96))
        found.append(Coverage(name, len(errors), held, float(np.sqrt(np.mean(np.square(errors))))))
    return found


def cell(done: list[Judgement], quantity: str, kind: str) -> str:
    """What was found of one cell of the table: sizes named, sizes that did not matter, and the rest."""
    texts = []
    for fault in table():
        if (fault.quantity, fault.kind) != (quantity, kind):
            continue
        of_fault = [one for one in done if one.fault == fault.name]
        sizes = []
        for one in of_fault:
            told = {"right": "named" if one.is_named else "no harm"}.get(one.verdict, one.verdict)
            sizes.append(f"{one.size:.3g} {told}")
        if sizes:
            texts.append(f"{fault.detail}: {', '.join(sizes)}")
    return "; ".join(texts) or "no such fault"


def main() -> None:
    """Measure and print."""
    parser = make_parser(__doc__)
    parser.add_argument("--seed", type=int, default=1, help="of all logs")
    parser.add_argument("--faultless", type=int, default=50, help="logs without a fault")
    parser.add_argument("--sizes", type=int, default=3, help="sizes of each fault")
    parser.add_argument("--coverage", type=int, default=0, help="logs for the coverage of intervals")
    parser.add_argument("--only", nargs="*", default=[], metavar="WORD", help="faults with a word in their names")
    parser.add_argument("--results", type=Path, help="file of results, to go on with")
    parser.add_argument("--table", type=Path, help="page to write the table of faults to")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.faultless = min(arguments.faultless, 2)
        arguments.sizes = 1
        arguments.only = arguments.only or ["depth: unit", "position: stuck", "velocity: axes", "azimuth: axes"]
    with tempfile.TemporaryDirectory() as name:
        done = measure(arguments, Path(name))
        covered = coverage(arguments, Path(name))
    rows = [(one.fault, one.size, one.code, one.error_m, one.without_m, one.verdict) for one in done]
    print_table(("fault", "size", "exit code", "error (m)", "without (m)", "verdict"), rows)
    if covered:
        print_table(("quantity", "logs", "95 % held", "rms error / sigma"), [tuple(asdict(one).values()) for one in covered])
    counts = Counter[str]()
    for one in done:
        is_faultless = one.fault == FAULTLESS
        counts["faultless" if is_faultless else "logs"] += 1
        counts["false_alarms" if one.verdict == "false alarm" else "faultless_right" if is_faultless else one.verdict] += 1
    wanted = ("logs", "right", "silent", "warned", "misled", "unhelpful", "refused", "faultless", "false_alarms")
    print_figures({name: counts[name] for name in wanted})


if __name__ == "__main__":
    main()
