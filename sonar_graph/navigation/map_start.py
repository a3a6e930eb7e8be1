"""Start at an unknown place of a known map: where the vehicle is, from the landmarks that it identifies.

The level frame o has its origin at the body's first position, and its yaw is zero there. Odometry carries it on, so that
a sighting of landmark i gives a place ``q_k`` in o; the landmark's height in the map gives the elevation. Errors of
odometry add up, so that two sightings share that of the earlier one: their covariance is ``Q_kl``. Heading psi and position
t of the start are common to all sightings::

    m_i = R(psi) q_k + t + e_k,    cov(e_k, e_l) = M_ij + R(psi) Q_kl R(psi)^T                                (1)

Two sightings of different landmarks give psi and t (two-point resection). Every pair proposes a start, refined by least
squares over the landmarks that agree with it. A landmark agrees where most of its sightings lie within the 99.9 % ellipse
of (1), and its mean within that of where the others predict it. One with a wrong identity lies anywhere in the area A_n
in which the vehicle has seen landmarks. The evidence of a start h, with the prior of a pose uniform over the area A of the
map and all headings, and its posterior covariance Sigma::

    E(h) = N(e) prod_agreeing a_i prod_others (b_i / A_n) (2 pi)^(3/2) |Sigma|^(1/2) / (2 pi A)              (2)
    E(one) = sum_i a_i / A prod_{j not i} (b_j / A_n),    E(other) = c_1 / A prod_{i > 1} (c_i / A_n)        (3)

E(one) is that of a single right identity, E(other) that of a map of another place, which is a priori as probable as this
one. With w the probability of a wrong identity, ``a = 1 - w, b = w, c = 1`` for a landmark that was seen several times. One
that was seen once is a wrong identity, or new: with v the share of the sightings that show a landmark for the first time,
``a = 1, b = w / ((1 - w) v), c = 1 + b``. Sightings of one landmark count once, by their mean: a recogniser errs in the
same way again. The vehicle is located when the best start outweighs all others together, and (3), by `ODDS`, and when its
heading is known well enough to linearise at it.

Landmarks that stand elsewhere have moved: the estimator gets the map without them. Where they are as many as those that
agree, the place is none. Some of them may also agree at a wrong start. For `WATCHED_S` after the first start all sightings
are therefore weighed again: where a start outweighs the one in use by `ODDS`, the estimator begins again.

Arun, Huang and Blostein, "Least-Squares Fitting of Two 3-D Point Sets", PAMI 9(5), 1987; MacKay, "Information Theory,
Inference, and Learning Algorithms", 2003, chapter 28 (evidence).
"""

import math
from collections import Counter
from collections.abc import Iterator
from itertools import combinations
from typing import Any, NamedTuple

import gtsam
import numpy as np

from sonar_graph.calibration import Calibration, KnownMap, Start
from sonar_graph.errors import CalibrationError
from sonar_graph.estimator import (
    Estimator,
    MakeEstimator,
    known_map_of,
    newest_landmarks_of,
    refused_rows_of,
    withheld_of,
)
from sonar_graph.measurements import Floats, LandmarkDetections, Measurements
from sonar_graph.models import (
    ACCEPTED,
    FEWEST,
    LOCATED_AGAIN,
    MINIMUM_PROBABILITY,
    NOT_LOCATED,
    elevation_on_floor,
    identify,
    listed,
    locate,
    locate_jacobians,
    polar_measurements,
)
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.samples import StampedRows
from sonar_graph.numerics import chi_square_quantile, diagonal_blocks
from sonar_graph.states import (
    FIRST_ANONYMOUS_ID,
    DetectionLog,
    Estimate,
    LandmarkMap,
    RefusedRow,
    Trajectory,
)

NO_MAP = (
    'start.source = "map" in the calibration, and no map: give one with --map, or state `position_m` and `rpy_rad` under '
    '[start] instead of `source = "map"`'
)
WRONG = 0.1
"""Probability of a wrong identity."""
ODDS = 1e3
"""Odds from which on the vehicle is located."""
AGREES = 13.8
"""Chi-square quantile of 99.9 %, two degrees of freedom."""
MOST_SIGHTINGS = 24
"""Number of sightings that propose starts, the newest ones."""
MOST_OF_LANDMARK = 4
"""Of one landmark: their mean counts as one sighting, and more of them would share the errors of odometry."""
LINEAR_SIGMAS = 3.0
"""Error of the heading that is found, in sigmas, up to which a sighting must be linear in it within its own sigma."""
LOOSER = 3.0
"""Sigmas of the prior start over those that the sightings leave: the estimator weighs them itself, so that a ninth of their
information counts twice. With a looser prior it would follow a moved landmark that it sees first."""
LOOSER_THAN_MAP = 10.0
"""The same of the place over those that the map's errors leave: a hundredth of what the map knows counts twice, and again
with each dive in the map of the last one."""
SELDOM = 8
"""Number of its sightings up to which each one of a landmark is news; after that their mean changes little."""
NEWS_SHARE = 0.05
"""Share of all sightings that is news together: a map that never fits would be compared with each frame of a long dive."""
VERTICAL_M_S = 0.5
"""Vertical speed that a depth may have missed since it was measured."""
HEIGHT_SIGMAS = 3.0
"""Sigmas of map and vehicle by which a landmark may be outside of the heights that the vertical aperture shows."""
LEAST_RISE = 0.05
"""Rise of the sonar's fan with elevation, beside which it counts as level."""
WATCHED_S = 120.0
"""Time after the vehicle was located in which a better start replaces a wrong one."""
NEAR = chi_square_quantile(0.999, 3)
SAME = 10.0
"""Distance, in sigmas, of starts that are refined to the same one."""
STEPS = 5
CONVERGED = 1e-6
"""Squared length of a step of least squares, in sigmas."""


