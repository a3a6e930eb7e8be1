"""``sonar-graph live`` and ``play``: the estimator on a running robot, and a log in place of one."""

from __future__ import annotations

import gc
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sonar_graph.cli.arguments import (
    EstimatorSettings,
    LogPath,
    OutputFolder,
    ReadingOptions,
    echo,
    estimator_settings,
    option,
    with_options,
)
from sonar_graph.cli.outputs import working
from sonar_graph.errors import LogError
from sonar_graph.files import interrupt_event, write_json

if TYPE_CHECKING:
    import threading

    from sonar_graph.live import Publisher
    from sonar_graph.logs import PartialCalibration

RECORD = "record.mcap"
COUNTS = "live.json"
# time between two lines of a log that waits to be played
REMIND_S = 10.0
# time for subscribers to find all topics, and to get the last messages
SETTLE_S = 1.0
DOMAIN = Annotated[int, typer.Option(min=0, max=232, help="ROS_DOMAIN_ID.")]


@dataclass(frozen=True)
class LinkOptions:
    """Options for where messages come from."""

    connect: list[str] | None = option(
        "zenoh router (tcp/ADDRESS:7447), as rmw_zenohd or `play` is one; or a foxglove_bridge "
        "(ws://ADDRESS:8765), to which nothing is sent back.",
        metavar="ENDPOINT",
    )
    domain: DOMAIN = 0

    @property
    def endpoints(self) -> list[str]:
        """Routers or bridges to connect to."""
        from sonar_graph.live import DEFAULT_ROUTER

        return self.connect or [DEFAULT_ROUTER]


@dataclass(frozen=True)
class LiveEstimation:
    """Options for the estimator of a live run and for the messages that it gets."""

    estimator: str = option("Name of an installed estimator.", "isam2")
    rate_hz: float = option("Estimates a second.", 10.0, min=0.1, max=100.0)
    lateness: float = option(
        "How long an estimate waits for a sensor that is late.",
        0.25,
        metavar="SECONDS",
        min=0.0,
    )
    settings: EstimatorSettings = None

    @property
    def overrides(self) -> dict[str, Any]:
        """Settings of the estimator that differ from its defaults."""
        given = estimator_settings(self.settings, [self.estimator])
        return given.get(self.estimator, {})


