"""``sonar-graph run``, ``compare``, ``report``, ``figures``, ``demo`` and ``estimators``: from a log to a report."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape
from rich.table import Table

from sonar_graph.cli.arguments import (
    EstimatorSettings,
    LogPath,
    OutputFolder,
    Overwrite,
    RateHz,
    ReadingOptions,
    answers,
    argument,
    echo,
    estimator_settings,
    option,
)
from sonar_graph.cli.bench import write_report_of
from sonar_graph.cli.outputs import (
    progress_bars,
    working,
    writable_folder,
    writable_log,
)
from sonar_graph.cli.recognise import (
    RecogniserOptions,
    recognise_log,
    warn_of_other_designs,
)
from sonar_graph.cli.simulate import write_basin
from sonar_graph.errors import EstimatorError, LogError
from sonar_graph.files import BATCH, COMPARISON, PAPER, result_written

if TYPE_CHECKING:
    from sonar_graph.evaluation import Comparison
    from sonar_graph.recognition import Recognition
    from sonar_graph.sequence import Sequence
    from sonar_graph.simulation import BasinOptions

DEFAULT_ESTIMATORS = "isam2,ekf-slam,dead-reckoning"
DEFAULT_RATE_HZ = 2.0
# exit code where results are written but sensors contradict each other beyond doubt, as of ``inspect``
DOUBTFUL = 3
LOG = "basin.mcap"
PAGE = "report.html"
# the three laps of the paper in less time; cheap sensors: gyros whose bias is that of switching on, a Doppler
# log that loses the bottom some three times. Images take most of the time: two a second still show each
# landmark several times
DEMO = {
    **{"duration_s": 390.0, "laps": 3, "imu": "mti1", "dvl": "explorer", "image": {}},
    **{"gyro_bias_scale": 10.0, "dvl_dropouts_per_hour": 30.0, "dvl_dropout_s": 5.0},
    "frame_rate_hz": 2.0,
}
DEMO_ESTIMATORS = ["isam2", "ekf-slam", "invariant-ekf", "dead-reckoning"]
# changes of the options for a run on which loops are compiled: shorter, with gaps of the Doppler log
SHORT = {"duration_s": 120.0, "laps": 1, "dvl_dropouts_per_hour": 120.0, "image": None}


@dataclass(frozen=True)
class EstimationOptions:
    """Options that `run` and `compare` share, for how estimators run and where their results go."""

    rate_hz: RateHz = None
    settings: EstimatorSettings = None
    overwrite: Overwrite = False


def run(
    log: LogPath,
    output: OutputFolder,
    reading: ReadingOptions,
    estimator: str = option("Name of an installed estimator.", "isam2"),
    *,
    estimation: EstimationOptions,
) -> None:
    """Run one estimator on a log; write its trajectories, landmarks and scores."""
    from sonar_graph.evaluation import write_comparison, write_viewer_files

    names = [estimator]
    recognition = RecogniserOptions()
    with (
        compared(log, output, names, reading, recognition, estimation) as comparison,
        working("writing results"),
        result_written(output, COMPARISON),
    ):
        write_comparison(comparison, output)
        write_viewer_files(comparison, output)
    print_outcome(
        comparison, f"Results: {output}; `sonar-graph report {output}` draws the page"
    )


def compare(
    log: LogPath,
    output: OutputFolder,
    recognition: RecogniserOptions,
    reading: ReadingOptions,
    estimators: str = option(
        "Names of installed estimators, with commas.", DEFAULT_ESTIMATORS
    ),
    *,
    estimation: EstimationOptions,
) -> None:
    """Run several estimators on the same measurements and write a report on how they compare.

    Landmarks are recognised in sonar images where the log has no detections; with --designs, --model or --rule also
    where it has, in their place.

    Writes report.html, comparison.json, result.mcap for a viewer, and runs/NAME/ with each estimator's trajectories.
    """
    from sonar_graph.report import write_report

    # blanks after commas are common, and a name that is given twice runs once
    names = list(dict.fromkeys(name.strip() for name in estimators.split(",")))
    with (
        compared(log, output, names, reading, recognition, estimation) as comparison,
        working("writing results"),
    ):
        page = write_report(comparison, output)
    print_outcome(comparison, f"Report: {page}")


def report(
    folder: Path = argument(
        "Folder that compare or bench wrote.", "DIR", exists=True, file_okay=False
    ),
    overwrite: Overwrite = False,
) -> None:
    """Write report.html, and a batch's tables, again from what compare, run or bench left in a folder."""
    from sonar_graph.batch import is_batch
    from sonar_graph.evaluation import read_comparison
    from sonar_graph.report import write_page

    # both kinds of results have the same command
    if is_batch(folder):
        with writable_folder(folder, [PAGE], kind=BATCH, overwrite=overwrite):
            page = write_report_of(folder)
    else:
        comparison = read_comparison(folder)
        with working("drawing"), writable_folder(folder, [PAGE], overwrite=overwrite):
            page = write_page(comparison, folder)
    echo(f"Report: {page}")


