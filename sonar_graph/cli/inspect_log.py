"""``sonar-graph inspect`` and ``calibration``: content of a log, agreement of its sensors, its calibration."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.markup import escape
from rich.table import Table

from sonar_graph.cli.arguments import (
    LogPath,
    ReadingOptions,
    answers,
    argument,
    echo,
    option,
    with_options,
)
from sonar_graph.cli.outputs import working
from sonar_graph.errors import CalibrationError, SonarGraphError

if TYPE_CHECKING:
    from sonar_graph.diagnosis import Finding
    from sonar_graph.logs import LogSummary

# exit codes; 2 is a mistake of the user
UNUSABLE = 1
DOUBTFUL = 3
HEAD = """\
# Calibration for --calibration FILE. A line that is commented out has the default, which counts where neither this file
# nor the log says something else. Units are in the names or after the lines; angles are in rad, lengths in m.
"""
# rows of the table for people; a log may have tens of thousands
MOST_TOPICS = 500


@with_options("salvage")
def inspect(
    log: LogPath,
    reading: ReadingOptions,
    toml: bool = option(
        "Print only the log configuration to start from, for --log-config.", False
    ),
    quick: bool = option(
        "Do not compare sensors with each other (time offsets, DVL mounting, biases, start, noise, map): seconds.",
        False,
    ),
    as_json: bool = option("Print everything as one JSON object.", False, "--json"),
) -> None:
    """Show what is in a log: topics, rates, gaps, which topic would be used for what and why, which sensors disagree.

    Ends with 0 where nothing is in doubt, 3 where the log can be used but something is in doubt (warnings, lines to
    act on, only sonar images), and 1 where it cannot be used as it is: no IMU or Doppler log, contradictions, damage.
    """
    from sonar_graph.files import strict_json
    from sonar_graph.logs import inspect_log
    from sonar_graph.map_file import read_map

    config = reading.config
    given = reading.given
    if reading.map is not None:
        # what a run would refuse is refused here too
        read_map(reading.map)
    # stamps and types alone, without the numbers in the messages: seconds for a large log
    summary = inspect_log(log, config, reading.choices, reading.window, given)
    if toml:
        echo(summary.toml, nl=False)
        return
    if reading.map is not None:
        # the converter's words about a start by convention
        summary.notes.pop("log.start", None)
    findings: list[Finding] = []
    skipped = ""
    # images alone can still be recognised
    is_usable = not (
        (summary.obstacles and not summary.has_images_alone)
        or summary.unusable
        or summary.damage
    )
    if quick:
        skipped = "not compared: --quick"
        if reading.map is not None:
            skipped += ", which leaves out the map too"
    elif summary.obstacles:
        skipped = f"not compared: {', '.join(summary.obstacles)}"
    else:
        from sonar_graph.diagnosis import check_sensors

        is_read = False
        try:
            with working("comparing sensors"):
                sequence = reading.read(log)
                is_read = True
                findings = check_sensors(sequence, config)
        # the tables above are worth printing all the same
        except SonarGraphError as error:
            skipped = f"not compared: {error}"
            is_usable = is_usable and is_read
    # for programs: the same content, without the exit code changing
    if as_json:
        derived = {
            "path": str(summary.path),
            "duration_s": summary.duration_s,
            "obstacles": summary.obstacles,
            "sensors": [finding.plain() for finding in findings],
            "sensors_skipped": skipped,
        }
        echo(strict_json(asdict(summary) | derived))
    else:
        print_summary(summary, findings, skipped)
    if not is_usable:
        raise typer.Exit(UNUSABLE)
    is_doubted = summary.warnings or any(finding.acts for finding in findings)
    if summary.has_images_alone or is_doubted:
        raise typer.Exit(DOUBTFUL)


def print_summary(summary: LogSummary, findings: list[Finding], skipped: str) -> None:
    """Print the tables of a log, and a line for each note, finding and warning, as which grave quantities count."""
    console = answers()

    def say(heading: str, text: str, style: str = "bold") -> None:
        console.print(f"[{style}]{escape(heading)}[/] {escape(text)}", soft_wrap=True)

    console.print(
        f"[bold]{escape(summary.name or summary.path.name)}[/], {summary.duration_s:.1f} s\n",
        soft_wrap=True,
    )
    # without a box, so that lines can be copied
    topics = Table(box=None, pad_edge=False)
    for heading in ("topic", "type"):
        topics.add_column(heading, overflow="fold")
    for heading in (
        "messages",
        "rate (Hz)",
        "span (s)",
        "max gap (s)",
        "jitter (ms)",
        "recorded after (s)",
    ):
        topics.add_column(heading, justify="right")
    # spans are from the beginning of the log, not since 1970
    origin_ns = min((topic.first_stamp_ns for topic in summary.topics), default=0)
    shown = summary.topics[:MOST_TOPICS]
    for topic in shown:
        is_other = topic.encoding != "cdr"
        kind = topic.type_name + f" ({topic.encoding})" * is_other
        first_s = (topic.first_stamp_ns - origin_ns) * 1e-9
        last_s = (topic.last_stamp_ns - origin_ns) * 1e-9
        topics.add_row(
            escape(topic.name),
            escape(kind),
            str(topic.messages),
            f"{topic.rate_hz:.2f}",
            f"{first_s:.1f} to {last_s:.1f}",
            f"{topic.largest_gap_s:.2f}",
            f"{1e3 * topic.jitter_s:.2g}",
            "-" if topic.lag_s is None else f"{topic.lag_s:.3f}",
        )
    roles = Table("used for", "topic", "because", box=None, pad_edge=False)
    for role in summary.roles:
        cells = role.role.replace("_", " "), role.topic or "-", role.reason
        roles.add_row(*map(escape, cells))
    console.print(topics, "", roles, "", sep="\n")
    # a table that is cut must not look complete
    if len(summary.topics) > len(shown):
        say(
            "not shown",
            f"{len(summary.topics) - len(shown)} more topics; --json gives all",
        )
    about = [("calibration", summary.calibration), *summary.notes.items()]
    for subject, note in [
        *about,
        ("sonar images", summary.sonar),
        ("sensors", skipped),
    ]:
        if note:
            say(subject, note)
    if not skipped:
        console.print("\n[bold]sensors against each other[/] (± 95 %)")
        grave = {finding.quantity for finding in findings if finding.grave}
        for finding in findings:
            warned = "warning: " if finding.quantity in grave else ""
            style = "bold yellow" if finding.acts else "bold"
            say(warned + finding.quantity, finding.text(), style)
        console.print()
    for rows in summary.left_out:
        say("left out", rows)
    for topic in shown:
        if topic.refusal:
            say("not read", f"{topic.name} {topic.refusal}", "bold yellow")
        for fault in topic.stamp_faults:
            say("stamps", f"{topic.name}: {fault}", "bold yellow")
    for warning in summary.warnings:
        say("warning", warning, "bold yellow")
    for reason in summary.unusable:
        say("not usable as it is", reason, "bold red")
    for loss in summary.damage:
        say("damage", loss, "bold red")
    if summary.obstacles:
        lacking = escape(", ".join(summary.obstacles))
        console.print(f"[bold red]not usable for compare[/]: {lacking}", soft_wrap=True)
        say_it = "Say"
        if summary.has_images_alone:
            say_it = "If it has IMU and Doppler log, say"
            echo(
                f"Its sonar images can be used: sonar-graph recognise {summary.path} -o recognised.mcap; "
                f"sonar-graph join {summary.path} NAV -o joined.mcap brings in IMU and Doppler log of another file"
            )
        # the command can be copied as it is
        echo(
            f"{say_it} what its topics are: sonar-graph inspect {summary.path} --toml > log.toml, edit it, and give "
            "--log-config log.toml"
        )


@with_options("salvage", "map", "truth")
def calibration(
    reading: ReadingOptions,
    log: Path | None = argument(
        "MCAP log whose calibration and mountings count.", "[LOG]", None, exists=True
    ),
    template: bool = option("Print all fields with units and defaults.", False),
) -> None:
    """Print a calibration file to edit: all fields with units, meaning and defaults, and the values of a log."""
    from sonar_graph.calibration import Calibration
    from sonar_graph.logs import read_log
    from sonar_graph.settings import toml_template

    if not template:
        raise CalibrationError(
            "give --template: `sonar-graph calibration --template dive.mcap > vehicle.toml`"
        )
    stated = Calibration()
    source = ""
    if log is not None:
        sequence = read_log(log, **reading.of_log)
        stated = sequence.calibration
        source = f"# {log.name}: {sequence.notes['log.calibration']}\n"
    elif reading.given is not None:
        raise CalibrationError("--calibration: give a log too, for which it counts")
    echo(
        f"{HEAD}{source}\n{toml_template(Calibration, stated, f'by {log.name}' if log else '')}",
        nl=False,
    )
