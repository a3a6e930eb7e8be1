from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.logs.adapters.log_config import read_log_config
from sonar_graph.logs.inspection import inspect_log
from sonar_graph.logs.reading import read_sonar_frames
from sonar_graph.measurements import SonarFrames

IMAGE, PING = "marine_acoustic_msgs/msg/ProjectedSonarImage", "oculus_interfaces/msg/Ping"
AZIMUTHS = np.radians([30.0, 0.0, -30.0])
"""Left, middle, right."""
RANGES = [1.0, 1.5, 2.0, 2.5]
POLAR = np.arange(12).reshape(3, 4)
"""Beams by bins."""


def image(foreign: Any, row: int, data: bytes, dtype: int = 0, *, big: bool = False) -> dict[str, Any]:
    # z forward, x up: then y is to the right
    directions = [foreign.vector(0, -np.sin(a), np.cos(a)) for a in AZIMUTHS.tolist()]
    pixels = {"is_bigendian": big, "dtype": dtype, "beam_count": 3, "data": data}
    return {"header": foreign.header(row), "beam_directions": directions, "ranges": RANGES, "image": pixels}


def frames_in(path: Path, toml: Path | None = None, **settings: Any) -> list[SonarFrames]:
    return list(read_sonar_frames(path, config=read_log_config(toml) if toml else None, **settings))


def test_images_are_beams_by_bins_although_they_come_range_by_range(foreign: Any) -> None:
    messages = [image(foreign, i, (POLAR.T + i).astype("u1").tobytes()) for i in range(3)]
    (frames,) = frames_in(foreign.write(("/sonar", IMAGE, messages)))
    assert frames.intensity.shape == (3, 3, 4)
    np.testing.assert_array_equal(frames.intensity[1], POLAR + 1)
    np.testing.assert_allclose(frames.azimuths_rad, AZIMUTHS)
    np.testing.assert_allclose(frames.ranges_m, RANGES)
    assert (frames.stamps_ns - foreign.t0_ns).tolist() == [0, foreign.step_ns, 2 * foreign.step_ns]


def test_the_order_that_the_definition_states_can_be_chosen(foreign: Any) -> None:
    path = foreign.write(("/sonar", IMAGE, [image(foreign, 0, POLAR.astype("u1").tobytes())]))
    config = foreign.config('[sonar]\nimage_order = "beam-major"')
    np.testing.assert_array_equal(frames_in(path, config)[0].intensity[0], POLAR)
    assert (frames_in(path)[0].intensity[0] != POLAR).any()


@pytest.mark.parametrize(("dtype", "kind"), [(2, "u2"), (9, "f8")])
def test_samples_may_be_big_endian(foreign: Any, dtype: int, kind: str) -> None:
    path = foreign.write(("/sonar", IMAGE, [image(foreign, 0, POLAR.T.astype(f">{kind}").tobytes(), dtype, big=True)]))
    np.testing.assert_array_equal(frames_in(path)[0].intensity[0], POLAR)


