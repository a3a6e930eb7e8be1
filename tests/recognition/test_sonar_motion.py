from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from sonar_graph.calibration import (
    Calibration,
    DepthCalibration,
    DvlCalibration,
    FloorPrior,
    ImuCalibration,
    Mounting,
    SonarCalibration,
    Start,
)
from sonar_graph.measurements import Depth, Dvl, Floats, Imu
from sonar_graph.recognition.sonar_motion import SonarMotions
from sonar_graph.sequence import Sequence
from sonar_graph.simulation.sensors import (
    dvl_readings,
    imu_readings,
    regular_stamps,
    seconds_since_start,
)
from sonar_graph.simulation.vehicle import VehiclePath, rpy_from_rotation, smooth_noise
from sonar_graph.sonar import FloorView, SonarStep

FLOOR_Z_M = -1.7
MOUNTED = Calibration(
    imu=ImuCalibration(
        gyro_bias_sigma=0.0,
        mounting=Mounting(translation_m=(0.1, 0.05, 0.0), rpy_rad=(0.0, 0.0, 0.3)),
    ),
    dvl=DvlCalibration(
        mounting=Mounting(translation_m=(-0.2, 0.0, -0.15), rpy_rad=(0.0, 0.0, 0.7))
    ),
    depth=DepthCalibration(sigma_m=0.01, port_m=(0.3, 0.05, 0.1)),
    sonar=SonarCalibration(
        mounting=Mounting(
            translation_m=(0.4, 0.1, -0.05), rpy_rad=(0.1, np.radians(30), 0.2)
        )
    ),
    floor=FloorPrior(z_m=FLOOR_Z_M, sigma_m=0.01),
)


BODY_T_SONAR = MOUNTED.sonar.mounting.pose()


def exact_run(path: VehiclePath, calibration: Calibration = MOUNTED) -> Sequence:
    """Sensors without any noise, and a start that is true."""
    stamps = [regular_stamps(hz, path.duration_s) for hz in (100.0, 20.0, 10.0)]
    imu, dvl, depth = (path.at(seconds_since_start(ns)) for ns in stamps)
    imu_ns, dvl_ns, depth_ns = stamps
    start = Start(
        position_m=tuple(imu.position[0].tolist()),
        rpy_rad=tuple(rpy_from_rotation(imu.world_R_body[:1])[0].tolist()),
    )
    port = depth.position + depth.world_R_body.apply(calibration.depth.port_m)
    velocity_cov = np.tile(np.eye(3) * 1e-6, (len(dvl_ns), 1, 1))
    return Sequence(
        "exact",
        calibration.model_copy(update={"start": start}),
        imu=Imu(imu_ns, *imu_readings(imu, calibration.imu.mounting, 9.80665)),
        dvl=Dvl(dvl_ns, dvl_readings(dvl, calibration.dvl.mounting), velocity_cov),
        depth=Depth(depth_ns, port[:, 2], np.full(len(depth_ns), np.nan)),
    )


SECONDS = np.linspace(0, 20, 41)


SWAY = smooth_noise(
    SECONDS,
    np.array([0.6, 0.6, 0.2, 0.1, 0.1, 0.6]),
    4.0,
    6,
    np.random.default_rng(4),
)


PATH = VehiclePath.through(SECONDS, np.add(SWAY, [0, 0, -0.7, 0, 0, 0]))
"""It wanders by decimetres and sways by degrees."""


EXACT = exact_run(PATH)


def sonar_poses(stamps_ns: list[int]) -> list[gtsam.Pose3]:
    """world_T_sonar by the simulator's truth."""
    motion = PATH.at(seconds_since_start(np.array(stamps_ns)))
    bodies = zip(motion.world_R_body.as_matrix(), motion.position, strict=True)
    return [gtsam.Pose3(gtsam.Rot3(R), t) * BODY_T_SONAR for R, t in bodies]


def frames_of(count: int = 40) -> list[int]:
    """Between the stamps of all sensors."""
    return (EXACT.start_ns + 37_100_000 + 230_000_000 * np.arange(count)).tolist()


def along(
    sequence: Sequence, stamps_ns: list[int]
) -> tuple[tuple[SonarStep | None, ...], tuple[FloorView, ...]]:
    motions = SonarMotions(sequence)
    return tuple(zip(*map(motions.at, stamps_ns), strict=True))


