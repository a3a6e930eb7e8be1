"""DIDSON, ARIS and Oculus recordings; no file of a real DIDSON was at hand: they are written from the documents."""

import re

import numpy as np
import pytest

from sonar_graph.errors import DatasetError
from sonar_graph.images import decibels
from sonar_graph.logs import read_sonar_frames

from .sonar_recordings import (
    CONVERTERS,
    START_NS,
    STEP_NS,
    Aris,
    Ddf,
    Oculus,
    converted,
    images,
    log_of,
    no_ping,
    put,
)

ARIS_BEAMS = {1: 48, 2: 48, 3: 96, 5: 96, 6: 64, 8: 64, 9: 128, 12: 128}
WHOLE = [
    *(
        Ddf(images(5, beams, 512), version=v, high=high)
        for v in (3, 4)
        for beams, high in ((96, 1), (48, 0))
    ),
    Ddf(images(3, 48, 64), high=0, frame_version=b"5.26"),
    *(Aris(images(4, beams, 700), mode=mode) for mode, beams in ARIS_BEAMS.items()),
    Aris(
        images(5, 48, 64), mode=1, sound_speeds=[1480.0, 1480.1, 1480.0, 1480.2, 1480.0]
    ),  # it drifts
    *(
        Oculus(images(4, beams, 40).astype(kind) * factor, version=version)
        for version in (0, 2)
        for kind, factor in (("u1", 1), ("u2", 257), ("u4", 1))
        for beams in (256, 512)
    ),
]


@pytest.mark.parametrize(
    "recording",
    WHOLE,
    ids=lambda r: f"{type(r).__name__}-{r.frames.dtype}-{r.frames.shape[1]}",
)
def test_frames_are_read_as_they_were_recorded(tmp_path, recording):
    result = log_of(tmp_path, recording)
    first_ns = result.done.first_ns
    assert isinstance(recording, Oculus) or first_ns == START_NS
    images = result.by_stamp()
    assert len(images) == result.done.frames == len(recording.frames)
    for (stamp_ns, image), expected in zip(
        sorted(images.items()), enumerate(recording.frames), strict=True
    ):
        i, picture = expected
        assert stamp_ns == pytest.approx(first_ns + i * STEP_NS, abs=1000)
        np.testing.assert_array_equal(image, picture, strict=True)
    assert result.done.duration_s == pytest.approx((len(images) - 1) * 0.12)
    assert (result.done.lost, result.done.shortcomings()) == ([], [])


# fmt: off
WINDOWS = [  # start and length code, other fields, first range and length in metres; the first is of the 2014 paper
    (3, 0, {}, 1.26, 1.25), (1, 3, {}, 0.42, 10.0), (2, 0, {"serial": 18}, 0.75, 1.125), (2, 0, {"high": 0}, 1.68, 5.0),
    (2, 1, {"flags": 2}, 0.84, 5.0), (2, 1, {"flags": 3}, 0.75, 4.5),
    (2, 3, {"high": 0, "flags": 1}, 1.5, 36.0), (2, 0, {"serial": 15}, 0.75, 2.25), (3, 0, {"flags": 240}, 1.26, 1.25),
    (3, 0, {"flags": 1, "version": 4}, 1.26, 1.25),
]
# fmt: on


@pytest.mark.parametrize(
    ("start_code", "length_code", "others", "begin_m", "length_m"), WINDOWS
)
def test_window_codes_of_a_didson_are_metres_at_1465_m_s(
    tmp_path, start_code, length_code, others, begin_m, length_m
):
    beams = 96 if others.get("high", 1) else 48
    codes = {"start_code": start_code, "length_code": length_code} | others
    recording = Ddf(images(2, beams, 500), **codes)
    expected = begin_m + length_m / 500 * (np.arange(500) + 0.5)
    nominal = log_of(tmp_path, recording).frames.ranges_m
    np.testing.assert_allclose(nominal, expected, rtol=1e-6)
    warm = log_of(tmp_path, recording, sound_speed_m_s=1500.0)
    np.testing.assert_allclose(warm.frames.ranges_m, expected * 1500 / 1465, rtol=1e-6)
    assert "1500 m/s" in warm.notes["sonar.ranges"]