@with_options("start", "end", "salvage", "truth")
def live(
    output: OutputFolder,
    link_options: LinkOptions,
    estimation: LiveEstimation,
    reading: ReadingOptions,
    foxglove: int | None = option(
        "Also serve Foxglove and Lichtblick on 127.0.0.1 (8765).",
        metavar="PORT",
        min=1,
        max=65535,
    ),
    duration: float | None = option("End after so long.", metavar="SECONDS"),
) -> None:
    """Estimate while the robot moves: topics of ROS 2 over zenoh in, poses and landmarks out, and a record.

    A line each second has the time, the position with its sigmas, rates, landmarks, drops and latency. Writes
    DIR/record.mcap: everything that came, from which `run` gives the same estimates, bit for bit; at the end, after
    Ctrl-C, what `run` writes, report.html among it, and live.json with numbers of messages.
    """
    import numpy as np

    from sonar_graph.diagnosis import compared
    from sonar_graph.evaluation import RunResult, check_request, judge
    from sonar_graph.live import LiveOptions, LiveRun, open_link, open_outlets
    from sonar_graph.logs import LiveRecord, read_log
    from sonar_graph.report import doubt_lines, write_report

    estimator = estimation.estimator
    record = output / RECORD
    # a record cannot be made again: it is never replaced
    if record.exists():
        raise LogError(f"{record}: a record is there already: name another folder")
    # before anything is written: a wrong setting leaves no folder
    overrides = estimation.overrides
    params = check_request(estimator, overrides)
    given = with_map(reading)
    options = LiveOptions(
        estimator,
        overrides,
        estimation.rate_hz,
        estimation.lateness,
        reading.choices,
        reading.config,
        given,
    )
    with (
        open_link(link_options.endpoints, link_options.domain) as link,
        interrupt_event() as ended,
    ):
        # only once a link is open: a wrong address leaves no folder
        output.mkdir(parents=True, exist_ok=True)
        outlets = open_outlets(link, foxglove)
        screen = StatusLine()
        echo("compiling what the estimator needs; nothing is awaited until then")
        with (
            LiveRecord(record) as written,
            LiveRun(
                written, link.definition_of, options, outlets, screen.say, screen.show
            ) as run,
        ):
            run.wait_for_recogniser()
            gc.freeze()  # what was loaded is never looked at again, which would delay a pose
            link.listen(run.accept, run.wants)
            echo(
                f"listening to {', '.join(link_options.endpoints)}, domain {link_options.domain}; "
                f"the record is {record}"
            )
            last_s = time.monotonic() + (float("inf") if duration is None else duration)
            while not ended.is_set() and time.monotonic() < last_s:
                run.turn()
            screen.end()
            link.stop()
            outcome = run.finish()
    # an empty record would stand in the way of the next run
    if not run.engine.topics:
        record.unlink()
        raise LogError(f"nothing was estimated: {run.lacking()}")
    if outcome is None:
        raise LogError(
            f"nothing was estimated: {run.lacking()}; what came is in {record}"
        )
    # losses are written down: they decide whether the run can be trusted
    counts = run.counts()
    write_json(output / COUNTS, {"estimator": estimator, "messages": counts})
    # landmarks may have refuted a place that was found in a map
    is_lost = not len(outcome.smoothed)
    kept = ("causal", "smoothed", "landmarks", "withheld")
    found: dict[str, Any] = {name: getattr(outcome, name) for name in kept}
    if is_lost:
        found = {"reason": "; ".join(outcome.withheld)}
    result = RunResult(
        estimator,
        params or overrides,
        "failed" if is_lost else "ok",
        **found,
        refused=outcome.refused,
        update_s=np.array(outcome.update_s),
        finish_s=outcome.finish_s,
    )
    with working("writing results and the page"):
        # the page is of the record, so that it can be repeated from the record
        sequence = read_log(record)
        sequence = compared(sequence, reading.config)
        comparison = judge(sequence, outcome.causal.stamps_ns, [result])
        page = write_report(comparison, output)
    echo(
        f"{sum(counts['received'].values())} messages, {sum(counts['lost'].values())} lost"
    )
    of_sensors = {"log.doubtful", "log.sensors"} & sequence.notes.keys()
    for line in doubt_lines({name: sequence.notes[name] for name in of_sensors}):
        echo(line, err=True)
    for what in ("lost", "dropped"):
        for name, number in counts[what].items():
            echo(f"{what}: {number} of {name}")
    if is_lost:
        echo(f"sonar-graph: {estimator} failed: {result.reason}", err=True)
    echo(
        f"Results: {page}; the same estimates from the record: sonar-graph run {record} -o DIR"
    )
    if is_lost:
        raise typer.Exit(1)


def with_map(reading: ReadingOptions) -> PartialCalibration | None:
    """Fields of the calibration that are given, the map of landmarks among them."""
    from sonar_graph.logs import PartialCalibration
    from sonar_graph.map_file import read_map

    given = reading.given
    if reading.map is None:
        return given
    known, warnings = read_map(reading.map)
    for line in warnings:
        echo(line, err=True)
    fields = {"map": known.model_dump(mode="json")}
    of_map = PartialCalibration(fields, str(reading.map))
    return of_map if given is None else of_map.over(given)


@dataclass(frozen=True)
class PlayStart:
    """Options for when the first message is sent."""

    wait: float | None = option(
        "Longest time to wait for a listener, and then end; 0 sends at once. Unless given, as long as it takes.",
        metavar="SECONDS",
        min=0.0,
    )
    after: Path | None = option(
        "Wait until this file is there, such as one that a script makes.",
        metavar="FILE",
    )


