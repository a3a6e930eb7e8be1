"""Hostile input: tracebacks, hangs, memory, silent errors and lost files over generated cases.

    python benchmarks/validation/hostile_input.py [--cases 600] [--interrupts 30] [--seed 0] [--quick]

Each case of `hostile_files.py` is a command in a folder of its own, in a process of its own, which is forked from this
one. It may end with any exit code of the commands (0 to 3); ``hangs`` are those that take more than ten seconds of the
processor or a minute of the clock. ``silent_errors`` are logs of which reading gives other measurements of IMU, Doppler
log or depth than the sound log has, and neither an error nor a note says so; control characters on the terminal; and
cells of a table that a spreadsheet would calculate. ``files_lost`` are users' files that are not as they
were. ``peak_rss_mb`` is the largest of all commands.

Interrupts are SIGINT at random moments of ``sonar-graph compare`` on a log with gaps; ``interrupts_missed`` are those
that do not end with "interrupted", exit code 130, and no file in the folder or all of them; ``interrupts_late`` came
when all was done.
"""

import contextlib
import csv
import hashlib
import io
import json
import os
import resource
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unicodedata import category

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"  # processes are forked
from common import make_parser, note, print_figures, print_table
from hostile_files import BATCH, COMPARED, IMAGED, NOISE, SUITE, Case, SoundLog, cases

from sonar_graph.cli import main as sonar_graph
from sonar_graph.logs import read_log, write_log
from sonar_graph.report.rendering import csv_text
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin

PROCESSOR_LIMIT_S, TIME_LIMIT_S, INTERRUPT_S = 10, 60.0, 30.0
LONGEST_PAUSE_S = 0.5
"""Longer ones between two looks at a command are those of a machine that stood still."""
MOST_RSS_MB = 1500.0
SUITE_TEXT = """
name = "hostile"
reference = "dead-reckoning"
logs = [{{ name = "sound", log = "{log}" }}]
estimators = [{{ name = "dead-reckoning" }}]
"""
TARGETS = {
    "tracebacks": 0,
    "hangs": 0,
    "silent_errors": 0,
    "files_lost": 0,
    "interrupts_missed": 0,
}


@dataclass
class Outcome:
    """What a command did."""

    code: int
    seconds: float
    rss_mb: float
    out: bytes
    err: bytes
    reading: dict[str, Any]

    @property
    def hung(self) -> bool:
        return self.seconds >= TIME_LIMIT_S or self.code == -signal.SIGXCPU

    @property
    def crashed(self) -> bool:
        return not self.hung and (
            self.code not in (0, 1, 2, 3)
            or b"Traceback (most recent call last)" in self.err
        )

    def has_escapes(self) -> bool:
        """True for characters that a terminal obeys; what is printed is UTF-8."""
        said = (self.out + self.err).decode("utf-8", "replace")
        return any(
            category(char) in ("Cc", "Cf", "Cs", "Zl", "Zp") and char not in "\n\t"
            for char in said
        )


def digest(sequence: Sequence) -> str:
    columns = [
        sequence.imu.stamps_ns,
        sequence.imu.angular_velocity,
        sequence.imu.specific_force,
    ]
    columns += [sequence.dvl.stamps_ns, sequence.dvl.velocity]
    columns += [sequence.depth.z_m] if sequence.depth is not None else []
    mountings = [
        getattr(sequence.calibration, name).mounting.model_dump_json()
        for name in ("imu", "dvl", "sonar")
    ]
    return hashlib.sha256(
        b"".join(column.tobytes() for column in columns) + "".join(mountings).encode()
    ).hexdigest()


def reading_of(log: Path) -> dict[str, Any]:
    """What reading gives: a digest of the measurements with what the notes say is wrong, or an error."""
    try:
        sequence = read_log(log)
    except Exception as error:
        from sonar_graph.errors import SonarGraphError

        return {"error": str(error), "foreseen": isinstance(error, SonarGraphError)}
    return {"digest": digest(sequence), "notes": sequence.notes}


