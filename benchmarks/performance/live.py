"""Live operation over the loopback with both ends real: losses, latency, processor time, and equality with the record.

``sonar-graph play`` sends a simulated mission (IMU at 200 Hz, Doppler log at 12, depth and detections at 10 Hz) as a
zenoh router, ``sonar-graph live`` estimates, and a plain zenoh subscriber, here, takes the times.
``sonar-graph run`` then runs on the record. Beside the latency of the pose stands that of the bare middleware.

    python benchmarks/performance/live.py --quick        60 s of isam2, 20 s of each other estimator, 40 s of images
    python benchmarks/performance/live.py                30 minutes of isam2
    python benchmarks/performance/live.py --only 0       the first of the cases

The sonar images are those of a simulated basin, 96 beams x 512 bins, five a second. An image that was not recognised is
named in the record: ``images`` are those that came, ``recognised`` and ``images_dropped`` what became of them.

A prediction takes some 15 us where one follows another, and several times that after a pause, when processor and
caches are cold. ``cold_product_p99_us`` is what the product of two 4 x 4 matrices takes after pauses of 5 ms.
"""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_graph import Imu, write_log
from sonar_graph.live.zenoh_link import ATTACHMENT, open_session, parse_key
from sonar_graph.simulation import MissionOptions, simulate_mission

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import write_results

COMMAND = [sys.executable, "-m", "sonar_graph"]
FILES = ("causal.tum", "trajectory.tum", "landmarks.csv")
IMU, ODOMETRY, IMAGE, DETECTED = (
    "/imu/data",
    "/sonar_graph/odometry",
    "/sonar/image",
    "/sonar_graph/detections",
)
STAMP_AT = 4
"""Place of the stamp in a CDR payload that begins with a header."""
START_S = 60.0
"""Longest time for `live` to compile and listen."""
TICKS = os.sysconf("SC_CLK_TCK")


def stamp_of(payload):
    seconds, nanoseconds = np.frombuffer(
        payload[STAMP_AT : STAMP_AT + 8], "<u4"
    ).tolist()
    return seconds * 1_000_000_000 + nanoseconds


class Ear:
    """Plain subscriber: times of arrival and of sending, by topic and stamp."""

    def __init__(self, endpoint):
        self.session = open_session([endpoint])
        self.arrived = {topic: {} for topic in (IMU, ODOMETRY, IMAGE, DETECTED)}
        self.sent = {IMU: {}, IMAGE: {}}
        self.states = []
        self.subscriber = self.session.declare_subscriber("0/**", self.take)

    def take(self, sample):
        now_ns = time.time_ns()
        topic, _ = parse_key(str(sample.key_expr)) or ("", "")
        if topic in self.arrived:
            stamp_ns = stamp_of(sample.payload.to_bytes())
            self.arrived[topic][stamp_ns] = now_ns
            if topic in self.sent:
                _, self.sent[topic][stamp_ns], _, _ = ATTACHMENT.unpack_from(
                    sample.attachment.to_bytes()
                )
        elif topic == "/sonar_graph/state":
            self.states.append(sample.payload.to_bytes())

    def latencies_ms(self, source, topic):
        """Times from the sending of a message of a source to the arrival of one of another topic with its stamp."""
        arrived, sent = self.arrived[topic], self.sent[source]
        return np.array(
            [
                (arrived[stamp] - sent[stamp]) * 1e-6
                for stamp in sorted(arrived.keys() & sent.keys())
            ]
        )


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def cpu_s(pid):
    """Processor time of a process and its children, also of those that have ended."""
    total = 0.0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            name_and_rest = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(stat.parent.name) == pid or int(name_and_rest[1]) == pid:
            total += (int(name_and_rest[11]) + int(name_and_rest[12])) / TICKS
        if int(stat.parent.name) == pid:
            total += (int(name_and_rest[13]) + int(name_and_rest[14])) / TICKS
    return total