@pytest.mark.parametrize(
    ("recording", "first_deg", "last_deg"),
    [  # the first beam in a file is the right-most, unless the sonar is upside down
        (Ddf(images(1, 96, 512)), -14.26, 14.25),
        (Ddf(images(1, 96, 512), reverse=1), 14.25, -14.26),
        (Aris(images(2, 128, 64)), -14.705, 14.705),
        (Aris(images(2, 48, 64), mode=1, system=2, telephoto=1), -6.742, 6.742),
        # no table
        (Aris(images(2, 128, 64), telephoto=1), -7.0 * 127 / 128, 7.0 * 127 / 128),
        (Oculus(images(2, 26, 8)), 65.0, -60.0),
    ],
)
def test_azimuths_are_positive_to_the_left(tmp_path, recording, first_deg, last_deg):
    frames = log_of(tmp_path, recording).frames
    azimuths_deg = np.degrees(frames.azimuths_rad)
    assert azimuths_deg[[0, -1]] == pytest.approx([first_deg, last_deg], abs=0.01)
    if isinstance(recording, Oculus):
        assert azimuths_deg[1] == pytest.approx(60.0)
        ranges_m = 0.003 * (np.arange(8) + 0.5)
        np.testing.assert_allclose(frames.ranges_m, ranges_m, rtol=1e-6)


def test_the_log_says_the_scale_of_the_samples(tmp_path):
    counts = np.array([0, 51, 255], np.uint8)
    for recording, span_db in (
        (Ddf(images(1, 96, 64)), 90),
        (Aris(images(1, 128, 64)), 80),
    ):
        levels_db = decibels(counts, log_of(tmp_path, recording).image)
        np.testing.assert_allclose(levels_db, span_db * (counts / 255), rtol=1e-6)
    pings = images(1, 16, 8)
    for recording, full_scale, gamma in (
        (Oculus(pings, gamma_code=0), 255, 1),
        (Oculus(pings.astype("u2"), gamma_code=255), 65_535, 1),
        (Oculus(pings, gamma_code=51), 255, 0.2),
    ):
        image = log_of(tmp_path, recording).image
        assert (image.scale, image.full_scale) == ("linear", full_scale)
        assert image.gamma == pytest.approx(gamma, abs=1e-3)


# ---- damage of each kind


ONE_DDF = Ddf(images(1, 48, 64), high=0)
TWO_DDF = Ddf(images(2, 96, 512))
ONE_ARIS = Aris(images(1, 48, 64), mode=1)
NOISE = np.random.default_rng(1).integers(0, 256, 200_000, dtype=np.uint8).tobytes()


def poked(recording, at=0, value=b""):
    """Ending and content of a recording, with other bytes in one place."""
    content = bytearray(recording.content())
    content[at : at + len(value)] = value
    return recording.ending, bytes(content)


# fmt: off
REFUSED = [
    *((*poked(TWO_DDF, at, value), words) for at, value, words in [
        (0,  b"MOV",  "begins with b'MOV"),  (3,  b"\x02", "version 2; versions 3 and 4"),
        (3,  b"\x05", "convert aris"),       (16, b"\x61", "97 beams"),
        (12, b"\x07", "resolution 7"),       (24, b"\0\0", "0 samples"),
        (16, b"\x30", "no whole frame"),  # possible, but not the number of beams of the frames
        (25, b"\x01", "no whole frame"),  # nor that of samples
    ]),
    *((*poked(ONE_DDF, 512 + at, value.to_bytes(4, "little", signed=True)), words) for at, value, words in [
        (52, 32, "no whole frame: bytes 512 to 3839: frame 0 with window codes 32 and 0"),
        (52, -1,   "window codes -1 and 0"),  (56, 4,    "window codes 3 and 4"),  # at low frequency: four lengths
        (20, 1970, "year 1970"),              (20, 2038, "year 2038"),
        (44, 100,  "100 hundredths"),         (24, 13,   "a time that does not exist"),
    ]),
    (*poked(ONE_ARIS, 1024 + 20, (2**31 * 10**6).to_bytes(8, "little")), "frame 0 with a time of 2147483648000000 us"),
    *((*poked(Aris(images(3, 128, 64), **field)), words) for field, words in [
        ({"mode": 0}, "no whole frame: bytes 1024 to 28671: a header with ping mode 0"),
        ({"system": 7},         "system type 7"),      ({"in_order": 0},                 "not in order"),
        ({"sound_speed": 15.0}, "sound speed of 15"),  ({"sound_speed": float("nan")},   "sound speed of nan"),
    ]),
    ("ddf", ONE_DDF.content()[:600], "no whole frame: bytes 512 to 599: a frame cut off"),
    *(("ddf", ONE_DDF.content()[:length], "") for length in (0, 2, 3, 4, 300)),
    *((kind.ending, kind.file_header() + NOISE, "") for kind in (ONE_DDF, ONE_ARIS, Oculus(images(1, 16, 8)))),
    ("aris", b"SO" * 4000, "DDF"),
    ("raw", b"DDF\x05" + bytes(4000), "no Oculus ping"),
]
# fmt: on


