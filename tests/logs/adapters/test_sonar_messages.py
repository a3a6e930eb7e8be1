"""Sonar images of any driver as frames: order, samples, gains, bearings and ranges."""

from typing import Any

import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.images import SonarFrames
from sonar_graph.logs import inspect_log, read_sonar_frames
from sonar_graph.logs.adapters import read_log_config
from sonar_graph.measurements import Floats
from tests.logs.conftest import copy, recorded, writing

from .conftest import Entry, at, dvl, imu, rows_of, vector

AZIMUTHS = np.radians([30.0, 0.0, -30.0])
"""Left, middle, right."""
RANGES = [1.0, 1.5, 2.0, 2.5]
POLAR = np.arange(12).reshape(3, 4)
"""Beams by bins."""


def image(data: bytes, dtype: int = 0, *, big: bool = False) -> dict[str, Any]:
    # z forward, x up: then y is to the right
    directions = [vector(0, -np.sin(a), np.cos(a)) for a in AZIMUTHS.tolist()]
    pixels = {"is_bigendian": big, "dtype": dtype, "beam_count": 3, "data": data}
    return {"beam_directions": directions, "ranges": RANGES, "image": pixels}


def images(*messages: dict[str, Any]) -> Entry:
    kind = "marine_acoustic_msgs/msg/ProjectedSonarImage"
    return rows_of("/sonar", kind, messages)


def ping(*gains: int, size: int = 1, **other: Any) -> dict[str, Any]:
    """Samples range by range, each after its gain where there are gains."""
    rows = [samples.astype(f"<u{size}").tobytes() for samples in POLAR.T]
    heads = [np.array([gain], "<u4").tobytes() for gain in gains] or [b""] * 4
    message = {
        "range_resolution": 0.5,
        "has_gains": bool(gains),
        "n_ranges": 4,
        "n_beams": 3,
        "step": len(heads[0]) + len(rows[0]),
        "sample_size": size,
        "bearings": [-3000, 0, 3000],
        "ping_data": b"".join(map(bytes.__add__, heads, rows)),
    }
    return message | other


def pings(*messages: dict[str, Any]) -> Entry:
    return rows_of("/oculus", "oculus_interfaces/msg/Ping", messages)


def frames_in(
    foreign: Any, *entries: Entry, toml: str = "", **settings: Any
) -> list[SonarFrames]:
    config = read_log_config(foreign.config(toml))
    return list(read_sonar_frames(foreign.write(*entries), config=config, **settings))


ROWS = POLAR.T.astype("u1").tobytes()
BEAM_MAJOR = '[sonar]\nimage_order = "beam-major"'
LEFT = '[sonar]\nbearing_positive = "left"'
# fmt: off
CASES: dict[str, tuple[Entry, str, Floats, Floats]] = {
    "range by range": (images(image(ROWS)), "", POLAR, AZIMUTHS),
    "beam by beam, as the definition states": (
        images(image(POLAR.astype("u1").tobytes())), BEAM_MAJOR, POLAR, AZIMUTHS),
    "big endian": (images(image(POLAR.T.astype(">u2").tobytes(), 2, big=True)), "", POLAR, AZIMUTHS),
    "big endian numbers": (images(image(POLAR.T.astype(">f8").tobytes(), 9, big=True)), "", POLAR, AZIMUTHS),
    "positive bearings to the left": (pings(ping()), LEFT, POLAR, -AZIMUTHS),
    "row size from beams, samples and gain": (
        pings(ping(1, 4, 9, 16, size=2)), "[sonar]\nrow_bytes = false", POLAR / [1, 2, 3, 4], AZIMUTHS),
}
# fmt: on


@pytest.mark.parametrize(
    ("entry", "toml", "intensity", "azimuths_rad"), CASES.values(), ids=CASES
)
def test_images_are_beams_by_bins_however_they_come(
    foreign, entry, toml, intensity, azimuths_rad
):
    (frames,) = frames_in(foreign, entry, toml=toml)
    np.testing.assert_allclose(frames.intensity, [intensity])
    np.testing.assert_allclose(frames.azimuths_rad, azimuths_rad)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        (images(image(b"\0" * 11)), "/sonar: field .*11 bytes"),
        (images(image(b"\0" * 12, 17)), "/sonar: field .*dtype .* is 17"),
    ],
)
def test_an_image_that_does_not_fit_is_named(foreign, entry, message):
    with pytest.raises(LogError, match=message):
        frames_in(foreign, entry)


def test_inspect_describes_the_sonar_and_says_what_is_wrong_with_it(foreign):
    for entry, said in (
        (
            pings(ping()),
            "3 beams x 4 bins of uint8, azimuth -30.0° to 30.0°, 0.25 m to 1.75 m",
        ),
        (pings(ping(ping_data=b"\0" * 5)), "cannot be read: "),
        (imu(), "None"),
    ):
        assert str(inspect_log(foreign.write(entry)).sonar).startswith(said)
    assert frames_in(foreign, imu(), dvl()) == []


@pytest.mark.parametrize("bad", [[], [1], [0, 1]])
def test_messages_that_are_no_image_are_refused_by_their_time(foreign, tmp_path, bad):
    """Several messages may share an instant, sound ones and others."""
    messages = recorded(foreign.write(images(*[image(ROWS)] * 6)))
    times_ns = [10, 10, 20, 30, 30, 30]
    for (_, _, message), time_ns in zip(messages, times_ns, strict=True):
        message.log_time = time_ns
    path = tmp_path / "bad.mcap"
    with writing(path) as writer:
        copy(messages, writer, lambda _, row, data: data[:-8] if row in bad else data)
    refused = []
    blocks = read_sonar_frames(path, refused=lambda at_ns, _: refused.append(at_ns))
    assert sum(map(len, blocks)) == 6 - len(bad)
    assert refused == [times_ns[row] for row in bad]


def test_a_block_of_frames_ends_before_an_earlier_stamp(foreign):
    earlier = image(ROWS) | {"header": at(-1)}
    blocks = frames_in(foreign, images(image(ROWS), image(ROWS), earlier))
    assert [len(block) for block in blocks] == [2, 1]
