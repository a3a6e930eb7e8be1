"""``sonar-graph live`` and ``play``: the estimator on a running robot, and a log in place of one."""

from __future__ import annotations

import gc
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sonar_graph.cli.arguments import (
    EstimatorSettings,
    LogPath,
    OutputFolder,
    ReadingOptions,
    echo,
    estimator_settings,
)
from sonar_graph.cli.outputs import working
from sonar_graph.errors import LogError
from sonar_graph.files import COMPARISON, interrupt_event, result_written, write_json

if TYPE_CHECKING:
    from sonar_graph.live import Publisher

RECORD, COUNTS = "record.mcap", "live.json"
SETTLE_S = 1.0
"""Time for subscribers to find all topics, and to get the last messages."""
DOMAIN = Annotated[int, typer.Option(min=0, max=232, help="ROS_DOMAIN_ID.")]


def live(
    output: OutputFolder,
    connect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ENDPOINT",
            help="zenoh router (tcp/ADDRESS:7447), as rmw_zenohd or `play` is one; or a foxglove_bridge "
            "(ws://ADDRESS:8765), to which nothing is sent back.",
        ),
    ] = None,
    domain: DOMAIN = 0,
    estimator: Annotated[
        str, typer.Option("--estimator", help="Name of an installed estimator.")
    ] = "isam2",
    rate_hz: Annotated[
        float, typer.Option(min=0.1, max=100.0, help="Estimates a second.")
    ] = 10.0,
    lateness: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            min=0.0,
            help="How long an estimate waits for a sensor that is late.",
        ),
    ] = 0.25,
    settings: EstimatorSettings = None,
    topics: Annotated[
        list[str] | None,
        typer.Option(
            "--topic", metavar="ROLE=TOPIC", help="Topic for a role; may be repeated."
        ),
    ] = None,
    log_config: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="As for `run`.")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="As for `run`.")
    ] = None,
    foxglove: Annotated[
        int | None,
        typer.Option(
            metavar="PORT",
            min=1,
            max=65535,
            help="Also serve Foxglove and Lichtblick on 127.0.0.1 (8765).",
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RECORD",
            exists=True,
            dir_okay=False,
            help="Go on after a crash, from its record and calibration.",
        ),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="End after so long.")
    ] = None,
) -> None:
    """Estimate while the robot moves: topics of ROS 2 over zenoh in, poses and landmarks out, and a record.

    Writes DIR/record.mcap: everything that came, from which `run` gives the same estimates, bit for bit; at the end
    what `run` writes, and live.json with numbers of messages.
    """
    import numpy as np

    from sonar_graph.diagnosis import compared
    from sonar_graph.evaluation import (
        RunResult,
        check_request,
        judge,
        write_comparison,
        write_viewer_files,
    )
    from sonar_graph.live import (
        DEFAULT_ROUTER,
        LiveOptions,
        LiveRun,
        dropped_messages,
        open_link,
        open_outlets,
        recorded_messages,
    )
    from sonar_graph.logs import LiveRecord, read_log
    from sonar_graph.report import doubt_lines

    reading = ReadingOptions(
        calibration=calibration, topics=topics, log_config=log_config
    )
    record = output / RECORD
    if record.exists():
        advice = (
            f"continue it with --resume {record} and another folder"
            if resume is None
            else "name another folder"
        )
        raise LogError(f"{record}: a record is there already: {advice}")
    overrides = estimator_settings(settings, [estimator]).get(estimator, {})
    params = check_request(estimator, overrides)
    given = (
        reading.given
        if resume is None
        else LiveRecord.resumed_calibration(resume, reading.given)
    )
    options = LiveOptions(
        estimator, overrides, rate_hz, lateness, reading.choices, reading.config, given
    )
    with (
        open_link(connect or [DEFAULT_ROUTER], domain) as link,
        interrupt_event() as ended,
    ):
        output.mkdir(parents=True, exist_ok=True)
        outlets = open_outlets(link, foxglove)
        echo("compiling what the estimator needs")
        with (
            LiveRecord(record) as written,
            LiveRun(written, link.definition_of, options, outlets, echo) as run,
        ):
            if resume is not None:
                last_ns = run.catch_up(
                    recorded_messages(resume), dropped_messages(resume)
                )
                echo(
                    f"resumed from {resume}: blind for {(time.time_ns() - last_ns) * 1e-9:.1f} s"
                )
            else:  # after a crash nobody waits for it
                run.wait_for_recogniser()
            gc.freeze()  # what was loaded is never looked at again, which would delay a pose
            link.listen(run.accept, run.wants)
            echo(
                f"listening to {', '.join(connect or [DEFAULT_ROUTER])}, domain {domain}; the record is {record}"
            )
            last_s = time.monotonic() + (float("inf") if duration is None else duration)
            while not ended.is_set() and time.monotonic() < last_s:
                run.turn()
            link.stop()
            outcome = run.finish()
    if not run.engine.topics:
        record.unlink()
        raise LogError(f"nothing was estimated: {run.lacking()}")
    if outcome is None:
        raise LogError(
            f"nothing was estimated: {run.lacking()}; what came is in {record}"
        )
    counts = run.counts()
    write_json(output / COUNTS, {"estimator": estimator, "messages": counts})
    result = RunResult(
        estimator,
        params or overrides,
        "ok",
        causal=outcome.causal,
        smoothed=outcome.smoothed,
        landmarks=outcome.landmarks,
        refused=outcome.refused,
        withheld=outcome.withheld,
        update_s=np.array(outcome.update_s),
        finish_s=outcome.finish_s,
    )
    with working("writing results"):
        sequence = read_log(record)
        sequence = compared(sequence, reading.config)
        comparison = judge(sequence, outcome.causal.stamps_ns, [result])
        with result_written(output, COMPARISON):
            write_comparison(comparison, output)
            write_viewer_files(comparison, output)
    echo(
        f"{sum(counts['received'].values())} messages, {sum(counts['lost'].values())} lost"
    )
    of_sensors = {"log.doubtful", "log.sensors"} & sequence.notes.keys()
    for line in doubt_lines({name: sequence.notes[name] for name in of_sensors}):
        echo(line, err=True)
    for what in ("lost", "dropped"):
        for name, number in counts[what].items():
            echo(f"{what}: {number} of {name}")
    echo(
        f"Results: {output}; the same estimates from the record: sonar-graph run {record} -o DIR"
    )


