"""The gate of Doppler velocities by hand, and confirmation of the first velocities and those after a long gap."""

import numpy as np
import pytest
from scipy.stats import chi2

from sonar_graph.calibration import Calibration, DepthCalibration, Start
from sonar_graph.measurements import Depth, Dvl
from sonar_graph.navigation import Odometry
from sonar_graph.navigation.dvl_screening.depth_gate import (
    DEPTH_GATE,
    UNSTATED_M,
    VERTICAL_M_S,
)
from sonar_graph.navigation.dvl_screening.dvl_gate import (
    GATE,
    gate_velocities,
    needed,
)
from sonar_graph.navigation.samples import VelocityRows
from sonar_graph.states import Refusal

from .rows import NS, T0_NS, at, dvl, odometry_at_rest, stamps

WALK = 0.1
COVS = np.array([np.diag([1.0, 2.0, 3.0]) * 1e-4, np.diag([4.0, 5.0, 6.0]) * 1e-4])


def expected(seconds: float, u: list[float], v: list[float]) -> float:
    """The formula of the module: each axis has ``Q_u + Q_v + q t + (w t |u|)^2`` with w t at most 2."""
    turning = min(0.3 * seconds, 2.0) * np.linalg.norm(u)
    variances = np.diag(COVS.sum(axis=0)) + WALK**2 * seconds + turning**2
    return float(np.sum(np.subtract(v, u) ** 2 / variances))


@pytest.mark.parametrize("seconds", [0.1, 1.0, 5.0, 30.0])
def test_the_distance_is_that_of_the_formula(seconds):
    """A true velocity's passes the gate but once in a billion."""
    u = [0.6, -0.2, 0.3]
    v = [0.9, 0.4, -0.2]
    rows = VelocityRows(np.array([0, round(seconds * NS)]), np.array([u, v]), COVS)
    found = gate_velocities(rows, VelocityRows.of([]), WALK, GATE)
    assert found.distance == pytest.approx([0.0, expected(seconds, u, v)])
    assert chi2(3).isf(1e-9) == pytest.approx(GATE, abs=0.05)


HZ = 7.0
WRONG = [5.0, 0.0, 0.0]


def told(rows: Dvl, calls: int = 1) -> Odometry:
    """Odometry that was given the rows in so many blocks."""
    return odometry_at_rest(
        *(rows.rows(block) for block in np.array_split(np.arange(len(rows)), calls))
    )


def start(wrong: dict[int, list[float]], speed=0.3, hz=HZ, seconds=3.0) -> Dvl:
    velocity = np.tile([speed, 0.0, 0.0], (round(hz * seconds) + 1, 1))
    for row, value in wrong.items():
        velocity[row] = value
    return dvl(stamps(hz, seconds), velocity, 1e-4 * np.eye(3))


FASTER = [[5.0, 0.0, 0.0], [-3.0, 1.0, 0.0], [2.0, -2.0, 2.0]]


def refused(odometry: Odometry, rows: Dvl) -> list[int]:
    stamps_ns = rows.stamps_ns.tolist()
    return sorted(
        stamps_ns.index(row.stamp_ns)
        for row in odometry.refused
        if row.reason == Refusal.OUTLIER
    )


@pytest.mark.parametrize(
    "wrong",
    [
        *(
            dict.fromkeys(rows, WRONG)
            for rows in ((), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2))
        ),
        *(dict(enumerate(FASTER)), {0: [1.5, 0.0, 0.0]}, {0: [0.3, 0.0, -1.2]}),
    ],
)
@pytest.mark.parametrize("hz", [HZ, 1.0])
def test_wrong_ones_of_the_first_rows_are_refused_and_no_others(wrong, hz):
    rows = start(wrong, hz=hz, seconds=3.0 if hz > 1 else 12.0)
    odometry = told(rows)
    assert refused(odometry, rows) == sorted(wrong)
    assert np.array_equal(odometry.rows()[4][-5:], rows.velocity[-5:])
    assert np.abs(odometry.rows()[4]).max() == pytest.approx(0.3)


@pytest.mark.parametrize("speed", [0.0, 0.3, 1.0, 2.0, 3.0, 5.0, 10.0])
def test_a_vehicle_that_moves_from_the_start_keeps_its_first_row(speed):
    """Once enough rows agree, and never later than the tenth; its own rows are kept to the bit."""
    rows = start({}, speed)
    enough = needed(rows.velocity[0])
    assert enough <= min(10, 2 + speed**2 / 4)
    assert not len(told(rows.rows(slice(0, enough - 1))).rows()[3])
    columns = told(rows.rows(slice(0, enough))).rows()[3:6]
    for column, own in zip(
        columns, (rows.stamps_ns, rows.velocity, rows.velocity_cov), strict=True
    ):
        assert np.array_equal(column, own[:enough])


def test_the_start_stays_a_node_with_the_first_accepted_velocity():
    """Less surely known: by the walk and what the vehicle may have turned since."""
    rows = start({0: WRONG, 1: WRONG})
    stamps_ns, velocity, cov = told(rows).rows()[3:6]
    assert np.array_equal(stamps_ns, rows.stamps_ns)
    assert np.array_equal(velocity, np.tile([0.3, 0.0, 0.0], (len(rows), 1)))
    t = (rows.stamps_ns[2] - rows.stamps_ns[0]) * 1e-9
    walk = Calibration().dvl.velocity_walk_density
    assert cov[0] == pytest.approx(
        np.eye(3) * (1e-4 + walk**2 * t + (0.3 * t * 0.3) ** 2)
    )
    assert cov[2] == pytest.approx(1e-4 * np.eye(3))


