"""Motion of the sonar from its images alone: each frame is laid upon the one before.

A frame becomes a picture of the floor in level axes, or of the image's own plane where height and tilt are not known.
Levels over the median of their beam and of their range make the picture, so that gains of beams and spreading, which
move with the sonar, hold nothing back. The planar motion m = (yaw, x, y) between two pictures a, b maximises their
correlation rho (Evangelidis and Psarakis, PAMI 30(10), 2008: ECC, as in OpenCV). Its covariance is that of least
squares on pictures of variance 1 with white noise behind the blur, which is alike over A = 4 pi blur^2 pixels::

    P = A (1 / rho^2 - 1) (J^T J)^-1,    J = db/dm

Roll, pitch and motion up and down are taken to be small; they are given the standard deviations of `UNSEEN_SIGMAS`.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from sonar_graph.calibration import Calibration
from sonar_graph.errors import CalibrationError
from sonar_graph.images import SonarFrames, decibels
from sonar_graph.measurements import NS_PER_S, Floats
from sonar_graph.recognition.sonar_motion import OUT_OF_ORDER
from sonar_graph.sonar import (
    SLANT_PLANE,
    FloorView,
    MadeOfWindow,
    SonarStep,
    with_lens,
)

MotionFrom = Literal["navigation", "images", "fixed"]
PIXELS_AHEAD = 128
BLUR_PIXELS = 2.0
LOWEST_DB = -15.0
HIGHEST_DB = 25.0
"""Limits of a level over its beam and range: single echoes do not outweigh the floor."""
MOST_ROUNDS = 30
LEAST_CHANGE = 1e-4
LEAST_CORRELATION = 0.3
"""Two frames that agree less are of other scenes, or of nothing."""
LONGEST_STEP_NS = 2 * NS_PER_S
"""Longest time between frames that can be laid upon each other."""
FASTEST_RAD_S = math.radians(60.0)
FASTEST_M_S = 2.0
"""A vehicle with an imaging sonar neither turns nor drives faster: such a fit is wrong."""
UNKNOWN_RAD_S = math.radians(10.0)
UNKNOWN_M_S = 0.3
"""Standard deviations of a motion that was not measured, about that of the step before."""
UNSEEN_RAD_S = math.radians(2.0)
UNSEEN_M_S = 0.05
"""Standard deviations of roll and pitch rates, and of the speed up and down."""
Picture = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PlanarStep:
    """Planar motion between two frames in level axes, or in the image's plane."""

    start_ns: int
    end_ns: int
    motion: Floats
    """Yaw (rad) and x, y (m) of the sonar now in the axes of the frame before, shape (3,)."""
    covariance: Floats
    """Shape (3, 3)."""
    is_measured: bool
    """False: the frames could not be laid upon each other, and the step before goes on."""

    @property
    def duration_s(self) -> float:
        """Seconds between the frames."""
        return (self.end_ns - self.start_ns) * 1e-9