class MapSighting(NamedTuple):
    """A landmark of the map as seen in the level frame o."""

    row: int
    """Row of the landmark in the map."""
    q: Floats
    """Place in o, shape (2,), m."""
    S: Floats
    """Its covariance, shape (2, 2), m²."""
    rise_m: float = 0.0
    """From the height of the landmark in the map to the middle of the heights that the sonar's vertical aperture shows; 0
    where it is one of these."""
    by_odometry: Floats = np.zeros((2, 6))
    """Change of q with an error of odometry, which is the same twist in o for all that is seen later, shape (2, 6)."""
    C_odometry: Floats = np.zeros((6, 6))
    """Covariance of that error until this frame, without what is the same at all frames, shape (6, 6); S has both."""
    by_common: Floats = np.zeros((2, 5))
    """Change of q with what is the same at all frames over its sigma: gyro bias, roll and pitch of the start, (2, 5)."""


class FoundStart(NamedTuple):
    """Position and heading of the start in the map."""

    parameters: Floats
    """(psi, t_x, t_y), shape (3,), rad and m."""
    covariance: Floats
    """Shape (3, 3)."""
    of_map: Floats
    """The part of it that the map's errors make."""
    log_evidence: float
    """Logarithm of (2)."""
    agreeing: frozenset[int]
    """Rows of the landmarks that agree with it."""


class BodyInFrame(NamedTuple):
    """Pose of the body in o at a frame."""

    o_T_body: gtsam.Pose3
    C: Floats
    """Covariance of its perturbation, in its own axes, shape (6, 6)."""
    height_m2: float = 0.0
    """Variance of its height beside C."""
    by_odometry: Floats = np.zeros((6, 6))
    """Change of the perturbation with an error of odometry, a twist in o, shape (6, 6)."""


