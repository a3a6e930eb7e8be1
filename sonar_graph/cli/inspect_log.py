"""``sonar-graph inspect``: what is in a log, and what would be used for what."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from sonar_graph.cli.arguments import (
    CalibrationPath,
    EndTime,
    LogConfigPath,
    LogPath,
    StartTime,
    TopicChoices,
    answers,
    read_calibration,
    read_config,
    topic_choices,
    window_of,
)
from sonar_graph.cli.outputs import working

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from sonar_graph.diagnosis import Finding
    from sonar_graph.logs import LogSummary, PartialCalibration, TopicSummary
    from sonar_graph.logs.adapters import LogConfig
    from sonar_graph.logs.mcap import TimeWindow


def inspect(
    log: LogPath,
    topics: TopicChoices = None,
    log_config: LogConfigPath = None,
    start: StartTime = None,
    end: EndTime = None,
    calibration: CalibrationPath = None,
    toml: Annotated[
        bool, typer.Option("--toml", help="Print only the log configuration to start from, for --log-config.")
    ] = False,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Do not compare sensors with each other (time offsets, DVL mounting, biases, start, noise): seconds.",
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as one JSON object.")] = False,
) -> None:
    """Say what is in a log: topics, rates, gaps, which topic would be used for what and why, what sensors disagree."""
    from sonar_graph.logs import inspect_log

    config, chosen, window = read_config(log_config), topic_choices(topics or []), window_of(start, end)
    given = read_calibration(calibration)
    summary = inspect_log(log, config, chosen, window)
    if toml:
        typer.echo(summary.toml, nl=False)
        return
    findings: list[Finding] = []
    skipped = "not compared: --quick"
    if not quick:
        findings, skipped = _compare_sensors(summary, log, config, chosen, window, given)
    if as_json:
        typer.echo(_as_json(summary, findings, skipped))
    else:
        _print_summary(answers(), summary, findings, skipped)


def _compare_sensors(
    summary: LogSummary,
    log: Path,
    config: LogConfig | None,
    topics: dict[str, str],
    window: TimeWindow,
    calibration: PartialCalibration | None,
) -> tuple[list[Finding], str]:
    """What sensors say about each other, or why they were not asked."""
    from sonar_graph.diagnosis import check_sensors
    from sonar_graph.errors import SonarGraphError
    from sonar_graph.logs import read_log

    if summary.obstacles:
        return [], f"not compared: {', '.join(summary.obstacles)}"
    try:
        with working("comparing sensors"):
            sequence = read_log(log, calibration=calibration, config=config, topics=topics, window=window)
            return check_sensors(sequence, config), ""
    except SonarGraphError as error:
        return [], f"not compared: {error}"


def _as_json(summary: LogSummary, findings: list[Finding], skipped: str) -> str:
    from dataclasses import asdict

    from sonar_graph.files import strict_json

    content = asdict(summary) | {"path": str(summary.path), "duration_s": summary.duration_s}
    found = {"sensors": [finding.plain() for finding in findings], "sensors_skipped": skipped}
    return strict_json(content | {"obstacles": summary.obstacles} | found)


def _print_summary(console: Console, summary: LogSummary, findings: list[Finding], skipped: str) -> None:
    console.print(f"[bold]{escape(summary.name or summary.path.name)}[/], {summary.duration_s:.1f} s\n", soft_wrap=True)
    console.print(_topics_table(summary), "")
    console.print(_roles_table(summary), "")
    console.print(f"[bold]calibration[/] {escape(summary.calibration)}", soft_wrap=True)
    for subject, note in summary.notes.items():
        console.print(f"[bold]{escape(subject)}[/] {escape(note)}", soft_wrap=True)
    if summary.sonar:
        console.print(f"[bold]sonar images[/] {escape(summary.sonar)}", soft_wrap=True)
    _print_findings(console, findings, skipped)
    for rows in summary.left_out:
        console.print(f"[bold]left out[/] {escape(rows)}", soft_wrap=True)
    for topic in summary.topics:
        if topic.refusal:
            console.print(f"[bold yellow]not read[/] {escape(topic.name)} {escape(topic.refusal)}", soft_wrap=True)
        for fault in topic.stamp_faults:
            console.print(f"[bold yellow]stamps[/] {escape(topic.name)}: {escape(fault)}", soft_wrap=True)
    for warning in summary.warnings:
        console.print(f"[bold yellow]warning[/] {escape(warning)}", soft_wrap=True)
    for loss in summary.damage:
        console.print(f"[bold red]damage[/] {escape(loss)}", soft_wrap=True)
    if summary.obstacles:
        console.print(f"[bold red]not usable for compare[/]: {escape(', '.join(summary.obstacles))}", soft_wrap=True)
        hint = f"sonar-graph inspect {summary.path} --toml > log.toml"
        console.print(
            f"Say what its topics are: {escape(hint)}, edit it, and give --log-config log.toml", soft_wrap=True
        )


def _print_findings(console: Console, findings: list[Finding], skipped: str) -> None:
    if skipped:
        console.print(f"[bold]sensors[/] {escape(skipped)}", soft_wrap=True)
        return
    console.print("\n[bold]sensors against each other[/] (± 95 %)")
    for finding in findings:
        style = "bold yellow" if finding.acts else "bold"
        console.print(f"[{style}]{escape(finding.quantity)}[/] {escape(finding.text())}", soft_wrap=True)
    console.print()


def _topics_table(summary: LogSummary) -> Table:
    table = Table(box=None, pad_edge=False)
    for heading in ("topic", "type"):
        table.add_column(heading, overflow="fold")
    for heading in ("messages", "rate (Hz)", "span (s)", "max gap (s)", "jitter (ms)", "recorded after (s)"):
        table.add_column(heading, justify="right")
    origin_ns = min((topic.first_stamp_ns for topic in summary.topics), default=0)
    for topic in summary.topics:
        table.add_row(*map(escape, _topic_cells(topic, origin_ns)))
    return table


def _topic_cells(topic: TopicSummary, origin_ns: int) -> list[str]:
    kind = topic.type_name.replace("/msg/", "/")
    if topic.encoding != "cdr":
        kind += f" ({topic.encoding})"
    first_s, last_s = ((stamp_ns - origin_ns) * 1e-9 for stamp_ns in (topic.first_stamp_ns, topic.last_stamp_ns))
    span = f"{first_s:.1f} to {last_s:.1f}"
    lag = "-" if topic.lag_s is None else f"{topic.lag_s:.3f}"
    times = [f"{topic.rate_hz:.2f}", span, f"{topic.largest_gap_s:.2f}", f"{1e3 * topic.jitter_s:.2g}", lag]
    return [topic.name, kind, str(topic.messages), *times]


def _roles_table(summary: LogSummary) -> Table:
    table = Table("used for", "topic", "because", box=None, pad_edge=False)
    for role in summary.roles:
        table.add_row(escape(role.role.replace("_", " ")), escape(role.topic or "-"), escape(role.reason))
    return table
