"""``sonar-graph join``: sonar images of one file with IMU, Doppler log and the rest of another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sonar_graph.cli.arguments import (
    OutputLog,
    Overwrite,
    ReadingOptions,
    argument,
    echo,
    option,
    with_options,
)
from sonar_graph.cli.outputs import progress_bars, working, writable_log
from sonar_graph.errors import LogError

if TYPE_CHECKING:
    from sonar_graph.calibration import Calibration
    from sonar_graph.images import SonarFrames
    from sonar_graph.logs.mcap import Outgoing
    from sonar_graph.recognition import PlanarStep
    from sonar_graph.sequence import Sequence

TOPIC = "/sonar/image"
SEARCH_S = 10.0
# standard deviations of the estimated offset beyond which a stated one is doubted
DISAGREEING = 4.0
NS_PER_S = 10**9


@dataclass(frozen=True, eq=False)
class Seen:
    """Motion that the images of a file show."""

    stamps_ns: list[int]
    steps: list[PlanarStep]
    range_m: float
    """Middle of their window."""


@dataclass(frozen=True)
class JoinOptions:
    """Options for the clock offset of the images, and for the log that is written."""

    offset: float | None = option(
        "To add to the images' stamps. Default: estimated, by what images and sensors say of the motion.",
        metavar="SECONDS",
    )
    search: float | None = option(
        f"Estimate the offset within so much of --offset, or of 0; {SEARCH_S:g} where neither is given.",
        metavar="SECONDS",
        min=0.5,
        max=3600.0,
    )
    overwrite: Overwrite = False


@with_options("start", "end", "map")
def join(
    images: Path = argument(
        "MCAP log with sonar images, as `convert` makes of a sonar's recording.",
        "IMAGES",
        exists=True,
        dir_okay=False,
    ),
    navigation: Path = argument(
        "MCAP log with IMU and Doppler log.", "NAV", exists=True
    ),
    *,
    output: OutputLog,
    reading: ReadingOptions,
    options: JoinOptions,
) -> None:
    """Write sonar images of one file and all that another has into one log, on the clock of the latter.

    The options about topics and calibration are of NAV, but for the role sonar, which is of IMAGES.
    """
    from sonar_graph.logs import (
        METADATA,
        joined_calibration,
        read_images_alone,
        read_sonar_frames,
        with_notes,
        write_amended,
    )
    from sonar_graph.logs.mcap import Keep, scan

    # neither source may be replaced by the joined log
    path = writable_log(output, images, navigation, overwrite=options.overwrite)
    # before the images are read, which takes minutes
    if TOPIC in scan(navigation, lambda _: Keep.NONE).topics:
        raise LogError(
            f"{navigation}: has {TOPIC} already; recognise it as it is, or give a log without images"
        )
    sequence = reading.read(navigation)
    topic = reading.choices.get("sonar")
    alone = read_images_alone(images, topic=topic, salvage=reading.salvage)
    seen = look(images, topic, alone.calibration, salvage=reading.salvage)
    # with --search a stated offset is only where the search begins
    is_stated = options.offset is not None and options.search is None
    around_s = options.offset or 0.0
    search_s = options.search or SEARCH_S
    within_s = 0.0 if is_stated else search_s
    require_overlap(images, navigation, sequence, seen, around_s, within_s)
    seconds, said = offset_of(seen, sequence, around_s, search_s, is_stated=is_stated)
    shift_ns = round(seconds * NS_PER_S)
    # the notes of both files are kept apart by their prefix
    notes = {
        f"images.{key}": note
        for key, note in alone.notes.items()
        if key != "log.skipped"
    }
    record = with_notes(
        navigation,
        notes | {"images.file": images.name, "images.clock_offset": said},
    )
    record |= {
        "calibration": joined_calibration(images, navigation, topic, reading.given)
    }
    with progress_bars() as progress:
        blocks = read_sonar_frames(
            images, topic, salvage=reading.salvage, refused=lambda *_: None
        )
        amended = write_amended(
            navigation,
            path,
            [],
            more=on_the_clock(
                blocks, shift_ns, lambda done: progress("writing (frames)", done, 0)
            ),
            metadata={METADATA: record},
            salvage=reading.salvage,
        )
    echo(f"Clock offset, to be added to the stamps of {images.name}: {said}")
    # frames outside have no motion, and cannot be tracked
    within = sum(
        sequence.start_ns <= stamp_ns + shift_ns <= sequence.end_ns
        for stamp_ns in seen.stamps_ns
    )
    echo(
        f"{len(seen.stamps_ns)} frames, {within} of them while IMU and Doppler log measure"
    )
    for note in amended.notes.values():
        echo(f"Not copied: {note}")
    echo(f"Log: {path}\nNext: sonar-graph recognise {path} -o recognised.mcap")


def look(
    log: Path, topic: str | None, calibration: Calibration, *, salvage: bool
) -> Seen:
    """Motion between all frames of a log, in the plane of the image."""
    from sonar_graph.logs import read_sonar_frames
    from sonar_graph.recognition import ImageMotions, one_by_one

    motions = ImageMotions(calibration.model_copy(update={"floor": None}))
    seen = Seen([], [], 0.0)
    with progress_bars() as progress:
        for block in read_sonar_frames(
            log, topic, salvage=salvage, refused=lambda *_: None
        ):
            if not seen.range_m:
                seen = replace(seen, range_m=float(block.ranges_m.mean()))
            for frame in one_by_one(block):
                step = motions.add(frame)
                seen.stamps_ns.append(int(frame.stamps_ns[0]))
                seen.steps.extend([step] if step is not None else [])
            progress("laying frames upon each other", len(seen.stamps_ns), 0)
    return seen


def require_overlap(
    images: Path,
    navigation: Path,
    sequence: Sequence,
    seen: Seen,
    around_s: float,
    search_s: float,
) -> None:
    """Refuse images and navigation without common time for any offset within the search."""
    first_ns = min(seen.stamps_ns)
    last_ns = max(seen.stamps_ns)
    low_ns, high_ns = (
        round((around_s + side * search_s) * NS_PER_S) for side in (-1, 1)
    )
    if first_ns + low_ns <= sequence.end_ns and last_ns + high_ns >= sequence.start_ns:
        return
    apart_s = (sequence.start_ns - first_ns) * 1e-9
    raise LogError(
        f"{images}: {first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s; "
        f"{navigation}: {sequence.start_ns * 1e-9:.3f} to {sequence.end_ns * 1e-9:.3f} s: "
        f"no common time{f' with an offset of {around_s:+.3f} s' if around_s else ''}; if clocks differ, give --offset "
        f"and --search SECONDS ({apart_s:+.3f} makes both begin together)"
    )


def offset_of(
    seen: Seen, sequence: Sequence, around_s: float, search_s: float, *, is_stated: bool
) -> tuple[float, str]:
    """Offset in seconds, and its description."""
    from sonar_graph.recognition import estimate_offset

    try:
        with working("estimating the clock offset"):
            # also where the offset is stated, so that a wrong one is noticed
            estimate = estimate_offset(
                seen.steps, sequence, seen.range_m, around_s, search_s
            )
    except LogError as error:
        if not is_stated:
            raise
        found = str(error).rpartition("; ")[0]
    else:
        if not is_stated:
            return estimate.seconds, f"{estimate}"
        found = f"by the images {estimate}"
        if abs(estimate.seconds - around_s) > DISAGREEING * estimate.sigma_s:
            found += "; Warning: they do not agree, leave --offset out to take the images' own"
    return around_s, f"{around_s:+.3f} s, as stated; {found}"


def on_the_clock(
    blocks: Iterator[SonarFrames], shift_ns: int, progress: Callable[[int], None]
) -> Iterator[Outgoing]:
    """Messages of blocks of frames with their stamps moved, in the order of time; a frame that is late is left out."""
    from sonar_graph.logs import sonar_image_messages

    latest_ns = -1
    done = 0
    for block in blocks:
        # a log in order of time can be written in one pass
        late = block.stamps_ns <= latest_ns
        if not late.all():
            latest_ns = int(block.stamps_ns[-1])
            done += len(block)
            kept = replace(
                block,
                stamps_ns=block.stamps_ns[~late] + shift_ns,
                intensity=block.intensity[~late],
            )
            yield sonar_image_messages(TOPIC, kept)
        progress(done)
