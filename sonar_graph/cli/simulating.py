"""``sonar-graph simulate``: worlds with known truth."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from sonar_graph.cli.arguments import OutputLog
from sonar_graph.cli.outputs import writable_log
from sonar_graph.cli.progress import working
from sonar_graph.cli.settings import parse_setting
from sonar_graph.cli.texts import examples

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from sonar_graph.simulation.basin import BasinOptions

worlds = typer.Typer(
    name="simulate",
    help="Simulate a run with known truth and write it as an MCAP log.",
    epilog=examples(
        "sonar-graph simulate basin -o basin.mcap",
        "sonar-graph simulate basin -o short.mcap --duration-s 300 --laps 1",
    ),
)


@worlds.command(
    epilog=examples(
        "sonar-graph simulate basin -o basin.mcap",
        "sonar-graph simulate basin -o short.mcap --duration-s 300 --laps 1 --seed 7",
        "sonar-graph simulate basin -o hard.mcap --imu mti1 --dvl explorer --set wrong_id_rate=0.05",
    )
)
def basin(
    output: OutputLog,
    seed: Annotated[int | None, typer.Option(min=0, help="Same seed, same log. Default: 0.")] = None,
    duration_s: Annotated[float | None, typer.Option(help="Length of the run in seconds. Default: 2039.")] = None,
    laps: Annotated[int | None, typer.Option(min=1, help="Times round the landmarks. Default: 3.")] = None,
    imu: Annotated[str | None, typer.Option(help="Preset of the inertial sensor: hg1700 (default) or mti1.")] = None,
    dvl: Annotated[str | None, typer.Option(help="Preset of the Doppler log: workhorse (default) or explorer.")] = None,
    no_bias: Annotated[bool, typer.Option("--no-bias", help="Gyros without bias.")] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any other option of the basin; may be repeated."),
    ] = None,
) -> None:
    """A vehicle drives round four landmarks in a basin, with IMU, DVL, depth and landmark detections."""
    from sonar_graph.logs.writing import write_sequence
    from sonar_graph.simulation.basin import simulate_basin

    flags = {"seed": seed, "duration_s": duration_s, "laps": laps, "imu": imu, "dvl": dvl}
    values = {name: value for name, value in flags.items() if value is not None}
    if no_bias:
        values["gyro_bias_scale"] = 0.0
    options = _basin_options(values | dict(map(parse_setting, settings or [])))
    path = writable_log(output)
    with working("simulating"):
        write_sequence(path, simulate_basin(options))
    typer.echo(f"Log: {path}")


def _basin_options(values: dict[str, Any]) -> BasinOptions:
    from pydantic import ValidationError

    from sonar_graph.simulation.basin import BasinOptions

    try:
        return BasinOptions.model_validate(values)
    except ValidationError as error:
        faults = "; ".join(map(_fault, error.errors()))
        raise typer.BadParameter(f"{faults}. The basin has: {', '.join(BasinOptions.model_fields)}") from error


def _fault(error: ErrorDetails) -> str:
    name = ".".join(map(str, error["loc"]))
    if error["type"] == "extra_forbidden":
        return f"there is no option {name}"
    return f"{name}: {error['msg']}, not {error['input']!r}"