def run_apart(case: Case, folder: Path) -> Outcome:
    """The command in a forked process, and the reading of its log after it."""
    out, err, read = (
        folder.with_suffix(suffix) for suffix in (".out", ".err", ".read")
    )
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        os.setsid()
        resource.setrlimit(
            resource.RLIMIT_CPU, (PROCESSOR_LIMIT_S, resource.RLIM_INFINITY)
        )
        for path, target in ((out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), target)
        code = 99
        try:
            sonar_graph(case.command)
        except SystemExit as end:
            code = int(end.code or 0)
        except BaseException:
            traceback.print_exc()
        if case.log is not None:
            read.write_text(json.dumps(reading_of(case.log)))
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    seconds, before = 0.0, time.monotonic()
    while True:
        done, status, usage = os.wait4(pid, os.WNOHANG)
        now = time.monotonic()
        seconds, before = seconds + min(now - before, LONGEST_PAUSE_S), now
        if done:
            break
        if seconds > TIME_LIMIT_S:
            os.killpg(pid, signal.SIGKILL)
            _, status, usage = os.wait4(pid, 0)
            break
        time.sleep(0.005)
    reading = (
        json.loads(read.read_text()) if read.exists() and read.stat().st_size else {}
    )
    code = os.waitstatus_to_exitcode(status)
    return Outcome(
        code,
        seconds,
        usage.ru_maxrss * 1024 / 1e6,
        out.read_bytes(),
        err.read_bytes(),
        reading,
    )


def states(paths: list[Path]) -> list[object]:
    """What must stay: content of files, targets of links, kinds of all else."""
    found: list[object] = []
    for path in paths:
        try:
            kind = path.lstat().st_mode
        except OSError:
            found.append(None)
            continue
        if stat.S_ISLNK(kind):
            found.append(str(path.readlink()))
        else:
            found.append(
                hashlib.sha256(path.read_bytes()).hexdigest()
                if stat.S_ISREG(kind)
                else kind
            )
    return found


def judge(
    case: Case, outcome: Outcome, sound: dict[str, Any], lost: int
) -> Counter[str]:
    verdict = Counter(
        cases=1,
        tracebacks=int(outcome.crashed),
        hangs=int(outcome.hung),
        files_lost=lost,
    )
    verdict["refused"] = int(outcome.code == 2)
    reading = outcome.reading
    if "error" in reading and not reading["foreseen"]:
        verdict["tracebacks"] += 1
    is_other = (
        "digest" in reading
        and reading["digest"] != sound["digest"]
        and not case.may_differ
    )
    is_named = any(
        sound["notes"].get(subject) != note
        for subject, note in reading.get("notes", {}).items()
    )
    verdict["silent_errors"] = int(is_other and not is_named) + int(
        outcome.has_escapes()
    )
    return verdict


def formulas() -> int:
    """Cells of tables that begin a formula; numbers do not."""
    rows = [
        [text[:200], "-1.5", "1e-3"]
        for text in NOISE
        if "\0" not in text and "\r" not in text
    ]
    cells = [cell for row in csv.reader(io.StringIO(csv_text(rows))) for cell in row]
    wrong = [
        cell
        for cell in cells
        if cell.startswith(("=", "+", "@")) or (cell.startswith("-") and cell != "-1.5")
    ]
    return len(wrong) + (cells.count("-1.5") != len(rows))


def with_gaps(path: Path) -> None:
    """A log whose sensors pause, with faults that the estimators bridge."""
    sequence = simulate_basin(
        BasinOptions(duration_s=180.0, laps=1, dvl_dropouts_per_hour=100.0)
    )
    seconds = (sequence.imu.stamps_ns - sequence.start_ns) * 1e-9
    is_kept = np.flatnonzero((seconds % 40 < 36) | (seconds < 5))
    write_log(path, replace(sequence, imu=sequence.imu.rows(is_kept)))


