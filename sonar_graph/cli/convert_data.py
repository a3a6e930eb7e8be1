"""``sonar-graph convert``: public data sets, ROS bags and recordings of sonars as MCAP logs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sonar_graph.cli.arguments import (
    OutputLog,
    Overwrite,
    add_commands,
    argument,
    echo,
    examples,
    existing_file,
    option,
)
from sonar_graph.cli.outputs import progress_bars, working, writable_log
from sonar_graph.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from sonar_graph.logs.convert import BagConversion, SonarConversion
    from sonar_graph.logs.mcap import Progress
    from sonar_graph.sequence import Sequence


datasets = typer.Typer(
    name="convert",
    help="Convert text tables, a ROS bag, a sonar's recording or a public data set to an MCAP log.",
    epilog=examples(
        "sonar-graph convert dataset mrclam MRCLAM_Dataset6 --number 3 -o mrclam_6_3.mcap",
        "sonar-graph convert csv imu.csv dvl.csv --toml > dive.toml",
        "sonar-graph convert csv imu.csv dvl.csv --config dive.toml -o dive.mcap",
        "sonar-graph convert rosbag dive.bag -o dive.mcap",
        "sonar-graph convert aris dive.aris -o dive_sonar.mcap",
    ),
)
_MOST_LOSSES_SHOWN = 10
# public data sets, and the arguments of their readers
DATASETS = {
    "akit": ("FOLDER", "--number"),
    "dlr": ("FOLDER",),
    "mrclam": ("FOLDER", "--number"),
    "stpere": ("FOLDER",),
    "victoria-park": (),
}


def csv(
    tables: list[Path] = argument(
        "Text files, or a folder that holds them.", "TABLES...", exists=True
    ),
    output: Path | None = option(
        "MCAP log to write.", None, "--output", "-o", metavar="OUT.mcap"
    ),
    config: Path | None = existing_file(
        "Which columns of which tables are what; --toml begins one.", "FILE.toml"
    ),
    toml: bool = option(
        "Print only a guess at FILE.toml, by the names of the columns, to edit.", False
    ),
    overwrite: Overwrite = False,
) -> None:
    """Tables of any vehicle: IMU, Doppler log, depth, heading, fixes, detections, truth; delimiters are found."""
    from sonar_graph.diagnosis import check_sensors
    from sonar_graph.logs.convert import csv_template, read_csv

    if toml:
        echo(csv_template(tables), nl=False)
        return
    # the advice can be copied as it is
    named = " ".join(map(str, tables))
    if config is None:
        raise LogError(
            f"--config is missing; `sonar-graph convert csv {named} --toml > dive.toml` begins one"
        )
    if output is None:
        raise LogError("-o is missing; give the log to write, such as -o dive.mcap")
    # the table is read before the log is written, so that a mistake leaves no log
    sequence = _convert(
        lambda: read_csv(tables, config), [*tables, config], output, overwrite
    )
    for subject, heading in (("csv.left_out", "left out"), ("csv.warnings", "warning")):
        if subject in sequence.notes:
            echo(f"{heading}: {sequence.notes[subject]}", err=True)
    # the log states this start from now on, as if its owner had
    echo(f"start: {sequence.notes['log.start']}", err=True)
    for finding in check_sensors(sequence):
        if finding.quantity.endswith(": unit"):
            echo(
                f"warning: {finding.quantity}: {finding.text()} (or in {config}, and convert again)",
                err=True,
            )
    echo(f"What is in it: sonar-graph inspect {output}")


def dataset(
    name: str = argument("akit, dlr, mrclam, stpere or victoria-park.", "NAME"),
    *,
    output: OutputLog,
    folder: Path | None = argument(
        "Folder of the data set; victoria-park comes with gtsam.",
        "[FOLDER]",
        None,
        exists=True,
    ),
    number: int | None = option(
        "Robot of mrclam (1 to 5), trajectory of akit (from 1 on)."
    ),
    overwrite: Overwrite = False,
) -> None:
    """A public data set: underwater vehicles (akit, stpere), robots indoors (mrclam, dlr), a truck (victoria-park)."""
    from sonar_graph.logs import convert

    if name not in DATASETS:
        raise LogError(
            f"there is no data set {name!r}; there are: {', '.join(DATASETS)}"
        )
    wanted = DATASETS[name]
    given: dict[str, Any] = {"FOLDER": folder, "--number": number}
    # an argument that is not used would look like one that had no effect
    if [key for key, value in given.items() if value is not None] != list(wanted):
        needs = " and ".join(wanted) or "neither FOLDER nor --number"
        raise LogError(f"data set {name}: expected {needs}")
    read = getattr(convert, f"read_{name.replace('-', '_')}")
    arguments = [given[key] for key in wanted]
    _convert(lambda: read(*arguments), [folder], output, overwrite)


def rosbag(
    bag: Path = argument(
        "ROS 1 .bag, folder of a ROS 2 bag, or .mcap of ROS 1 messages.",
        "BAG",
        exists=True,
    ),
    *,
    output: OutputLog,
    definitions: Path | None = option(
        "Holds package/msg/Type.msg of types that the bag does not define.",
        metavar="FOLDER",
        exists=True,
        file_okay=False,
    ),
    overwrite: Overwrite = False,
) -> None:
    """Any ROS 1 bag, or ROS 2 bag of the sqlite3 kind, with all its topics."""
    from sonar_graph.logs.convert import convert_rosbag

    _convert_file(
        partial(convert_rosbag, definitions=definitions), bag, output, overwrite
    )


SonarRecording = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        exists=True,
        dir_okay=False,
        help="Recording as the sonar's software wrote it.",
    ),
]


def didson(
    recording: SonarRecording,
    output: OutputLog,
    sound_speed: float | None = option(
        "Of the water, m/s; default: ranges as the sonar names them (1465 m/s).",
        min=1350,
        max=1650,
    ),
    overwrite: Overwrite = False,
) -> None:
    """Images of a DIDSON (.ddf, versions 3 and 4)."""
    from sonar_graph.logs.convert import convert_didson

    _convert_file(
        partial(convert_didson, sound_speed_m_s=sound_speed),
        recording,
        output,
        overwrite,
    )


def aris(
    recording: SonarRecording, output: OutputLog, overwrite: Overwrite = False
) -> None:
    """Images of an ARIS (.aris)."""
    from sonar_graph.logs.convert import convert_aris

    _convert_file(convert_aris, recording, output, overwrite)


def oculus(
    recording: SonarRecording, output: OutputLog, overwrite: Overwrite = False
) -> None:
    """Images of an Oculus: its network messages, one after another in a file."""
    from sonar_graph.logs.convert import convert_oculus

    _convert_file(convert_oculus, recording, output, overwrite)


def _convert_file(
    convert: Callable[[Path, Path, Progress], BagConversion | SonarConversion],
    source: Path,
    output: Path,
    overwrite: bool,
) -> None:
    # checked first: converting takes minutes
    path = writable_log(output, source, overwrite=overwrite)
    with progress_bars() as progress:
        done = convert(
            source,
            path,
            lambda at, total: progress(f"converting {source.name}", at, total),
        )
    for line in (
        f"{source.name}: {done.content}",
        *done.shortcomings(_MOST_LOSSES_SHOWN),
    ):
        echo(line)
    echo(f"Log: {path}\nWhat is in it: sonar-graph inspect {path}")


def _convert(
    read: Callable[[], Sequence],
    sources: Iterable[Path | None],
    output: Path,
    overwrite: bool,
) -> Sequence:
    from sonar_graph.logs import write_log

    path = writable_log(output, *sources, overwrite=overwrite)
    with working("converting"):
        sequence = read()
        write_log(path, sequence)
    detections = len(sequence.detections) if sequence.detections else 0
    echo(
        f"{sequence.name}: {sequence.duration_s:.1f} s, {detections} landmark detections\nLog: {path}"
    )
    return sequence


add_commands(
    datasets,
    "sonar-graph convert",
    {
        csv: [
            "imu.csv dvl.csv --toml > dive.toml",
            "imu.csv dvl.csv --config dive.toml -o dive.mcap",
            "folder_of_tables --config dive.toml -o dive.mcap",
        ],
        dataset: [
            "mrclam MRCLAM_Dataset6 --number 3 -o mrclam_6_3.mcap",
            "akit A-KIT --number 1 -o akit_1.mcap",
            "stpere StPereDataset -o stpere.mcap",
            "victoria-park -o victoria_park.mcap",
        ],
        rosbag: ["dive.bag -o dive.mcap", "ros2_bag_folder -o dive.mcap"],
        didson: [
            "dive.ddf -o dive_sonar.mcap",
            "dive.ddf --sound-speed 1482 -o dive_sonar.mcap",
        ],
        aris: ["dive.aris -o dive_sonar.mcap"],
        oculus: ["pings.raw -o dive_sonar.mcap"],
    },
)
