"""``sonar-graph run``, ``compare`` and ``report``: from a log to a side-by-side report.

``sonar-graph demo``: the experiment of the 2014 paper in short, from sonar images to the report.

``sonar-graph estimators``: what is installed, with every setting.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from sonar_graph.cli.arguments import (
    CalibrationPath,
    DesignsPath,
    EndTime,
    EstimatorSettings,
    LogConfigPath,
    LogPath,
    ModelPath,
    OutputFolder,
    RateHz,
    RuleName,
    Salvage,
    StartTime,
    TopicChoices,
    answers,
    check_rate,
    estimator_settings,
    read_calibration,
    read_config,
    topic_choices,
    window_of,
)
from sonar_graph.cli.bench import write_report_of
from sonar_graph.cli.outputs import Report, progress_bars, working, writable_folder, writable_log
from sonar_graph.cli.recognise import our_recogniser, warn_of_other_designs
from sonar_graph.cli.simulate import write_basin
from sonar_graph.errors import EstimatorError, LogError, UnknownEstimatorError

if TYPE_CHECKING:
    from sonar_graph.evaluation import Comparison
    from sonar_graph.recognition import Recognition
    from sonar_graph.sequence import Sequence


DEFAULT_ESTIMATORS = "isam2,ekf-slam,dead-reckoning"
DEFAULT_RATE_HZ = 2.0


@dataclass(frozen=True)
class LogSource:
    """A log, and what the user said about reading it."""

    path: Path
    calibration: Path | None = None
    topics: list[str] | None = None
    config: Path | None = None
    start: str | None = None
    end: str | None = None
    salvage: bool = False
    designs: Path | None = None
    model: Path | None = None
    rule: str | None = None

    @property
    def files(self) -> tuple[Path | None, ...]:
        """What is read, and must not be overwritten."""
        return self.path, self.calibration, self.config, self.designs, self.model

    @property
    def is_recognised_anew(self) -> bool:
        """Whether images are looked at even where the log has detections."""
        return not (self.designs is None and self.model is None and self.rule is None)

    def read(self, progress: Report) -> Sequence:
        """The log as a sequence; the errors are those of reading a log, a calibration, or choices of topics."""
        from sonar_graph.logs import read_log

        topics, config = topic_choices(self.topics or []), read_config(self.config)
        return read_log(
            self.path,
            calibration=read_calibration(self.calibration),
            topics=topics,
            config=config,
            window=window_of(self.start, self.end),
            salvage=self.salvage,
            progress=partial(progress, f"reading {self.path.name}"),
        )


def run(
    log: LogPath,
    output: OutputFolder,
    estimator: Annotated[str, typer.Option("--estimator", help="Name of an installed estimator.")] = "isam2",
    rate_hz: RateHz = DEFAULT_RATE_HZ,
    settings: EstimatorSettings = None,
    calibration: CalibrationPath = None,
    topics: TopicChoices = None,
    log_config: LogConfigPath = None,
    start: StartTime = None,
    end: EndTime = None,
    salvage: Salvage = False,
) -> None:
    """Run one estimator on a log; write its trajectories, landmarks and scores."""
    source = LogSource(log, calibration, topics, log_config, start, end, salvage)
    comparison = _compare_log(source, output, [estimator], rate_hz, settings)
    _print_summary(comparison)
    typer.echo(f"Results: {output}")
    _exit_by(comparison)


def compare(
    log: LogPath,
    output: OutputFolder,
    estimators: Annotated[str, typer.Option(help="Names of installed estimators, with commas.")] = DEFAULT_ESTIMATORS,
    rate_hz: RateHz = DEFAULT_RATE_HZ,
    settings: EstimatorSettings = None,
    designs: DesignsPath = None,
    model: ModelPath = None,
    rule: RuleName = None,
    calibration: CalibrationPath = None,
    topics: TopicChoices = None,
    log_config: LogConfigPath = None,
    start: StartTime = None,
    end: EndTime = None,
    salvage: Salvage = False,
) -> None:
    """Run several estimators on the same measurements and write a report on how they compare.

    Landmarks are recognised in sonar images where the log has no detections; with --designs, --model or --rule also
    where it has, in their place.

    Writes report.html, comparison.json, result.mcap for a viewer, and runs/NAME/ with each estimator's trajectories.
    """
    source = LogSource(log, calibration, topics, log_config, start, end, salvage, designs, model, rule)
    comparison = _compare_log(source, output, _estimator_names(estimators), rate_hz, settings)
    page = _write_report(comparison, output)
    _print_summary(comparison)
    typer.echo(f"Report: {page}")
    _exit_by(comparison)


def report(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", exists=True, file_okay=False, help="Folder that compare or bench wrote."),
    ],
) -> None:
    """Write report.html, and a batch's tables, anew from what compare, run or bench left in a folder."""
    from sonar_graph.batch import is_batch
    from sonar_graph.evaluation import read_comparison

    if is_batch(folder):
        typer.echo(f"Report: {write_report_of(writable_folder(folder))}")
        return
    comparison = read_comparison(folder)
    typer.echo(f"Report: {_write_report(comparison, writable_folder(folder))}")


def _estimator_names(text: str) -> list[str]:
    """Names from a list with commas, in order.

    Raises
    ------
    EstimatorError
        When there is none, one is empty, or one comes again.
    """
    names = [name.strip() for name in text.split(",")]
    if not any(names):
        raise EstimatorError(f"--estimators {text!r}: expected names such as {DEFAULT_ESTIMATORS}")
    again = next((name for name in names if names.count(name) > 1), None)
    if not all(names):
        raise EstimatorError(f"--estimators {text!r}: a name is empty; expected names such as {DEFAULT_ESTIMATORS}")
    if again is not None:
        raise EstimatorError(f"--estimators {text!r}: {again} is named twice; each runs once")
    return names


