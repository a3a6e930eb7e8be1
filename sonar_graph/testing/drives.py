"""Small sequences with known truth: a left turn past three landmarks, with right or wrong identities, and a rest.

In the turn body velocity and angular rate are constant, so that the truth is a circle in closed form.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sonar_graph.calibration import (
    Calibration,
    ImuCalibration,
    PositionCalibration,
    Start,
)
from sonar_graph.measurements import (
    NS_PER_S,
    Depth,
    Dvl,
    Floats,
    Heading,
    Imu,
    Ints,
    LandmarkDetections,
    PositionFixes,
)
from sonar_graph.sequence import Sequence
from sonar_graph.states import LandmarkMap, Trajectory

START_NS = 1_700_000_000 * NS_PER_S
DURATION_S = 20
STILL_S = 60
SPEED_M_S = 0.3
YAW_RATE_RAD_S = 0.05
HEIGHT_M = -0.5
LANDMARKS_M = {4: (7.0, 3.0), 9: (3.0, 7.0), 11: (5.5, 5.5)}
STILL_START = Start(position_m=(1.0, -2.0, HEIGHT_M), rpy_rad=(0.1, -0.05, 0.7))
IMU_HZ = 50
DVL_HZ = 5
DEPTH_HZ = 5
FRAME_HZ = 2
HEADING_HZ = 5
FIX_HZ = 1
SEED = 20
TRACK_FRAMES = 4
MISNAMED_FRAMES = 8


def small_world(dvl_delay_s: float = 0.0) -> Sequence:
    """Left turn of 20 s with little noise.

    Parameters
    ----------
    dvl_delay_s
        Time by which the DVL begins after the IMU.

    Examples
    --------
    >>> from sonar_graph.testing import small_world
    >>> world = small_world()
    >>> world.duration_s, len(world.imu), len(world.dvl), world.true_landmarks.ids
    (20.0, 1001, 101, array([ 4,  9, 11]))
    """
    noise = np.random.default_rng(SEED)
    begin_ns = START_NS + round(dvl_delay_s * NS_PER_S)
    x, y, z = _circle(np.array([begin_ns])).positions[0].tolist()
    yaw_rad = YAW_RATE_RAD_S * dvl_delay_s
    start = Start(position_m=(x, y, z), rpy_rad=(0.0, 0.0, yaw_rad))
    calibration = Calibration(start=start, imu=ImuCalibration(gyro_bias_sigma=1e-5))
    imu = _turning_imu(calibration, noise)
    dvl_ns = _stamps(dvl_delay_s, DVL_HZ, DURATION_S)
    depth_ns = _stamps(0, DEPTH_HZ, DURATION_S)
    velocity_sigma = np.array(calibration.dvl.velocity_sigma_m_s)
    velocity = velocity_sigma * noise.standard_normal((len(dvl_ns), 3))
    velocity += [SPEED_M_S, 0.0, 0.0]
    z_m = HEIGHT_M + calibration.depth.sigma_m * noise.standard_normal(len(depth_ns))
    return Sequence(
        name="left turn",
        calibration=calibration,
        imu=imu,
        dvl=Dvl(dvl_ns, velocity, _unstated(len(dvl_ns), 3, 3)),
        depth=Depth(depth_ns, z_m, _unstated(len(depth_ns))),
        detections=_detections(calibration, noise),
        truth=_circle(_stamps(0, IMU_HZ, DURATION_S)),
        true_landmarks=_true_landmarks(),
    )


def aided_world() -> Sequence:
    """Left turn with heading and position fixes as well; every second row of these states its noise.

    Examples
    --------
    >>> from sonar_graph.testing import aided_world
    >>> world = aided_world()
    >>> len(world.heading), len(world.positions)
    (101, 21)
    """
    world = small_world()
    noise = np.random.default_rng(SEED)
    gnss = PositionCalibration(sigma_m=(0.5, 0.5, 1.0), antenna_m=(-0.4, 0.2, 0.6))
    # not at the stamps of other sensors
    heading_ns = _stamps(0, HEADING_HZ, DURATION_S) + NS_PER_S // 7
    fixes_ns = _stamps(0, FIX_HZ, DURATION_S)
    sigma_rad = world.calibration.heading.sigma_rad
    white_rad = sigma_rad * noise.standard_normal(len(heading_ns))
    yaw_rad = YAW_RATE_RAD_S * (heading_ns - START_NS) * 1e-9 + white_rad
    sigmas_rad = _unstated(len(heading_ns))
    sigmas_rad[1::2] = sigma_rad
    body = _circle(fixes_ns)
    # fixes are of the antenna, not of the body
    antenna = body.positions + body.rotations().apply(gnss.antenna_m)
    fixes = antenna + gnss.sigma_m * noise.standard_normal((len(fixes_ns), 3))
    covs = _unstated(len(fixes_ns), 3, 3)
    covs[1::2] = np.diag(np.square(gnss.sigma_m))
    return replace(
        world,
        name="left turn with heading and fixes",
        calibration=world.calibration.model_copy(update={"positions": gnss}),
        heading=Heading(heading_ns, yaw_rad, sigmas_rad),
        positions=PositionFixes(fixes_ns, fixes, covs),
    )


def misnamed_world(*, is_tracked: bool = False) -> Sequence:
    """Left turn in which all first identities are wrong, later a fifth of them, and some detections have none.

    Parameters
    ----------
    is_tracked
        Landmarks are seen in tracks of `TRACK_FRAMES` frames, and an identity is wrong for a whole track.

    Examples
    --------
    >>> from sonar_graph.testing import misnamed_world
    >>> named, probability = misnamed_world().detections.most_probable()
    >>> named[:2], int((named < 0).sum())
    (array([ 9, 11]), 6)
    """
    world = small_world()
    noise = np.random.default_rng(SEED)
    rows = world.detections
    assert rows is not None
    frame, place = np.divmod(np.arange(len(rows)), len(LANDMARKS_M))
    # a new track for each landmark every few frames
    track = frame // TRACK_FRAMES * len(LANDMARKS_M) + place
    named = noise.choice(["right", "wrong", "nothing"], len(rows), p=[0.7, 0.2, 0.1])
    if is_tracked:
        named = named[track]
    named[frame < MISNAMED_FRAMES] = "wrong"
    names = np.array(list(LANDMARKS_M), dtype=np.int64)
    # the next landmark: wrong, but one that exists
    wrong = names[(place + 1) % len(names)]
    ids = np.select([named == "wrong", named == "nothing"], [wrong, -1], names[place])
    misnamed = replace(rows, candidate_ids=ids[:, None])
    if is_tracked:
        misnamed = replace(misnamed, track=track)
    return replace(world, detections=misnamed)


def still_world() -> Sequence:
    """Tilted vehicle at rest for 60 s, without noise.

    Examples
    --------
    >>> from sonar_graph.testing import still_world
    >>> world = still_world()
    >>> world.duration_s, world.detections is None
    (60.00000000000001, True)
    """
    calibration = Calibration(start=STILL_START)
    imu_stamps = _stamps(0, IMU_HZ, STILL_S)
    slow_stamps = _stamps(0, DVL_HZ, STILL_S)
    # at rest the accelerometers measure the reaction to gravity, upwards
    body_R_world = Rotation.from_euler("xyz", STILL_START.rpy_rad).inv()
    up_in_body = body_R_world.apply([0.0, 0.0, calibration.gravity_m_s2])
    m = len(imu_stamps)
    n = len(slow_stamps)
    return Sequence(
        name="at rest",
        calibration=calibration,
        imu=Imu(imu_stamps, np.zeros((m, 3)), np.tile(up_in_body, (m, 1))),
        dvl=Dvl(slow_stamps, np.zeros((n, 3)), _unstated(n, 3, 3)),
        depth=Depth(slow_stamps, np.full(n, HEIGHT_M), _unstated(n)),
    )


def _unstated(*shape: int) -> Floats:
    """Uncertainties of rows that state none."""
    return np.full(shape, np.nan)


def every_stamp(sequence: Sequence) -> Ints:
    """Stamps of all measurements after the start until the end, shape (n,)."""
    stamps = [block.stamps_ns for block in sequence.blocks().values()]
    stamps_ns = np.unique(np.concatenate(stamps))
    return stamps_ns[(stamps_ns > sequence.start_ns) & (stamps_ns <= sequence.end_ns)]


def _stamps(first_s: float, rate_hz: int, until_s: int) -> Ints:
    first = round(first_s * rate_hz)
    number = np.arange(first, until_s * rate_hz + 1, dtype=np.int64)
    return START_NS + number * (NS_PER_S // rate_hz)


def _circle(stamps_ns: Ints) -> Trajectory:
    """Truth: x = (v/ω) sin ωt, y = (v/ω)(1 - cos ωt), yaw = ωt."""
    yaw_rad = YAW_RATE_RAD_S * (stamps_ns - START_NS) * 1e-9
    radius_m = SPEED_M_S / YAW_RATE_RAD_S
    x = radius_m * np.sin(yaw_rad)
    y = radius_m * (1 - np.cos(yaw_rad))
    positions = np.column_stack([x, y, np.full(len(x), HEIGHT_M)])
    return Trajectory.without_covariances(
        stamps_ns, positions, Rotation.from_euler("z", yaw_rad[:, None]).as_quat()
    )


def _turning_imu(calibration: Calibration, noise: np.random.Generator) -> Imu:
    """Constant yaw rate; the specific force is centripetal acceleration v ω to the left, and gravity."""
    stamps_ns = _stamps(0, IMU_HZ, DURATION_S)
    shape = (len(stamps_ns), 3)
    # white noise of a density, sampled at this rate
    root_hz = np.sqrt(IMU_HZ)
    # v omega towards the centre of the circle
    force = np.array([0.0, SPEED_M_S * YAW_RATE_RAD_S, calibration.gravity_m_s2])
    rate_sigma = calibration.imu.gyro_noise_density * root_hz
    force_sigma = calibration.imu.accel_noise_density * root_hz
    rates = rate_sigma * noise.standard_normal(shape) + [0.0, 0.0, YAW_RATE_RAD_S]
    return Imu(stamps_ns, rates, force + force_sigma * noise.standard_normal(shape))


def _detections(
    calibration: Calibration, noise: np.random.Generator
) -> LandmarkDetections:
    """Every landmark in every frame that lies between two IMU samples; one in ten is not recognised."""
    # between the stamps of IMU and DVL, so that poses have to be interpolated
    frames_ns = _stamps(0, FRAME_HZ, DURATION_S - 2)[3:] + NS_PER_S // 3
    stamps_ns = np.repeat(frames_ns, len(LANDMARKS_M))
    n = len(stamps_ns)
    there = np.tile(_true_landmarks().positions, (len(frames_ns), 1))
    body = _circle(frames_ns)
    # the sonar sits at the body's origin
    here = np.repeat(body.positions, len(LANDMARKS_M), axis=0)
    facing = np.repeat(body.quaternions_xyzw, 3, axis=0)
    seen: Floats = Rotation.from_quat(facing).inv().apply(there - here)
    sonar = calibration.sonar
    range_m = np.linalg.norm(seen, axis=1)
    range_m += sonar.range_sigma_m * noise.standard_normal(n)
    azimuth_rad = np.arctan2(seen[:, 1], seen[:, 0])
    azimuth_rad += sonar.azimuth_sigma_rad * noise.standard_normal(n)
    ids = np.tile(_true_landmarks().ids, len(frames_ns))[:, None]
    probability = np.where(np.arange(n) % 10 == 9, 0.05, 0.99)[:, None]
    unstated = _unstated(n, 2, 2)
    return LandmarkDetections(
        stamps_ns, range_m, azimuth_rad, unstated, ids, probability
    )


def _true_landmarks() -> LandmarkMap:
    ids = np.array(list(LANDMARKS_M), dtype=np.int64)
    positions = np.array([(x, y, HEIGHT_M) for x, y in LANDMARKS_M.values()])
    return LandmarkMap(ids, positions, _unstated(len(ids), 3, 3))