def figures(
    folder: Path = argument(
        "Folder that compare, run or bench wrote.", "DIR", exists=True, file_okay=False
    ),
    output: Path | None = option(
        "Folder to write to. Default: DIR/paper.", None, "--output", "-o", metavar="DIR"
    ),
    overwrite: Overwrite = False,
) -> None:
    """Write every figure as SVG and PDF and every table as CSV, in the widths and type of journals.

    Beside them protocol.txt, with how each number was got and a caption for each figure.
    """
    from sonar_graph.batch import is_batch, read_batch
    from sonar_graph.evaluation import read_comparison
    from sonar_graph.report import write_paper

    # beside the result, so that figures and numbers stay together
    target = folder / "paper" if output is None else output
    with (
        working("drawing"),
        writable_folder(target, [], kind=PAPER, overwrite=overwrite),
    ):
        read = read_batch if is_batch(folder) else read_comparison
        document = write_paper(read(folder), target, overwrite=overwrite)
    echo(f"Figures and tables: {document}")


def demo(
    output: OutputFolder = Path("demo"),
    overwrite: Overwrite = False,
) -> None:
    """Repeat the 2014 paper's basin experiment in short: simulate sonar images, recognise landmarks, compare, report.

    Three laps in 390 s instead of 2039 s; the log takes about 40 MB. One run is not enough to compare estimators: bench
    makes many.
    """
    from sonar_graph.estimator import load_estimator
    from sonar_graph.numerics import compiled_beside
    from sonar_graph.report import write_report
    from sonar_graph.simulation import BasinOptions

    names = DEMO_ESTIMATORS
    with writable_folder(output, names_written(output, names), overwrite=overwrite):
        log = writable_log(output / LOG, overwrite=overwrite)
    # a vehicle that people can afford, on which landmarks are of use
    options = BasinOptions.model_validate(DEMO)
    short = partial(run_basin, options.model_copy(update=SHORT), names)
    # compiled for these modules only, while images are simulated
    modules = [sys.modules[load_estimator(name).__module__] for name in names]
    with compiled_beside(short, modules) as wait_until_compiled:
        echo(
            f"Simulating {options.duration_s:g} s in a basin, {options.laps} laps, with sonar images: {log}"
        )
        write_basin(log, options)
        echo("Recognising landmarks in them, then running the estimators")
        with writable_folder(output, names_written(output, names), overwrite=overwrite):
            # the simulator has made the sensors as they are calibrated: to compare them would take as long as
            # to recognise the landmarks
            options_left = ReadingOptions(), RecogniserOptions()
            prepared = prepared_log(log, *options_left, are_sensors_trusted=True)
            with working("compiling the estimators for the first use"):
                wait_until_compiled()
            comparison = compare_prepared(*prepared, names, {}, DEFAULT_RATE_HZ)
            with working("writing results"):
                page = write_report(comparison, output)
    print_outcome(comparison, f"Report: {page}")


def run_basin(options: BasinOptions, names: list[str]) -> None:
    """Run estimators on a simulated basin, for the code that is compiled on the way."""
    from sonar_graph.evaluation import compare as compare_runs
    from sonar_graph.simulation import simulate_basin

    # the results are thrown away: only the compiled loops count
    compare_runs(simulate_basin(options), names)


def estimators() -> None:
    """List the installed estimators with their settings, defaults and meaning."""
    from sonar_graph.estimator import installed_estimators, load_estimator
    from sonar_graph.settings import settings_of

    console = answers()
    failed = False
    for name, point in installed_estimators().items():
        try:
            # a plug-in that cannot be loaded must not hide the others
            settings = load_estimator(name).Params
        except EstimatorError as error:
            console.print(escape(str(error)), "", sep="\n", soft_wrap=True)
            failed = True
            continue
        console.print(
            f"[bold]{escape(name)}[/] ({escape(point.value)})", soft_wrap=True
        )
        table = Table("setting", "default", "meaning", box=None, pad_edge=True)
        for setting in settings_of(settings):
            table.add_row(*(escape(str(part)) for part in setting))
        console.print(table if settings.model_fields else "  no settings")
        console.print()
    if failed:
        raise typer.Exit(1)