class FloorPicture:
    """Raster of the floor, or of the image's plane, for frames of one sonar with some beams and bins."""

    def __init__(self, ranges_m: Floats, azimuths_rad: Floats, view: FloorView) -> None:
        seen = (
            view.floor_points(
                *(grid.ravel() for grid in np.meshgrid(ranges_m, azimuths_rad))
            )
            @ view.level_R_sonar.T
        )
        # a calibration in other units puts the floor out of reach
        if np.isnan(seen).all():
            raise CalibrationError(
                f"the sonar is {view.height_m:.4g} m above the floor and sees nothing of it up to its range of "
                f"{ranges_m.max():.4g} m: check floor.z_m and start.position_m (metres) and sonar.mounting (radians)"
            )
        low = np.nanmin(seen[:, :2], axis=0)
        high = np.nanmax(seen[:, :2], axis=0)
        # as many pixels ahead for every sonar: ECC takes time by the pixel
        self.pixel_m = float(high[0] - low[0]) / PIXELS_AHEAD
        self.corner_m = low
        """Level (x, y) of the first pixel."""
        x, y = (np.arange(a, b, self.pixel_m) for a, b in zip(low, high, strict=True))
        q = np.stack(
            [
                *np.meshgrid(x, y, indexing="ij"),
                np.full((len(x), len(y)), -view.height_m),
            ],
            axis=-1,
        )
        q = q @ view.level_R_sonar
        order = np.argsort(azimuths_rad)
        # place of each pixel of the raster in the image, with fractions, for the lookup of every frame
        azimuth = np.arctan2(q[..., 1], q[..., 0])
        beams = order.astype(float)
        self._beam = np.interp(azimuth, azimuths_rad[order], beams, -1, -1).astype(
            np.float32
        )
        bins = (np.linalg.norm(q, axis=-1) - ranges_m[0]) / (ranges_m[1] - ranges_m[0])
        self._bin = bins.astype(np.float32)
        self.seen = (
            (self._beam >= 0) & (self._bin >= 0) & (self._bin <= len(ranges_m) - 1)
        )
        """Pixels in the image, shape (height, width): x by y."""
        # a blur over pixels that are not seen loses their share: it is put back below
        self._share = np.maximum(
            _blurred(self.seen.astype(np.float32)), np.float32(1e-3)
        )
        rows, columns = np.meshgrid(x, y, indexing="ij")
        self._xy = np.stack([rows, columns])

    def of(self, image_db: Picture) -> Picture:
        """Picture of a frame of levels, shape (beams, bins)."""
        # by range: spreading and absorption; then by beam: the gains of beams
        levels = image_db - np.median(image_db, axis=0, keepdims=True)
        levels = np.clip(
            levels - np.median(levels, axis=1, keepdims=True), LOWEST_DB, HIGHEST_DB
        )
        picture = cv2.remap(
            levels.astype(np.float32), self._bin, self._beam, cv2.INTER_LINEAR
        )
        return np.where(
            self.seen, _blurred(np.where(self.seen, picture, 0)) / self._share, 0
        ).astype(np.float32)

    def motion(
        self, before: Picture, now: Picture, guess: Floats
    ) -> tuple[Floats, Floats] | None:
        """Motion (yaw, x, y) between two pictures and its covariance; None where they do not agree."""
        mask = self.seen.astype(np.uint8)
        ends = (
            cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS,
            MOST_ROUNDS,
            LEAST_CHANGE,
        )
        best = None
        correlation = LEAST_CORRELATION
        # ECC climbs: the motion of the step before, and rest, are near most maxima
        for start in (guess, np.zeros(3)):
            try:
                rho, warp = cv2.findTransformECC(
                    before,
                    now,
                    self._warp(start),
                    cv2.MOTION_EUCLIDEAN,
                    ends,
                    mask,
                    gaussFiltSize=1,
                )
            except (
                cv2.error
            ):  # it did not converge, or there is nothing in the pictures
                continue
            if rho > correlation:
                best = self._motion(np.asarray(warp, float))
                correlation = float(rho)
        if best is None:
            return None
        # inverse of P, with A = 4 pi blur^2
        information = self._information(now) / (
            4 * math.pi * BLUR_PIXELS**2 * (1 / min(correlation, 0.999) ** 2 - 1)
        )
        # a picture that changes along one direction only does not show the motion along the other
        if np.linalg.cond(information) > 1e12:
            return None
        return best, np.asarray(np.linalg.inv(information))

    def _information(self, picture: Picture) -> Floats:
        """Sum of J^T J over the pixels of a picture scaled to variance 1, shape (3, 3)."""
        by_x, by_y = np.gradient(
            picture / max(float(picture[self.seen].std()), 1e-6), self.pixel_m
        )
        # gradients at the rim are those of the rim
        inner = cv2.erode(self.seen.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(
            bool
        )
        x, y = self._xy
        # derivatives by yaw about the sonar, x and y
        J = np.stack([by_y * x - by_x * y, by_x, by_y], axis=-1)[inner]
        return np.asarray(J.T @ J, float)

    def _warp(self, motion: Floats) -> Picture:
        """Pixel (column, row) now from that before, as OpenCV has it, shape (2, 3): the inverse motion."""
        yaw = motion[0]
        place = motion[1:]
        c = math.cos(yaw)
        s = math.sin(yaw)
        # OpenCV maps pixels now to pixels before, columns first
        R = np.array([[c, -s], [s, c]]).T
        shift = (R @ (self.corner_m - place) - self.corner_m) / self.pixel_m
        return np.ascontiguousarray(
            np.column_stack([R[::-1, ::-1], shift[::-1]]), np.float32
        )

    def _motion(self, warp: Floats) -> Floats:
        R = warp[::-1, 1::-1]
        shift = warp[::-1, 2]
        place = self.corner_m - R.T @ (shift * self.pixel_m + self.corner_m)
        return np.array([math.atan2(R[0, 1], R[0, 0]), *place])


def _blurred(picture: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR_PIXELS))


