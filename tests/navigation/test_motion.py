"""Steps of two sensors and motion over them, against GTSAM's exponentials, a dense recursion and noisy runs.

Then the laws of every way to a motion: over steps and over gaps.
"""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonar_graph.calibration import (
    Calibration,
    DvlCalibration,
    ImuCalibration,
    Mounting,
)
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation import Odometry

from . import ways
from .rows import (
    T0_NS,
    dead_reckoned,
    dense_covariance,
    dvl,
    imu,
    stamps,
    steps_of,
    waves,
)
from .ways import (
    WAYS,
    Way,
    attitude,
    change_of,
    moved_by,
    rows,
    spoilt,
)

every_way = pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)

LEVER = np.array([-0.2, 0.1, -0.15])
BIAS = np.array([0.01, -0.02, 0.03])
GYRO_DENSITY = 3e-3
seeds = st.integers(0, 2**32 - 1)


def same_pose(a: gtsam.Pose3, b: gtsam.Pose3) -> bool:
    return bool(np.abs(gtsam.Pose3.Logmap(a.between(b))).max() < 1e-10)


def sensors(interpolation: str = "linear", **options) -> Calibration:
    """Bold enough for any velocity, with a lever arm."""
    imu = ImuCalibration(gyro_noise_density=GYRO_DENSITY, **options)
    dvl = DvlCalibration(
        velocity_walk_density=10.0, mounting=Mounting(translation_m=tuple(LEVER))
    )
    return Calibration(imu=imu, dvl=dvl, odometry_interpolation=interpolation)


def brisk(seed: int) -> tuple[Imu, Dvl]:
    """Stamps in no relation, each sample with its own covariance, none before the first velocity."""
    rng = np.random.default_rng(seed)
    quick = stamps(40, 2.5) + rng.integers(-5_000_000, 5_000_000, 101)
    slow = (
        T0_NS + np.sort(rng.choice(np.arange(20, 2300), 9, replace=False)) * 1_000_000
    )
    root = 0.01 * rng.standard_normal((9, 3, 3))
    force = np.array([0.3, -0.2, 9.8]) + waves(quick, seed + 1, 1.0)
    velocity = np.array([0.5, 0.1, 0.0]) + waves(slow, seed + 2, 0.3)
    return imu(quick, waves(quick, seed, 0.8), force), dvl(
        slow, velocity, root @ np.swapaxes(root, 1, 2)
    )


@pytest.mark.parametrize("interpolation", ["linear", "hold-past"])
@given(seeds, st.lists(st.integers(0, 2400), min_size=3, max_size=3).map(sorted))
@settings(max_examples=15)
def test_motions_are_dead_reckoning_and_a_dense_recursion(interpolation, seed, ends_ms):
    """From the first velocity on, and from any instant to another by what is known at a third; one by one alike."""
    inertial, log = brisk(seed % 2**31)
    gapless = {"gap_s": 10.0}
    calibration = sensors(interpolation)
    odometry = Odometry(
        calibration.model_copy(
            update={"dvl": calibration.dvl.model_copy(update=gapless)}
        )
    )
    odometry.add(inertial, log)
    first_ns = int(log.stamps_ns[0])
    start, end, known = (max(T0_NS + ms * 1_000_000, first_ns) for ms in ends_ms)
    known = max(known, odometry.reached_ns(first_ns))
    intervals = np.array(
        [
            (first_ns, int(log.stamps_ns[-1]), int(inertial.stamps_ns[-1])),
            (start, end, known),
        ]
    )
    found = odometry.motions(*intervals.T.copy(), BIAS)
    for e, (begin_ns, end_ns, known_ns) in enumerate(intervals.tolist()):
        steps = steps_of(
            inertial, log, begin_ns, end_ns, known_ns, interpolation == "hold-past"
        )
        expected, D = dense_covariance(steps, BIAS, LEVER, GYRO_DENSITY)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected))).max() + 1e-30
        poses = dead_reckoned(steps, BIAS, LEVER)
        turned = [
            p.rotation().matrix() @ exp_mean(dt * (w - BIAS)) @ f * dt
            for p, dt, w, f in zip(
                poses, steps.duration_s, steps.rate, steps.force, strict=False
            )
        ]
        assert same_pose(gtsam.Pose3(gtsam.Rot3(found.dR[e]), found.dp[e]), poses[-1])
        assert np.abs((found.C[e] - expected) / scale).max() < 1e-3
        assert np.array_equal(found.C[e], found.C[e].T)
        assert found.D[e] == pytest.approx(D, abs=1e-3 * np.abs(D).max() + 1e-15)
        assert found.impulse[e] == pytest.approx(
            np.sum(turned, axis=0) if turned else np.zeros(3), abs=1e-9
        )
        one = odometry.motion(begin_ns, end_ns, BIAS, None, known_ns)
        assert same_pose(one.i_T_j, poses[-1])
        assert np.allclose(one.covariance, found.C[e], rtol=0, atol=1e-9 * scale)
        assert np.allclose(one.D_bias, found.D[e], rtol=0, atol=1e-12)