@pytest.mark.parametrize(("ending", "content", "words"), REFUSED)
def test_other_files_and_headers_that_make_no_sense_are_refused_by_name(
    tmp_path, ending, content, words
):
    """What was there before is left as it is."""
    path = tmp_path / "dive"
    path.write_bytes(content)
    log = tmp_path / "dive.mcap"
    log.write_bytes(b"precious")
    with pytest.raises(DatasetError, match=re.escape(words) or None) as caught:
        CONVERTERS[ending](path, log)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert log.read_bytes() == b"precious"
    assert sorted(tmp_path.iterdir()) == [path, log]


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(DatasetError, match=r"dive: cannot be read: No such file"):
        CONVERTERS["ddf"](tmp_path / "dive", tmp_path / "dive.mcap")


# ---- messages and clocks of an Oculus


def test_messages_without_images_are_skipped(tmp_path):
    pictures = images(4, 16, 8)
    _, first, *pings = Oculus(pictures).pieces()
    note = no_ping(b"SO" * 6)
    huge = bytearray(no_ping())
    put(huge, 10, "I", 1 << 20)
    begin = 2 * len(note) + len(first)
    for between, fault in (
        (note, ""),
        (bytes(len(note)), "no message begins here"),
        (bytes(huge), "a message of kind 0x55, version 0"),
    ):
        content = b"".join([note, first, note, between, *pings, note])
        result = converted(tmp_path, content, "raw")
        np.testing.assert_array_equal(result.frames.intensity, pictures)
        told = f"bytes {begin} to {begin + len(between) - 1}: {fault}"
        assert [str(loss) for loss in result.done.lost] == ([told] if fault else [])


@pytest.mark.recording
@pytest.mark.parametrize(
    "name", ["sample.aris", "one_ping_8bit.raw", "three_pings_8bit.raw"]
)
def test_recordings_of_real_sonars_are_read_to_the_byte(recordings, tmp_path, name):
    source = recordings / "sonar" / name
    is_aris = name.endswith("aris")
    done = CONVERTERS[name.split(".")[1]](source, tmp_path / "dive.mcap")
    assert done.shortcomings() == []
    (frames,) = read_sonar_frames(tmp_path / "dive.mcap")
    # an ARIS 1200 with telephoto lens
    bins, beams, head_bytes, edge_deg = (
        (2000, 48, 1024, -6.742) if is_aris else (703, 256, 2048, 30.0)
    )
    content = np.fromfile(source, np.uint8)[1024 * is_aris :].reshape(len(frames), -1)
    images = content[:, head_bytes:].reshape(-1, bins, beams).transpose(0, 2, 1)
    np.testing.assert_array_equal(frames.intensity, images)
    edges_deg = np.degrees(frames.azimuths_rad)[[0, -1]]
    assert edges_deg == pytest.approx([edge_deg, -edge_deg])
    if is_aris:
        # 2013-06-14, by the sonar
        assert frames.stamps_ns[0] == 1_371_198_080_759_456_000
        # the header also states 3.33 m and 20.3 m, for 1450 m/s; the water had 1435.93 m/s
        window_m = frames.ranges_m[[0, -1]] * 1450 / 1435.93
        assert window_m == pytest.approx([3.3299, 3.33 + 20.3], abs=0.02)
    else:
        assert frames.ranges_m[-1] == pytest.approx(2.0, abs=0.005)
        steps_ns = [62_502_130, 62_502_097][: len(frames) - 1]
        assert np.diff(frames.stamps_ns) == pytest.approx(steps_ns)