class MapLocator:
    """Finds the start in a map, frame by frame; results depend on stamps alone."""

    def __init__(self, calibration: Calibration) -> None:
        assert calibration.map is not None
        self.found: FoundStart | None = None
        self.moved: list[int] = []
        """Identities of the landmarks that have moved, by the start that was found."""
        self._refuted: FoundStart | None = None
        """Last start from which most landmarks stand elsewhere than in the map."""
        self._given_up = 0
        """Number of starts that were in use before they were refuted."""
        self._calibration = calibration
        self.map = calibration.map
        self._places = np.array(self.map.positions_m)
        self._rows = {landmark_id: row for row, landmark_id in enumerate(self.map.ids)}
        self._odometry = Odometry(calibration)
        self._start_ns: int | None = None
        self._found_ns: list[int] = []
        """Frames at which the start was found, and found again."""
        self.sightings: list[MapSighting] = []
        self._times_seen: Counter[int] = Counter()
        """Number of sightings, by row of the map."""
        self._weighed = 0
        """Number of sightings when they were weighed last."""
        self._others: set[int] = set()
        """Identities that were seen and are not in the map."""
        self._body_T_sonar = calibration.sonar.mounting.pose()
        self._heights_m2 = np.diag(self.map.joint())[2::3].tolist()
        """Variances of the landmarks' heights."""
        self._depths = StampedRows(np.empty(0), np.empty(0))
        """Heights of the pressure port, m, and their variances, m²; NaN where the calibration's holds."""

    def add(self, measurements: Measurements) -> None:
        """Take in measurements, and look for the start, or for a better one, after each frame."""
        for stamp_ns in self.frames_seen(measurements):
            if not self.is_watching(stamp_ns):
                return
            if not self._is_due():
                continue
            of_all = newest_of_each(self.sightings, MOST_OF_LANDMARK)
            data = map_data(of_all, self.map)
            self._give_up_if_refuted(data)
            best = located(self.newest(), self.map)
            if best is None:
                continue
            if self.found is not None:
                is_better = outweighs(best, self.found, data)
                # the estimator finds its own way from a start that is near enough
                if not is_better or is_near(best, self.found):
                    continue
            # a few fit a mirror image, or a map of another place, by chance; each new start repeats the run until now
            by_all = refined(best.parameters, data)
            moved = [] if by_all is None else moved_landmarks(by_all, data)
            if by_all is None or len(moved) * (1 + self._given_up) >= len(
                by_all.agreeing
            ):
                self._refuted = best
                continue
            self.found = best
            self._found_ns.append(stamp_ns)
            self.moved = [self.map.ids[row] for row in moved]

    def _is_due(self) -> bool:
        """True at a frame with news: a landmark that was seldom seen, or many sightings since the last one."""
        since = self.sightings[self._weighed :]
        is_new = any(self._times_seen[each.row] <= SELDOM for each in since)
        if not is_new and len(since) < NEWS_SHARE * len(self.sightings):
            return False
        self._weighed = len(self.sightings)
        return True

    def _give_up_if_refuted(self, data: "MapData") -> None:
        """Forget a start from which as many landmarks stand elsewhere by now as agree."""
        if self.found is None:
            return
        # odometry has drifted since
        start = refined(self.found.parameters, data)
        if start is None or len(moved_landmarks(start, data)) < len(start.agreeing):
            return
        self._refuted = start
        self._given_up += 1
        self.found = None
        self.moved = []

    def is_watching(self, stamp_ns: int) -> bool:
        """True as long as the start may still change."""
        return self.found is None or stamp_ns <= self._found_ns[0] + WATCHED_S * 1e9

    def frames_seen(self, measurements: Measurements) -> Iterator[int]:
        """Take in measurements; yields the stamp of each frame that shows landmarks of the map, once it is taken in."""
        self._odometry.add(measurements.imu, measurements.dvl)
        if measurements.depth is not None:
            depth = measurements.depth
            self._depths.insert(depth.stamps_ns, depth.z_m, depth.variance_m2)
        if measurements.detections is None:
            return
        for frame in measurements.detections.frames():
            if self._see(frame):
                yield int(frame.stamps_ns[0])

    def lacking(self) -> str:
        """What is missing for a start."""
        seen = len({sighting.row for sighting in self.sightings})
        if not seen and self._others:
            return f"none of its identities {listed(self.map.ids)} was seen; seen: {listed(self._others)}"
        if seen < 2:
            return (
                f"{seen} of its landmarks seen, and at least two are needed; with one state the start: position_m and "
                "rpy_rad under [start] in a file for --calibration"
            )
        if self._refuted is not None:
            agreeing = listed(self.map.ids[row] for row in self._refuted.agreeing)
            return (
                f"at the only place that fits landmarks {agreeing}, as many others or more stand elsewhere: other axes, a "
                "map of another place, or most landmarks moved; `sonar-graph inspect LOG --map FILE` looks for its mistake"
            )
        return (
            f"of its landmarks {seen} were identified, and no place explains them {ODDS:g} times better than all others "
            "together: few landmarks or wrong identities, sigmas of the map that are too small, another unit, or another "
            "map; `sonar-graph inspect LOG --map FILE` looks for its mistake"
        )

    def _see(self, frame: LandmarkDetections) -> bool:
        """Add the sightings of a frame; True where there are any."""
        stamp_ns = int(frame.stamps_ns[0])
        if self._start_ns is None:
            self._start_ns = self._odometry.start_by(stamp_ns)
        if self._start_ns is None or stamp_ns < self._start_ns:
            return False
        ids, outcomes = identify(frame, MINIMUM_PROBABILITY)
        accepted = [k for k in range(len(frame)) if outcomes[k] == ACCEPTED]
        rows = [k for k in accepted if int(ids[k]) in self._rows]
        self._others.update(
            int(ids[k])
            for k in accepted
            if int(ids[k]) not in self._rows and ids[k] < FIRST_ANONYMOUS_ID
        )
        if not rows:
            return False
        start = self._calibration.start
        roll, pitch, _ = start.rpy_rad
        o_T_start = gtsam.Pose3(
            gtsam.Rot3.RzRyRx(roll, pitch, 0.0),
            np.array([0.0, 0.0, start.position_m[2]]),
        )
        motion = self._odometry.motion(
            self._start_ns,
            stamp_ns,
            np.zeros(3),
            o_T_start.rotation().matrix(),
            stamp_ns,
        )
        by_bias = motion.D_bias * self._calibration.imu.gyro_bias_sigma  # (6, 3)
        o_T_body = o_T_start.compose(motion.i_T_j)
        o_Ad_body = o_T_body.AdjointMap()
        by_odometry = o_T_body.inverse().AdjointMap()
        by_tilt = start_turns(o_T_start, start)
        common = np.hstack([o_Ad_body @ by_bias, by_tilt])  # twists in o, (6, 5)
        of_body = by_odometry @ common
        C = motion.covariance + of_body @ of_body.T
        C_odometry = o_Ad_body @ motion.covariance @ o_Ad_body.T
        body = self._at_depth(BodyInFrame(o_T_body, C, 0.0, by_odometry), stamp_ns)
        o_T_sonar = body.o_T_body.compose(self._body_T_sonar)
        z, R_z = polar_measurements(frame, self._calibration.sonar)
        for k in rows:
            row = self._rows[int(ids[k])]
            range_m, azimuth_rad = z[k].tolist()
            floor_z_m = self._places[row, 2]
            elevation_rad = elevation_on_floor(
                o_T_sonar, range_m, azimuth_rad, floor_z_m, aperture_rad=2.0 * math.pi
            )
            sight = Ray(range_m, azimuth_rad, elevation_rad or 0.0)
            point = locate(o_T_sonar, *sight)
            of_floor_m2 = self._heights_m2[row] if elevation_rad is not None else 0.0
            found = spread(body, self._body_T_sonar, sight, R_z[k], of_floor_m2)
            # a sonar shows what is near and strong beyond its aperture too, and there elevation changes the place most
            rise_m = self._rise_m(row, o_T_sonar, sight, found.height_m2)
            by_error = found.by_body @ body.by_odometry
            by_common = by_error @ common
            self.sightings.append(
                MapSighting(
                    row, point[:2], found.S, rise_m, by_error, C_odometry, by_common
                )
            )
            self._times_seen[row] += 1
        return True

    def _rise_m(
        self, row: int, o_T_sonar: gtsam.Pose3, sight: "Ray", height_m2: float
    ) -> float:
        """`MapSighting.rise_m` of a landmark; ``height_m2``: variance of the height at which the sonar has it."""
        half_rad = 0.5 * self._calibration.sonar.elevation_aperture_rad
        forward, left, upright = sight.range_m * o_T_sonar.rotation().matrix()[2]
        in_fan = [math.cos(sight.azimuth_rad), math.sin(sight.azimuth_rad)]
        level = in_fan[0] * forward + in_fan[1] * left
        # along the arc of elevations the height is a sine: highest and lowest at its ends, or at the top between them
        top_rad = math.atan2(upright, level)
        arc_rad = [-half_rad, half_rad, top_rad, top_rad - math.pi, top_rad + math.pi]
        e = np.clip(arc_rad, -half_rad, half_rad)
        heights_m = o_T_sonar.z() + level * np.cos(e) + upright * np.sin(e)
        middle_m = (heights_m.min() + heights_m.max()) / 2
        beyond_m = middle_m - self._places[row, 2]
        margin_m = HEIGHT_SIGMAS * math.sqrt(self._heights_m2[row] + height_m2)
        is_shown = abs(beyond_m) <= np.ptp(heights_m) / 2 + margin_m
        return 0.0 if is_shown else beyond_m

    def _at_depth(self, body: BodyInFrame, stamp_ns: int) -> BodyInFrame:
        """The body at the height of the last depth, where that is better known than by odometry."""
        start_m2 = self._calibration.start.position_sigma_m[2] ** 2
        R = body.o_T_body.rotation().matrix()
        carried_m2 = start_m2 + (R[2] @ body.C[3:, 3:] @ R[2])
        last = int(self._depths.stamps_ns.searchsorted(stamp_ns, side="right")) - 1
        if last < 0:
            return body._replace(height_m2=start_m2)
        heights_m, variances_m2 = self._depths.values
        depth_m2 = variances_m2[last]
        if math.isnan(depth_m2):
            depth_m2 = self._calibration.depth.sigma_m**2
        since_s = float(stamp_ns - self._depths.stamps_ns[last]) * 1e-9
        depth_m2 += (VERTICAL_M_S * since_s) ** 2
        if depth_m2 > carried_m2:
            return body._replace(height_m2=start_m2)
        x, y, _ = body.o_T_body.translation()
        z = heights_m[last] - R[2] @ self._calibration.depth.port_m
        o_T_body = gtsam.Pose3(body.o_T_body.rotation(), np.array([x, y, z]))
        # without the error of odometry along the vertical
        level = np.eye(6)
        level[3:, 3:] -= np.outer(R[2], R[2])
        by_odometry = level @ body.by_odometry
        return BodyInFrame(o_T_body, level @ body.C @ level.T, depth_m2, by_odometry)

    def newest(self) -> list[MapSighting]:
        """The newest sightings, a few of each landmark, in the order of time."""
        return newest_of_each(self.sightings, MOST_OF_LANDMARK)[-MOST_SIGHTINGS:]

    def again_s(self) -> list[float]:
        """Times since the start at which a better one replaced it."""
        first_ns = self._start_ns or 0
        return [(stamp_ns - first_ns) * 1e-9 for stamp_ns in self._found_ns[1:]]

    def standing(self) -> KnownMap:
        """The map without the landmarks that have moved."""
        return self.map.without(self.moved)

    def start(self) -> Start:
        """Prior start at the place that was found, looser than it is known."""
        assert self.found is not None
        psi, x, y = self.found.parameters.tolist()
        variances = np.diag(self.found.covariance)
        of_map = np.diag(self.found.of_map)
        # filters are linearised about the heading, which must not be looser than it needs
        factors = np.array([LOOSER, LOOSER_THAN_MAP, LOOSER_THAN_MAP])
        sigmas = np.sqrt(LOOSER**2 * (variances - of_map) + factors**2 * of_map)
        start = self._calibration.start
        roll, pitch, _ = start.rpy_rad
        level_sigma_m = float(max(sigmas[1:].max(), 0.1))
        return start.model_copy(
            update={
                "position_m": (x, y, start.position_m[2]),
                "rpy_rad": (roll, pitch, psi),
                "position_sigma_m": (
                    level_sigma_m,
                    level_sigma_m,
                    start.position_sigma_m[2],
                ),
                "rpy_sigma_rad": (
                    *start.rpy_sigma_rad[:2],
                    float(max(sigmas[0], 0.02)),
                ),
            }
        )


