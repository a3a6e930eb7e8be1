"""Reading of AcTags in simulated DIDSON frames by AcTag's detector.

A lap of the simulated basin with four AcTags on its floor instead of landmarks, stones and rough patches beside them.
Frames go through the recogniser of `benchmarks/actag_plugin`, with the true motion between frames.
"""

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.append(str(Path(__file__).resolve().parents[1] / "actag_plugin"))

import cv2
import gtsam
import numpy as np
from actag_plugin import (
    FOAM_DB,
    PLATE_DB,
    AcTagRecogniser,
    AcTagSettings,
    tag_design,
)
from common import conclude, make_parser, note, print_table, refuse

from sonar_graph.calibration import Calibration
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.simulation import BasinOptions, simulate_basin_frames
from sonar_graph.simulation.sonar_image.frames import FrameTruth
from sonar_graph.sonar import SonarStep

TAGS = (1, 2, 3, 4)
FAR_M = 0.1
"""A tag that is decoded farther from where it is counts as wrong."""


def write_designs(folder: Path, settings: AcTagSettings) -> Path:
    """The tags as a user would give them: pictures and a TOML file."""
    entries = []
    for tag in TAGS:
        design = tag_design(settings.family, tag, settings.tag_size_m)
        grey = (design.mask - PLATE_DB) / (FOAM_DB - PLATE_DB) * 255
        cv2.imwrite(str(folder / f"{tag}.png"), grey.astype(np.uint8))
        entries.append(
            f'[[landmark]]\nid = {tag}\nname = "{design.name}"\nsize_m = {design.size_m}\npicture = "{tag}.png"\n'
        )
    file = folder / "tags.toml"
    file.write_text("".join(entries), encoding="utf-8")
    return file


def errors_of(
    found: LandmarkDetections, truth: FrameTruth
) -> list[tuple[float, float] | None]:
    """Errors of range and azimuth of each detection; None where no such tag is."""
    errors: list[tuple[float, float] | None] = []
    for row, tag in enumerate(found.candidate_ids[:, 0].tolist()):
        at = np.flatnonzero(truth.ids == tag)
        off = [
            (
                found.range_m[row] - truth.range_m()[0, a],
                found.azimuth_rad[row] - truth.azimuth_rad()[0, a],
            )
            for a in at
        ]
        errors += [e if np.hypot(e[0], 2 * e[1]) < FAR_M else None for e in off] or [
            None
        ]
    return errors


def pose_of(truth: FrameTruth) -> gtsam.Pose3:
    x, y, z, w = truth.quaternions_xyzw[0]
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), truth.positions[0])


def run(options: BasinOptions, settings: AcTagSettings) -> dict[str, float]:
    recogniser = AcTagRecogniser(Calibration(), settings.model_dump())
    before = None
    errors = []
    in_view = decoded = frames = 0
    spent_s = 0.0
    for block in simulate_basin_frames(options, frames_per_block=1):
        pose = pose_of(block.truth)
        step = (
            None
            if before is None
            else SonarStep(before.between(pose), np.zeros((6, 6)))
        )
        before, frames, start = pose, frames + 1, time.perf_counter()
        found = recogniser.process(block.frames, step).detections
        spent_s += time.perf_counter() - start
        whole = block.truth.ids[
            (block.truth.share_in_view[0] == 1) & (block.truth.ids > 0)
        ]
        in_view += len(whole)
        if found is not None:
            decoded += len(np.intersect1d(whole, found.candidate_ids))
            errors += errors_of(found, block.truth)
    right = np.array([e for e in errors if e is not None]).reshape(-1, 2)
    rms = np.sqrt(np.mean(right**2, axis=0)) if len(right) else np.full(2, np.nan)
    return {
        "frames": frames,
        "tags_in_view": in_view,
        "decoded_share": decoded / max(in_view, 1),
        "reported": len(errors),
        "wrong": errors.count(None),
        "range_rms_m": float(rms[0]),
        "azimuth_rms_deg": float(np.degrees(rms[1])),
        "frame_ms": 1e3 * spent_s / frames,
    }


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--corrections",
        type=int,
        default=AcTagSettings().bit_corrections,
        help="bits put right",
    )
    arguments = parser.parse_args()
    settings = AcTagSettings(bit_corrections=arguments.corrections)
    with tempfile.TemporaryDirectory() as folder:
        try:
            file = write_designs(Path(folder), settings)
        except CalibrationError as error:
            refuse(str(error))
        note(f"one lap past {len(TAGS)} tags")
        values = {
            "duration_s": 130.0,
            "laps": 1,
            "frame_rate_hz": 1.0 if arguments.quick else 5.0,
        }
        figures = run(
            BasinOptions.model_validate(values | {"image": {"designs": str(file)}}),
            settings,
        )
    print_table(["figure", "value"], figures.items())
    conclude({**figures, "passed": figures["wrong"] == 0}, is_quick=arguments.quick)


if __name__ == "__main__":
    main()
