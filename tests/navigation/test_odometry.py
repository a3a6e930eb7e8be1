"""Odometry: nodes and steps by stamps alone, running motion, motion between any two instants."""

from itertools import pairwise

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
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import Dvl, Imu
from sonar_graph.navigation import Odometry, PreintegratedMotion
from sonar_graph.navigation.samples import longest_interval_ns

from .rows import NS, T0_NS, at, dvl, imu, stamps, waves
from .ways import (
    DVL,
    NOISY,
    QUIET,
    body_moved,
    doppler,
    inertial,
    with_long_gap,
)

SECONDS = 3.0
ZERO = np.zeros(3)
EARTH = np.array([0.02, -0.03, 0.05])
BIAS = np.array([0.01, -0.02, 0.03])


HELD = Calibration(odometry_interpolation="hold-past")


def recorded(dvl_offset_s: float = 0.013, seconds: float = SECONDS) -> tuple[Imu, Dvl]:
    imu_ns = stamps(50, seconds)
    dvl_ns = stamps(7, seconds - 0.5, dvl_offset_s)
    rng = np.random.default_rng(0)
    cov = 1e-4 * (1 + rng.random((len(dvl_ns), 1, 1))) * np.eye(3)
    return imu(imu_ns, waves(imu_ns, 1, 0.5), waves(imu_ns, 3, 1.0)), dvl(
        dvl_ns, waves(dvl_ns, 2, 0.3), cov
    )


def odometry_of(
    imu_rows: Imu | None, dvl_rows: Dvl | None, calibration: Calibration | None = None
) -> Odometry:
    odometry = Odometry(calibration or Calibration())
    odometry.add(imu_rows, dvl_rows)
    return odometry


def same(one: PreintegratedMotion, other: PreintegratedMotion) -> bool:
    """To the last bit."""
    columns = ("covariance", "D_bias", "bias", "duration_s", "mean_specific_force")
    return one.i_T_j.equals(other.i_T_j, 0.0) and all(
        np.array_equal(getattr(one, c), getattr(other, c), equal_nan=True)
        for c in columns
    )


def assert_same(one: PreintegratedMotion, other: PreintegratedMotion) -> None:
    """But for rounding."""
    assert np.abs(gtsam.Pose3.Logmap(one.i_T_j.between(other.i_T_j))).max() < 1e-12
    scale = np.sqrt(np.outer(np.diag(other.covariance), np.diag(other.covariance)))
    assert np.abs(one.covariance - other.covariance).max() <= 1e-9 * scale.max()
    assert np.allclose(one.D_bias, other.D_bias, rtol=0, atol=1e-12)
    assert one.duration_s == pytest.approx(other.duration_s, abs=1e-12)
    assert np.allclose(
        one.mean_specific_force, other.mean_specific_force, equal_nan=True, atol=1e-12
    )


@given(st.permutations(range(9)))
@settings(max_examples=10)
def test_motion_does_not_depend_on_the_order_of_the_rows(order):
    agile = Calibration(dvl=DvlCalibration(velocity_walk_density=2.0))
    whole = odometry_of(*recorded(), agile)
    pieces = Odometry(agile)
    for k in order:
        pieces.add(
            *(
                block.between(at(0.4 * k - 0.3), at(0.4 * k + 0.1))
                for block in recorded()
            )
        )
    first, *_, last = whole.epochs(0, at(10.0)).tolist()
    assert not pieces.refused
    assert pieces.start_by(last) == whole.start_by(last)
    assert same(pieces.motion(first, last, BIAS), whole.motion(first, last, BIAS))


def test_velocity_at_an_epoch_is_that_of_the_imus_point_of_a_rigid_body():
    """By its row and the rate in between."""
    imu_rows, dvl_rows = recorded()
    arm = np.array([0.5, -0.1, 0.3])
    known = Calibration(imu=ImuCalibration(mounting=Mounting(translation_m=tuple(arm))))
    epoch_ns = int(dvl_rows.stamps_ns[5])
    velocity, variance = odometry_of(imu_rows, dvl_rows, known).velocity_at_imu(
        epoch_ns
    )
    since = (imu_rows.stamps_ns - epoch_ns) * 1e-9
    rate = [np.interp(0.0, since, column) for column in imu_rows.angular_velocity.T]
    assert velocity == pytest.approx(dvl_rows.velocity[5] + np.cross(rate, arm))
    assert variance == pytest.approx(np.trace(dvl_rows.velocity_cov[5]) / 3.0)
    with pytest.raises(MeasurementError, match=rf"epoch_ns: {at(0.25)} is none of the"):
        odometry_of(imu_rows, dvl_rows).velocity_at_imu(at(0.25))