def _compare_log(
    source: LogSource, output: Path, names: list[str], rate_hz: float, settings: list[str] | None
) -> Comparison:
    from sonar_graph.evaluation import compare as compare_runs

    overrides = estimator_settings(settings or [], names)
    _check_settings(names, overrides)
    writable_folder(output, source.files)
    with progress_bars() as progress:
        sequence = source.read(progress)
    check_rate(rate_hz, sequence, DEFAULT_RATE_HZ)
    sequence, recognition = _with_recognised(source, sequence)
    with progress_bars() as progress:
        comparison = compare_runs(sequence, names, overrides, rate_hz=rate_hz, progress=progress)
    comparison = replace(comparison, recognition=recognition)
    _write_results(comparison, output)
    return comparison


def _with_recognised(source: LogSource, sequence: Sequence) -> tuple[Sequence, Recognition | None]:
    """The sequence with landmarks recognised in the log's sonar images, where that is asked for or it has none yet.

    Raises
    ------
    LogError
        When it is asked for and there are no images.
    """
    from sonar_graph.recognition import no_images, recognise_images, with_detections

    if sequence.detections is not None and not source.is_recognised_anew:
        return sequence, None
    topic = topic_choices(source.topics or []).get("sonar")
    with progress_bars() as progress:
        found = recognise_images(
            source.path,
            sequence,
            topic=topic,
            config=read_config(source.config),
            recogniser=our_recogniser(sequence.calibration, source.designs, source.model, source.rule),
            window=window_of(source.start, source.end),
            salvage=source.salvage,
            progress=lambda done: progress("recognising landmarks (frames)", done, 0),
        )
    if found is None:
        if source.is_recognised_anew:
            raise LogError(f"{no_images(source.path)}; --designs, --model and --rule are for images")
        return sequence, None
    if source.designs is None:
        warn_of_other_designs(sequence)
    return with_detections(sequence, found), found


def _check_settings(names: list[str], overrides: dict[str, dict[str, Any]]) -> None:
    """Refuse unknown names and settings before the log is read.

    An estimator that cannot be loaded is no mistake of the user's: its run fails, and the others go on.
    """
    from sonar_graph.estimator import load_estimator, make_params

    for name in names:
        try:
            estimator = load_estimator(name)
        except UnknownEstimatorError:
            raise
        except EstimatorError:
            continue
        make_params(estimator, overrides.get(name, {}), name)


def _write_results(comparison: Comparison, folder: Path) -> None:
    from sonar_graph.evaluation import write_comparison, write_viewer_files

    with working("writing results"):
        write_comparison(comparison, folder)
        write_viewer_files(comparison, folder)


def _write_report(comparison: Comparison, folder: Path) -> Path:
    from sonar_graph.report import write_page

    with working("drawing"):
        return write_page(comparison, folder)


def _print_summary(comparison: Comparison) -> None:
    from sonar_graph.report import published_counterpart, summary

    out = answers()
    out.print(summary(comparison))
    counterpart = published_counterpart(comparison)
    if counterpart is not None:
        out.print(counterpart)


def _exit_by(comparison: Comparison) -> None:
    """Exit with 1 when a run failed, saying why; everything is written by then."""
    failed = [run for run in comparison.runs if run.status == "failed"]
    for run in failed:
        typer.echo(f"sonar-graph: {run.estimator} failed: {run.reason}", err=True)
    if failed:
        raise typer.Exit(1)


LOG = "basin.mcap"
DEMO = {"duration_s": 390.0, "laps": 3, "imu": "mti1", "dvl": "explorer", "image": {}}
"""The three laps of the paper in less time; cheap sensors, so that dead reckoning drifts within minutes."""


def demo(output: OutputFolder = Path("demo")) -> None:
    """Repeat the 2014 paper's basin experiment in short: simulate sonar images, recognise landmarks, compare, report.

    Three laps in 390 s instead of 2039 s; the log takes about 90 MB.
    """
    from sonar_graph.simulation import BasinOptions

    log = writable_log(writable_folder(output) / LOG)
    options = BasinOptions.model_validate(DEMO)
    typer.echo(f"Simulating {options.duration_s:g} s in a basin, {options.laps} laps, with sonar images: {log}")
    write_basin(log, options)
    typer.echo("Recognising landmarks in them, then running the estimators")
    compare(log, output)


def estimators() -> None:
    """List the installed estimators with their settings, defaults and meaning."""
    from sonar_graph.errors import EstimatorError
    from sonar_graph.estimator import installed_estimators, load_estimator
    from sonar_graph.settings import settings_of

    console = answers()
    failed = False
    for name, point in installed_estimators().items():
        try:
            settings = load_estimator(name).Params
        except EstimatorError as error:
            console.print(escape(str(error)), "", sep="\n", soft_wrap=True)
            failed = True
            continue
        console.print(f"[bold]{escape(name)}[/] ({escape(point.value)})", soft_wrap=True)
        table = Table("setting", "default", "meaning", box=None, pad_edge=True)
        for setting in settings_of(settings):
            table.add_row(escape(setting.name), escape(str(setting.default)), escape(setting.meaning))
        console.print(table if settings.model_fields else "  no settings")
        console.print()
    if failed:
        raise typer.Exit(1)
