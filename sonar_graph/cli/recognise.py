"""``sonar-graph recognise`` and ``calibrate``: landmarks in sonar images."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sonar_graph.cli.arguments import (
    REQUIRED,
    DesignsPath,
    LogPath,
    OutputLog,
    Overwrite,
    ReadingOptions,
    answers,
    argument,
    echo,
    existing_file,
    nested_settings,
    option,
    validated,
    with_options,
)
from sonar_graph.cli.outputs import (
    is_json,
    is_own_page,
    progress_bars,
    working,
    writable_file,
    writable_log,
)
from sonar_graph.errors import LogError
from sonar_graph.files import replacing

if TYPE_CHECKING:
    from sonar_graph.calibration import Calibration
    from sonar_graph.devices import LandmarkDesign
    from sonar_graph.logs import ImagesAlone
    from sonar_graph.recognition import (
        LandmarkRecogniser,
        MotionFrom,
        Recognition,
        TrackStories,
    )
    from sonar_graph.sequence import Sequence
    from sonar_graph.sonar import RecogniserParams

    Run = Sequence | ImagesAlone

TOPIC = "/sonar/landmarks"
# metadata record with the outcome of every frame
RECORD = "sonar_graph_recognition"
MOST_WARNINGS_SHOWN = 10
# tracks of a class below which calibrate warns
FEW_TRACKS = 10
RecogniserName = Annotated[
    str,
    typer.Option(
        "--recogniser",
        metavar="NAME",
        help="designs: ours; else the name of an installed plug-in.",
    ),
]
Motion = Annotated[
    Literal["navigation", "images", "fixed"] | None,
    typer.Option(
        help="How the sonar moves between frames: by IMU and Doppler log (the default where the log has both), as the "
        "images themselves show (else), or not at all.",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="A setting of the recogniser, such as identity.unknown_prior=0.5 (sections: detection, tracking, "
        "appearance, identity; a wrong name is answered with those that there are, and "
        "help(sonar_graph.sonar.recogniser) explains them), or of the plug-in; may be repeated.",
    ),
]


@dataclass(frozen=True)
class RecogniserOptions:
    """Options for recognising landmarks by their designs."""

    designs: DesignsPath = None
    model: Path | None = existing_file(
        "How often landmarks look like which, as calibrate measured it.", "MODEL.json"
    )
    rule: str | None = option(
        "How beliefs are updated: virtual-evidence (ours, the default) or jeffrey (the 2014 paper's)."
    )

    @property
    def is_given(self) -> bool:
        """True if the user gave any of them."""
        return self != RecogniserOptions()

    def read_designs(self) -> tuple[LandmarkDesign, ...] | None:
        """Designs of the user, if given."""
        from sonar_graph.devices import load_designs

        return None if self.designs is None else load_designs(self.designs)

    def params(self, settings: list[str] | None = None) -> RecogniserParams:
        """Settings of the recogniser."""
        from sonar_graph.devices import DEFAULT_DESIGNS
        from sonar_graph.sonar import RecogniserParams, read_confusion

        values = nested_settings(settings)
        if self.rule is not None:
            if "rule" in (identity := values.setdefault("identity", {})):
                raise typer.BadParameter(
                    f"--rule {self.rule} and --set identity.rule={identity['rule']}: give one of them"
                )
            # the option is a shorter name of the setting
            identity["rule"] = self.rule
        if self.model is not None:
            values["confusion"] = confusion = read_confusion(self.model)
            confusion.check_designs(
                self.read_designs() or DEFAULT_DESIGNS, str(self.model)
            )
        return validated(RecogniserParams, values, "recogniser")

    def recogniser(
        self,
        calibration: Calibration,
        settings: list[str] | None = None,
        name: str = "designs",
    ) -> LandmarkRecogniser:
        """The recogniser of that name."""
        from sonar_graph.recognition import RECOGNISERS
        from sonar_graph.sonar import Recogniser

        if name == "designs":
            return Recogniser(calibration, self.read_designs(), self.params(settings))
        if self.is_given:
            raise typer.BadParameter(
                f"--designs, --model and --rule are not for the recogniser {name}: use --set"
            )
        make, _ = RECOGNISERS.load(name)
        made: LandmarkRecogniser = make(calibration, nested_settings(settings))
        return made


@dataclass(frozen=True)
class RecognitionChoices:
    """Options for how landmarks are recognised beside their designs, and for the page of tracks."""

    recogniser: RecogniserName = "designs"
    motion: Motion = None
    settings: Settings = None
    report: Path | None = option(
        "Page to write: every track with picture, probabilities and fate.",
        metavar="PAGE.html",
    )
    overwrite: Overwrite = False


@with_options("start", "end", "map", "truth")
def recognise(
    log: LogPath,
    output: OutputLog,
    recognition: RecogniserOptions,
    reading: ReadingOptions,
    options: RecognitionChoices,
) -> None:
    """Recognise landmarks in a log's sonar images; write a copy of the log with the detections in it.

    Detections that an earlier recognise put into the log are replaced. Without IMU or Doppler log the motion is from
    the images.
    """
    from sonar_graph.logs import (
        DETECTIONS,
        METADATA,
        detection_messages,
        lacking_navigation,
        no_images,
        with_notes,
        write_amended,
    )
    from sonar_graph.recognition import SEE_TRACKS, TrackStories
    from sonar_graph.report import write_track_page
    from sonar_graph.sonar import Recogniser

    path = writable_log(output, log, overwrite=options.overwrite)
    page = None
    if options.report is not None:
        page = writable_file(
            options.report, ".html", is_own_page, overwrite=options.overwrite
        )
    # images alone are enough: their own motion stands in for navigation
    sequence, motion = with_motion(log, reading, options.motion)
    # a mistake in a setting is reported before the images are read
    made = recognition.recogniser(
        sequence.calibration, options.settings, options.recogniser
    )
    stories = TrackStories(sequence.calibration.sonar.image) if page else None
    if stories is not None and not isinstance(made, Recogniser):
        raise typer.BadParameter(
            f"--report shows the tracks of the recogniser of designs; {options.recogniser} has none"
        )
    found = recognise_log(log, sequence, reading, made, motion, stories)
    # a log without images is a mistake here, but not for compare
    if found is None:
        raise LogError(no_images(log))
    with working("writing"):
        # what was lost on the way into the new log must not be lost to its reader
        notes = sequence.notes
        losses = {
            f"copied.{k}": f"{log.name}: {notes[k]}"
            for k in ("log.ending", "log.damage")
            if k in notes
        }
        amended = write_amended(
            log,
            path,
            detection_messages(TOPIC, found.detections) if found.detections else [],
            anew={TOPIC: DETECTIONS},
            metadata={
                METADATA: with_notes(log, found.notes | losses),
                RECORD: {"recognition": json.dumps(found.entry())},
            },
            salvage=reading.salvage,
        )
    out = answers()
    out.print(
        f"{found.frames} frames, {0 if found.detections is None else len(found.detections)} detections"
    )
    for outcome, count in found.outcomes.most_common():
        out.print(f"  {count:6d}  {outcome}")
    # images alone have no truth to compare with
    for line in found.naming(getattr(sequence, "true_landmarks", None)):
        if page is None or line != SEE_TRACKS:
            out.print(line, markup=False)
    if motion != "navigation":
        has_navigation = not lacking_navigation(
            log, reading.choices, reading.config, reading.window
        )
        for line in without_navigation(
            found, f"as --motion {motion} asks" if has_navigation else ""
        ):
            echo(f"Without navigation: {line}")
    for stamp_ns, reason in found.warnings[:MOST_WARNINGS_SHOWN]:
        out.print(f"Warning: {(stamp_ns - sequence.start_ns) * 1e-9:.3f} s: {reason}")
    if (more := sum(found.warned().values()) - MOST_WARNINGS_SHOWN) > 0:
        out.print(
            f"Warning: {more} more such rows; with their stamps in the log's metadata record {RECORD}"
        )
    if recognition.designs is None and options.recogniser == "designs":
        warn_of_other_designs(sequence)
    for topic, count in amended.replaced.items():
        echo(f"Replaced: {count} messages that the log had on {topic}")
    for note in amended.notes.values():
        echo(f"Not copied: {note}")
    if page is not None and stories is not None and isinstance(made, Recogniser):
        names = [f"{design.id}: {design.name}" for design in made.designs]
        write_track_page(page, log.name, found, stories, names, sequence.start_ns)
        echo(f"Page: {page}")
    echo(f"Log: {path}")


@dataclass(frozen=True)
class CalibrateOptions:
    """Options for what the model is measured by: labels, motion, designs and settings."""

    labels: list[Path] | None = option(
        "Labels instead of a truth, as `label` writes them or as CSV; one file for each log, in their order.",
        metavar="LABELS.json",
        exists=True,
        dir_okay=False,
    )
    motion: Motion = None
    designs: DesignsPath = None
    settings: Settings = None
    overwrite: Overwrite = False


@with_options("start", "end", "map", "truth")
def calibrate(
    logs: list[Path] = argument("Logs with images and truth.", "LOG...", exists=True),
    output: Path = option(
        "File to write.", REQUIRED, "--output", "-o", metavar="MODEL.json"
    ),
    *,
    reading: ReadingOptions,
    options: CalibrateOptions,
) -> None:
    """Measure how often landmarks look like which, on logs with sonar images whose truth or labels are known."""
    from sonar_graph.recognition import LabelledLog, calibrate_by_labels, read_labels
    from sonar_graph.recognition import calibrate as measure
    from sonar_graph.states import counted

    labels = options.labels
    sources = [*logs, *(labels or [])]
    is_model = is_json(lambda content: content.keys() >= {"ids", "matrix"})
    path = writable_file(
        output, ".json", is_model, sources, overwrite=options.overwrite
    )
    # links and relative paths may name one file twice
    for row, log in enumerate(logs):
        if any(log.samefile(other) for other in logs[:row]):
            raise LogError(
                f"{log}: is named twice, and its frames would count twice; name each log once"
            )
    if labels and len(labels) != len(logs):
        raise LogError(
            f"{len(logs)} logs and {len(labels)} files for --labels; give one for each log, in their order"
        )
    if options.motion is not None and not labels:
        raise typer.BadParameter(
            "--motion is for --labels: a log with truth has IMU and Doppler log"
        )
    recognition = RecogniserOptions(options.designs)
    params = recognition.params(options.settings)
    known = recognition.read_designs()
    how: dict[str, Any] = {"designs": known, "params": params, **reading.of_images}
    # whole logs, as --start and --end of one would be wrong for another
    del how["window"]
    with working("calibrating"):
        if labels:
            # labels first: a mistake in them is found before a log is read
            pairs = list(zip(logs, labels, strict=True))
            given = [read_labels(file, log) for log, file in pairs]
            labelled = []
            for (log, file), own in zip(pairs, given, strict=True):
                run, motion = with_motion(log, reading, options.motion)
                labelled.append(LabelledLog(log, run, own, file, motion))
            measured = calibrate_by_labels(labelled, **how)
        else:
            measured = measure([(log, reading.read(log)) for log in logs], **how)
    with replacing(path) as partial:
        partial.write_text(measured.model_dump_json(indent=2) + "\n", encoding="utf-8")
    out = answers()
    for number in range(1, len(labels or []) + 1):
        out.print(measured.provenance[f"labels {number}"])
    # frames of one track are alike: a model of few tracks knows few views
    few = []
    for name in (*(f"landmark {i}" for i in measured.ids), "no landmark"):
        frames, tracks = (
            measured.provenance[f"{what} of {name}"] for what in ("frames", "tracks")
        )
        out.print(
            f"  {name}: {counted(int(frames), 'frame')}, {counted(int(tracks), 'track')}"
        )
        few += [name] if int(tracks) < FEW_TRACKS else []
    out.print(
        f"  range sigma {1e3 * measured.range_sigma_m:.1f} mm, across {1e3 * measured.across_sigma_m:.1f} mm, "
        f"a track is reported every {measured.report_interval_s:.1f} s"
    )
    if few:
        out.print(
            f"Caution: fewer than {FEW_TRACKS} tracks of {', '.join(few)}: frames of one track are alike; "
            "give more logs before the model is relied on"
        )
    if assumed := measured.provenance.get("confusion matrix"):
        out.print(f"Confusion matrix, which the rule of 2014 alone uses: {assumed}")
    echo(f"Model: {path}")


def with_motion(
    log: Path, reading: ReadingOptions, motion: MotionFrom | None
) -> tuple[Run, MotionFrom]:
    """Read what goes with a log's images, and choose the source of the sonar's motion."""
    from sonar_graph.logs import lacking_navigation, read_images_alone

    # without IMU or Doppler log only the images can give the motion
    lacking = lacking_navigation(log, reading.choices, reading.config, reading.window)
    if motion == "navigation" and lacking:
        raise LogError(
            f"{log}: --motion navigation: no {' and no '.join(map(str.upper, lacking))} in the log; leave --motion "
            "out, or bring the sensors of another file in with `sonar-graph join`"
        )
    if motion == "navigation" or (motion is None and not lacking):
        return reading.read(log), "navigation"
    alone = read_images_alone(log, calibration=reading.given, **reading.of_images)
    return alone, motion or "images"


def without_navigation(found: Recognition, asked: str = "") -> list[str]:
    """Lines on the source of the motion, and what is lost; ``asked``: why the log's navigation is left out."""
    from sonar_graph.recognition import NO_FLOOR

    motion = found.notes["detections.motion"]
    lines = [f"motion {motion}"]
    if motion.startswith("none"):
        lines.append(
            "frames of a sonar at rest repeat their speckle, so that each track counts once"
        )
    if NO_FLOOR not in found.outcomes:
        lines.append(
            "height and tilt are taken to stay those of the calibration's start"
        )
    if asked:
        lines.append(f"the log's IMU and Doppler log are not used, {asked}")
    else:
        lines.append(
            "no estimator can run on the images alone; `sonar-graph join` brings in IMU and Doppler log of a file"
        )
    return lines


def recognise_log(
    log: Path,
    sequence: Run,
    reading: ReadingOptions,
    recogniser: LandmarkRecogniser,
    motion: MotionFrom = "navigation",
    stories: TrackStories | None = None,
) -> Recognition | None:
    """Landmarks in a log's sonar images, with a progress bar; None without images."""
    from sonar_graph.recognition import recognise_images

    with progress_bars() as progress:
        return recognise_images(
            log,
            sequence,
            motion=motion,
            recogniser=recogniser,
            **reading.of_images,
            progress=lambda done: progress(
                "recognising landmarks", done, 0, f"{done} frames"
            ),
            seen=stories.see if stories is not None else None,
        )


def warn_of_other_designs(sequence: Run) -> None:
    """Print a warning if a log's notes name designs of its own, which were not looked for."""
    named = re.search(r'"designs":"([^"]+)"', sequence.notes.get("options", ""))
    if named is not None:
        answers().print(
            f"Warning: the log was made with the designs of {named[1]}; give them with --designs"
        )
