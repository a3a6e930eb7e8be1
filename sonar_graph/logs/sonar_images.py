"""Sonar images of a log: their frames, where the sonar is mounted, and the setup of a log that has nothing else."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonar_graph.calibration import Calibration
from sonar_graph.errors import LogError
from sonar_graph.files import as_path
from sonar_graph.images import SonarFrames
from sonar_graph.logs.adapters import (
    LogConfig,
    Refused,
    SonarAdapter,
    as_log_config,
)
from sonar_graph.logs.mcap import (
    Keep,
    Recording,
    TimeWindow,
    keeping,
    scan,
    stream,
)
from sonar_graph.logs.roles import (
    NAVIGATION,
    SONAR,
    Window,
    as_window,
    choose_each,
    choose_topic,
    choose_topics,
)
from sonar_graph.logs.vehicle_setup import (
    PartialCalibration,
    gathered,
    mounted_by,
    read_calibration,
    read_notes,
    recorded_fields,
    recorded_name,
    static_mounting,
    with_fields,
)

OF_THE_IMAGES = ("image", "lens", "elevation_aperture_rad")
"""Fields of a sonar's calibration that a recording of images knows better than a log without."""


@dataclass(frozen=True, eq=False)
class ImagesAlone:
    """What goes with sonar images where no other sensor is used."""

    name: str
    calibration: Calibration
    start_ns: int
    """Stamp of the first frame."""
    notes: dict[str, str]


def lacking_navigation(
    path: Path,
    topics: Mapping[str, str],
    config: LogConfig | None = None,
    window: TimeWindow | None = None,
) -> list[str]:
    """Roles of `NAVIGATION` that no topic of a log plays, where the user did not name one.

    Of several that fit, reading the log refuses and lists them.
    """
    config = config or LogConfig()
    # types are enough: nothing is decompressed
    recording = scan(path, window=window)
    wanted = {role: topic for role, topic in topics.items() if role in NAVIGATION}
    choices = choose_each(recording, wanted, config, NAVIGATION)
    asked = wanted.keys() | {
        role for role in NAVIGATION if {"topic", "type"} & config.table(role).keys()
    }
    return [
        role
        for role, choice in choices.items()
        if not (choice.topic or choice.candidates or role in asked)
    ]


def read_images_alone(
    path: Path,
    *,
    calibration: PartialCalibration | None = None,
    topic: str | None = None,
    config: LogConfig | None = None,
    window: TimeWindow | None = None,
    salvage: bool = False,
) -> ImagesAlone:
    """Read the setup of a log that is used for its sonar images alone.

    Parameters are those of `read_sonar_frames`, with the fields of a calibration that go before the log's own.

    Raises
    ------
    LogError
        When the log has no sonar images, or cannot be read.
    CalibrationError
        When the calibration in the log is invalid, or becomes so.
    """
    config = config or LogConfig()
    recording = scan(path)
    if not salvage:
        recording.require_sound()
    # the first frame shows whether the images can be read, and when they begin; others are named when they are used
    first = next(
        read_sonar_frames(
            path, topic, config, window=window, salvage=salvage, refused=lambda *_: None
        ),
        None,
    )
    if first is None:
        raise LogError(no_images(path, window))
    recorded = read_calibration(recording)
    is_stated = SONAR in mounted_by(
        recorded.model_dump(exclude_unset=True) if recorded else {}
    )
    # what the user states goes before the record, and the record before the frames of the log
    is_stated |= calibration is not None and SONAR in mounted_by(calibration.values)
    frame = None if is_stated else sonar_frame(recording, topic, config)
    mounting = None if frame is None else static_mounting(path, frame)
    return ImagesAlone(
        recorded_name(recording) or path.stem,
        gathered(calibration, recorded, {} if mounting is None else {SONAR: mounting}),
        int(first.stamps_ns[0]),
        read_notes(recording) | recording.notes(),
    )