def newest_of_each(sightings: list[MapSighting], most: int) -> list[MapSighting]:
    """The newest sightings of every landmark, in the order of time."""
    count: Counter[int] = Counter()
    newest = []
    for sighting in reversed(sightings):
        count[sighting.row] += 1
        if count[sighting.row] <= most:
            newest.append(sighting)
    return newest[::-1]


class Ray(NamedTuple):
    """A landmark as the sonar sees it, at the elevation of its height in the map."""

    range_m: float
    azimuth_rad: float
    elevation_rad: float


def start_turns(o_T_start: gtsam.Pose3, start: Start) -> Floats:
    """Twists in o of a start that is rolled, and one that is pitched, by one sigma, shape (6, 2)."""
    _, pitch, _ = start.rpy_rad
    sigmas_rad = np.array(start.rpy_sigma_rad[:2])
    # roll turns about the start's first axis without its roll, pitch about the level axis across
    axes = gtsam.Rot3.Ry(pitch).matrix()[:, :2]
    turns = axes * sigmas_rad  # (3, 2)
    # about the place of the start instead of the origin of o
    moves = np.cross(o_T_start.translation(), turns, axisb=0, axisc=0)
    return np.vstack([turns, moves])


class Spread(NamedTuple):
    """Uncertainty of the place of a landmark."""

    S: Floats
    """Covariance of its level place, shape (2, 2), m²."""
    by_body: Floats
    """Change of that place with the body's perturbation, shape (2, 6)."""
    height_m2: float
    """Variance of its height at this elevation."""


