"""A stated start that the truth or the true landmarks contradict, and a known map that the sightings contradict.

A start is wrong where a `live` run came too late; a map is in another unit or has other axes (`sonar_graph.navigation`).

Landmarks whose places are known, of a map or of the truth, place the start with a covariance (`map_start`).
"""

from collections.abc import Iterator

import numpy as np

from sonar_graph.calibration import KnownMap
from sonar_graph.diagnosis.findings import (
    ACTING_SIGMAS,
    IN_CALIBRATION,
    NO_NEED,
    Finding,
    Gravity,
    contradiction,
    in_degrees,
    numbers,
    unknown,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.models import listed, named, wrap_angle
from sonar_graph.navigation import FoundStart, first_start, map_fit
from sonar_graph.navigation.alignment import Estimate1D
from sonar_graph.sequence import Sequence
from sonar_graph.states import FIRST_ANONYMOUS_ID

FARTHEST_M = 0.5
"""Distance of a start from the truth that a rough survey of both makes."""
FARTHEST_RAD = 0.1
"""The same for its heading, with landmarks that are some metres away."""
STAMPS_S = 1.0
"""Error of the truth's stamps that is no error of the start."""
TRUE_SIGMA_M = 0.01
"""Of a place that counts as true."""


def start_place_findings(right: Sequence, motion: BodyMotion) -> Iterator[Finding]:
    """Distance of a stated start from the truth or, without one, of the first landmarks from their true places."""
    if not right.calibration.start.states("position_m"):
        return
    by_truth = truth_finding(right, motion)
    if by_truth is not None:
        yield by_truth
        return
    true = right.true_landmarks
    if true is None or right.detections is None or not len(true):
        return
    # true places are a map without errors
    known = KnownMap.of(true.ids.tolist(), true.positions, sigma_m=TRUE_SIGMA_M)
    found = first_start(right, known)
    if found is not None:
        yield from stated_start_findings(right, found, "of the truth")


def map_findings(right: Sequence) -> Iterator[Finding]:
    """What is wrong with the known map, or with a stated start in it."""
    known = right.calibration.map
    if known is None or right.detections is None:
        return
    seen = set(right.detections.most_probable()[0].tolist())
    identities = {i for i in seen if 0 <= i < FIRST_ANONYMOUS_ID}
    # landmarks that were never named could be any of the map
    if identities and identities.isdisjoint(known.ids):
        yield contradiction(
            "map: identities",
            f"none of the map's identities {listed(known.ids)} was seen; seen: {listed(identities)}",
            "give the map of this place, with the identities of the log",
            "none in common",
        )
        return
    # a map in another unit or sense fits nowhere: such mistakes are looked for first
    fit = map_fit(right)
    if not fit.is_checked:
        why = "fewer than three of its landmarks are seen"
        yield Finding("map: axes, unit and sense", unknown(why))
    if fit.mistake:
        yield contradiction(
            "map: places",
            f"the sightings contradict the map: {fit.mistake}",
            fit.remedy,
            "the sightings do not fit it",
        )
        return
    if fit.is_checked and fit.start is None:
        yield Finding(
            "map: places",
            unknown("they fit nowhere"),
            cause="the sightings give no single place in it: a map of another place, or landmarks moved, or stand in a row",
            line="give the map of this place, or none",
            gravity=Gravity.ACT,
        )
    if fit.start is not None:
        sigma = np.sqrt(fit.start.covariance[0, 0])
        turn = Estimate1D(wrap_angle(fit.start.parameters[0]), sigma)
        agreeing = [known.ids[row] for row in fit.start.agreeing]
        fits = f"the sightings of landmarks {listed(agreeing)} fit the map, {NO_NEED}"
        if others := identities.difference(known.ids):
            fits += f"; not in it: {listed(others)}"
        yield Finding("map: yaw of the start in it", in_degrees(turn), "°", fits)
    if fit.rise_m:
        aperture_deg = np.degrees(right.calibration.sonar.elevation_aperture_rad)
        yield Finding(
            "map: heights",
            unknown("another zero, or another sonar"),
            cause=f"most landmarks are not within the sonar's vertical aperture of {aperture_deg:.0f}° at their heights "
            "in the map: these count from another zero than the depth, or the sonar's tilt or aperture is wrong",
            line=f"add {fit.rise_m:+.1f} m to each z_m of the map; or give `rpy_rad` under [sonar.mounting] or "
            f"`elevation_aperture_rad` under [sonar] {IN_CALIBRATION}",
            gravity=Gravity.ACT,
        )
    if fit.elsewhere:
        yield Finding(
            "map: landmarks elsewhere",
            unknown("they moved"),
            cause=f"{named(fit.elsewhere)}: seen several times in another place than the map has: moved, wrong lines of "
            "the survey, or heights from another zero",
            line="correct these lines of the map, or leave them out",
            gravity=Gravity.ACT,
        )
    if fit.start is not None and right.calibration.start.source != "map":
        yield from stated_start_findings(right, fit.start, "of the map")


def stated_start_findings(
    right: Sequence, found: FoundStart, whose: str
) -> Iterator[Finding]:
    """A stated start that is elsewhere than landmarks have it; nothing where both agree by their covariances."""
    start = right.calibration.start
    yaw, x, y = found.parameters.tolist()
    stated_x, stated_y, _ = start.position_m
    turn_rad = wrap_angle(yaw - start.rpy_rad[2])
    off = np.array([turn_rad, x - stated_x, y - stated_y])
    sigmas = [start.rpy_sigma_rad[2], *start.position_sigma_m[:2]]
    # Mahalanobis distance, with the uncertainty of both poses
    P = found.covariance + np.diag(np.square(sigmas))
    is_near = np.hypot(*off[1:]) <= FARTHEST_M and abs(off[0]) <= FARTHEST_RAD
    if is_near or float(off @ np.linalg.solve(P, off)) <= ACTING_SIGMAS**2:
        return
    yield contradiction(
        "start pose",
        estimate="the landmarks have it elsewhere",
        cause=f"landmarks {whose} place it at ({x:.2f}, {y:.2f}) m with a yaw of {wrap_angle(yaw):.3f} rad, not at "
        f"({stated_x:.2f}, {stated_y:.2f}) m with {start.rpy_rad[2]:.3f} rad: another start, a log that is joined after its "
        "beginning, or landmarks of another frame?",
        line=f'`start.source = "map"` with a map, or `start.position_m` and `start.rpy_rad`, {IN_CALIBRATION}',
    )


FROM_TRUTH = "start position: distance from the truth"


def truth_finding(right: Sequence, motion: BodyMotion) -> Finding | None:
    """The truth at the start; None where they agree or the truth begins later."""
    truth = right.truth
    begin_ns = right.start_ns
    if truth is None or len(truth) < 2:
        return None
    if not truth.stamps_ns[0] <= begin_ns <= truth.stamps_ns[-1]:
        return None
    start = right.calibration.start
    x, y, _ = truth.at(np.array([begin_ns])).positions[0].tolist()
    off_m = np.hypot(*np.subtract((x, y), start.position_m[:2]))
    # stamps of the truth that are off by a second move it by the way of that second
    soon = motion.seconds <= motion.seconds[0] + STAMPS_S
    way_m = float(np.abs(motion.path_m[soon] - motion.path_m[0]).max())
    sigma_m = np.hypot(*start.position_sigma_m[:2])
    if off_m <= FARTHEST_M + way_m + ACTING_SIGMAS * sigma_m:
        return None
    return contradiction(
        FROM_TRUTH,
        estimate=Estimate1D(off_m, sigma_m),
        unit="m",
        cause=f"the truth begins {off_m:.2f} m from the start of the calibration: a log that is joined after its beginning, "
        "or another world of the truth?",
        line=f"`start.position_m = {numbers((x, y, start.position_m[2]), 2)}` {IN_CALIBRATION}; where the truth has a world "
        "of its own, as of a motion capture, read the aligned errors",
    )
