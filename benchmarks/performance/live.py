"""Live operation over the loopback with both ends real: losses, latency, processor time, and equality with the record.

``sonar-graph play`` sends a simulated mission (IMU at 200 Hz, Doppler log at 12, depth and detections at 10 Hz) as a
zenoh router, ``sonar-graph live`` estimates, and a plain zenoh subscriber, here, takes the times.
``sonar-graph run`` then runs on the record. Beside the latency of the pose stands that of the bare middleware.

    python benchmarks/performance/live.py --quick        60 s of isam2, 20 s of each other estimator
    python benchmarks/performance/live.py                30 minutes of isam2
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

import numpy as np

from sonar_graph import Imu, write_log
from sonar_graph.live.zenoh_link import ATTACHMENT, open_session, parse_key
from sonar_graph.simulation import MissionOptions, simulate_mission

COMMAND = [sys.executable, "-m", "sonar_graph"]
FILES = ("causal.tum", "trajectory.tum", "landmarks.csv")
STAMP_AT = 4
"""Place of the stamp in a CDR payload that begins with a header."""
START_S = 60.0
"""Longest time for `live` to compile and listen."""
TICKS = os.sysconf("SC_CLK_TCK")


def stamp_of(payload):
    seconds, nanoseconds = np.frombuffer(payload[STAMP_AT : STAMP_AT + 8], "<u4").tolist()
    return seconds * 1_000_000_000 + nanoseconds


class Ear:
    """Plain subscriber: times of arrival and of sending, by topic and stamp."""

    def __init__(self, endpoint):
        self.session = open_session([endpoint])
        self.arrived = {"/imu/data": {}, "/sonar_graph/odometry": {}}
        self.sent = {}
        self.states = []
        self.subscriber = self.session.declare_subscriber("0/**", self.take)

    def take(self, sample):
        now_ns = time.time_ns()
        topic, _ = parse_key(str(sample.key_expr)) or ("", "")
        if topic in self.arrived:
            stamp_ns = stamp_of(sample.payload.to_bytes())
            self.arrived[topic][stamp_ns] = now_ns
            if topic == "/imu/data":
                _, self.sent[stamp_ns], _, _ = ATTACHMENT.unpack_from(sample.attachment.to_bytes())
        elif topic == "/sonar_graph/state":
            self.states.append(sample.payload.to_bytes())

    def latencies_ms(self, topic):
        """Times from the sending of the IMU row to the arrival of a message of its stamp."""
        common = self.arrived[topic].keys() & self.sent.keys()
        return np.array([(self.arrived[topic][stamp] - self.sent[stamp]) * 1e-6 for stamp in sorted(common)])


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def cpu_s(pid):
    """Processor time of a process and its children."""
    total = 0.0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            name_and_rest = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(stat.parent.name) == pid or int(name_and_rest[1]) == pid:
            total += (int(name_and_rest[11]) + int(name_and_rest[12])) / TICKS
    return total


def start_live(folder, endpoint, estimator, more=()):
    options = ["--connect", endpoint, "--estimator", estimator, *more]
    live = subprocess.Popen(
        [*COMMAND, "live", "-o", str(folder), *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
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
        [*COMMAND, "run", str(record), "-o", str(folder), "--estimator", estimator], check=True, capture_output=True
    )
    count = 0
    for name in FILES:
        mine, theirs = ((place / "runs" / estimator / name).read_bytes() for place in (live, folder))
        if len(mine) != len(theirs):
            return -1
        count += int(np.count_nonzero(np.frombuffer(mine, np.uint8) != np.frombuffer(theirs, np.uint8)))
    return count


def one(folder, log, duration_s, estimator, rate, kill_at_s=None):
    """A live run, listened to, and the run on its record."""
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
    if kill_at_s is not None:
        time.sleep(kill_at_s)
        killed_s = time.monotonic()
        subprocess.run(["pkill", "-KILL", "-P", str(live.pid)], check=False)
        live.kill()
        live.communicate()
        live = start_live(folder / "resumed", endpoint, estimator, ["--resume", str(folder / "live" / "record.mcap")])
        result["resume_s"] = round(time.monotonic() - killed_s, 2)
    place = folder / ("live" if kill_at_s is None else "resumed")
    player.wait(timeout=duration_s / rate + START_S)
    result["cpu_share"] = round((cpu_s(live.pid) - before_s) / (time.monotonic() - begun_s), 3)
    time.sleep(1.0)
    end_live(live)
    ear.session.close()
    counts = json.loads((place / "live.json").read_text())["messages"]
    result["lost"], result["dropped"] = sum(counts["lost"].values()), sum(counts["dropped"].values())
    bare, pose = ear.latencies_ms("/imu/data"), ear.latencies_ms("/sonar_graph/odometry")
    for name, values in (("bare", bare), ("stamp_to_pose", pose)):
        if len(values):
            p50, p99 = np.percentile(values, [50, 99])
            result |= {f"{name}_p50_ms": round(p50, 2), f"{name}_p99_ms": round(p99, 2), f"{name}_count": len(values)}
    result["predictor_p99_us"] = predictor_p99_us(ear.states)
    result["differing_bytes"] = differing_bytes(place, place / "record.mcap", folder / "again", estimator)
    return result


def twice(imu):
    """Rows at twice the rate, with means in between: for traffic, not for accuracy."""
    columns = []
    for column in (imu.stamps_ns, imu.angular_velocity, imu.specific_force):
        between = (
            column[:-1] + (column[1:] - column[:-1]) // 2 if column.ndim == 1 else 0.5 * (column[:-1] + column[1:])
        )
        both = np.empty((2 * len(column) - 1, *column.shape[1:]), column.dtype)
        both[::2], both[1::2] = column, between
        columns.append(both)
    return Imu(*columns)


def predictor_p99_us(states):
    """Value of the last state message."""
    if not states:
        return None
    texts = states[-1].decode("latin-1").split("predictor_p99_us")[1]
    return float("".join(c for c in texts[:24] if c.isdigit()) or "nan")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--estimators", default="isam2,ekf-slam,invariant-ekf,dead-reckoning")
    given = parser.parse_args()
    long_s, short_s = (60.0, 20.0) if given.quick else (1800.0, 60.0)
    first, *others = given.estimators.split(",")
    cases = [(first, long_s, 1.0, None), *((name, short_s, 1.0, None) for name in others)]
    cases += [(first, 2 * short_s, 1.0, 0.5 * short_s), (first, long_s / 2, 3.0, None)]
    is_met = True
    for estimator, duration_s, rate, kill_at_s in cases:
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            mission = simulate_mission(MissionOptions(duration_s=duration_s, dvl="explorer", frame_rate_hz=10.0))
            write_log(folder / "mission.mcap", replace(mission, imu=twice(mission.imu)))
            result = {"case": "killed and resumed" if kill_at_s else f"{duration_s:g} s"}
            result |= one(folder, folder / "mission.mcap", duration_s, estimator, rate, kill_at_s)
        print(json.dumps(result), flush=True)
        is_met &= result["differing_bytes"] == 0
        if rate == 1.0 and kill_at_s is None:
            is_met &= result["lost"] == 0
            is_met &= result["stamp_to_pose_p99_ms"] <= result["bare_p99_ms"] + 10.0 and result["cpu_share"] <= 0.25
    raise SystemExit(not is_met)


if __name__ == "__main__":
    main()