def spread(
    body: BodyInFrame,
    body_T_sonar: gtsam.Pose3,
    sight: Ray,
    R_z: Floats,
    floor_m2: float,
) -> Spread:
    """Uncertainty of the place of a landmark that is seen at the elevation of its height in the map.

    ``R_z``: of range and azimuth; ``floor_m2``: variance of its height in the map. Where the body errs in height by h, or
    turns the landmark up by h, the elevation changes until the height is that of the map again.
    """
    # (3, 6), (3, 3)
    _, by_body, by_polar = locate_jacobians(body.o_T_body, body_T_sonar, *sight)
    by_z = by_polar[:, :2]
    cov = by_z @ R_z @ by_z.T  # (3, 3)
    height_m2 = (cov + by_body @ body.C @ by_body.T)[2, 2] + body.height_m2
    cov[2, 2] += MOST_OF_LANDMARK * (body.height_m2 + floor_m2)
    up_fan = by_polar[:, 2] / sight.range_m
    rise = math.copysign(max(abs(up_fan[2]), LEAST_RISE), up_fan[2])
    by_height = up_fan[:2] / rise  # of the level place
    T = np.column_stack([np.eye(2), -by_height])  # (2, 3)
    level_by_body = T @ by_body
    S = T @ cov @ T.T + level_by_body @ body.C @ level_by_body.T
    return Spread(S, level_by_body, height_m2)


def located(sightings: list[MapSighting], known: KnownMap) -> FoundStart | None:
    """The start that outweighs all others by `ODDS`; None without one."""
    data = map_data(sightings, known)
    starts = candidates(data)
    if not starts:
        return None
    weights = data.weights
    log_near = math.log(data.near_m2)
    # the first of them lies anywhere in the map, the others near it
    first = log_near - math.log(data.area_m2)
    all_wrong = np.sum(weights.wrong - log_near)
    by_one = all_wrong + weights.right - weights.wrong
    one = np.logaddexp.reduce(by_one) + first  # (3)
    of_other_place = np.sum(weights.elsewhere - log_near) + first  # (3)
    best = starts[0]
    rivals = [start.log_evidence for start in starts[1:]] + [of_other_place, one]
    weight = np.logaddexp.reduce(rivals)
    is_ahead = best.log_evidence - weight >= math.log(ODDS)
    return best if is_ahead and is_linear(best, data) else None


def map_data(sightings: list[MapSighting], known: KnownMap) -> "MapData":
    """Sightings, one at least, and landmarks as arrays."""
    places = np.array(known.positions_m)[:, :2]
    m = len(places)
    is_level = np.arange(3 * m) % 3 < 2
    M = known.joint()[np.ix_(is_level, is_level)]  # (2 m, 2 m)
    q = np.array([s.q for s in sightings])
    S = np.array([s.S for s in sightings])
    rows = np.array([s.row for s in sightings])
    reach_m = np.linalg.norm(q, axis=1).max()
    area_m2 = np.prod(np.ptp(places, axis=0) + 2.0 * reach_m)
    near_m2 = min((2.0 * reach_m) ** 2, area_m2)
    is_of = np.unique(rows)[:, None] == rows
    weights = IdentityWeights.of(is_of.sum(axis=1))
    Q = sightings_covariance(sightings)
    S_inv = np.linalg.inv(S)
    return MapData(q, S, S_inv, Q, rows, is_of, places, M, area_m2, near_m2, weights)


def sightings_covariance(sightings: list[MapSighting]) -> Floats:
    """Joint covariance of places in the order of time, shape (2 k, 2 k).

    Errors of odometry are twists in o, which add up: the later of two sightings has that of the earlier one, too. Without
    what they share, landmarks of a group would count as independent.
    """
    H = np.array([s.by_odometry for s in sightings])  # (k, 2, 6)
    C = shared_errors(np.array([s.C_odometry for s in sightings]))  # (k, 6, 6)
    S = np.array([s.S for s in sightings])  # (k, 2, 2)
    B = np.array([s.by_common for s in sightings])  # (k, 2, 5)
    k = len(sightings)
    earlier_later = np.einsum("kia,lja->kilj", H @ C, H)  # (k, 2, k, 2)
    is_earlier = np.arange(k)[:, None] < np.arange(k)
    shared = earlier_later * is_earlier[:, None, :, None]
    Q = shared + shared.transpose(2, 3, 0, 1) + np.einsum("kia,lja->kilj", B, B)
    Q[np.arange(k), :, np.arange(k)] = S
    Q = Q.reshape(2 * k, 2 * k)
    lacking_m2 = max(-np.linalg.eigvalsh(Q)[0], 0.0)
    if lacking_m2:
        lacking_m2 += np.linalg.eigvalsh(S).min()
    return Q + lacking_m2 * np.eye(2 * k)


def shared_errors(C: Floats) -> Floats:
    """Covariances of odometry, shape (k, 6, 6), each reduced to what is in the later ones too.

    A gap of the Doppler log is bridged anew at its end: sightings within it have errors that later ones have not.
    """
    C = C.copy()
    for k in range(len(C) - 2, -1, -1):
        w, V = np.linalg.eigh(C[k + 1] - C[k])
        C[k] += (V * np.minimum(w, 0.0)) @ V.T
    return C


def candidates(data: "MapData") -> list[FoundStart]:
    """Starts with two or more landmarks that agree, the one with the most evidence first."""
    found: list[FoundStart] = []
    for proposal, pair in proposals(data):
        # sightings of the same landmarks propose the same start many times; a landmark that agrees with none of the
        # starts may be far from the pair that proposed them, and would agree with one that is turned a little
        if any(pair <= start.agreeing and is_same(proposal, start) for start in found):
            continue
        start = refined(proposal, data)
        if start is not None and math.isfinite(start.log_evidence):
            found.append(start)
    starts: list[FoundStart] = []
    for start in sorted(found, key=lambda start: -start.log_evidence):
        if not any(is_same(start.parameters, better) for better in starts):
            starts.append(start)
    return starts