def start_live(folder, endpoint, estimator, more=()):
    options = ["--connect", endpoint, "--estimator", estimator, *more]
    live = subprocess.Popen(
        [*COMMAND, "live", "-o", str(folder), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    said = []
    for line in live.stdout:
        said.append(line)
        if "listening" in line:
            return live
    raise SystemExit("live ended before it listened: " + "".join(said))


def end_live(live):
    live.send_signal(signal.SIGINT)
    said, _ = live.communicate(timeout=120)
    if live.returncode:
        raise SystemExit(f"live ended with code {live.returncode}: {said}")


def differing_bytes(live, record, folder, estimator):
    """Bytes in which the files of a live run differ from those of `run` on its record; -1 for other lengths."""
    subprocess.run(
        [*COMMAND, "run", str(record), "-o", str(folder), "--estimator", estimator],
        check=True,
        capture_output=True,
    )
    count = 0
    for name in FILES:
        mine, theirs = (
            (place / "runs" / estimator / name).read_bytes() for place in (live, folder)
        )
        if len(mine) != len(theirs):
            return -1
        count += int(
            np.count_nonzero(
                np.frombuffer(mine, np.uint8) != np.frombuffer(theirs, np.uint8)
            )
        )
    return count


def one(folder, log, duration_s, estimator, rate, is_cut=False):
    """A live run, listened to, and the run on its record; of a log, or with ``is_cut`` of its beginning."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    result = {"estimator": estimator, "rate": rate}
    # the player is the router, so it is there first; it waits until live has compiled
    gate = folder / "go"
    player = subprocess.Popen(
        [*COMMAND, "play", str(log), "--listen", endpoint, "--rate", str(rate), "--after", str(gate)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    time.sleep(3.0)
    live = start_live(folder / "live", endpoint, estimator)
    ear = Ear(endpoint)
    time.sleep(1.0)
    before_s, begun_s = cpu_s(live.pid), time.monotonic()
    gate.touch()
    place = folder / "live"
    try:
        player.wait(timeout=duration_s / rate + (0.0 if is_cut else START_S))
    except subprocess.TimeoutExpired:
        player.send_signal(signal.SIGINT)
        player.communicate(timeout=START_S)
    result["cpu_share"] = round(
        (cpu_s(live.pid) - before_s) / (time.monotonic() - begun_s), 3
    )
    time.sleep(1.0)
    end_live(live)
    ear.session.close()
    counts = json.loads((place / "live.json").read_text())["messages"]
    result["lost"], result["dropped"] = (
        sum(counts["lost"].values()),
        sum(counts["dropped"].values()),
    )
    result["dropped_for"] = counts["dropped"]
    latencies = {
        "bare": ear.latencies_ms(IMU, IMU),
        "stamp_to_pose": ear.latencies_ms(IMU, ODOMETRY),
        "image_to_detections": ear.latencies_ms(IMAGE, DETECTED),
    }
    for name, values in latencies.items():
        if len(values):
            p50, p99 = np.percentile(values, [50, 99])
            result |= {
                f"{name}_p50_ms": round(p50, 2),
                f"{name}_p99_ms": round(p99, 2),
                f"{name}_count": len(values),
            }
            result[f"{name}_max_ms"] = round(values.max(), 1)
    if ear.sent[IMAGE]:
        result["within_50_ms"] = round(
            float(np.mean(latencies["image_to_detections"] <= 50.0)), 3
        )
        result["images"], result["recognised"] = (
            counts["received"][IMAGE],
            counts["received"].get(DETECTED, 0),
        )
        result["images_dropped"] = sum(
            n for what, n in counts["dropped"].items() if what.startswith(IMAGE)
        )
    key = "predictor_cpu_p99_us"
    result[key] = stated(ear.states, key)
    result["cold_product_p99_us"] = cold_product_p99_us()
    result["load"] = round(os.getloadavg()[1], 1)
    result["differing_bytes"] = differing_bytes(
        place, place / "record.mcap", folder / "again", estimator
    )
    return result


def twice(imu):
    """Rows at twice the rate, with means in between: for traffic, not for accuracy."""
    columns = []
    for column in (imu.stamps_ns, imu.angular_velocity, imu.specific_force):
        between = (
            column[:-1] + (column[1:] - column[:-1]) // 2
            if column.ndim == 1
            else 0.5 * (column[:-1] + column[1:])
        )
        both = np.empty((2 * len(column) - 1, *column.shape[1:]), column.dtype)
        both[::2], both[1::2] = column, between
        columns.append(both)
    return Imu(*columns)


def stated(states, key):
    """Number of the last state message, by its key."""
    if not states:
        return None
    text = states[-1].decode("latin-1").split(key)[1]
    return float("".join(c for c in text[:24] if c.isdigit()) or "nan")


def cold_product_p99_us():
    """Time of a product of two 4 x 4 matrices after pauses as long as those between rows of the IMU."""
    took_s, matrix = [], np.eye(4)
    for _ in range(1000):
        time.sleep(0.005)
        begun_s = time.perf_counter()
        matrix @ matrix
        took_s.append(time.perf_counter() - begun_s)
    return round(1e6 * np.percentile(took_s, 99), 1)


def write_mission(path, duration_s):
    mission = simulate_mission(
        MissionOptions(duration_s=duration_s, dvl="explorer", frame_rate_hz=10.0)
    )
    write_log(path, replace(mission, imu=twice(mission.imu)))


def write_basin(path, _):
    options = ["--images", "--set", "laps=1", "--set", "duration_s=150"]
    subprocess.run(
        [*COMMAND, "simulate", "basin", "-o", str(path), *options],
        check=True,
        capture_output=True,
    )


class Case(NamedTuple):
    """A log that is sent, and how."""

    name: str
    estimator: str
    duration_s: float
    rate: float = 1.0
    with_images: bool = False

    def is_met(self, result):
        """Tell whether the aims hold that are no matter of the machine's other load, and those of a run at its pace."""
        is_met = result["differing_bytes"] == 0 and result["lost"] == 0
        if self.with_images:
            is_met &= (
                result["images"] == result["recognised"] + result["images_dropped"]
            )
        elif self.rate == 1.0:
            is_met &= (
                result["stamp_to_pose_p99_ms"] <= result["bare_p99_ms"] + 10.0
                and result["cpu_share"] <= 0.25
            )
        return is_met


TITLE = "Live operation: losses, latency and equality of the record"
HEADERS = (
    "case",
    "lost",
    "dropped",
    "differing bytes",
    "IMU row to pose p50, p99, ms",
    "bare middleware p50, p99, ms",
    "prediction p99, own time, us",
    "of one core",
    "images, recognised, within 50 ms",
    "load",
    "met",
)


def row_of(result, *, is_met):
    """Row of a case in the table of results."""
    seconds = f"{result['duration_s']:g} s"
    seen = "-"
    if "images" in result:
        seen = f"{result['images']}, {result['recognised']}, {result['within_50_ms']}"
    return (
        f"{result['estimator']}, {seconds}, {result['case']}",
        result["lost"],
        result["dropped"],
        result["differing_bytes"],
        f"{result['stamp_to_pose_p50_ms']}, {result['stamp_to_pose_p99_ms']}",
        f"{result['bare_p50_ms']}, {result['bare_p99_ms']}",
        result["predictor_cpu_p99_us"],
        f"{result['cpu_share']:.2f}",
        seen,
        result["load"],
        "yes" if is_met else "no",
    )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument(
        "--estimators", default="isam2,ekf-slam,invariant-ekf,dead-reckoning"
    )
    parser.add_argument(
        "--only", type=int, nargs="*", help="numbers of the cases, from 0"
    )
    parser.add_argument(
        "--write", action="store_true", help="write benchmarks/results/live.md"
    )
    given = parser.parse_args()
    long_s, short_s = (60.0, 20.0) if given.quick else (1800.0, 60.0)
    first, *others = given.estimators.split(",")
    cases = [
        Case("at its pace", first, long_s),
        *(Case("at its pace", name, short_s) for name in others),
        Case("three times the pace", first, long_s / 2, rate=3.0),
        Case("with images", first, 40.0, with_images=True),
        Case(
            "with images, three times the pace", first, 90.0, rate=3.0, with_images=True
        ),
    ]
    is_met = True
    rows = []
    for number, case in enumerate(cases):
        if given.only is not None and number not in given.only:
            continue
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            log = folder / "log.mcap"
            (write_basin if case.with_images else write_mission)(log, case.duration_s)
            how = (
                case.duration_s,
                case.estimator,
                case.rate,
                case.with_images,
            )
            result = {"case": case.name, "duration_s": case.duration_s} | one(
                folder, log, *how
            )
        print(json.dumps(result), flush=True)
        is_met &= case.is_met(result)
        rows.append(row_of(result, is_met=case.is_met(result)))
    if given.write:
        write_results("live.md", TITLE, HEADERS, rows)
    raise SystemExit(not is_met)


if __name__ == "__main__":
    main()
