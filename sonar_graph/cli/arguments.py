"""Arguments and options that several commands share, and settings given as texts."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import Field, dataclass, field, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints
from unicodedata import category

import typer
from rich.console import Console, ConsoleOptions
from rich.segment import Segment

from sonar_graph.errors import EstimatorError, LogError

if TYPE_CHECKING:
    from sonar_graph.calibration import Section
    from sonar_graph.logs import PartialCalibration
    from sonar_graph.logs.adapters import LogConfig
    from sonar_graph.logs.mcap import TimeWindow
    from sonar_graph.sequence import Sequence

Model = TypeVar("Model", bound="Section")
# columns of output that does not go to a terminal, so that lines stay whole
FILE_WIDTH = 2000
# metadata of a field: what typer shows of it
SHOWN = "shown"
# default of an option that must be given
REQUIRED = Parameter.empty


def option(meaning: str, default: Any = None, *names: str, **shown: Any) -> Any:
    """An option: the default of a command's parameter, or of a field of a class of options.

    Without names it has that of its field; ``shown``: keywords of typer.
    """
    made = typer.Option(..., *names, help=meaning, **shown)
    return field(default=default, metadata={SHOWN: made})


def argument(meaning: str, metavar: str, default: Any = REQUIRED, **checks: Any) -> Any:
    """An argument of a command, as the default of its parameter; required unless it has a default itself."""
    made = typer.Argument(metavar=metavar, help=meaning, **checks)
    return field(default=default, metadata={SHOWN: made})


def existing_file(meaning: str, metavar: str = "FILE") -> Any:
    """Option for a file that must exist."""
    return option(meaning, metavar=metavar, exists=True, dir_okay=False)


LogPath = Annotated[
    Path,
    typer.Argument(
        metavar="LOG",
        exists=True,
        readable=True,
        help="MCAP log to read: a file, or the folder of a ROS 2 bag.",
    ),
]
OutputLog = Annotated[
    Path, typer.Option("--output", "-o", metavar="OUT.mcap", help="MCAP log to write.")
]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace files of these names even where sonar-graph did not write them.",
    ),
]
OutputFolder = Annotated[
    Path, typer.Option("--output", "-o", metavar="DIR", help="Folder to write to.")
]
RateHz = Annotated[
    float | None,
    typer.Option(
        min=1e-3,
        max=1e3,
        help="How often every estimator is asked for its estimate; at most as often as the IMU measures. "
        "Default: 2, or of the record of a live run as often as then.",
    ),
]
EstimatorSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME.SETTING=VALUE",
        help="Change a setting of an estimator; may be repeated.",
    ),
]
DesignsPath = Annotated[
    Path | None,
    typer.Option(
        metavar="PATH",
        exists=True,
        help="Landmark designs: a TOML file, or a folder of such files. Default: those that ship.",
    ),
]


@dataclass(frozen=True)
class ReadingOptions:
    """Options for reading a log; `with_options` gives them to a command."""

    calibration: Path | None = existing_file(
        "TOML or JSON file, or a log, whose fields go before those of the log's own calibration and mountings."
    )
    map: Path | None = option(
        "Map of known landmarks: a map.toml that a run has written, or a CSV table of a survey. A start that the log "
        "does not state is found in it.",
        metavar="FILE",
        exists=True,
    )
    truth: Path | None = existing_file(
        "True poses in place of the log's: a table `t x y z qx qy qz qw` (TUM), or `t x y z`, in seconds and metres. Keys "
        "of the table truth in --log-config hold for it, unless they are of a topic."
    )
    topics: list[str] | None = option(
        "Topic for a role, where inspect says that several fit or none; may be repeated. "
        "Roles: imu, dvl, depth, heading, positions, detections, truth, true_landmarks, sonar.",
        None,
        "--topic",
        metavar="ROLE=TOPIC",
    )
    log_config: Path | None = existing_file(
        "What the topics of a foreign log are: types, fields, units, axes. `inspect LOG --toml` prints one.",
        "FILE.toml",
    )
    start: str | None = option(
        "Leave out what was recorded before: seconds from the log's beginning (90.5), or a date and time, "
        "in UTC unless it says else (2026-05-01T12:30:00Z).",
        metavar="TIME",
    )
    end: str | None = option(
        "Leave out what was recorded then and later; written like --start.",
        metavar="TIME",
    )
    salvage: bool = option(
        "Read what is whole of a log that is damaged in its middle, "
        "and say what is lost. One that is cut off is always read as far as it goes.",
        False,
    )

    @property
    def choices(self) -> dict[str, str]:
        """Topics by role, from texts such as ``imu=/imu/data``."""
        choices = {}
        # a topic may contain an equals sign, a role may not
        for text in self.topics or []:
            role, _, topic = text.partition("=")
            if not role or not topic:
                raise LogError(
                    f"--topic {text}: expected ROLE=TOPIC such as imu=/imu/data"
                )
            choices[role] = topic
        return choices

    @property
    def config(self) -> LogConfig | None:
        """Description of the log's topics from a TOML file, if one is given."""
        from sonar_graph.logs.adapters import as_log_config

        # without a description the topics are chosen by their types
        return as_log_config(self.log_config, "inspect_log")

    @property
    def given(self) -> PartialCalibration | None:
        """Fields of a calibration from a file, if one is given."""
        from sonar_graph.logs import PartialCalibration

        given = self.calibration
        return None if given is None else PartialCalibration.read(given)

    @property
    def window(self) -> TimeWindow:
        """Part of the log to read."""
        from sonar_graph.logs.mcap import TimeWindow

        return TimeWindow.parse(self.start, self.end)

    @property
    def of_log(self) -> dict[str, Any]:
        """Arguments of `sonar_graph.logs.read_log`."""
        return {
            "calibration": self.given,
            "topics": self.choices,
            "config": self.config,
            "window": self.window,
        }

    @property
    def of_images(self) -> dict[str, Any]:
        """Arguments of the readers of sonar images."""
        return {
            "topic": self.choices.get("sonar"),
            "config": self.config,
            "window": self.window,
            "salvage": self.salvage,
        }

    def read(
        self, log: Path, *, progress: Callable[[int, int], None] | None = None
    ) -> Sequence:
        """Read a log as a sequence."""
        from sonar_graph.logs import read_log
        from sonar_graph.map_file import in_map

        # the map comes last: the start that the log states goes before one that is found in a map
        sequence = read_log(log, **self.of_log, salvage=self.salvage, progress=progress)
        if self.truth is not None:
            from sonar_graph.logs.convert import with_truth

            of_truth = self.config.table("truth") if self.config else {}
            sequence = with_truth(sequence, self.truth, of_truth)
        return in_map(sequence, self.map)