def test_wrong_rows_that_go_on_for_long_are_never_believed():
    """The gate widens from the last row that it believed, and doubt begins there too, however the log is cut."""
    ns = stamps(5.0, 40.0)
    t = (ns - T0_NS) * 1e-9
    wrong = (t > 10.0) & (t < 30.0)
    directions = np.random.default_rng(0).standard_normal((len(ns), 3))
    velocity = np.where(
        wrong[:, None],
        5.0 * directions / np.linalg.norm(directions, axis=1)[:, None],
        [0.5, 0.0, 0.0],
    )
    rows = dvl(ns, velocity, 1e-4 * np.eye(3))
    for calls in (1, 7):
        used = np.isin(ns, told(rows, calls).rows()[3])
        assert not used[wrong].any()
        assert used[~wrong].sum() >= np.count_nonzero(~wrong) - 2


def after_gap(gap_s: float, wrong: dict[int, list[float]]) -> tuple[Dvl, int]:
    """A log with a gap after 10 s, and its first row after that."""
    ns = stamps(HZ, 10.0 + gap_s + 5.0)
    ns = ns[(ns <= at(10.0)) | (ns > at(10.0 + gap_s))]
    first = int(np.argmax(np.diff(ns))) + 1
    velocity = np.tile([0.3, 0.0, 0.0], (len(ns), 1))
    for row, value in wrong.items():
        velocity[first + row] = value
    return dvl(ns, velocity, 1e-4 * np.eye(3)), first


@pytest.mark.parametrize(
    "wrong",
    [{0: WRONG}, {1: WRONG}, {0: WRONG, 1: WRONG, 2: WRONG}, {0: [2.0, 1.0, 0.0]}],
)
@pytest.mark.parametrize("gap_s", [10.0, 60.0])
def test_wrong_rows_after_a_long_gap_are_refused_and_no_others(gap_s, wrong):
    rows, first = after_gap(gap_s, wrong)
    for calls in (1, len(rows)):
        odometry = told(rows, calls)
        assert refused(odometry, rows) == [first + row for row in wrong]
        assert np.abs(odometry.rows()[4]).max() == pytest.approx(0.3)


DEPTHS = Calibration(
    start=Start(position_m=(0.0, 0.0, -5.0)), depth=DepthCalibration(sigma_m=0.1)
)
NOISE_M = np.sqrt(0.1**2 + 0.1**2 + UNSTATED_M**2)


def used(
    seconds: list[float], z_m: list[float], calibration: Calibration = DEPTHS
) -> list[int]:
    """Rows that are used; the others are named, and the same whether they come at once or one by one."""
    unknown = np.full(len(z_m), np.nan)
    rows = Depth(np.array([at(s) for s in seconds]), np.array(z_m), unknown)
    found = []
    whole = Odometry(calibration)
    single = Odometry(calibration)
    for k in range(len(rows)):
        found += [k] * (single.used_depths(rows.rows(slice(k, k + 1))) is not None)
    kept = whole.used_depths(rows)
    assert ([] if kept is None else kept.stamps_ns.tolist()) == rows.stamps_ns[
        found
    ].tolist()
    assert whole.refused == single.refused
    refused_ns = np.delete(rows.stamps_ns, found).tolist()
    assert [(row.sensor, row.stamp_ns, row.reason) for row in whole.refused] == [
        ("depth", stamp_ns, Refusal.OUT_OF_REACH) for stamp_ns in refused_ns
    ]
    assert all(row.distance > DEPTH_GATE for row in whole.refused)
    return found


def test_a_depth_passes_as_far_as_a_vehicle_gets_and_its_noise_goes():
    """``V t`` and the quantile of noise; chi2: once in a billion."""
    assert chi2.sf(DEPTH_GATE, 1) == pytest.approx(1e-9, rel=0.02)
    for seconds in (0.1, 1.0, 2.9):
        edge_m = VERTICAL_M_S * seconds + np.sqrt(DEPTH_GATE) * NOISE_M
        for sign in (1.0, -1.0):
            assert used([0.0, seconds], [-5.0, -5.0 + sign * 0.999 * edge_m]) == [0, 1]
            assert used([0.0, seconds], [-5.0, -5.0 + sign * 1.001 * edge_m]) == [0]


UNSTATED = Calibration(depth=DepthCalibration(sigma_m=0.1))


def test_a_chain_of_wrong_depths_is_overruled_by_a_longer_one():
    seconds = (np.arange(12) * 0.2).tolist()
    assert used(seconds, [-900.0] * 4 + [-5.0] * 8, UNSTATED) == [2, 3, *range(8, 12)]
    for calibration in (DEPTHS, UNSTATED):
        assert used(seconds, [-5.0] * 8 + [-900.0] * 4, calibration) == [*range(8)]
        assert used(seconds, [-5.0, -900.0, -900.0] * 4, calibration) == [0, 3, 6, 9]
    assert used([0.0, 1.0, 2.0, 10.0], [-100.0, -130.0, -130.0, -115.0], UNSTATED) == [
        3
    ]