def views_after(sequence: Sequence, *seconds: float) -> tuple[FloorView, ...]:
    """Views of the floor at these times since the start."""
    return along(sequence, [sequence.start_ns + round(s * 1e9) for s in seconds])[1]


def test_motion_tilt_and_height_are_those_of_the_simulators_truth():
    poses = sonar_poses(frames_of())
    (first, *steps), (_, *views) = along(EXACT, frames_of())
    assert first is None
    joined = gtsam.Pose3()
    for (before, here), step, found in zip(pairwise(poses), steps, views, strict=True):
        off = before.between(here).localCoordinates(step.previous_T_sonar)
        assert np.abs(off).max() < 1e-3
        view = FloorView.from_pose(here, FLOOR_Z_M)
        np.testing.assert_allclose(found.level_R_sonar, view.level_R_sonar, atol=2e-3)
        assert found.height_m == pytest.approx(view.height_m, abs=5e-3)
        joined = joined * step.previous_T_sonar
    moved = poses[0].between(poses[-1]).translation()
    np.testing.assert_allclose(joined.translation(), moved, atol=5e-3)
    assert np.linalg.norm(moved) > 0.1


def numbers(sequence: Sequence, stamps_ns: list[int]) -> Floats:
    """All results of each frame but the motion of the first, one row a frame."""
    steps, views = along(sequence, stamps_ns)
    moved = [
        np.append(s.previous_T_sonar.matrix(), s.covariance) if s else np.zeros(52)
        for s in steps
    ]
    seen = [
        [*v.level_R_sonar.ravel(), v.height_m, v.height_sigma_m, v.tilt_sigma_rad]
        for v in views
    ]
    return np.hstack([moved, seen])


MEASURED = {
    "imu": ("angular_velocity", "specific_force"),
    "dvl": ("velocity", "velocity_cov"),
    "depth": ("z_m",),
}


def test_nothing_stamped_after_a_frame_influences_it():
    """Also of one that falls on a Doppler stamp, between rows of the IMU."""
    imu = replace(EXACT.imu, stamps_ns=EXACT.imu.stamps_ns + 3_000_000)
    run = replace(EXACT, imu=imu)
    stamps_ns = [*frames_of(12), *run.dvl.stamps_ns[60:63].tolist()]
    expected = numbers(run, stamps_ns)
    for k in (0, 5, 12, 14):
        changed = {}
        for role, names in MEASURED.items():
            rows = getattr(run, role)
            off = 3.0 * (rows.stamps_ns > stamps_ns[k])
            columns = {name: (getattr(rows, name).T + off).T for name in names}
            changed[role] = replace(rows, **columns)
        spoiled = numbers(replace(run, **changed), stamps_ns)
        np.testing.assert_array_equal(spoiled[: k + 1], expected[: k + 1])
        assert k == 14 or np.abs(spoiled - expected)[-1].max() > 0.1


def at_rest(
    rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0), **calibration: object
) -> Sequence:
    """A vehicle that does not move."""
    poses = np.tile([1.0, 2.0, -0.7, *rpy_rad], (41, 1))
    known = MOUNTED.model_copy(update=calibration)
    return exact_run(VehiclePath.through(SECONDS, poses), known)


def with_start(run: Sequence, **changes: object) -> Sequence:
    start = run.calibration.start.model_copy(update=changes)
    return replace(run, calibration=run.calibration.model_copy(update={"start": start}))


@pytest.mark.parametrize("is_force_measured", [True, False])
def test_gravity_corrects_a_start_that_is_tilted_wrongly(is_force_measured):
    """Without accelerometers (negative control) the error stays."""
    level = {"rpy_rad": (0.0, 0.0, 1.0), "rpy_sigma_rad": (0.1, 0.1, 0.1)}
    run = with_start(at_rest((0.05, -0.1, 1.0)), **level)
    if not is_force_measured:
        force = np.full_like(run.imu.specific_force, np.nan)
        run = replace(run, imu=replace(run.imu, specific_force=force))
    first, _, last = views_after(run, 0, 2, 10)
    up = BODY_T_SONAR.rotation().unrotate(
        gtsam.Rot3.RzRyRx(0.05, -0.1, 0.0).matrix()[2]
    )
    off = [np.linalg.norm(view.level_R_sonar[2] - up) for view in (first, last)]
    assert off[0] == pytest.approx(np.hypot(0.05, 0.1), rel=0.02)
    assert first.tilt_sigma_rad == pytest.approx(0.1, rel=0.01)
    if is_force_measured:
        assert off[1] < 0.1 * off[0]
        assert last.tilt_sigma_rad < 0.02
    else:
        assert off[1] == pytest.approx(off[0], rel=1e-6)
        assert last.tilt_sigma_rad >= 0.1