def play(
    log: LogPath,
    rate: Annotated[
        float,
        typer.Option(min=1e-3, max=1e3, help="Speed: 2 is twice as fast as recorded."),
    ] = 1.0,
    listen: Annotated[
        str,
        typer.Option(
            metavar="ENDPOINT",
            help="Where to listen as a zenoh router; loopback unless named.",
        ),
    ] = "tcp/127.0.0.1:7447",
    connect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ENDPOINT", help="Router to send to, instead of listening."
        ),
    ] = None,
    domain: DOMAIN = 0,
    wait: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            min=0.0,
            help="Longest time to wait for somebody who listens.",
        ),
    ] = 30.0,
    after: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Wait until this file is there, such as one that a script makes.",
        ),
    ] = None,
) -> None:
    """Send the messages of a log over zenoh as a robot would, for rehearsals and tests of `live`."""
    from sonar_graph.live import (
        Publisher,
        open_session,
        play_messages,
        recorded_messages,
    )

    session = open_session(connect or (), () if connect else [listen])
    publishers: dict[str, Publisher] = {}
    unknown: set[str] = set()
    for topic, kind in topics_of(log).items():
        try:
            publishers[topic] = Publisher(session, domain, topic, kind)
        except LogError as error:
            unknown.add(topic)
            echo(f"not sent: {topic}: {error}")
    with interrupt_event() as ended:
        last_s = time.monotonic() + wait
        if wait:
            echo(f"waiting up to {wait:g} s for somebody who listens")
        while (
            not any(one.is_heard for one in publishers.values())
            and time.monotonic() < last_s
        ):
            if ended.wait(0.05):
                break
        ended.wait(SETTLE_S)
        while after is not None and not after.exists() and not ended.wait(0.05):
            pass
        echo(f"playing {log} to {', '.join(connect or [listen])}; Ctrl-C ends")
        wanted = (
            message
            for message in recorded_messages(log)
            if message.topic not in unknown
        )
        count, latest_s = play_messages(
            wanted,
            rate,
            lambda message: publishers[message.topic].put(message.payload),
            ended.is_set,
        )
        ended.wait(SETTLE_S)
    session.close()
    echo(
        f"{count} messages of {len(publishers)} topics, the latest {latest_s * 1e3:.0f} ms behind its time"
    )


def topics_of(log: Path) -> dict[str, str]:
    """Types of the topics of a log that ROS 2 messages are on, by name."""
    from sonar_graph.logs.mcap import Keep, scan

    recording = scan(log, lambda _: Keep.NONE)
    return {
        name: topic.type_name
        for name, topic in recording.topics.items()
        if topic.encoding == "cdr"
    }
