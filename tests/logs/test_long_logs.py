"""Logs with images that are larger than what may be in memory at a time."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

PROBE = """
import json, re, sys, time
from pathlib import Path
import numpy as np
from sonar_graph.logs.mcap import Instant, Keep, TimeWindow, scan, stream

def peak_mb():
    status = Path("/proc/self/status").read_text()  # getrusage would count the parent's memory too
    return int(re.search(r"VmHWM:\\s+(\\d+) kB", status)[1]) * 1024 / 1e6

path = Path(sys.argv[1])
before_s = time.perf_counter()
part = scan(path, lambda _: Keep.ALL, TimeWindow(Instant.parse("100"), Instant.parse("110")))
part_s, start_mb = time.perf_counter() - before_s, peak_mb()
before_s, total = time.perf_counter(), 0
for piece in stream(path, lambda kind: Keep.ALL if kind.endswith("Image") else Keep.NONE):
    for stack in piece.stacks.values():
        total += sum(payloads.nbytes for _, payloads in stack)
print(json.dumps({
    "part_s": part_s, "part": len(part.topics["/image"]), "start_mb": start_mb,
    "stream_s": time.perf_counter() - before_s, "peak_mb": peak_mb(), "total": total,
}))
"""
IMAGE_BYTES, IMAGES = 1 << 20, 1000


@pytest.fixture(scope="module")
def long_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1 GB of images, one a second, between numbers at 10 Hz."""
    path = tmp_path_factory.mktemp("long") / "log.mcap"
    image = np.random.default_rng(0).bytes(IMAGE_BYTES)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        channels = []
        for name, kind in (("/image", "Image"), ("/number", "Number")):
            schema = writer.register_schema(f"test_msgs/msg/{kind}", "ros2msg", b"uint8[] data\n")
            channels.append(writer.register_channel(name, "cdr", schema))
        for i in range(10 * IMAGES):
            if i % 10 == 0:
                writer.add_message(channels[0], i * 10**8, image, 0)
            writer.add_message(channels[1], i * 10**8, b"12345678", 0)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells peak memory in /proc")
def test_a_long_log_is_read_in_bounded_memory(long_log: Path) -> None:
    probe = subprocess.run([sys.executable, "-c", PROBE, str(long_log)], check=True, capture_output=True, text=True)
    found = json.loads(probe.stdout)
    assert found["total"] == IMAGES * IMAGE_BYTES
    assert found["part"] == 10
    assert found["part_s"] < 0.1 * found["stream_s"]  # a hundredth of the log, read without the rest
    assert found["peak_mb"] < 150