class IdentityWeights(NamedTuple):
    """Logarithms of the weights in (2) and (3) of l landmarks that were seen, shape (l,) each."""

    right: Floats
    """a: seen where it stands."""
    wrong: Floats
    """b: another landmark was seen, which may stand anywhere."""
    elsewhere: Floats
    """c: seen in a map of another place."""

    @classmethod
    def of(cls, counts: Any) -> "IdentityWeights":
        """Weights by the number of sightings of each landmark, shape (l,)."""
        is_once = counts == 1
        # the next landmark counts as one that is seen again
        again = np.count_nonzero(~is_once) + 1
        v = again / (again + np.sum(counts - 1))
        odds = WRONG / ((1.0 - WRONG) * v)
        right = np.where(is_once, 1.0, 1.0 - WRONG)
        wrong = np.where(is_once, odds, WRONG)
        elsewhere = np.where(is_once, 1.0 + odds, 1.0)
        return cls(np.log(right), np.log(wrong), np.log(elsewhere))


class MapData(NamedTuple):
    """Sightings and landmarks as arrays."""

    q: Floats
    """Shape (k, 2)."""
    S: Floats
    """Shape (k, 2, 2)."""
    S_inv: Floats
    """Inverses of S."""
    Q: Floats
    """Joint covariance of q, shape (2 k, 2 k)."""
    rows: Any
    """Landmark of each sighting, shape (k,)."""
    is_of: Any
    """True for the sightings of each landmark that was seen, shape (l, k)."""
    places: Floats
    """Shape (m, 2)."""
    M: Floats
    """Joint covariance of the places, shape (2 m, 2 m)."""
    area_m2: float
    """A."""
    near_m2: float
    """A_n."""
    weights: IdentityWeights

    @property
    def place_cov(self) -> Floats:
        """Covariance of each place, shape (m, 2, 2)."""
        return diagonal_blocks(self.M, 2)


def proposals(data: MapData) -> list[tuple[Floats, frozenset[int]]]:
    """(psi, t_x, t_y) by each pair of sightings of two landmarks whose distance in the map fits, with their rows."""
    found = []
    for k, j in combinations(range(len(data.q)), 2):
        a = data.rows[k]
        b = data.rows[j]
        if a == b:
            continue
        seen = data.q[j] - data.q[k]
        placed = data.places[b] - data.places[a]
        # a map that errs as a whole keeps the distances of its landmarks
        cov = of_difference(data.Q, k, j) + of_difference(data.M, a, b)
        far_m = np.linalg.norm(placed)
        sigma_m = math.sqrt(np.trace(cov))
        if abs(np.linalg.norm(seen) - far_m) > 4.0 * sigma_m or far_m < sigma_m:
            continue
        psi = math.atan2(placed[1], placed[0]) - math.atan2(seen[1], seen[0])
        middle = 0.5 * (data.q[k] + data.q[j])
        t = 0.5 * (data.places[a] + data.places[b]) - turn(psi) @ middle
        found.append((np.array([psi, *t]), frozenset({int(a), int(b)})))
    return found