class ImageMotions:
    """Motion from frame to frame by the frames themselves; height and tilt are those of the calibration's start.

    Parameters
    ----------
    calibration
        With a floor and a start that is stated, pictures are of the floor; else of the image's plane.
    is_fixed
        The sonar is at rest, and nothing is measured.
    """

    def __init__(self, calibration: Calibration, *, is_fixed: bool = False) -> None:
        self._calibration = calibration
        self._is_fixed = is_fixed
        self.view: FloorView | None = None
        """Height and tilt, which are taken to stay; None: not stated."""
        if calibration.floor is not None and "start" in calibration.model_fields_set:
            world_T_sonar = calibration.start.pose().compose(
                calibration.sonar.mounting.pose()
            )
            # a start below the floor states no height
            if world_T_sonar.z() > calibration.floor.z_m:
                self.view = FloorView.from_pose(world_T_sonar, calibration.floor.z_m)
        view = self.view or SLANT_PLANE
        self._rasters = MadeOfWindow(partial(FloorPicture, view=view))
        self._before: tuple[int, FloorPicture, Picture] | None = None
        self._last = np.zeros(3)
        """Rates of the step before."""
        self.step: PlanarStep | None = None
        """Motion to the last frame; None for the first and for a sonar at rest."""
        self.measured = self.steps = 0
        """Number of steps that were measured, and of all."""
        self._stamp_ns: int | None = None

    def refusal(self, stamp_ns: int) -> str:
        """Reason not to use a frame: it is from before the last one; empty without."""
        is_late = self._stamp_ns is not None and stamp_ns < self._stamp_ns
        return OUT_OF_ORDER if is_late else ""

    def add(self, frame: SonarFrames) -> PlanarStep | None:
        """Lay a block of one frame upon the frame before."""
        stamp_ns = int(frame.stamps_ns[0])
        self.step = None
        self._stamp_ns = stamp_ns
        if self._is_fixed:
            return None
        frame = with_lens(frame, self._calibration.sonar.lens)
        raster = self._rasters.of(frame)
        picture = raster.of(
            decibels(
                np.ascontiguousarray(frame.intensity[0]), self._calibration.sonar.image
            )
        )
        before = self._before
        self._before = (stamp_ns, raster, picture)
        # a picture of another window lies on another raster
        if before is None or before[1] is not raster or stamp_ns <= before[0]:
            return None
        seconds = (stamp_ns - before[0]) * 1e-9
        found = None
        if stamp_ns - before[0] <= LONGEST_STEP_NS:
            # vehicles are slow to change their velocity: begin at the motion of the step before
            found = raster.motion(before[2], picture, self._last * seconds)
        fastest = seconds * np.array([FASTEST_RAD_S, FASTEST_M_S, FASTEST_M_S])
        is_measured = found is not None and bool((np.abs(found[0]) <= fastest).all())
        if found is not None and is_measured:
            motion, covariance = found
            self._last = motion / seconds
        else:
            # not measured: go on as before, for as long as that is likely, with a large covariance
            motion = self._last * min(seconds, LONGEST_STEP_NS * 1e-9)
            covariance = np.diag(
                np.square(seconds * np.array([UNKNOWN_RAD_S, UNKNOWN_M_S, UNKNOWN_M_S]))
            )
        self.steps = self.steps + 1
        self.measured = self.measured + is_measured
        self.step = PlanarStep(before[0], stamp_ns, motion, covariance, is_measured)
        return self.step

    def at(self, stamp_ns: int) -> tuple[SonarStep | None, FloorView | None]:
        """Motion to the last frame, and view of the floor, if height and tilt are stated."""
        assert stamp_ns == self._stamp_ns
        return (
            SonarStep.none() if self.step is None else self._sonar_step(self.step)
        ), self.view

    def _sonar_step(self, step: PlanarStep) -> SonarStep:
        """Step in the sonar's axes, with what a plane does not show."""
        yaw, x, y = step.motion.tolist()
        # from level axes into those of the sonar, where steps are given
        level_T_sonar = gtsam.Pose3(
            gtsam.Rot3((self.view or SLANT_PLANE).level_R_sonar), np.zeros(3)
        )
        planar = gtsam.Pose3(gtsam.Rot3.Rz(yaw), np.array([x, y, 0.0]))
        turn, place = (step.duration_s * sigma for sigma in (UNSEEN_RAD_S, UNSEEN_M_S))
        covariance = np.diag(np.square([turn, turn, 0.0, 0.0, 0.0, place]))
        now_R_before = planar.rotation().matrix().T
        # yaw is the same; x and y turn into the axes of the frame now
        tangent = np.eye(3)  # translation of the tangent is in the axes now
        tangent[1:, 1:] = now_R_before[:2, :2]
        covariance[2:5, 2:5] = tangent @ step.covariance @ tangent.T
        adjoint = level_T_sonar.inverse().AdjointMap()
        pose = level_T_sonar.inverse().compose(planar).compose(level_T_sonar)
        return SonarStep(pose, adjoint @ covariance @ adjoint.T)

    def notes(self) -> dict[str, str]:
        """What the motion is from, for the notes of a log."""
        if self._is_fixed:
            return {"detections.motion": "none: the sonar is taken to be at rest"}
        return {
            "detections.motion": f"from the images: {self.measured} of {self.steps} steps measured"
        }