def interrupts(folder: Path, count: int, rng: np.random.Generator) -> Counter[str]:
    """Ctrl-C at random moments of a comparison."""
    log, verdict = folder / "gaps.mcap", Counter[str]()
    with_gaps(log)
    command = [
        sys.executable,
        "-m",
        "sonar_graph",
        "compare",
        str(log),
        "--estimators",
        "isam2,ekf-slam",
        "-o",
    ]
    began = time.monotonic()
    subprocess.run([*command, str(folder / "whole")], check=True, capture_output=True)
    whole_s = time.monotonic() - began
    note(f"a comparison takes {whole_s:.1f} s")
    for number in range(2 * count):
        if verdict["interrupts"] == count:
            break
        out, after_s = folder / f"interrupted{number}", rng.uniform(0.1, 0.97) * whole_s
        with subprocess.Popen(
            [*command, str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process:
            time.sleep(after_s)
            if process.poll() is not None:
                verdict["interrupts_late"] += 1
                continue
            process.send_signal(signal.SIGINT)
            try:
                _, said = process.communicate(timeout=INTERRUPT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                said = b"it did not end"
        files = [path.name for path in out.rglob("*") if path.is_file()]
        is_whole = "comparison.json" in files and not any(
            "partial" in name for name in files
        )
        is_sound = process.returncode == 130 and said.splitlines()[-1:] == [
            b"sonar-graph: interrupted"
        ]
        if (
            process.returncode == 0 and is_whole
        ):  # it came while the process was already leaving
            verdict["interrupts_late"] += 1
            continue
        verdict["interrupts"] += 1
        if not is_sound or not (is_whole or not files):
            verdict["interrupts_missed"] += 1
            note(
                f"interrupt after {after_s:.2f} s: exit {process.returncode}, {said[-300:]!r}, {files}"
            )
    return verdict


def main() -> int:
    parser = make_parser(__doc__)
    parser.add_argument("--cases", type=int, help="number of cases (default: 600)")
    parser.add_argument(
        "--interrupts", type=int, help="number of interrupted comparisons (default: 30)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the cases (default: 0)")
    options = parser.parse_args()
    count = options.cases if options.cases is not None else 32 if options.quick else 600
    interrupted = (
        options.interrupts
        if options.interrupts is not None
        else 2
        if options.quick
        else 30
    )
    totals, by_kind, rss_mb = (
        Counter[str](),
        defaultdict[str, Counter[str]](Counter),
        0.0,
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        log = SoundLog.written(folder)
        sound = reading_of(folder / "control.mcap")
        (folder / SUITE).write_text(SUITE_TEXT.format(log=log.path))
        images = [
            "--duration-s",
            "119",
            "--laps",
            "1",
            "--images",
            "--set",
            "frame_rate_hz=0.3",
        ]
        for command in (  # compiled and loaded before the first fork
            ["compare", str(log.path), "-o", str(folder / COMPARED)],
            ["simulate", "basin", *images, "-o", str(folder / IMAGED)],
        ):
            with contextlib.suppress(SystemExit):
                sonar_graph(command)
        batch = [
            "bench",
            str(folder / SUITE),
            "-o",
            str(folder / BATCH),
            "--workers",
            "1",
        ]
        subprocess.run(
            [sys.executable, "-m", "sonar_graph", *batch],
            check=True,
            capture_output=True,
        )
        for own, case in cases(log, count, options.seed):
            before = states(case.protected)
            outcome = run_apart(case, own)
            after = states(case.protected)
            verdict = judge(
                case,
                outcome,
                sound,
                sum(a != b for a, b in zip(before, after, strict=True)),
            )
            rss_mb = max(rss_mb, outcome.rss_mb)
            totals += verdict
            by_kind[case.kind] += verdict
            by_kind[case.kind]["rss_mb"] = max(
                by_kind[case.kind]["rss_mb"], round(outcome.rss_mb)
            )
            by_kind[case.kind]["slowest_ms"] = max(
                by_kind[case.kind]["slowest_ms"], round(outcome.seconds * 1e3)
            )
            if any(verdict[name] for name in TARGETS) or outcome.rss_mb > MOST_RSS_MB:
                told = " ".join(word[-60:] for word in case.command)
                note(
                    f"{own.name} {case.kind}: {told}: {dict(verdict)}, exit {outcome.code}, {outcome.seconds:.1f} s, "
                    f"{outcome.rss_mb:.0f} MB: {outcome.err[-500:]!r} {str(outcome.reading)[:300]}"
                )
            shutil.rmtree(own, ignore_errors=True)
        totals["silent_errors"] += formulas()
        totals += interrupts(folder, interrupted, np.random.default_rng(options.seed))
    headings = [
        "cases",
        "refused",
        "tracebacks",
        "hangs",
        "silent_errors",
        "files_lost",
        "rss_mb",
        "slowest_ms",
    ]
    print_table(
        ["kind", *headings],
        [[kind, *(found[h] for h in headings)] for kind, found in by_kind.items()],
    )
    figures = {
        name: totals[name]
        for name in ("cases", "refused", *TARGETS, "interrupts", "interrupts_late")
    }
    figures |= {"peak_rss_mb": round(rss_mb), "seed": options.seed}
    is_passed = (
        all(figures[name] == target for name, target in TARGETS.items())
        and rss_mb <= MOST_RSS_MB
    )
    print_figures(figures | {"passed": is_passed})
    return 0 if is_passed or options.quick else 1


if __name__ == "__main__":
    sys.exit(main())