def names_written(output: Path, estimators: list[str]) -> list[str]:
    """Names of the files that a comparison of some estimators may write into a folder or replace there."""
    from sonar_graph.evaluation import result_names

    # pictures are named by their stamps, so that only the folder has their names
    pictures = [
        path.relative_to(output).as_posix()
        for path in output.glob("recognised/*.jpg")
        if path.stem.isdigit()
    ]
    return [PAGE, *result_names(estimators), *pictures]


@contextmanager
def compared(
    log: Path,
    output: Path,
    names: list[str],
    reading: ReadingOptions,
    recognition: RecogniserOptions,
    estimation: EstimationOptions,
) -> Iterator[Comparison]:
    """Read a log, recognise landmarks if it needs that, and compare estimators; mistakes are reported first.

    The folder for the results is kept from other commands until the block, which writes them, ends.
    """
    from sonar_graph.evaluation import check_request

    # mistakes come to light before the log is read, which may take minutes
    overrides = estimator_settings(estimation.settings, names)
    for name in names:
        check_request(name, overrides.get(name))
    sources = (
        log,
        reading.calibration,
        reading.log_config,
        recognition.designs,
        recognition.model,
    )
    written = names_written(output, names)
    with writable_folder(output, written, sources, overwrite=estimation.overwrite):
        prepared = prepared_log(log, reading, recognition)
        yield compare_prepared(*prepared, names, overrides, estimation.rate_hz)


def prepared_log(
    log: Path,
    reading: ReadingOptions,
    recognition: RecogniserOptions,
    *,
    are_sensors_trusted: bool = False,
) -> tuple[Sequence, Recognition | None]:
    """Read a log, compare its sensors unless they are trusted, and recognise landmarks if it needs that.

    The recognition is None where the log had detections, or no images.
    """
    from sonar_graph.diagnosis import compared, trusted
    from sonar_graph.logs import LIVE_RATE, no_images

    with progress_bars() as progress:
        sequence = reading.read(log, progress=partial(progress, f"reading {log.name}"))
    with working("comparing sensors"):
        sequence = (
            trusted(sequence)
            if are_sensors_trusted
            else compared(sequence, reading.config)
        )
    found = None
    # what was recognised is in it: estimates are those of the live run
    is_of_live_run = LIVE_RATE in sequence.notes
    if (sequence.detections is None and not is_of_live_run) or recognition.is_given:
        recogniser = recognition.recogniser(sequence.calibration)
        found = recognise_log(log, sequence, reading, recogniser)
        if found is None and recognition.is_given:
            raise LogError(
                f"{no_images(log)}; --designs, --model and --rule are for images"
            )
    # designs of others look like speckle to a recogniser that does not know them
    if found is not None:
        if recognition.designs is None:
            warn_of_other_designs(sequence)
        from sonar_graph.recognition import with_detections

        sequence = with_detections(sequence, found)
    return sequence, found


def compare_prepared(
    sequence: Sequence,
    recognition: Recognition | None,
    names: list[str],
    overrides: dict[str, dict[str, Any]],
    rate_hz: float | None,
) -> Comparison:
    """Compare estimators on a log that was read, with a progress bar for each."""
    from sonar_graph.evaluation import compare as compare_runs
    from sonar_graph.logs import LIVE_RATE

    # the record of a live run gives the estimates of that run only at its rate
    rate_hz = rate_hz or float(sequence.notes.get(LIVE_RATE, DEFAULT_RATE_HZ))
    with progress_bars() as progress:
        comparison = compare_runs(
            sequence, names, overrides, rate_hz=rate_hz, progress=progress
        )
    return replace(comparison, recognition=recognition)


def print_outcome(comparison: Comparison, place: str) -> None:
    """Print the table of scores and where the files are.

    Exit with 1 if a run failed, with the reason, and with 3 if sensors contradict each other beyond doubt.
    """
    from sonar_graph.report import doubtful_lines, summary

    out = answers()
    out.print(summary(comparison))
    echo(place)
    # results are written all the same: the others may be what was wanted
    if failed := [run.estimator for run in comparison.failed_runs]:
        echo(f"sonar-graph: {', '.join(failed)} failed, for the reason above", err=True)
        raise typer.Exit(1)
    if doubtful_lines(comparison):
        echo(
            "sonar-graph: the results are doubtful, for the reasons that begin with Doubtful",
            err=True,
        )
        # a script must not take doubtful numbers for results
        raise typer.Exit(DOUBTFUL)
