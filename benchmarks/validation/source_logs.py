"""Small logs to be damaged."""

import itertools
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, IndexType

sys.path.insert(0, str(Path(__file__).parents[1] / "performance"))
from log_truth import Truth, read_truth
from mission_log import write_mission

from sonar_graph.logs import write_log
from sonar_graph.simulation import MissionOptions, simulate_mission

CHUNK_BYTES = 1 << 16
DURATION_S, FRAMES = 20.0, 5
SETTINGS: dict[str, dict[str, Any]] = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "no message index": {"index_types": IndexType.CHUNK},
    "no summary": {
        "index_types": IndexType.MESSAGE,
        "use_statistics": False,
        "use_summary_offsets": False,
        "repeat_channels": False,
        "repeat_schemas": False,
    },
    "unchunked": {"use_chunking": False},
    "unchunked, data CRC": {"use_chunking": False, "enable_data_crcs": True},
    "data CRC": {"enable_data_crcs": True},
}
WRITING = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parents[1] / "performance")!r})
from mission_log import write_mission
write_mission(Path(sys.argv[1]), {DURATION_S}, {FRAMES}, chunk_bytes={CHUNK_BYTES})
"""


def source_logs(folder: Path) -> list[Path]:
    """One log for each kind of container, and one of our own."""
    paths = []
    for name, settings in SETTINGS.items():
        paths.append(folder / f"{name}.mcap")
        write_mission(
            paths[-1], DURATION_S, FRAMES, chunk_bytes=CHUNK_BYTES, **settings
        )
    paths.append(folder / "own.mcap")
    write_log(
        paths[-1], simulate_mission(MissionOptions(duration_s=120.0, landmarks=5))
    )
    return paths


def killed_logs(folder: Path, count: int) -> list[tuple[Path, Truth]]:
    """Logs whose writer was killed, and the truth from a writer that was not."""
    whole = folder / "zstd.mcap"
    truth = read_truth(whole)
    found = []
    for number in itertools.count():
        path = folder / f"killed{number}.mcap"
        writer = subprocess.Popen([sys.executable, "-c", WRITING, str(path)])
        size = whole.stat().st_size * (number + 1) // (count + 1)
        while writer.poll() is None and (
            not path.exists() or path.stat().st_size < size
        ):
            time.sleep(1e-4)
        writer.kill()
        writer.wait()
        found.append((path, truth))
        if len(found) == count:
            return found
    raise AssertionError
