"""``sonar-graph label``: a page on which landmarks in sonar images are labelled by clicks."""

from __future__ import annotations

import shlex
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from sonar_graph.cli.arguments import (
    REQUIRED,
    DesignsPath,
    LogPath,
    Overwrite,
    ReadingOptions,
    echo,
    option,
    with_options,
)
from sonar_graph.cli.outputs import is_json, progress_bars, writable_file
from sonar_graph.errors import LogError
from sonar_graph.files import interrupt_event

if TYPE_CHECKING:
    from sonar_graph.devices import LandmarkDesign
    from sonar_graph.recognition import LabelDesk, Labels, LabelServer


@dataclass(frozen=True)
class LabelOptions:
    """Options for the frames that are shown, the page and the file of the labels."""

    designs: DesignsPath = None
    period: float = option(
        "Shortest time between the frames that are shown.",
        0.5,
        metavar="SECONDS",
        min=0.0,
    )
    port: int = option("Port on 127.0.0.1; 0: any that is free.", 0, min=0, max=65535)
    no_browser: bool = option("Only print the address.", False)
    overwrite: Overwrite = False


@with_options("map", "truth")
def label(
    log: LogPath,
    output: Path = option(
        "File of the labels.", REQUIRED, "--output", "-o", metavar="LABELS.json"
    ),
    *,
    reading: ReadingOptions,
    options: LabelOptions,
) -> None:
    """Click landmarks in a log's sonar images, on a page in the browser; labels are saved after every click.

    A file of labels that exists is continued. `calibrate --labels` measures the model of recognition by it.
    """
    from sonar_graph.devices import DEFAULT_DESIGNS, load_designs
    from sonar_graph.files import spelt
    from sonar_graph.logs import no_images, read_images_alone, read_sonar_frames
    from sonar_graph.recognition import (
        LabelDesk,
        Labels,
        LabelServer,
        read_labels,
        shown_frames,
    )

    are_labels = is_json(lambda content: content.keys() == {"log", "labels"})
    path = writable_file(
        output, ".json", are_labels, [log], overwrite=options.overwrite
    )
    # the page offers the identities of these designs
    designs = options.designs
    known = DEFAULT_DESIGNS if designs is None else load_designs(designs)
    # labels are hours of work: an existing file is added to
    is_continued = path.exists() and path.stat().st_size and not options.overwrite
    labels = read_labels(path, log) if is_continued else Labels(log=spelt(log.name))
    alone = read_images_alone(log, calibration=reading.given, **reading.of_images)
    blocks = read_sonar_frames(log, **reading.of_images, refused=lambda *_: None)
    with progress_bars() as progress:
        frames = shown_frames(
            blocks,
            alone.calibration.sonar,
            round(options.period * 1e9),
            lambda done: progress("drawing frames", done, 0),
        )
    if not frames:
        raise LogError(no_images(log, reading.window))
    # the desk writes the file after every click
    desk = LabelDesk(frames, labels, path)
    with LabelServer(
        desk,
        lambda nonce: page_of(log, path, known, desk, nonce),
        [one.id for one in known],
        options.port,
    ) as server:
        serve(server, path, labels, is_shown=not options.no_browser)
    # calibrate must read the log as it was labelled
    repeated = [
        ("--labels", path),
        ("--designs", designs),
        ("--calibration", reading.calibration),
        ("--log-config", reading.log_config),
        *(("--topic", text) for text in reading.topics or []),
        ("-o", "model.json"),
    ]
    words = [str(log)]
    for name, value in repeated:
        words += [] if value is None else [name, str(value)]
    echo(f"Next: sonar-graph calibrate {shlex.join(words)}")


def serve(server: LabelServer, path: Path, labels: Labels, *, is_shown: bool) -> None:
    """Serve until Ctrl-C, then print the number of labels."""
    echo(
        f"{len(server.desk.frames)} frames, {len(labels.labels)} labels so far. The page: {server.address}"
    )
    echo("Ctrl-C ends.")
    if is_shown:
        webbrowser.open(server.address)
    # the main thread waits for Ctrl-C
    serving = Thread(target=server.serve_forever, daemon=True)
    serving.start()
    with interrupt_event() as ended:
        while not ended.wait(0.1):
            pass
    server.shutdown()
    echo(f"\nLabels: {path} ({len(server.desk.labels)})")


def page_of(
    log: Path,
    path: Path,
    designs: tuple[LandmarkDesign, ...],
    desk: LabelDesk,
    nonce: str,
) -> str:
    """The page as text."""
    from sonar_graph.report import render

    first_ns = desk.frames[0].stamp_ns
    content = {
        "kind": "labels",
        "name": log.name,
        "names": [path.name],
        "nonce": nonce,
        "designs": designs,
        "seconds": [
            round((frame.stamp_ns - first_ns) * 1e-9, 3) for frame in desk.frames
        ],
    }
    return render("label.html", content)