def test_tilt_is_as_uncertain_as_gyros_make_it():
    """Between two looks at gravity: white noise and a bias, from the start's variance."""
    noise = {"gyro_bias_sigma": 0.003, "gyro_noise_density": 0.002}
    run = at_rest(imu=MOUNTED.imu.model_copy(update=noise), use_gravity=False)
    (view,) = views_after(with_start(run, rpy_sigma_rad=(0.01, 0.02, 0.5)), 0.8)
    expected = 0.02**2 + 0.002**2 * 0.8 + (0.003 * 0.8) ** 2
    assert view.tilt_sigma_rad**2 == pytest.approx(expected, rel=1e-6)


def test_depth_corrects_a_start_that_is_too_high_by_the_variances_of_both():
    """By hand; a sample may state its own variance."""
    high = {"position_m": (1.0, 2.0, -0.4), "position_sigma_m": (0.1, 0.1, 0.1)}
    run = with_start(at_rest(), **high)
    before, after = views_after(run, 0, 1e-9)
    start_m = -0.4 + BODY_T_SONAR.translation()[2] - FLOOR_Z_M
    assert before.height_m == pytest.approx(start_m, abs=1e-9)
    assert before.height_sigma_m == pytest.approx(np.hypot(0.1, 0.01), rel=1e-6)
    assert after.height_m == before.height_m  # no sample since
    for stated_m2, variance_m2 in ((np.nan, 0.01**2), (1.0, 1.0)):
        stated = np.full(len(run.depth), stated_m2)
        loose = replace(run, depth=replace(run.depth, variance_m2=stated))
        (later,) = views_after(loose, 0.1)
        gain = 0.1**2 / (0.1**2 + variance_m2)
        sigma_m = np.sqrt(0.1**2 * (1 - gain) + 0.01**2)
        assert later.height_m == pytest.approx(start_m - gain * 0.3, abs=1e-4)
        assert later.height_sigma_m == pytest.approx(sigma_m, rel=1e-2)


@pytest.mark.parametrize("every", [1, 12])
def test_height_follows_the_doppler_log_between_depth_samples(every):
    """One sample only; the vehicle climbs by centimetres and sways by degrees, also between two frames."""
    stamps_ns = frames_of(49)[::every]
    _, views = along(replace(EXACT, depth=EXACT.depth.rows(slice(0, 2))), stamps_ns)
    true = [pose.translation()[2] - FLOOR_Z_M for pose in sonar_poses(stamps_ns)]
    assert np.ptp(true) > 0.02
    np.testing.assert_allclose([view.height_m for view in views], true, atol=6e-3)
    assert (np.diff([view.height_sigma_m for view in views[2:]]) > 0).all()


def test_doppler_noise_is_in_height_and_steps_gyro_noise_in_steps():
    """At rest, by hand: 20 samples a second of 1 mm/s, over a second; the gyros' own variance is 300 times that.

    The lever arm from body to sonar turns with the gyros' error.
    """
    gyro = 0.004**2
    doppler = 1e-3**2 / 20
    assert gyro > 300 * doppler
    imu = MOUNTED.imu.model_copy(update={"gyro_noise_density": 0.004})
    run = at_rest(imu=imu, dvl=MOUNTED.dvl.model_copy(update={"mounting": Mounting()}))
    run = replace(run, depth=run.depth.rows(slice(0, 2)))
    (_, step), views = along(run, [run.start_ns + 10**9, run.start_ns + 2 * 10**9])
    before, after = (view.height_sigma_m**2 for view in views)
    assert after - before == pytest.approx(doppler, rel=0.1)
    # a turn of the body turns the sonar and moves it by its lever
    sonar_from_body = BODY_T_SONAR.inverse().AdjointMap()
    expected = sonar_from_body @ np.diag([gyro] * 3 + [doppler] * 3) @ sonar_from_body.T
    atol = 0.03 * np.abs(expected).max()
    np.testing.assert_allclose(step.covariance, expected, atol=atol)