def play(
    log: LogPath,
    rate: float = option(
        "Speed: 2 is twice as fast as recorded.", 1.0, min=1e-3, max=1e3
    ),
    listen: str = option(
        "Where to listen as a zenoh router; loopback unless named.",
        "tcp/127.0.0.1:7447",
        metavar="ENDPOINT",
    ),
    connect: list[str] | None = option(
        "Router to send to, instead of listening.", metavar="ENDPOINT"
    ),
    domain: DOMAIN = 0,
    *,
    start: PlayStart,
) -> None:
    """Send the messages of a log over zenoh as a robot would, for rehearsals and tests of `live`."""
    from sonar_graph.live import (
        Publisher,
        open_session,
        play_messages,
        recorded_messages,
    )

    # as a router, because most rehearsals have none
    session = open_session(connect or (), () if connect else [listen])
    publishers: dict[str, Publisher] = {}
    unknown: set[str] = set()
    for topic, kind in topics_of(log).items():
        try:
            publishers[topic] = Publisher(session, domain, topic, kind)
        except LogError as error:
            unknown.add(topic)
            echo(f"not sent: {topic}: {error}")
    where = ", ".join(connect or [listen])
    with interrupt_event() as ended:
        if start.wait != 0.0:
            command = (
                f"sonar-graph live -o DIR --connect {(connect or [listen])[0]}"
                f" --domain {domain} --calibration {log}"
            )
            wait_for_listener(publishers, command, start.wait, ended)
        ended.wait(SETTLE_S)
        if not ended.is_set():
            for line in unheard_lines(publishers):
                echo(line)
        after = start.after
        while after is not None and not after.exists() and not ended.wait(0.05):
            pass
        echo(f"playing {log} to {where}; Ctrl-C ends")
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


class StatusLine:
    """Lines of a live run on the terminal; the status of a second replaces that of the second before."""

    def __init__(self) -> None:
        self._is_terminal = sys.stdout.isatty()
        self._is_shown = False

    def show(self, status: str) -> None:
        """Show a status: in its own line, or as a line where the output is no terminal."""
        if not self._is_terminal:
            echo(status)
            return
        # a longer status would wrap, and the next could not replace it
        width = shutil.get_terminal_size().columns
        typer.echo("\r\x1b[2K", nl=False)
        echo(status[: width - 1], nl=False)
        sys.stdout.flush()
        self._is_shown = True

    def say(self, line: str) -> None:
        """Print a line that stays."""
        self.end()
        echo(line)

    def end(self) -> None:
        """Leave the line of the status, which stays as it is."""
        if self._is_shown:
            typer.echo()
        self._is_shown = False


def wait_for_listener(
    publishers: dict[str, Publisher],
    command: str,
    wait_s: float | None,
    ended: threading.Event,
) -> None:
    """Wait until a topic has a subscriber; a `LogError` with the ``command`` of one where none comes in time."""
    limit = "" if wait_s is None else f" up to {wait_s:g} s (--wait)"
    echo(f"waiting{limit} for a listener, such as: {command}")
    begin_s = time.monotonic()
    next_s = REMIND_S
    # messages without a receiver would be missing from the rehearsal
    while not any(one.is_heard for one in publishers.values()):
        waited_s = time.monotonic() - begin_s
        if wait_s is not None and waited_s > wait_s:
            raise LogError(
                f"nobody listened within {wait_s:g} s: start `{command}` in another terminal;"
                " a longer --wait waits longer, --wait 0 sends at once"
            )
        if waited_s > next_s:
            echo(f"nobody listens yet after {next_s:g} s; `live` compiles first")
            next_s += REMIND_S
        if ended.wait(0.05):
            return


def unheard_lines(publishers: dict[str, Publisher]) -> list[str]:
    """Line with the topics without a subscriber, but for static frames, whose subscribers zenoh does not report."""
    # static frames are latched, so their listeners come and go
    unheard = [
        topic
        for topic, one in publishers.items()
        if not one.is_heard and not topic.endswith("_static")
    ]
    return [f"nobody listens to {', '.join(unheard)}"] if unheard else []


def topics_of(log: Path) -> dict[str, str]:
    """Types of the topics of a log that ROS 2 messages are on, by name."""
    from sonar_graph.logs.mcap import Keep, scan

    # names and types alone: the messages are read while they are sent
    recording = scan(log, lambda _: Keep.NONE)
    return {
        name: topic.type_name
        for name, topic in recording.topics.items()
        if topic.encoding == "cdr"
    }