def with_options(
    *left_out: str,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Replace each dataclass among a command's parameters by its fields, which typer turns into options.

    The command does not offer the fields that are left out; they have their defaults. A command from which this has
    left fields out stays as it is when `add_commands` adds it.
    """

    def expand(command: Callable[..., None]) -> Callable[..., None]:
        # annotations are texts because of `from __future__ import annotations`
        hints = get_type_hints(command, include_extras=True)
        groups: dict[str, Any] = {
            name: kind for name, kind in hints.items() if is_dataclass(kind)
        }

        @wraps(command)
        def run(**values: Any) -> None:
            for name, kind in groups.items():
                # fields that the command does not offer keep their defaults
                given = {f.name for f in fields(kind)} & values.keys()
                values[name] = kind(**{key: values.pop(key) for key in given})
            command(**values)

        offered: list[Parameter] = []
        for name, own in signature(command).parameters.items():
            if name not in groups:
                offered.append(_offered(name, hints[name], own.default))
                continue
            kinds = get_type_hints(groups[name], include_extras=True)
            offered += [
                _offered(f.name, kinds[f.name], f)
                for f in fields(groups[name])
                if f.name not in left_out
            ]
        # typer must see the options, and `wraps` has copied the command's own signature
        run.__signature__ = Signature(offered)  # type: ignore[attr-defined]
        run.__annotations__ = {one.name: one.annotation for one in offered}
        return run

    return expand


def _offered(name: str, kind: Any, default: Any) -> Parameter:
    """The parameter that typer sees, of a field of options or of a default that `option` or `argument` made."""
    if isinstance(default, Field):
        if shown := default.metadata.get(SHOWN):
            # else typer would offer the opposite of a flag too
            if kind is bool and not shown.param_decls:
                shown.param_decls = (f"--{name.replace('_', '-')}",)
            kind = Annotated[kind, shown]
        default = default.default
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def parse_settings(texts: list[str]) -> dict[str, Any]:
    """Values by name from texts such as ``laps=2``, read as TOML, or as plain text if they are no TOML."""
    settings: dict[str, Any] = {}
    for text in texts:
        # blanks around the equals sign are common in shells
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not name:
            raise EstimatorError(f"--set {text}: expected name=value")
        parsed: Any = value
        # several lines of TOML could set other names too
        if "\n" not in value:
            # TOML gives numbers, lists and booleans their types
            with suppress(tomllib.TOMLDecodeError):
                parsed = tomllib.loads(f"value = {value}")["value"]
        if name in settings and settings[name] != parsed:
            raise EstimatorError(
                f"--set {text}: {name} is also set to {settings[name]}; give it once"
            )
        # with the final dots `lag` is not taken for a section that holds `lag_s`
        if within := [
            other
            for other in settings
            if f"{other}.".startswith(f"{name}.") != f"{name}.".startswith(f"{other}.")
        ]:
            raise EstimatorError(
                f"--set {text}: {within[0]} is set too, and one is inside the other; give one of them"
            )
        settings[name] = parsed
    return settings


def nested_settings(texts: list[str] | None) -> dict[str, Any]:
    """Settings in sections, from texts such as ``laps=2`` or ``image.noise_db=20``; errors as in `parse_settings`."""
    from sonar_graph.settings import nested

    return nested(parse_settings(texts or []))


def estimator_settings(
    texts: list[str] | None, names: list[str]
) -> dict[str, dict[str, Any]]:
    """Settings by estimator, from texts such as ``isam2.smoother.lag_s=20``; dots go into nested settings."""
    from sonar_graph.estimator import installed_estimators
    from sonar_graph.settings import nested, suggestion

    given = parse_settings(texts or [])
    for path in given:
        # the first part is the estimator, further dots are sections of its settings
        estimator, dot, setting = path.partition(".")
        if dot and estimator not in names:
            hint = suggestion(estimator, names)
            # a setting without the estimator before it is the commonest mistake
            if hint == ";" and estimator not in installed_estimators():
                hint = f"; the estimator's name comes first, such as {names[0]}.{path}"
            raise EstimatorError(
                f"--set {path}: {estimator} is not among the estimators that run: {', '.join(names)}{hint.rstrip(';')}"
            )
        if not dot or not all(setting.split(".")):
            raise EstimatorError(
                f"--set {path}: expected ESTIMATOR.setting=value with one of {', '.join(names)}"
            )
    return nested(given)


def validated(kind: type[Model], values: dict[str, Any], whose: str) -> Model:
    """Settings as their model."""
    from sonar_graph.settings import parse

    return parse(kind, values, f"settings of the {whose}", typer.BadParameter)


def examples(*commands: str) -> str:
    """Commands to copy, for the end of a help page; an empty line keeps each on a line of its own."""
    return "\n\n".join(["Examples:", *commands])


def add_commands(
    app: typer.Typer, start: str, commands: dict[Callable[..., None], list[str]]
) -> None:
    """Add commands in the order of the help, each with what follows its name in examples.

    ``start``: what stands before the name.
    """
    for command, lines in commands.items():
        shown = (f"{start} {command.__name__} {line}".rstrip() for line in lines)
        app.command(epilog=examples(*shown))(with_options()(command))


def printable(text: str) -> str:
    """Text without what a terminal would obey: names in a log may hold escape sequences, which are spelt out."""
    # nearly every text, in a fraction of the time
    if text.isprintable():
        return text
    obeyed = {
        char
        for char in set(text) - {"\n", "\t"}
        if category(char) in ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
    }
    return text.translate({ord(char): f"\\u{ord(char):04x}" for char in obeyed})


def echo(text: str, *, err: bool = False, nl: bool = True) -> None:
    """Print a text that may hold names of a log."""
    typer.echo(printable(text), err=err, nl=nl)


class PlainConsole(Console):
    """Console for texts that may hold names of a log."""

    def render(
        self, renderable: Any, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Pieces of a text, table or anything else, without what a terminal would obey in them."""
        for piece in super().render(renderable, options):
            yield piece if piece.control else piece._replace(text=printable(piece.text))


def answers() -> Console:
    """Console for results on stdout; if that is no terminal, it is `FILE_WIDTH` wide."""
    # numbers and paths keep the colour of the text around them
    console = PlainConsole(highlight=False)
    if not console.is_terminal:
        console.width = FILE_WIDTH
    return console