def test_a_node_is_reached_only_when_an_imu_row_covers_it():
    imu_ns = T0_NS + np.array([0, 100, 200])
    dvl_ns = T0_NS + np.array([-50, 0, 50, 150, 250])
    odometry = odometry_of(imu(imu_ns, 0.0), dvl(dvl_ns, 0.0))
    reached = [
        (odometry.epochs(0, T0_NS + until) - T0_NS).tolist()
        for until in (-1, 0, 99, 100, 160, 200, 300)
    ]
    assert reached == [
        [],
        [-50, 0],
        [-50, 0],
        [-50, 0, 50],
        [-50, 0, 50],
        [-50, 0, 50, 150],
        [-50, 0, 50, 150],
    ]
    assert odometry.start_by(T0_NS) == T0_NS
    assert (odometry.epochs(T0_NS + 50, T0_NS + 300) - T0_NS).tolist() == [150]


@pytest.mark.parametrize("calibration", [Calibration(), HELD], ids=["linear", "held"])
def test_forgetting_changes_nothing_afterwards(calibration):
    imu_rows, dvl_rows = recorded(seconds=12.0)
    full, forgetful = (odometry_of(imu_rows, dvl_rows, calibration) for _ in range(2))
    epochs = full.epochs(0, T0_NS + 20 * NS).tolist()
    for k, epoch_ns in enumerate(epochs[1:-1], 1):
        forgetful.forget_before(epoch_ns)
        for until_ns in (epochs[k + 1], epoch_ns + 10_000_000):
            assert same(
                forgetful.motion(epoch_ns, until_ns, BIAS),
                full.motion(epoch_ns, until_ns, BIAS),
            )
        for mine, theirs in zip(
            forgetful.velocity_at_imu(epoch_ns),
            full.velocity_at_imu(epoch_ns),
            strict=True,
        ):
            assert np.array_equal(mine, theirs)
        assert np.array_equal(
            forgetful.epochs(epoch_ns, T0_NS + 20 * NS), epochs[k + 1 :]
        )
    with pytest.raises(MeasurementError, match="lies before the rows"):
        forgetful.motion(epochs[0], epochs[-1], BIAS)


def test_what_bounds_no_motion_is_named():
    odometry = odometry_of(
        imu(stamps(50, 1.35, 0.15), 0.0), dvl(stamps(10, 2.0), [0.5, 0, 0])
    )
    for (start_s, end_s), message in (
        ((1.0, 0.2), "before its start"),
        (
            (0.14, 1.0),
            rf"start_ns: {at(0.14)} lies before the rows; begin at {at(0.15)} or later",
        ),
    ):
        with pytest.raises(MeasurementError, match=message):
            odometry.motion(at(start_s), at(end_s), ZERO)
    with pytest.raises(
        MeasurementError, match="end_ns: expected integer nanoseconds, not "
    ):
        odometry.motion(at(0.2), float(at(1.0)), ZERO)
    for bias, message in (
        (np.zeros(6), r"expected shape \(3,\), not \(6,\)"),
        ([0, np.nan, 0], "expected finite"),
    ):
        with pytest.raises(MeasurementError, match=f"bias: {message}"):
            odometry.motion(at(0.2), at(1.0), bias)
    assert odometry.motion(at(0.15), at(0.15), ZERO).duration_s == 0.0


