"""The picture of 10_live.md: ``python docs/tutorials/live.py PICTURE.png``.

A basin is sent by ``sonar-graph play``, ``sonar-graph live`` estimates, and what it publishes is drawn here as it was
at four times.
"""

import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from sonar_graph.live import open_session
from sonar_graph.live.zenoh_link import parse_key
from sonar_graph.logs.cdr import Decoder, definition, parse_definition
from sonar_graph.simulation import LANDMARKS_XY_M

COMMAND = [sys.executable, "-m", "sonar_graph"]
DURATION_S, SHARES = 150.0, (0.25, 0.5, 0.75, 1.0)
POSE, MAP = "/sonar_graph/pose", "/sonar_graph/landmarks"
KINDS = {
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    MAP: "sonar_graph_msgs/msg/LandmarkMap",
}
LARGER = 5.0
"""By how much ellipses are drawn too large."""
QUANTILE_95 = 5.991
"""Of chi square, 2 degrees of freedom."""


def heard_of(log: Path, folder: Path) -> list[tuple[str, Any]]:
    """What a live run publishes on the log, in the order in which it came."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    go, found = folder / "go", list[tuple[str, Any]]()
    decoders = {
        topic: Decoder(parse_definition(kind, definition(kind)))
        for topic, kind in KINDS.items()
    }

    def take(sample: Any) -> None:
        topic, _ = parse_key(str(sample.key_expr)) or ("", "")
        if topic in decoders:
            payload = np.frombuffer(sample.payload.to_bytes(), np.uint8)[None].copy()
            found.append(
                (
                    topic,
                    decoders[topic]
                    .decode([(np.zeros(1, np.int64), payload)])
                    .groups[0],
                )
            )

    player = subprocess.Popen(
        [*COMMAND, "play", log, "--listen", endpoint, "--after", go]
    )
    time.sleep(5.0)
    options = ["--connect", endpoint, "--calibration", log]
    with subprocess.Popen(
        [*COMMAND, "live", "-o", folder / "dive", *options], stdout=subprocess.PIPE
    ) as live:
        assert live.stdout is not None
        while b"listening" not in live.stdout.readline():
            pass
        session = open_session([endpoint])
        subscriber = session.declare_subscriber("0/sonar_graph/**", take)
        time.sleep(1.0)
        go.touch()
        player.wait()
        live.send_signal(signal.SIGINT)
        live.communicate()
    subscriber.undeclare()
    session.close()
    return found


def draw(found: list[tuple[str, Any]], path: Path) -> None:
    """The path so far and the map at four times."""
    figure = Figure((13, 4.2), layout="constrained")
    panels = figure.subplots(1, len(SHARES), sharex=True, sharey=True)
    stamps_s = [
        float(m["header.stamp.sec"][0] + 1e-9 * m["header.stamp.nanosec"][0])
        for _, m in found
    ]
    for panel, share in zip(panels, SHARES, strict=True):
        until_s = stamps_s[0] + share * (stamps_s[-1] - stamps_s[0])
        seen = [
            one for one, at_s in zip(found, stamps_s, strict=True) if at_s <= until_s
        ]
        # of those of one instant the last: with a sensor that comes late all are estimated anew
        poses = {
            at_s: [float(m[f"pose.pose.position.{axis}"][0]) for axis in "xy"]
            for (topic, m), at_s in zip(found, stamps_s, strict=True)
            if topic == POSE and at_s <= until_s
        }
        panel.plot(
            *np.transpose([poses[at_s] for at_s in sorted(poses)]),
            color="tab:blue",
            linewidth=1.2,
        )
        panel.plot(*np.transpose(LANDMARKS_XY_M), "k+", markersize=10)
        for m in [m for topic, m in seen if topic == MAP][-1:]:
            covariances = m["covariance"].reshape(-1, 3, 3)
            for identity, at, P in zip(
                m["ids"][0], m["position"].reshape(-1, 3), covariances, strict=True
            ):
                variances, axes = np.linalg.eigh(P[:2, :2])
                width, height = 2.0 * LARGER * np.sqrt(QUANTILE_95 * variances)
                angle = np.degrees(np.arctan2(axes[1, 0], axes[0, 0]))
                panel.add_patch(
                    Ellipse(
                        at[:2],
                        width,
                        height,
                        angle=angle,
                        color="tab:orange",
                        alpha=0.6,
                    )
                )
                panel.annotate(
                    str(identity), at[:2], (6, 6), textcoords="offset points"
                )
        panel.set_title(f"{until_s - stamps_s[0]:.0f} s", fontsize=10)
        panel.set_aspect("equal")
        panel.set_xlabel("x, m")
    panels[0].set_ylabel("y, m")
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch) / "basin.mcap"
        setting = ["--set", "laps=1", "--set", f"duration_s={DURATION_S:g}"]
        subprocess.run([*COMMAND, "simulate", "basin", "-o", log, *setting], check=True)
        draw(heard_of(log, Path(scratch)), Path(sys.argv[1]))