def exp_mean(phi: np.ndarray) -> np.ndarray:
    """Mean of Exp(s phi) over s in [0, 1], by quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(10)
    return sum(
        w / 2 * gtsam.Rot3.Expmap((1 + s) / 2 * phi).matrix()
        for s, w in zip(nodes, weights, strict=True)
    )


@every_way
def test_the_bias_derivative_and_correction_are_those_of_integrating_again(way):
    """To first order; uncorrected, or corrected with the opposite sign, the motion is far off."""
    imu, dvl = rows()
    base = moved_by(way, imu, dvl)
    step = 1e-6
    change = np.array([4e-4, -3e-4, 5e-4])
    J = [
        change_of(base, moved_by(way, *spoilt(imu, dvl, "rate", -step * axis))) / step
        for axis in np.eye(3)
    ]
    assert base.D_bias == pytest.approx(
        np.transpose(J), rel=1e-3, abs=max(0.02, 1e-3 * np.abs(J).max())
    )
    again = moved_by(way, imu, dvl, change).i_T_j
    poses = (base.corrected(change), base.i_T_j, base.corrected(-change))
    corrected, uncorrected, opposite = (
        np.abs(gtsam.Pose3.Logmap(pose.between(again))).max() for pose in poses
    )
    assert corrected < 0.01 * uncorrected < 0.006 * opposite
    assert same_pose(base.corrected(base.bias), base.i_T_j)


@every_way
def test_earths_rotation_is_removed_as_if_it_stood_still(way):
    """Exaggerated twentyfold, and known in the frame of the first node."""
    imu, dvl = rows()
    world_earth = np.array([0.0, 1e-3, 8e-4])
    felt = spoilt(
        imu,
        dvl,
        "rate",
        attitude((imu.stamps_ns - T0_NS) * 1e-9).inv().apply(world_earth),
    )
    earth = attitude(np.array([way.start_s])).inv().apply(world_earth)[0]
    still = moved_by(way, imu, dvl)
    found = moved_by(way, *felt, earth=earth)
    left_in = moved_by(way, *felt)
    assert found.i_T_j.equals(still.i_T_j, 8e-3 if way.until_s == ways.OPEN_S else 2e-3)
    assert found.i_T_j.rotation().equals(still.i_T_j.rotation(), 4e-4)
    assert not left_in.i_T_j.rotation().equals(still.i_T_j.rotation(), 1e-3)


ONE_PLACE = {"body_p_imu": ways.BODY_P_DVL}
PINGS = {"pings_s": (5.0, 11.0, 12.0)}
ISOTROPIC = {"velocity_sigma_m_s": (0.01, 0.01, 0.01)}


@pytest.mark.parametrize(
    ("way", "column", "sensors", "measured", "tolerance"),
    [
        # IMU and Doppler log in one place: noise of single rates on the lever is left out
        (WAYS["linear"], "rate", ONE_PLACE, {"lever": np.zeros(3)}, 0.03),
        # of few rows, the ends count as if whole: 1 / (2 n) too large
        (WAYS["linear"], "velocity", {}, {}, 0.1),
        (WAYS["held"], "velocity", {}, {}, 0.002),
        (WAYS["closed gap"], "rate", ONE_PLACE, {"lever": np.zeros(3)}, 0.02),
        (WAYS["closed gap"], "force", {}, {}, 0.04),
        (WAYS["open gap"], "force", {}, {"dvl_hz": 10.0}, 0.03),
        (WAYS["open gap"], "velocity", ISOTROPIC, {}, 1e-6),
        (WAYS["open walk"], "velocity", ISOTROPIC, {}, 0.15),
        # with what the ends of a gap share with their neighbours
        (Way(5.0, 12.0), "velocity", {}, {}, 0.02),
        (Way(5.0, 12.0, is_blind=True), "velocity", {}, {}, 0.08),
        (Way(5.0, 12.0), "velocity", {"gap_s": 0.9}, PINGS, 0.02),
    ],
)
def test_noise_spreads_as_noise_of_every_sample_does(
    way, column, sensors, measured, tolerance
):
    """``J Q J^T`` of white noise of every number of a column, J by differences; of pings alone too.

    What gaps that follow each other share counts once; intervals of samples at their ends count as if they went on.
    """
    imu, dvl = rows(**measured)
    sigma, values, noise = {
        "rate": (
            [1e-3 * np.sqrt(ways.IMU_HZ)] * 3,
            imu.angular_velocity,
            {"imu": {"gyro_noise_density": 1e-3}},
        ),
        "force": (
            [1e-2 * np.sqrt(ways.IMU_HZ)] * 3,
            imu.specific_force,
            {"imu": {"accel_noise_density": 1e-2}},
        ),
        "velocity": (
            sensors.get("velocity_sigma_m_s", ways.SIGMA_M_S),
            dvl.velocity,
            {"velocity_sigma_m_s": ways.SIGMA_M_S},
        ),
    }[column]
    known = noise | sensors
    base = moved_by(way, imu, dvl, known=known)
    truth = np.zeros((6, 6))
    step = 1e-5
    for row, axis in np.ndindex(values.shape):
        delta = np.zeros_like(values)
        delta[row, axis] = step
        j = (
            change_of(
                base, moved_by(way, *spoilt(imu, dvl, column, delta), known=known)
            )
            / step
        )
        truth += np.outer(j, j) * sigma[axis] ** 2
    deviation = np.sqrt(np.diag(truth))
    used = deviation > 1e-6
    off = (base.covariance - truth)[np.ix_(used, used)] / np.outer(
        deviation[used], deviation[used]
    )
    assert np.abs(off).max() < tolerance