def test_a_gap_is_longer_than_the_calibration_says():
    """Between nodes that follow each other; held samples leave none."""
    calibration = Calibration(dvl=DvlCalibration(gap_s=0.5))
    assert longest_interval_ns(calibration) == NS // 2
    rows = (
        imu(stamps(10, 5.0), 0.0),
        dvl(T0_NS + np.array([0, 500, 1001, 1501, 4000]) * 1_000_000, 0.0),
    )
    odometry, held = (
        odometry_of(*rows, c)
        for c in (calibration, HELD.model_copy(update={"dvl": calibration.dvl}))
    )
    assert not odometry.is_gap(at(0.0), at(0.5))
    assert odometry.is_gap(at(0.0), at(0.5) + 1)
    assert not held.is_gap(at(0.0), at(1e6))
    ends_s = [
        (0.0, 0.5),
        (0.5, 1.001),
        (1.001, 1.501),
        (1.501, 4.0),
        (0.0, 1.501),
        (1.501, 2.0),
        (1.501, 2.1),
    ]
    starts, ends = (np.array([at(s[k]) for s in ends_s]) for k in (0, 1))
    is_gap = [False, True, False, True, True, False, True]
    for column in odometry.motions(starts, ends, ends, ZERO):
        assert [np.isnan(value).all() for value in column] == is_gap
    assert np.isfinite(held.motions(starts, ends, ends, ZERO).dp).all()


def without(rows, *spans_s: tuple[float, float]):
    """Rows but those within some spans."""
    t = (rows.stamps_ns - T0_NS) * 1e-9
    return rows.rows(
        np.all([(t <= begin) | (t >= end) for begin, end in spans_s], axis=0)
    )


def flickering(rows: Dvl, *spans_s: tuple[float, float]) -> Dvl:
    """Rows; those within some spans measured the vertical velocity alone."""
    whole = np.isin(rows.stamps_ns, without(rows, *spans_s).stamps_ns)[:, None]
    cov = np.where(whole[:, :, None], 1e-4 * np.eye(3), np.diag([1e4, 1e4, 1e-4]))
    return Dvl(
        rows.stamps_ns,
        np.where(whole, rows.velocity, rows.velocity * [0.0, 0.0, 1.0]),
        cov,
    )


SURGING = with_long_gap()
EVERYWHERE = inertial(stamps(50.0, 12.1)), doppler(stamps(5.0, 12.0, 0.003))
UNFELT = Imu(
    EVERYWHERE[0].stamps_ns, EVERYWHERE[0].angular_velocity, np.full((606, 3), np.nan)
)
CUT = {
    "plain": EVERYWHERE,
    "a long gap, whose end is confirmed": SURGING,
    "two short gaps": (EVERYWHERE[0], without(EVERYWHERE[1], (3.1, 5.3), (6.5, 8.9))),
    "gaps without force": (UNFELT, without(EVERYWHERE[1], (3.1, 5.3), (6.5, 8.9))),
    "holes of the IMU": (
        without(EVERYWHERE[0], (2.0, 2.4), (5.0, 7.2)),
        without(EVERYWHERE[1], (6.5, 8.9)),
    ),
    "few beams": (
        EVERYWHERE[0],
        flickering(EVERYWHERE[1], (0.3, 0.7), (2.0, 2.7), (4.0, 6.6), (7.0, 7.3)),
    ),
    "few beams about a gap": (
        SURGING[0],
        flickering(SURGING[1], (4.9, 6.3), (15.0, 17.1)),
    ),
    "fast, so that ten velocities confirm": (
        EVERYWHERE[0],
        Dvl(
            EVERYWHERE[1].stamps_ns,
            EVERYWHERE[1].velocity + np.array([5.0, 0, 0]),
            EVERYWHERE[1].velocity_cov,
        ),
    ),
}
INSTANTS_MS = st.integers(0, 20_200) | st.integers(0, 100).map(
    lambda ping: 200 * ping + 3
)
"""Any, and those of the Doppler log, which no IMU row shares."""


