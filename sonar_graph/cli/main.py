"""The commands: thin layers over the library, one module for each group.

Exit codes: 0 done; 1 a comparison with a failed run or a batch with one (everything is written),
or an inspected log that cannot be used as it is; 2 a mistake of the user, in one line on stderr; 3 an inspected
log with something in doubt; 130 interrupted. Only unforeseen errors end in a traceback.
"""

import contextlib
import logging
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from sonar_graph.cli.arguments import add_commands, examples, printable
from sonar_graph.cli.bench import bench
from sonar_graph.cli.compare import compare, demo, estimators, figures, report, run
from sonar_graph.cli.convert_data import datasets
from sonar_graph.cli.inspect_log import calibration, inspect
from sonar_graph.cli.join import join
from sonar_graph.cli.label import label
from sonar_graph.cli.live import live, play
from sonar_graph.cli.recognise import calibrate, recognise
from sonar_graph.cli.simulate import worlds
from sonar_graph.errors import SonarGraphError
from sonar_graph.files import (
    INTERRUPTED,
    end_at_once,
    noticed_interrupts,
    terminations_as_interrupts,
)
from sonar_graph.version import __version__

MISTAKE = 2
app = typer.Typer(
    name="sonar-graph",
    help="Landmark SLAM for underwater vehicles: estimators compared on the same log.",
    epilog=examples(
        "sonar-graph demo -o demo",
        "sonar-graph inspect dive.mcap",
        "sonar-graph compare dive.mcap -o comparison",
    ),
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(worlds)
app.add_typer(datasets)
COMMANDS: dict[Callable[..., None], list[str]] = {
    inspect: ["dive.mcap", "dive.mcap --toml"],
    calibration: ["--template > vehicle.toml", "--template dive.mcap > vehicle.toml"],
    run: [
        "dive.mcap --estimator isam2 -o out",
        "dive.mcap --estimator ekf-slam -o out --calibration vehicle.toml",
    ],
    compare: [
        "dive.mcap -o comparison",
        "dive.mcap --estimators isam2,dead-reckoning --rate-hz 5 -o comparison",
        "dive.mcap --log-config dive.toml -o comparison",
    ],
    join: [
        "dive.aris dive.mcap -o joined.mcap",
        "dive_sonar.mcap dive.mcap --offset 3600 --search 30 -o joined.mcap",
    ],
    recognise: [
        "dive.mcap -o recognised.mcap",
        "dive.mcap -o recognised.mcap --rule jeffrey",
    ],
    label: ["dive.mcap -o labels.json"],
    calibrate: [
        "dive.mcap -o model.json",
        "dive.mcap --labels labels.json -o model.json",
    ],
    live: ["-o dive", "-o dive --calibration vehicle.toml --foxglove 8765"],
    play: ["dive.mcap", "dive.mcap --rate 3"],
    bench: [
        "suite.toml -o results",
        "suite.toml -o results --workers 2",
        "suite.toml -o results --scheduler tcp://10.0.0.5:8786",
    ],
    report: ["comparison"],
    figures: ["comparison", "comparison -o paper"],
    estimators: [""],
    demo: ["-o demo"],
}
add_commands(app, "sonar-graph", COMMANDS)


def show_version(wanted: bool) -> None:
    """Print the version and end, before anything else is looked at."""
    if wanted:
        typer.echo(f"sonar-graph {__version__}")
        raise typer.Exit


@app.callback()
def of_all_commands(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=show_version,
            is_eager=True,
            help="Show the version and exit.",
        ),
    ] = False,
) -> None:
    """Landmark SLAM for underwater vehicles: estimators compared on the same log."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its code; the entry point of ``sonar-graph``."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    # commands print the notes of a log themselves
    logging.getLogger("sonar_graph.logs").addHandler(logging.NullHandler())
    try:
        with terminations_as_interrupts(), noticed_interrupts() as check:
            try:
                code = _run(given)
            finally:  # compiled code may have made another exception of Ctrl-C, or none
                check()
    except KeyboardInterrupt:
        code = INTERRUPTED
    # a second Ctrl-C at the end must not print a traceback
    if arguments is None:
        signal.signal(signal.SIGINT, end_at_once)
    if code == INTERRUPTED:  # typer turns Ctrl-C into this code without a word
        _complain("interrupted", INTERRUPTED)
    if arguments is None and sys.getprofile() is sys.gettrace() is None:
        with contextlib.suppress(OSError):  # its reader may be gone
            sys.stdout.flush()
        # the ordinary end takes a while, in which a Ctrl-C would have the last word
        os._exit(int(code or 0))
    sys.exit(int(code or 0))


def _run(given: list[str]) -> int | None:
    try:
        return app(given or ["--help"], prog_name="sonar-graph", standalone_mode=False)
    except (SonarGraphError, OSError) as error:
        return _complain(str(error), MISTAKE)
    except Exception as error:
        if not hasattr(error, "format_message"):  # not typer's own: an unforeseen error
            raise
        # the help of a subcommand is more use than that of all
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "sonar-graph"
        return _complain(
            f"{error.format_message().rstrip('.')}; see {command} --help", MISTAKE
        )


def _complain(message: str, code: int) -> int:
    print(printable(f"sonar-graph: {' '.join(message.split())}"), file=sys.stderr)
    return code
