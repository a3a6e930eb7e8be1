"""What a conversion wrote, read back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sonar_graph.logs.convert.didson_aris import convert_aris, convert_didson
from sonar_graph.logs.convert.oculus import convert_oculus
from sonar_graph.logs.convert.sonar_file import SonarConversion
from sonar_graph.logs.mcap.reader import Recording, scan
from sonar_graph.logs.mcap.topic import Keep
from sonar_graph.logs.reading import read_sonar_frames
from sonar_graph.logs.vehicle_setup import read_calibration, read_notes
from sonar_graph.measurements import SonarFrames

CONVERTERS: dict[str, Callable[..., SonarConversion]] = {
    "ddf": convert_didson,
    "aris": convert_aris,
    "raw": convert_oculus,
}


@dataclass
class Converted:
    done: SonarConversion
    blocks: list[SonarFrames]
    recording: Recording

    @property
    def frames(self) -> SonarFrames:
        """All of them, where there is one block."""
        (block,) = self.blocks
        return block

    @property
    def notes(self) -> dict[str, str]:
        return read_notes(self.recording)

    @property
    def calibration(self) -> Any:
        return read_calibration(self.recording)

    def by_stamp(self) -> dict[int, NDArray[Any]]:
        return {
            stamp_ns: image
            for block in self.blocks
            for stamp_ns, image in zip(block.stamps_ns.tolist(), block.intensity, strict=True)
        }


def converted(folder: Path, content: bytes, ending: str, **settings: Any) -> Converted:
    source, log = folder / f"dive.{ending}", folder / "dive.mcap"
    source.write_bytes(content)
    done = CONVERTERS[ending](source, log, **settings)
    return Converted(done, list(read_sonar_frames(log)), scan(log, lambda _: Keep.NONE))


def degrees(frames: SonarFrames) -> NDArray[np.float64]:
    return np.degrees(frames.azimuths_rad)