def answers(odometry: Odometry, until_ns: int, asked_ns: int) -> list[np.ndarray]:
    """The answers at an instant: epochs, and motions from the first and others, to epochs and another instant."""
    if (first_ns := odometry.start_by(until_ns)) is None:
        return []
    epochs_ns, reached_ns = odometry.epochs_reached(first_ns - 1, until_ns)
    newest_ns = epochs_ns[-1]
    middle_ns = epochs_ns[len(epochs_ns) // 2]
    asked_ns = min(max(asked_ns, reached_ns[0]), until_ns)
    starts_ns = first_ns, middle_ns, (newest_ns + until_ns) // 2
    found = [odometry.motion(first_ns, asked_ns, BIAS, np.eye(3), asked_ns)]
    found += [
        odometry.motion(start_ns, until_ns, BIAS, np.eye(3)) for start_ns in starts_ns
    ]
    found += [
        odometry.motion(start_ns, newest_ns, BIAS, np.eye(3), until_ns)
        for start_ns in (middle_ns, first_ns)
    ]
    parts = [
        (
            m.i_T_j.matrix(),
            m.covariance,
            m.D_bias,
            m.mean_specific_force,
            [m.duration_s],
        )
        for m in found
    ]
    many = odometry.motions(
        np.append(epochs_ns[:-1], newest_ns),
        np.append(epochs_ns[1:], until_ns),
        np.append(reached_ns[1:], until_ns),
        BIAS,
    )
    return [epochs_ns, reached_ns, *map(np.asarray, sum(parts, ())), *many]


@pytest.mark.parametrize("rows", CUT.values(), ids=CUT.keys())
@given(
    st.lists(st.tuples(INSTANTS_MS, INSTANTS_MS, st.booleans()), min_size=1, max_size=8)
)
@settings(max_examples=10)
def test_how_rows_are_cut_and_what_is_asked_in_between_change_no_bit(rows, calls):
    """Also what comes in long before it is requested, and what is kept of another request.

    So nothing is used that is stamped after what was asked for.
    """
    calibration = Calibration(imu=NOISY, dvl=DVL)
    pieces = Odometry(calibration)
    after_ns = 0
    pieces._earth = EARTH
    for until_ms, asked_ms, is_asked in sorted(calls):
        until_ns = T0_NS + until_ms * 1_000_000
        asked_ns = T0_NS + asked_ms * 1_000_000
        pieces.add(*(block.between(after_ns, until_ns) for block in rows))
        after_ns = until_ns
        if is_asked:
            whole = odometry_of(*rows, calibration)
            whole._earth = EARTH
            told = answers(pieces, until_ns, asked_ns)
            known = answers(whole, until_ns, asked_ns)
            assert len(told) == len(known)
            for one, other in zip(told, known, strict=True):
                assert np.array_equal(one, other, equal_nan=True)


@given(st.integers(1, 95), st.integers(1, 95))
@settings(max_examples=15)
def test_a_chain_is_the_motion_of_the_whole_wherever_it_is_cut(cut, other_cut):
    """At any inertial rows, with what is known at the end: mean, covariance, bias derivative and mean force."""
    odometry = odometry_of(*recorded(dvl_offset_s=0.0))
    odometry._earth = EARTH
    until_ns = T0_NS + 2 * NS
    known_ns = until_ns + NS // 10
    cuts = [
        T0_NS,
        *sorted({T0_NS + cut * 20_000_000, T0_NS + other_cut * 20_000_000}),
        until_ns,
    ]
    chained = first = odometry.motion(cuts[0], cuts[1], BIAS, np.eye(3), known_ns)
    for a, b in pairwise(cuts[1:]):
        last = odometry.motion(a, b, BIAS, chained.i_T_j.rotation().matrix(), known_ns)
        chained = chained.then(last)
    assert_same(chained, odometry.motion(T0_NS, until_ns, BIAS, np.eye(3), known_ns))
    assert (
        np.abs(gtsam.Pose3.Logmap(chained.i_T_j.between(last.then(first).i_T_j))).max()
        > 1e-6
    )


@pytest.mark.parametrize(
    ("start_s", "end_s"),
    [
        (1.03, 1.17),
        (5.93, 8.31),
        (6.0, 16.0),
        (8.07, 8.36),
        (13.0, 15.9),
        (5.03, 16.53),
    ],
)
def test_motion_is_that_of_the_vehicle_before_in_over_and_after_a_gap(start_s, end_s):
    turn, step = body_moved(start_s, end_s)
    odometry = odometry_of(*with_long_gap(), Calibration(imu=QUIET, dvl=DVL))
    found = odometry.motion(at(start_s), at(end_s), ZERO)
    assert found.i_T_j.translation() == pytest.approx(step, abs=0.02)
    assert found.i_T_j.rotation().equals(gtsam.Rot3(turn.as_matrix()), 1e-4)
    assert found.duration_s == pytest.approx(end_s - start_s)