def of_difference(joint: Floats, i: int, j: int) -> Floats:
    """Covariance of the difference of two places, shape (2, 2), from that of all, shape (2 n, 2 n)."""
    blocks = joint.reshape(len(joint) // 2, 2, -1, 2)
    shared = blocks[i, :, j]
    return blocks[i, :, i] + blocks[j, :, j] - shared - shared.T


def turn(psi: float) -> Floats:
    """Rotation of the plane, shape (2, 2)."""
    c = math.cos(psi)
    s = math.sin(psi)
    return np.array([[c, -s], [s, c]])


def refined(
    parameters: Floats, data: MapData, kept: frozenset[int] = frozenset()
) -> FoundStart | None:
    """Least squares of (1) over the landmarks that agree, with the evidence (2).

    A landmark that the others predict elsewhere, with what their sightings share, is left out, the worst one first. Those
    ``kept`` agree in any case.
    """
    seen = data.rows[np.argmax(data.is_of, axis=1)]  # (l,)
    is_kept = np.isin(seen, list(kept))
    left_out = np.zeros(len(seen), bool)
    while True:
        fit = least_squares(parameters, data, is_kept, left_out)
        if fit is None:
            return None
        fitted = np.flatnonzero(fit.agreeing)
        squared = np.where(is_kept[fitted], 0.0, fit.squared)
        worst = int(squared.argmax())
        if len(fitted) <= 2 or squared[worst] <= AGREES:
            break
        left_out[fitted[worst]] = True
        parameters = fit.parameters
    wrong = np.sum(data.weights.wrong[~fit.agreeing] - math.log(data.near_m2))
    right = fit.log_density + np.sum(data.weights.right[fit.agreeing])
    log_det = math.log(np.linalg.det(fit.covariance))
    volume = 1.5 * math.log(2.0 * math.pi) + 0.5 * log_det
    prior = math.log(2.0 * math.pi * data.area_m2)
    rows = frozenset(seen[fit.agreeing].tolist())
    log_evidence = right + wrong + volume - prior
    return FoundStart(fit.parameters, fit.covariance, fit.of_map, log_evidence, rows)


class Fit(NamedTuple):
    """Least squares of (1) over a landmarks that agree, of l that were seen."""

    parameters: Floats
    """Shape (3,)."""
    covariance: Floats
    """Shape (3, 3)."""
    of_map: Floats
    """The part of it that the map's errors make."""
    agreeing: Any
    """Shape (l,)."""
    squared: Floats
    """Squared Mahalanobis distance of each from where the others have it, shape (a,)."""
    log_density: float
    """Of all errors."""


def least_squares(
    parameters: Floats, data: MapData, kept: Any, left_out: Any
) -> Fit | None:
    """Fit to the landmarks that are kept or agree, but for some, shapes (l,); None where they are fewer than two."""
    seen = data.rows[np.argmax(data.is_of, axis=1)]  # (l,)
    agreeing = ~left_out
    covariance = np.zeros((3, 3))
    for _ in range(STEPS):
        agrees, agreeing = agreement(parameters, covariance, agreeing, data)
        # wrong identities count against no start: only a landmark that disagrees as a whole counts with all sightings
        disagreeing = kept & ~agreeing
        agrees[disagreeing] = data.is_of[disagreeing]
        agreeing = (agreeing | kept) & ~left_out
        if np.count_nonzero(agreeing) < 2:
            return None
        q, Q = mean_sightings(agrees[agreeing], data)  # (a, 2), (2 a, 2 a)
        a = len(q)
        R = turn(parameters[0])
        e = (data.places[seen[agreeing]] - q @ R.T - parameters[1:]).ravel()  # (2 a,)
        all_R = np.kron(np.eye(a), R)
        coordinates = np.add.outer(2 * seen[agreeing], np.arange(2)).ravel()
        M = data.M[np.ix_(coordinates, coordinates)]  # (2 a, 2 a)
        W = all_R @ Q @ all_R.T + M
        W_inv = np.asarray(np.linalg.inv(W), np.float64)
        by_psi = q @ turn(parameters[0] + 0.5 * math.pi).T
        by_t = np.tile(np.eye(2), (a, 1))
        J = np.column_stack([by_psi.ravel(), by_t])  # (2 a, 3)
        weighted = W_inv @ J  # (2 a, 3)
        gradient = weighted.T @ e
        covariance = np.asarray(np.linalg.inv(J.T @ weighted), np.float64)
        step = covariance @ gradient
        parameters = parameters + step
        if step @ gradient < CONVERGED:
            break
    _, log_det = np.linalg.slogdet(2.0 * math.pi * W)
    log_density = -0.5 * float(e @ W_inv @ e + log_det)
    # what is left of W^-1 beside the start predicts each landmark by the others
    P = W_inv - weighted @ covariance @ weighted.T
    own = diagonal_blocks(P, 2)
    residual = (P @ e).reshape(a, 2, 1)
    squared = np.zeros(a)
    if a > 2:
        squared = (residual * np.linalg.solve(own, residual)).sum(axis=(1, 2))
    gain = covariance @ weighted.T  # (3, 2 a)
    of_map = gain @ M @ gain.T
    return Fit(parameters, covariance, of_map, agreeing, squared, log_density)


def agreement(
    parameters: Floats, covariance: Floats, fitted: Any, data: MapData
) -> tuple[Any, Any]:
    """Sightings of each landmark within the ellipse of (1), shape (l, k), and landmarks with most of them, (l,).

    ``covariance``: of the start; ``fitted``: the landmarks that gave it, shape (l,), whose errors it has in it.
    """
    R = turn(parameters[0])
    e = data.places[data.rows] - data.q @ R.T - parameters[1:]  # (k, 2)
    J = np.tile(np.eye(2, 3, 1), (len(e), 1, 1))  # (k, 2, 3)
    J[:, :, 0] = data.q @ turn(parameters[0] + 0.5 * math.pi).T
    # a heading by two landmarks near each other is too uncertain to place a third one far away
    J[data.is_of[fitted].any(axis=0)] = 0.0
    of_start = J @ covariance @ J.transpose(0, 2, 1)  # (k, 2, 2)
    W = R @ data.S @ R.T + data.place_cov[data.rows] + of_start  # (k, 2, 2)
    squared = np.einsum("ki,ki->k", e, np.linalg.solve(W, e[:, :, None])[:, :, 0])
    agrees = data.is_of & (squared <= AGREES)
    return agrees, 2 * agrees.sum(axis=1) > data.is_of.sum(axis=1)


def outweighs(best: FoundStart, other: FoundStart, data: MapData) -> bool:
    """Check that a start explains all sightings `ODDS` times better than one by the other's landmarks.

    Drift of odometry moves both.
    """
    new = refined(best.parameters, data)
    old = refined(other.parameters, data, other.agreeing)
    if new is None or old is None:
        return new is not None
    return new.log_evidence - old.log_evidence >= math.log(ODDS)


def moved_landmarks(start: FoundStart, data: MapData) -> list[int]:
    """Rows of the landmarks that disagree with a start by the same sightings, and stand elsewhere."""
    return [
        int(row)
        for is_of in data.is_of
        if (row := data.rows[is_of][0]) not in start.agreeing
        and stands_elsewhere(is_of, data)
    ]


def stands_elsewhere(is_of: Any, data: MapData) -> bool:
    """Check that a landmark that disagrees has `FEWEST` sightings in one place: wrong identities are here and there."""
    q = data.q[is_of]
    e = q - np.median(q, axis=0)
    squared = np.einsum("ki,kij,kj->k", e, data.S_inv[is_of], e)
    return bool(np.count_nonzero(squared <= AGREES) >= FEWEST)


def mean_sightings(is_averaged: Any, data: MapData) -> tuple[Floats, Floats]:
    """Weighted mean of some sightings of each landmark, shape (a, 2), and the joint covariance of the means, (2 a, 2 a).

    ``is_averaged``: (a, k).
    """
    information = np.einsum("ak,kij->aij", is_averaged, data.S_inv)
    S = np.linalg.inv(information)
    weights = np.einsum("ak,aij,kjl->aikl", is_averaged, S, data.S_inv)  # (a, 2, k, 2)
    A = weights.reshape(2 * len(S), -1)
    return (A @ data.q.ravel()).reshape(-1, 2), A @ data.Q @ A.T


def is_linear(start: FoundStart, data: MapData) -> bool:
    """Check that the heading is known well enough for an estimator that is linearised at the start."""
    squared_rad2 = LINEAR_SIGMAS**2 * start.covariance[0, 0]
    second_order_m = 0.5 * squared_rad2 * np.linalg.norm(data.q, axis=1)
    sigma_m = np.sqrt(0.5 * np.trace(data.S, axis1=1, axis2=2))
    return second_order_m.mean() <= sigma_m.mean()


def is_near(start: FoundStart, other: FoundStart) -> bool:
    """Check that two starts differ by no more than both are uncertain, within 99.9 %."""
    P = start.covariance + other.covariance
    return squared_distance(start.parameters, other.parameters, P) <= NEAR


def is_same(parameters: Floats, better: FoundStart) -> bool:
    """Check that (psi, t_x, t_y) is a better start, within `SAME` sigmas of it."""
    squared = squared_distance(parameters, better.parameters, better.covariance)
    return squared <= SAME**2


def squared_distance(parameters: Floats, other: Floats, P: Floats) -> float:
    """Squared Mahalanobis distance of (psi, t_x, t_y) from another."""
    d = parameters - other
    d[0] = math.remainder(d[0], 2.0 * math.pi)
    return float(d @ np.linalg.solve(P, d))


class StartInMap:
    """An estimator that begins once its start is found in the map, with all measurements since the first.

    `process` returns None until then. Where landmarks that are seen later refute that start, the estimator begins again.
    """

    def __init__(self, make: MakeEstimator, calibration: Calibration) -> None:
        self._make = make
        self._calibration = calibration
        self._locator = MapLocator(calibration)
        self._since_first: list[Measurements] | None = []
        """All measurements; None once the start no longer changes."""
        self._begun_at: FoundStart | None = None
        self._inner: Estimator | None = None

    def process(self, measurements: Measurements) -> Estimate | None:
        """Causal estimate at the end of the measurements; None as long as the vehicle is not located in the map."""
        if self._since_first is None:
            return None if self._inner is None else self._inner.process(measurements)
        self._since_first.append(measurements)
        self._locator.add(measurements)
        estimate = self._estimate(measurements, self._since_first)
        if not self._locator.is_watching(measurements.end_ns):
            self._since_first = None
        return estimate

    def _estimate(
        self, newest: Measurements, since_first: list[Measurements]
    ) -> Estimate | None:
        """Estimate by the newest measurements; where the start has changed, by all of them."""
        found = self._locator.found
        if found is None:
            self._inner = None
            return None
        if self._inner is not None and found is self._begun_at:
            return self._inner.process(newest)
        started = self._calibration.model_copy(
            update={"start": self._locator.start(), "map": self._locator.standing()}
        )
        self._begun_at = found
        self._inner = self._make(started, Odometry(started))
        estimate = None
        for each in since_first:
            estimate = self._inner.process(each)
        return estimate

    def trajectory(self) -> Trajectory:
        """Poses at all instants, also those before the vehicle was located; none until then."""
        if self._inner is None:
            return Trajectory.from_estimates([])
        return self._inner.trajectory()

    def landmarks(self) -> LandmarkMap:
        """Best present estimate of every landmark; none before the vehicle is located."""
        if self._inner is None:
            return LandmarkMap.empty()
        return self._inner.landmarks()

    def newest_landmarks(self) -> LandmarkMap:
        """Landmarks as of the last update."""
        return (
            self.landmarks()
            if self._inner is None
            else newest_landmarks_of(self._inner)
        )

    def known_map(self) -> KnownMap:
        """Landmarks with their joint covariance."""
        assert self._inner is not None
        return known_map_of(self._inner)

    def detections(self) -> DetectionLog:
        """Outcome of every detection since the first measurements."""
        if self._inner is None:
            return DetectionLog.empty()
        return self._inner.detections()

    def refused_rows(self) -> list[RefusedRow]:
        """Refused rows so far."""
        return [] if self._inner is None else refused_rows_of(self._inner)

    def withheld(self) -> list[str]:
        """Messages of the estimator; before it begins, that the vehicle is not located."""
        if self._inner is None:
            return [f"{NOT_LOCATED}: {self._locator.lacking()}"]
        again = [
            f"{LOCATED_AGAIN} after {after_s:.1f} s: landmarks that were seen by then contradict the place before; "
            "causal poses until then are wrong"
            for after_s in self._locator.again_s()
        ]
        return [*again, *withheld_of(self._inner)]


def make_estimator(make: MakeEstimator, calibration: Calibration) -> Any:
    """Estimator with an odometry of its own, which waits for its start where that is to be found in the map."""
    if calibration.start.source == "map":
        if calibration.map is None:
            raise CalibrationError(NO_MAP)
        return StartInMap(make, calibration)
    return make(calibration, Odometry(calibration))
