"""``sonar-graph simulate``: a basin with known truth, and landmarks on a recorded run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sonar_graph.cli.arguments import (
    REQUIRED,
    OutputLog,
    Overwrite,
    ReadingOptions,
    add_commands,
    echo,
    examples,
    nested_settings,
    option,
    validated,
    with_options,
)
from sonar_graph.cli.outputs import progress_bars, working, writable_log

if TYPE_CHECKING:
    from sonar_graph.logs.mcap import Outgoing
    from sonar_graph.simulation import BasinOptions

Seed = Annotated[
    int | None, typer.Option(min=0, help="Same seed, same log. Default: 0.")
]


@with_options("start", "end", "salvage", "map", "truth")
def landmarks(
    log: Path = option(
        "MCAP log with a reference trajectory.",
        REQUIRED,
        "--on",
        metavar="LOG",
        exists=True,
    ),
    *,
    output: OutputLog,
    reading: ReadingOptions,
    seed: Seed = None,
    settings: list[str] | None = option(
        "Any other option of the landmarks; may be repeated.",
        None,
        "--set",
        metavar="NAME=VALUE",
    ),
    overwrite: Overwrite = False,
) -> None:
    """Landmarks along a recorded run, and the detections of a sonar; IMU and DVL stay as recorded."""
    from sonar_graph.logs import write_log
    from sonar_graph.simulation import LandmarkOptions, add_landmarks
    from sonar_graph.states import counted

    given = ({} if seed is None else {"seed": seed}) | nested_settings(settings)
    options = validated(LandmarkOptions, given, "landmarks")
    path = writable_log(output, log, overwrite=overwrite)
    with working("simulating"):
        # on the true path, so that the recorded sensors keep their own errors
        sequence = add_landmarks(reading.read(log), options)
        write_log(path, sequence)
    detections = sequence.detections
    placed = sequence.true_landmarks
    echo(
        f"{counted(len(placed or ()), 'landmark')}, {counted(len(detections or ()), 'detection')}\nLog: {path}"
    )


# written out, so that help need not import the simulator
_OTHERS = (
    "imu, dvl, gyro_bias_scale, accel_bias_scale, dvl_scale_error, dvl_dropouts_per_hour, dvl_dropout_s, frame_rate_hz, "
    "range_sigma_m, azimuth_sigma_rad, detection_probability, wrong_id_rate, tracks, id_delay_s, wrong_id_share, "
    "anonymous_share, false_detections_per_frame, confident_false_fraction, start_position_sigma_m, "
    "start_rotation_sigma_rad, floor_sigma_m, speed_m_s; and with --images image.NAME: scene, contrast_db, plate_db, "
    "foam_height_m, sediment, fouling, texture_shape, texture_length_m, ripple_height_m, ripple_length_m, noise_db, "
    "strangers, attitude_error_deg, altitude_error_m, sonar, window_m, designs, speckle, side_lobes, cross_talk_db, "
    "measured_lens, floor_db, absorption_db_m, tvg_error_db, joints, shadows, multipath, surface_path_db, "
    "floor_reflection, drop_probability, time_offset_s, sound_speed_error, stones, decoys. "
    "imu: hg1700 (default) or mti1; dvl: workhorse (default) or explorer. image.scene is a preset "
    "of those from contrast_db to altitude_error_m: easy (default), murky, worn or hard. image.designs is a TOML "
    "file of at least four landmarks; the four lowest ids are laid, in their order"
)
worlds = typer.Typer(
    name="simulate",
    help="Simulate a run with known truth and write it as an MCAP log.",
    epilog=examples(
        "sonar-graph simulate basin -o basin.mcap",
        "sonar-graph simulate basin -o images.mcap --images",
        "sonar-graph simulate landmarks --on dive.mcap -o with_landmarks.mcap",
    ),
)


@dataclass(frozen=True)
class BasinChoices:
    """Options of the basin that the command line names; --set gives any other."""

    seed: Seed = None
    duration_s: float | None = option("Length of the run in seconds. Default: 2039.")
    laps: int | None = option("Times round the landmarks. Default: 3.", min=1)
    images: bool = option(
        "Record sonar images, in which landmarks are still to be found, not detections.",
        False,
    )
    settings: list[str] | None = option(
        f"Any other option of the basin; may be repeated: {_OTHERS}.",
        None,
        "--set",
        metavar="NAME=VALUE",
    )
    overwrite: Overwrite = False

    def of_basin(self) -> BasinOptions:
        """Options for the simulator; a setting of --set goes before the option of the same name."""
        from sonar_graph.simulation import BasinOptions

        values: dict[str, Any] = {
            name: getattr(self, name)
            for name in ("seed", "duration_s", "laps")
            if getattr(self, name) is not None
        }
        # a setting may name anything, and goes before the option of its name
        given = nested_settings(self.settings)
        if "image" in given and not self.images:
            raise typer.BadParameter(
                "--set image.NAME=VALUE is for sonar images: give --images too, or leave it out"
            )
        if self.images:
            values["image"] = {}
        return validated(BasinOptions, values | given, "basin")


def basin(
    output: OutputLog,
    options: BasinChoices,
) -> None:
    """A vehicle drives round four landmarks in a basin, with IMU, DVL, depth and landmark detections or images."""
    from sonar_graph.simulation import LANDMARKS_XY_M, designs_laid

    # options are checked before the file
    world = options.of_basin()
    path = writable_log(output, overwrite=options.overwrite)
    write_basin(path, world)
    if world.image is not None:
        placed = zip(designs_laid(world.image), LANDMARKS_XY_M.tolist(), strict=True)
        laid = ", ".join(
            f"{design.id} {design.name} at ({x:g}, {y:g})" for design, (x, y) in placed
        )
        echo(f"Landmarks: {laid}")
    echo(f"Log: {path}")


def write_basin(path: Path, options: BasinOptions) -> None:
    """Write the log of a simulated basin, with images if its options have them."""
    from sonar_graph.logs import sonar_image_messages, write_log
    from sonar_graph.simulation import simulate_basin, simulate_basin_frames
    from sonar_graph.simulation.sonar_image import SONARS, SOUND_SPEED_M_S

    image = options.image
    if image is None:
        with working("simulating"):
            write_log(path, simulate_basin(options))
        return
    total = round(options.duration_s * options.frame_rate_hz)

    def images() -> Iterator[Outgoing]:
        done = 0
        # block by block: a run of images does not fit into memory
        for block in simulate_basin_frames(options):
            yield sonar_image_messages(
                "/sonar/image",
                block.frames,
                frequency_hz=SONARS[image.sonar].frequency_hz,
                sound_speed_m_s=SOUND_SPEED_M_S * (1 + image.sound_speed_error),
            )
            done += len(block.frames)
            report("simulating images", done, total)

    with progress_bars() as report:
        write_log(path, simulate_basin(options), images())


add_commands(
    worlds,
    "sonar-graph simulate",
    {
        landmarks: [
            "--on dive.mcap -o with_landmarks.mcap",
            "--on dive.mcap -o hard.mcap --seed 7 --set wrong_id_rate=0.05",
        ],
        basin: [
            "-o basin.mcap",
            "-o short.mcap --duration-s 300 --laps 1 --seed 7",
            "-o hard.mcap --set imu=mti1 --set dvl=explorer --set wrong_id_rate=0.05",
            "-o images.mcap --images --duration-s 130 --laps 1",
            "-o bare.mcap --images --set image.multipath=false --set image.stones=0",
            "-o hard.mcap --images --set image.scene=hard --set image.contrast_db=-6",
        ],
    },
)