def sonar_frame(
    recording: Recording, topic: str | None = None, config: LogConfig | None = None
) -> str | None:
    """Frame of the sonar in ``/tf_static`` as its first image names it; None without images, or where several could be.

    Parameters
    ----------
    recording
        The log; of images that are not in it the first is read from its file.
    topic, config
        As for `read_sonar_frames`.
    """
    choice = choose_topic(SONAR, recording, config or LogConfig(), topic)
    if choice.topic is None or choice.adapter is None:
        return None
    images = recording.topics[choice.topic]
    pieces = (
        [images]
        if images.keep is Keep.ALL
        else stream(recording.path, keeping([images.type_name]), salvage=True)
    )
    found = (piece.messages() for piece in pieces if piece.name == choice.topic)
    # the first piece may hold other topics only
    messages = next((groups for groups in found if groups), None)
    return choice.adapter.frame_in(messages) if messages else None


def joined_calibration(
    images: Path,
    navigation: Path,
    topic: str | None = None,
    given: PartialCalibration | None = None,
) -> str:
    """JSON of the calibration of a navigation, with what images of another log know of their sonar.

    What the user gives goes before both. The sonar's mounting is that of the navigation's record or ``/tf_static``, or
    else that of the images'; without either it stays unstated. ``topic`` is that of the images.
    """
    known = recorded_fields(navigation) or {}
    own = (recorded_fields(images) or {}).get(SONAR, {})
    # the sonar's own recording has its lens and scale
    better = {name: own[name] for name in OF_THE_IMAGES if name in own}
    frame = sonar_frame(scan(images), topic)
    found = None if frame is None else static_mounting(navigation, frame)
    # the vehicle's tree goes before that of the sonar's own log
    if found is None and frame is not None and "mounting" not in own:
        found = static_mounting(images, frame)
    mounting = {} if found is None else {"mounting": found.model_dump(mode="json")}
    return with_fields(
        {SONAR: own | mounting}, known, {SONAR: better}, given.values if given else {}
    )


def no_images(log: Path | str, window: TimeWindow | None = None) -> str:
    """Message for a log without sonar images, or without any in a part of it."""
    if window is not None and (window.start or window.end):
        return f"{log}: has no sonar images between --start and --end; leave them out to use the whole log"
    return (
        f"{log}: has no sonar images; `sonar-graph inspect {log}` lists what it has "
        "(`sonar-graph compare` and read_log need none)"
    )


def read_sonar_frames(
    path: Path,
    topic: str | None = None,
    config: LogConfig | str | Path | None = None,
    *,
    window: Window | None = None,
    salvage: bool = False,
    refused: Refused | None = None,
) -> Iterator[SonarFrames]:
    """Read the frames of one sonar in blocks that share beams and bins, holding one chunk of the file at a time.

    Blocks and the frames in them are in the order of the log; a block ends before a frame with an earlier stamp.

    Parameters
    ----------
    path
        An MCAP file.
    topic
        Topic of the images, where several fit.
    config
        Description of the topics of a foreign log; its table is ``[sonar]``.
    window, salvage
        As for `read_log`.
    refused
        Called with stamp and reason of each message that is no image; None: the first is an error.

    Raises
    ------
    MissingTopicError
        When the wanted topic is missing, or cannot be read.
    LogError
        When several topics fit, the file is damaged in its middle (without ``salvage``, after the last frame), or an
        image is not as its message states (without ``refused``). A log without sonar images gives no block.
    """
    call = "read_sonar_frames"
    path = as_path(path, f"{call}(path)")
    config = as_log_config(config, call) or LogConfig()
    part = as_window(window, call)
    recording = scan(path)
    choice = choose_topics(
        recording, {SONAR: topic} if topic else {}, config, (SONAR,)
    )[SONAR]
    if choice.topic is None or not isinstance(choice.adapter, SonarAdapter):
        return
    # images of a dive do not fit into memory
    for piece in stream(
        path,
        keeping([recording.topics[choice.topic].type_name]),
        part,
        salvage=salvage,
    ):
        if piece.name == choice.topic:
            yield from choice.adapter.read(piece, refused)


def describe_frames(frames: SonarFrames) -> str:
    """Size, sector and range of a block, in words."""
    _, beams, bins = frames.intensity.shape
    left, right = np.degrees([frames.azimuths_rad.max(), frames.azimuths_rad.min()])
    return (
        f"{beams} beams x {bins} bins of {frames.intensity.dtype}, azimuth {right:.1f}° to {left:.1f}°, "
        f"{frames.ranges_m.min():.2f} m to {frames.ranges_m.max():.2f} m"
    )