def test_blocks_are_split_where_the_range_changes(foreign: Any) -> None:
    data = POLAR.T.astype("u1").tobytes()
    messages = [image(foreign, i, data) | {"ranges": [r * (2 if i == 1 else 1) for r in RANGES]} for i in range(3)]
    blocks = frames_in(foreign.write(("/sonar", IMAGE, messages)))
    assert [(len(block), float(block.ranges_m[-1])) for block in blocks] == [(1, 2.5), (1, 5.0), (1, 2.5)]
    assert [(block.stamps_ns[0] - foreign.t0_ns) // foreign.step_ns for block in blocks] == [0, 1, 2]


@pytest.mark.parametrize(("data", "dtype", "words"), [(b"\0" * 11, 0, "11 bytes"), (b"\0" * 12, 17, "dtype .* is 17")])
def test_an_image_that_does_not_fit_is_named(foreign: Any, data: bytes, dtype: int, words: str) -> None:
    path = foreign.write(("/sonar", IMAGE, [image(foreign, 0, data, dtype)]))
    with pytest.raises(LogError, match=rf"/sonar: field .*{words}"):
        frames_in(path)


def ping(foreign: Any, row: int, *, gains: list[int] | None, size: int = 1, padding: int = 0) -> dict[str, Any]:
    rows = [samples.astype(f"<u{size}").tobytes() for samples in POLAR.T]
    if gains is not None:
        rows = [np.array([gain], "<u4").tobytes() + samples for gain, samples in zip(gains, rows, strict=True)]
    rows = [samples + b"\xff" * padding for samples in rows]
    return {
        "header": foreign.header(row),
        "range_resolution": 0.5,
        "has_gains": gains is not None,
        "n_ranges": 4,
        "n_beams": 3,
        "step": len(rows[0]),
        "sample_size": size,
        "bearings": [-3000, 0, 3000],
        "ping_data": b"".join(rows),
    }


@pytest.mark.parametrize("padding", [0, 2])
@pytest.mark.parametrize("size", [1, 2])
def test_oculus_rows_begin_with_a_gain_that_is_taken_out(foreign: Any, size: int, padding: int) -> None:
    gains = [1, 4, 9, 16]
    messages = [
        ping(foreign, 0, gains=None, size=size, padding=padding),
        ping(foreign, 1, gains=gains, size=size, padding=padding),
    ]
    plain, gained = sorted(frames_in(foreign.write(("/oculus", PING, messages))), key=lambda f: f.stamps_ns[0])
    np.testing.assert_array_equal(plain.intensity[0], POLAR)
    np.testing.assert_allclose(gained.intensity[0], POLAR / [1, 2, 3, 4])
    np.testing.assert_allclose(plain.azimuths_rad, AZIMUTHS)  # hundredths of a degree, negative on the left
    np.testing.assert_allclose(plain.ranges_m, [0.25, 0.75, 1.25, 1.75])


def test_the_size_of_a_row_follows_from_beams_samples_and_gain(foreign: Any) -> None:
    path = foreign.write(("/oculus", PING, [ping(foreign, 0, gains=[1, 4, 9, 16], size=2)]))
    (frames,) = frames_in(path, foreign.config("[sonar]\nrow_bytes = false"))
    np.testing.assert_allclose(frames.intensity[0], POLAR / [1, 2, 3, 4])


def test_the_side_of_positive_bearings_can_be_said(foreign: Any) -> None:
    path = foreign.write(("/oculus", PING, [ping(foreign, 0, gains=None)]))
    (frames,) = frames_in(path, foreign.config('[sonar]\nbearing_positive = "left"'))
    np.testing.assert_allclose(frames.azimuths_rad, -AZIMUTHS)


def test_of_two_sonars_one_must_be_chosen(foreign: Any) -> None:
    messages = [image(foreign, 0, POLAR.T.astype("u1").tobytes())]
    path = foreign.write(("/left", IMAGE, messages), ("/right", IMAGE, messages))
    with pytest.raises(LogError, match=r"2 topics fit: /left, /right; choose one: --topic sonar=/left"):
        frames_in(path)
    assert len(frames_in(path, topic="/right")) == 1


def test_a_log_without_sonar_has_no_frames(foreign: Any) -> None:
    assert frames_in(foreign.write(foreign.imu(), foreign.dvl())) == []


def test_inspect_describes_the_sonar_and_says_what_is_wrong_with_it(foreign: Any) -> None:
    sound = foreign.write(("/oculus", PING, [ping(foreign, 0, gains=None)]))
    assert inspect_log(sound).sonar == "3 beams x 4 bins of uint8, azimuth -30.0° to 30.0°, 0.25 m to 1.75 m"
    broken = foreign.write(("/oculus", PING, [ping(foreign, 0, gains=None) | {"ping_data": b"\0" * 5}]))
    assert "cannot be read: " in str(inspect_log(broken).sonar)
    assert inspect_log(foreign.write(foreign.imu())).sonar is None


@pytest.mark.recording
def test_a_real_oculus_ping_comes_out_as_its_own_header_says(foreign: Any, recordings: Path) -> None:
    raw = (recordings / "sonar" / "one_ping_8bit.raw").read_bytes()
    bearings = np.round(np.linspace(-3000, 3000, 256)).astype(int).tolist()
    pixels = np.frombuffer(raw[2048 : 2048 + 256 * 703], np.uint8).reshape(703, 256)
    message = ping(foreign, 0, gains=None) | {
        "range_resolution": 2.0 / 703,
        "n_ranges": 703,
        "n_beams": 256,
        "step": 256,
        "bearings": bearings,
        "ping_data": pixels.tobytes(),
    }
    (frames,) = frames_in(foreign.write(("/oculus", PING, [message])))
    assert frames.intensity.shape == (1, 256, 703)
    # neighbours along a beam and across beams look alike in the right order, and do not when it is transposed
    right = frames.intensity[0].astype(float)
    config = foreign.config('[sonar]\nimage_order = "beam-major"\nrow_bytes = false')
    (wrong,) = frames_in(foreign.write(("/oculus", PING, [message])), config)
    assert _roughness(right) < 0.8 * _roughness(wrong.intensity[0].astype(float))


def _roughness(image: np.ndarray) -> float:
    return float(np.abs(np.diff(image, axis=0)).mean() + np.abs(np.diff(image, axis=1)).mean())
