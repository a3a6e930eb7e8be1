"""Check of a log's sensors against each other: units, axes, offsets, mountings, scale and noise.

Each step puts right what it finds before the next one compares. The estimators are in
`sonar_graph.navigation.alignment` and `sonar_graph.diagnosis.signals`; here each number is compared with the
calibration and the log configuration of a run, and becomes a line for one of the two. Derivation:
docs/theory/sensor_check.md.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from sonar_graph.calibration import Start
from sonar_graph.devices import is_partial
from sonar_graph.diagnosis.aiding_check import (
    AZIMUTH,
    CHECKS,
    DEPTH,
    HEADING,
    HEADING_TURN,
    MOST_MISFIT,
    OR_DVL,
    OTHER_UNIT,
    POSITIONS,
    RANGE,
    VERTICAL_BIAS,
    Check,
    begins_below_water,
    findings_of,
    fix_height_findings,
    heading_findings,
    position_findings,
    start_depth_findings,
    start_heading_findings,
    vertical_bias,
)
from sonar_graph.diagnosis.axes import (
    AxesMatch,
    is_of_force,
    match_axes,
    turns_less_than_body,
)
from sonar_graph.diagnosis.causes import (
    BEST_NOISE_M_S,
    PITCH,
    pitched_one,
    unlike_pair,
    velocity_steps,
)
from sonar_graph.diagnosis.findings import (
    ACTING_SIGMAS,
    ALSO,
    IN_CALIBRATION,
    IN_LOG_CONFIG,
    NO_NEED,
    Finding,
    Findings,
    Gravity,
    contradiction,
    in_degrees,
    judged,
    known_values,
    matters,
    notes_of,
    numbers,
    scale_line,
    shift_line,
    signed_axes,
    unknown,
    unused,
    with_interval,
    worst_first,
)
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.signals import (
    CLEARLY_BETTER,
    MOST_WILD,
    Match,
    are_wild,
    weighted,
)
from sonar_graph.diagnosis.start import (
    ARM,
    LARGE_TURN_RAD,
    LEAST_BIAS_RAD_S,
    LEAST_HEADING_RAD,
    NO_GRAVITY,
    StartTilt,
    accel_bias_findings,
    acting_bias,
    bias_findings,
    find_start_tilt,
    lacks_gravity,
    lever_findings,
    start_heading_finding,
    tilt_findings,
    turned_mounting,
    with_bias,
    with_fitted,
    without_bias,
)
from sonar_graph.diagnosis.truth_check import (
    map_findings,
    reference_faults,
    start_place_findings,
)
from sonar_graph.diagnosis.turn_rate import scaled_gyros, turn_rate_finding
from sonar_graph.diagnosis.turned_sensor import EITHER, TurnedPair
from sonar_graph.diagnosis.units import (
    DVL_UNIT,
    WRONG_UNIT,
    coarse_findings,
    force_scale,
    wrong_units,
)
from sonar_graph.logs import (
    DRIFTING,
    FELT_ALONG,
    OTHER_WAYS,
    STEPPED_BACK,
    TAKEN_AS_ZERO,
    axis_doubts,
    gravity_warning,
    row_notes,
    stuck_quantities,
)
from sonar_graph.logs.adapters import LogConfig, axes_matrix
from sonar_graph.measurements import NS_PER_S, Dvl, Floats, Imu
from sonar_graph.navigation.alignment import (
    DvlMatch,
    Estimate1D,
    Estimates3D,
    longest_rest,
    match_dvl_to_imu,
    match_reference_to_imu,
    noise_densities,
)
from sonar_graph.sequence import Sequence

YAW = "DVL mounting yaw"
LEVEL_TURNS = ("DVL mounting roll", "DVL mounting pitch")
DVL_SCALE = "DVL scale"
GYRO_SCALE = "`angular_velocity_scale"
TURNED = "velocity changes as the IMU measures, turned by as much"
DVL_AXES = "DVL axes"
WRONG_AXES = "wrong axes"
ANY_AXES = "axes of gyros, accelerometers or Doppler log"
NO_AXES = "no axes of the vehicle"
CONTRADICTED = "they contradict each other"
START_TILT = ("start roll", "start pitch")
DELAYS = (": delay", ": time offset")
"""Ends of quantities of a sensor's stamps against those of another."""
COMPARED = "log.compared"
"""Subject of the note that sensors were compared, or why not."""
LONGEST_S = 600.0
"""Longest part in which Doppler log and accelerometers are compared, in the middle of the log."""
LEAST_OFFSET_S = 0.01
LEAST_YAW_RAD = np.radians(0.25)
LEAST_LEAN_RAD = np.radians(3.0)
"""Roll and pitch of a mounting that is not measured."""
LEAST_SCALE = 0.002
FROM_START = "distance from the start"
"""End of the quantities of sensors that are compared with a stated start."""
LARGE_OFFSET_S = 0.2
"""Beyond it the Doppler log contradicts the accelerometers so much that results are doubtful."""
LARGE_SCALE = 0.05
"""The same for a scale."""
LARGEST_DENSITY_RATIO = 1.5
"""Ratio to the calibration's density, either way, from which on a line is advised."""
LARGEST_RESTING_M_S = 0.1
FROM_DRIVE = "from the turns of the drive"
BIAS_SIGMA_RATIO = 1.4
"""Root mean square of error over sigma of the fitted gyro bias: the fit takes errors of a Doppler log for white."""
CERTAIN_SIGMAS = 4.0
PAIRED_SIGMAS = 2.0
LEAST_TOGETHER_S = 0.1
"""Difference between two delays that counts as none."""
LEAST_SHARE_OF_DELAY = 0.5
MOST_SHARE_OF_DELAY = 1.5
"""Share of a late IMU's delay that depths, sightings and fixes show."""
LEAST_SPEED_SIGMAS = 10.0
"""Level speed over the noise of a good Doppler log, from which on its slow errors are no bias of the gyros."""
UPRIGHT = np.array([0.0, 0.0, 1.0])
Z_NEGATED = np.diag([1.0, 1.0, -1.0])
BACKWARDS = -np.eye(3)
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
Corrected = tuple[Findings, Sequence]
"""Findings, and the sequence with their faults put right."""


def check_sensors(sequence: Sequence, config: LogConfig | None = None) -> Findings:
    """Findings in the order in which to act; wrong units alone, since they spoil the rest.

    Parameters
    ----------
    sequence
        As a run would read it.
    config
        Log configuration of the reading; corrections are added to it.

    Examples
    --------
    >>> from sonar_graph.diagnosis import check_sensors
    >>> from sonar_graph.testing import small_world
    >>> [finding.quantity for finding in check_sensors(small_world()) if finding.acts]
    []
    """
    # matrices are small: threads of BLAS would only wait for each other
    with threadpool_limits(1, user_api="blas"):
        usable = of_usable_velocities(without_stuck(sequence))
        findings = all_findings(usable, config or LogConfig())
    return worst_first([*unplaced_findings(sequence, findings), *findings])


def of_usable_velocities(sequence: Sequence) -> Sequence:
    """The sequence without rows of the Doppler log of too few beams, and with wild rows between their neighbours.

    A wild row stays, since the gyros' turn is taken at its stamp too. Where many are wild, the log is.
    """
    whole = ~is_partial(sequence.dvl.velocity_cov)
    if not whole.any():
        return sequence
    dvl = sequence.dvl.rows(whole)
    is_wild = are_wild(dvl.velocity, BEST_NOISE_M_S)
    if 0.0 < is_wild.mean() <= MOST_WILD:
        usual_ns = dvl.stamps_ns[~is_wild]
        velocity = dvl.velocity.copy()
        for axis in velocity.T:
            axis[is_wild] = np.interp(dvl.stamps_ns[is_wild], usual_ns, axis[~is_wild])
        dvl = replace(dvl, velocity=velocity)
    return replace(sequence, dvl=dvl)


def compared(sequence: Sequence, config: LogConfig | None = None) -> Sequence:
    """The sequence with notes of what its sensors contradict; itself where they were compared before.

    A sequence that was not read from a log gets the notes of `row_notes` too.

    Examples
    --------
    >>> from sonar_graph.diagnosis import compared
    >>> from sonar_graph.testing import small_world
    >>> compared(small_world()).notes["log.compared"]
    'sensors with each other'
    """
    if COMPARED in sequence.notes:
        return sequence
    notes = sequence.notes | {COMPARED: "sensors with each other"}
    if "log.topics" not in notes:
        notes |= row_notes(sequence)
    for subject, text in notes_of(check_sensors(sequence, config)).items():
        of_rows = notes.get(subject)
        notes[subject] = f"{of_rows}; {text}" if of_rows else text
    return replace(sequence, notes=notes)


def trusted(sequence: Sequence) -> Sequence:
    """The sequence with a note that its sensors are as its calibration has them, such as those of a simulator."""
    notes = sequence.notes | {COMPARED: "no: the sensors are as calibrated"}
    return replace(sequence, notes=notes)


def all_findings(sequence: Sequence, config: LogConfig) -> Findings:
    """Each comparison after those whose faults would spoil it, of a sequence without them."""
    check = SensorCheck(sequence, config)
    steps = (
        check.find_spoilt_rows,
        check.find_axes,
        check.find_wrong_sensor,
        check.compare_pair,
        check.compare_others,
    )
    for step in steps:
        if step():
            break
    return check.rows()


@dataclass(eq=False)
class SensorCheck:
    """Findings so far, and the sequence with their faults put right; a step is True where nothing more can be compared."""

    sequence: Sequence
    config: LogConfig
    forces: Findings = field(default_factory=list)
    axes: Findings = field(default_factory=list)
    tilting: Findings = field(default_factory=list)
    """Bias of the accelerometers."""
    of_dvl: Findings = field(default_factory=list)
    lever: Findings = field(default_factory=list)
    bias: Findings = field(default_factory=list)
    by_motion: Findings = field(default_factory=list)
    reference: Findings = field(default_factory=list)
    others: Findings = field(default_factory=list)
    """Map and noise."""
    match: DvlMatch = field(init=False)
    right: Sequence = field(init=False)
    """The sequence as the lines on the Doppler log would make it."""

    def rows(self) -> Findings:
        """All findings in the order in which to act."""
        of_pair = [*self.forces, *self.axes, *self.tilting, *self.of_dvl]
        of_motion = [*self.lever, *self.bias, *self.by_motion]
        return [*of_pair, *of_motion, *self.reference, *self.others]

    def find_spoilt_rows(self) -> bool:
        """Units, stamps, axes and resolutions that spoil every comparison."""
        self.others = wrong_units(self.sequence, self.config)
        if not self.others and (reason := spoilt_by(self.sequence)):
            self.others = [Finding("sensors with each other", unknown(reason))]
        self.others = self.others or coarse_findings(self.sequence)
        return bool(self.others)

    def find_axes(self) -> bool:
        """Scale of the forces, and axes of all three sensors."""
        if lacks_gravity(self.sequence):
            # as if its owner had stated so
            update = {"use_gravity": False}
            calibration = self.sequence.calibration.model_copy(update=update)
            self.sequence = replace(self.sequence, calibration=calibration)
        self.forces, sequence = force_findings(self.sequence, self.config)
        self.axes, self.sequence = tried_axes(sequence, self.config)
        return any(f.estimate.reason == NO_AXES for f in self.axes)

    def put_turn_right(self, quantity: str, axis: int, turn_rad: Floats) -> None:
        """Turn IMU or Doppler log back, by a rotation vector that shows about one axis of the body."""
        pair = TurnedPair(self.sequence, turn_rad)
        angle = in_degrees(self.match.turn[axis])
        self.axes.append(pair.finding(quantity, angle, TURNED))
        self.sequence = pair.corrected()
        self.match = match_of_pair(self.sequence)

    def find_wrong_sensor(self) -> bool:
        """Gyros or velocities that are wrong by themselves, and so no reference for others; late ones are not wrong."""
        self.match = match_of_pair(self.sequence)
        yaw = self.match.turn[2]
        if matters(yaw, LARGE_TURN_RAD):
            self.put_turn_right(YAW, 2, np.array([0.0, 0.0, yaw.value]))
        in_time = self.sequence
        if matters(self.match.offset, LEAST_OFFSET_S):
            in_time = replace(in_time, dvl=shifted(in_time.dvl, self.match.offset))
        alone = (turn_rate_finding(in_time, self.config), velocity_steps(self.sequence))
        self.of_dvl = [finding for finding in alone if finding is not None]
        return bool(self.of_dvl)

    def compare_pair(self) -> bool:
        """IMU and Doppler log with each other."""
        known_rad = known_values(self.match.turn[:2])
        axis = int(np.argmax(np.abs(known_rad)))
        if matters(self.match.turn[axis], LEAST_LEAN_RAD):
            self.put_turn_right(LEVEL_TURNS[axis], axis, np.append(known_rad, 0.0))
        match = self.match
        known = self.sequence.calibration
        self.tilting, calibration = accel_bias_findings(match, known)
        sequence = replace(self.sequence, calibration=calibration)
        self.sequence = sequence
        if match.scale.is_known and any(finding.acts for finding in self.forces):
            # velocities cannot be compared better than the forces' own scale is known
            sigma = np.hypot(match.scale.sigma, self.forces[0].estimate.sigma)
            match = replace(match, scale=replace(match.scale, sigma=sigma))
        self.of_dvl = dvl_findings(match, sequence, self.config)
        self.right = corrected_sequence(sequence, match, self.of_dvl)
        self.lever = lever_findings(match, calibration)
        if any(EITHER in finding.cause for finding in self.axes):
            self.lever = unknown_arm("IMU or Doppler log is turned")
        elif any(f.acts for f in self.of_dvl) and (
            names := brought_apart(sequence, self.right)
        ):
            self.of_dvl = [contradicted(finding, names) for finding in self.of_dvl]
            self.lever = unknown_arm("IMU and Doppler log do not fit")
            self.right = sequence
        is_explained = any(f.acts for f in [*self.axes, *self.tilting, *self.of_dvl])
        if is_explained or not (unlike := unlike_pair(self.right)):
            return False
        self.of_dvl.append(sense_of_pair(self.right) or unlike)
        self.lever = []
        return True

    def compare_others(self) -> bool:
        """Bias of the gyros, and all other sensors with the motion by IMU and Doppler log."""
        tilt = find_start_tilt(self.right)
        self.find_faults_of_reference(tilt)
        right, estimates = self.find_bias(tilt)
        self.by_motion = [
            of_heading_alone(f, right, self.match.turn[2])
            if f.quantity == HEADING_TURN
            else f
            for f in motion_findings(right, self.config, estimates)
        ]
        self.join_vertical_bias()
        self.doubt_arm()
        # sensors that are wrong by others do not fit a right truth either
        if any(f.grave for f in [*self.of_dvl, *self.by_motion]):
            self.reference = []
        self.reference += reference_findings(right, self.config, tilt)
        start = right.calibration.start
        if start.states("rpy_rad"):
            off = tilt.angle(1).minus(start.rpy_rad[1])
            found = pitched_one(self.by_motion, off, right.calibration)
            self.by_motion, is_imu = found
            # a start by a pitched IMU is as wrong as its mounting
            if is_imu:
                self.reference = [
                    f for f in self.reference if not f.quantity.startswith(START_TILT)
                ]
        # sensors that are wrong do not fit a right map either
        if not any(finding.grave for finding in self.by_motion):
            self.others = list(map_findings(right))
        self.others += noise_findings(self.sequence)
        self.explain_delays()
        self.leave_out_consequences()
        return False

    def find_faults_of_reference(self, tilt: StartTilt) -> None:
        """Faults of the truth, which is then compared with nothing else."""
        if self.right.truth is None:
            return
        alone = self.right
        self.right = replace(alone, truth=None)
        unbiased, _ = self.find_bias(tilt)
        as_before = replace(unbiased, truth=alone.truth)
        self.reference = list(reference_faults(as_before, self.config))
        if not any(fault.grave for fault in self.reference):
            self.right = alone

    def find_bias(self, tilt: StartTilt) -> tuple[Sequence, Estimates3D]:
        """Rows on the bias of the gyros; the sequence with the bias that they state, and what is left of it."""
        right = self.right
        driven = driven_bias(self.match, self.sequence)
        estimates, sources = surest_bias(driven, tilt)
        imu = right.calibration.imu
        up = UPRIGHT
        motion = BodyMotion.of(right)
        if motion is not None:
            up = np.median(motion.up, axis=0)
            vertical = vertical_bias(right, motion)
            if vertical is not None:
                allowed = imu.gyro_bias_sigma
                estimates = with_vertical(estimates, vertical.estimate, up, allowed)
        D_heading = up * right.duration_s  # (3,)
        self.bias = bias_findings(estimates, sources, imu, D_heading)
        return without_acting_bias(right, estimates)

    def join_vertical_bias(self) -> None:
        """Keep one row on the bias that is known, and one line for all axes."""
        of_vertical = [f for f in self.by_motion if f.quantity == VERTICAL_BIAS]
        if any(f.estimate.is_known for f in of_vertical):
            self.bias = [f for f in self.bias if f.estimate.is_known or f.acts]
        if any(f.acts for f in of_vertical):
            self.bias = [
                replace(f, cause=ALSO, consequence="", line="") for f in self.bias
            ]

    def doubt_arm(self) -> None:
        """Leave the lever arm open where a pitch or delays look like one."""
        if any(f.acts and f.quantity.endswith(PITCH.name) for f in self.by_motion):
            self.lever = unknown_arm("IMU or Doppler log is pitched")
        # gyros that are late against the forces look like an arm
        angles = (HEADING.name, AZIMUTH.name)
        if any(f.quantity.startswith(angles) for f in acting_delays(self.by_motion)):
            self.lever = unknown_arm("gyros or other sensors are late")

    def explain_delays(self) -> None:
        """Name the sensor whose stamps are wrong, where several look late."""
        found = by_late_imu(self.of_dvl, self.by_motion, self.config)
        self.of_dvl, self.by_motion = found
        of_stamps = acting_delays([self.of_dvl[0], *self.by_motion, *self.reference])
        role = drifting_role(self.sequence)
        if not (role and (of_stamps or self.tilting)):
            return
        cause = f"stamps of [{role}] drift from the times of recording, or jump"
        line = f'`stamp = "log"` under [{role}] {IN_LOG_CONFIG}'
        late = replace(self.of_dvl[0], cause=cause, line=line, gravity=Gravity.GRAVE)
        self.of_dvl[0] = late
        self.lever = unknown_arm("the stamps drift")
        # other sensors look late as well, and forces at other times are a bias
        self.tilting = []
        self.by_motion = [f for f in self.by_motion if not f.quantity.endswith(DELAYS)]
        self.reference = [f for f in self.reference if f not in of_stamps]

    def leave_out_consequences(self) -> None:
        """Leave out rows that follow from others."""
        if any(f.grave and GYRO_SCALE in f.line for f in self.by_motion):
            # neither forces nor velocities fit turns of a wrong scale
            self.tilting = []
            self.of_dvl = [
                f for f in self.of_dvl if f.quantity != DVL_SCALE or not f.acts
            ]
        if any(f.quantity == YAW for f in self.axes):
            self.of_dvl = [f for f in self.of_dvl if f.quantity != YAW or f.acts]


def match_of_pair(sequence: Sequence) -> DvlMatch:
    """Comparison of Doppler log and IMU in the middle of the log."""
    return match_dvl_to_imu(*middle_rows(sequence), sequence.calibration)


def unknown_arm(reason: str) -> Findings:
    """The row of a lever arm that is not known."""
    return [Finding(ARM, unknown(reason), "m")]


def driven_bias(match: DvlMatch, sequence: Sequence) -> Estimates3D:
    """Bias of the gyros by the whole drive."""
    if lacks_gravity(sequence):
        return (unknown(NO_GRAVITY),) * 3
    x, y, z = (
        replace(one, sigma=BIAS_SIGMA_RATIO * one.sigma) for one in match.gyro_bias
    )
    along_xy = sequence.dvl.velocity[:, :2]
    level_speed_m_s = np.sqrt(np.mean(np.sum(along_xy**2, axis=1)))
    if level_speed_m_s < LEAST_SPEED_SIGMAS * BEST_NOISE_M_S:
        z = unknown("too slow for a turn to bend the path")
    return x, y, z


def unplaced_findings(sequence: Sequence, findings: Findings) -> Iterator[Finding]:
    """Mountings that are not known, where sensors contradict each other: they come before all that may follow from them."""
    warnings = sequence.notes.get("log.warnings", "").split("; ")
    roles = [text.partition(":")[0] for text in warnings if TAKEN_AS_ZERO in text]
    if roles and any(finding.grave for finding in findings):
        names = ", ".join(roles)
        cause = f"those of {names} are not in the log and count as zero, which may be all that is wrong"
        line = f"give them {IN_CALIBRATION} first"
        yield contradiction("mountings", cause, line, "not known")


def spoilt_by(sequence: Sequence) -> str:
    """Fault of rows that spoils every comparison, and that is named where rows are checked; empty without one."""
    if STEPPED_BACK in sequence.notes.get("log.doubtful", ""):
        return STEPPED_BACK
    calibration = sequence.calibration
    doubts = axis_doubts(sequence.imu, sequence.dvl, sequence.depth, calibration)
    fault = next(doubts, "")
    if fault or lacks_gravity(sequence):
        return fault
    force = sequence.imu.specific_force
    mounting = calibration.imu.mounting
    gravity = gravity_warning(force, mounting, calibration.gravity_m_s2) or ""
    return gravity if OTHER_WAYS in gravity or FELT_ALONG in gravity else ""


def acting_delays(findings: Iterable[Finding]) -> Findings:
    """Findings to act on about the stamps of a sensor against those of another."""
    return [f for f in findings if f.acts and f.quantity.endswith(DELAYS)]


def drifting_role(sequence: Sequence) -> str:
    """``dvl`` or ``imu``, whichever alone has stamps that drift from the times of recording; else empty."""
    faults = sequence.notes.get("log.stamps", "").split("; ")
    roles = {one.partition(":")[0] for one in faults if DRIFTING in one}
    roles &= {"dvl", "imu"}
    return roles.pop() if len(roles) == 1 else ""


def by_late_imu(
    of_dvl: Findings, by_motion: Findings, config: LogConfig
) -> tuple[Findings, Findings]:
    """Findings of the Doppler log and of others, where all are early against a late IMU with one line for the IMU."""
    late, *others = of_dvl
    offset = late.estimate
    delays = acting_delays(by_motion)
    if not (late.acts and delays):
        return of_dvl, by_motion
    for delay in delays:
        together = delay.estimate.minus(-offset.value)
        is_apart = matters(together, LEAST_TOGETHER_S, offset.sigma)
        # all but headings are compared with a path of the Doppler log, which is in time, along the late turns
        share = -delay.estimate.value / offset.value
        is_between = LEAST_SHARE_OF_DELAY < share < MOST_SHARE_OF_DELAY
        if is_apart and (delay.quantity.startswith(HEADING.name) or not is_between):
            return of_dvl, by_motion
    names = " and ".join(delay.quantity.partition(" against")[0] for delay in delays)
    of_imu = replace(
        late,
        cause=f"{names} differ from the IMU by as much: the IMU's own stamps are wrong",
        line=shift_line("imu", config, -offset.value),
    )
    # the first IMU row is the start, and is stamped late
    left = [f for f in by_motion if not f.quantity.endswith(FROM_START)]
    return [of_imu, *others], [f for f in left if f not in delays]


def middle_rows(sequence: Sequence) -> tuple[Imu, Dvl]:
    """Rows of the middle `LONGEST_S` of a longer log, to which the fit of the Doppler log is limited for its cost."""
    imu = without_bias(sequence.imu, sequence.calibration)
    dvl = sequence.dvl
    first_ns = int(max(imu.stamps_ns[0], dvl.stamps_ns[0]))
    last_ns = int(min(imu.stamps_ns[-1], dvl.stamps_ns[-1]))
    spare_ns = (last_ns - first_ns - round(LONGEST_S * NS_PER_S)) // 2
    if spare_ns <= 0:
        return imu, dvl
    inner = (first_ns + spare_ns, last_ns - spare_ns)
    return imu.between(*inner) or imu, dvl.between(*inner) or dvl


def without_stuck(sequence: Sequence) -> Sequence:
    """Sequence without rows of IMU and Doppler log that are stuck, which its reading names: no reference for others."""
    imu = sequence.imu
    dvl = sequence.dvl
    if sequence.calibration.odometry_interpolation != "linear":
        return sequence  # wheels turn evenly
    stuck = stuck_quantities(imu, dvl)
    of_imu = np.flatnonzero(~(stuck["angular rate"] | stuck["specific force"]))
    of_dvl = np.flatnonzero(~stuck["velocity"])
    if len(of_imu) < 2 or len(of_dvl) < 2:
        return sequence
    return replace(sequence, imu=imu.rows(of_imu), dvl=dvl.rows(of_dvl))


def force_findings(sequence: Sequence, config: LogConfig) -> Corrected:
    """Scale of the accelerometers by gravity, and the sequence with the scale put right."""
    found = force_scale(sequence, config)
    if found is not None and found.acts:
        imu = sequence.imu
        force = imu.specific_force / found.estimate.value
        sequence = replace(sequence, imu=replace(imu, specific_force=force))
    return [found] if found else [], sequence


def tried_axes(sequence: Sequence, config: LogConfig) -> Corrected:
    """Findings about axes as of `axes_findings`; without a line where other sensors fit them worse."""
    findings, right = axes_findings(sequence, config)
    if right is not sequence and (names := brought_apart(sequence, right)):
        cause = f"{CONTRADICTED}, and with axes that fit them better {names} fits worse"
        return [no_axes_finding(ANY_AXES, cause)], sequence
    return findings, right


def no_axes_finding(quantity: str, cause: str) -> Finding:
    """Gyros, accelerometers and Doppler log that no axes bring together."""
    line = f"name a `topic` under [dvl] or [imu] with values in axes of the vehicle or of the sensor {IN_LOG_CONFIG}"
    return contradiction(quantity, cause, line, NO_AXES)


def axes_findings(sequence: Sequence, config: LogConfig) -> Corrected:
    """Findings about axes and signs of gyros and Doppler log, and the sequence with the axes put right."""
    calibration = sequence.calibration
    force = sequence.imu.specific_force
    # the accelerometers' own axes come first
    if gravity_warning(force, calibration.imu.mounting, calibration.gravity_m_s2):
        return [], sequence
    found = match_axes(sequence.imu, sequence.dvl, calibration)
    ratio = turns_less_than_body(sequence.imu, sequence.dvl, calibration)
    # with gyros of wrong axes no velocities of the body fit
    if ratio is not None and (
        found is None or found.ratio < ratio or (found.gyro == np.eye(3)).all()
    ):
        cause = f"velocities change, {ratio:.2g} times closer, as in axes of the world, and do not turn with the vehicle"
        return [no_axes_finding(DVL_AXES, cause)], sequence
    # steps of a velocity fit no axes, and have a finding of their own
    if found is None or (found.is_mixed and velocity_steps(sequence) is not None):
        return [], sequence
    if found.is_mixed:
        cause = (
            f"velocities change as the IMU measures, {found.ratio:.2g} times closer, "
            "with axes that are no rotation: along beams, or of wrong scale"
        )
        return [no_axes_finding(DVL_AXES, cause)], sequence
    if found.scale != 1.0:
        return scaled_dvl(found, sequence, config)
    is_gyro = (found.gyro != np.eye(3)).any()
    is_dvl = (found.dvl != np.eye(3)).any()
    if (is_gyro or is_dvl) and found.ratio < CLEARLY_BETTER:
        cause = f"{CONTRADICTED}, and no axes fit clearly better"
        return [no_axes_finding(ANY_AXES, cause)], sequence
    # gravity is felt upwards: of the accelerometers only level axes can be wrong
    is_level = found.dvl[2, 2] == 1.0
    if is_dvl and is_level and is_of_force(found.gyro, found.dvl):
        return force_axes(found, sequence, config)
    findings = Findings()
    if is_gyro:
        names = ", ".join(signed_axes(found.gyro))
        cause = (
            f"gravity and velocity change, {found.ratio:.2g} times closer, as gyro rates about the axes ({names}) would "
            "have it"
        )
        findings.append(gyro_axes_finding(found.gyro, cause, sequence, config))
        sequence = scaled_gyros(sequence, found.gyro)
    # of a permutation the angle of a turn about the vertical is exact
    yaw_rad = float(np.arctan2(found.dvl[1, 0], found.dvl[0, 0]))
    if is_level and yaw_rad and np.linalg.det(found.dvl) > 0:
        pair = TurnedPair(sequence, np.array([0.0, 0.0, yaw_rad]))
        cause = axes_cause(found)
        findings.append(pair.finding(DVL_AXES, unknown(WRONG_AXES), cause))
        sequence = pair.corrected()
    elif is_dvl:
        axes = found.dvl if found.is_vertical_sure else upright(found.dvl, sequence)
        cause = axes_cause(replace(found, dvl=axes))
        findings.append(dvl_axes_finding(axes, cause, sequence))
        sequence = turned_dvl(sequence, axes)
    return findings, sequence


def scaled_dvl(found: AxesMatch, sequence: Sequence, config: LogConfig) -> Corrected:
    """Another unit of the velocities, and the sequence with it put right."""
    times = 1 / found.scale
    cause = f"velocities change {times:.3g} times as much as the IMU measures"
    line = scale_line("dvl", "scale", config, times)
    finding = contradiction(DVL_UNIT, cause, line, WRONG_UNIT)
    dvl = sequence.dvl
    scaled = replace(dvl, velocity=found.scale * dvl.velocity)
    return [finding], replace(sequence, dvl=scaled)


def force_axes(found: AxesMatch, sequence: Sequence, config: LogConfig) -> Corrected:
    """Axes of the accelerometers that differ from those of gyros and Doppler log, and the sequence with them put right."""
    R = sequence.calibration.imu.mounting.rotation_matrix()
    turn = R.T @ found.dvl.T @ R
    table = config.table("imu")
    before = axes_matrix(table.get("rotation", "flu"))
    of_rates = axes_matrix(table.get("angular_velocity_axes", ("x", "y", "z")))
    rotation = turn @ before
    # rates stay as they are
    rate_axes = of_rates @ before @ rotation.T
    lines = [
        ", ".join(f'"{name}"' for name in signed_axes(np.round(axes)))
        for axes in (rotation, rate_axes)
    ]
    finding = contradiction(
        "accelerometer axes",
        estimate=WRONG_AXES,
        cause=f"forces change as gyros and Doppler log have it, {found.ratio:.2g} times closer, about the axes "
        f"({', '.join(signed_axes(found.dvl.T))})",
        line=f"`rotation = [{lines[0]}]` and `angular_velocity_axes = [{lines[1]}]` under [imu] {IN_LOG_CONFIG}",
    )
    imu = sequence.imu
    force = imu.specific_force @ turn.T
    return [finding], replace(sequence, imu=replace(imu, specific_force=force))


def gyro_axes_finding(
    axes: Floats, cause: str, sequence: Sequence, config: LogConfig
) -> Finding:
    """Axes of the gyros that differ from those of the accelerometers: the driver has them wrong."""
    body_R_imu = sequence.calibration.imu.mounting.rotation_matrix()
    # the line replaces that of the configuration
    given = config.table("imu").get("angular_velocity_axes", ("x", "y", "z"))
    driver = body_R_imu.T @ axes @ body_R_imu @ axes_matrix(given)
    names = ", ".join(f'"{name}"' for name in signed_axes(np.round(driver)))
    return contradiction(
        "gyro axes",
        f"{cause}, and the accelerometers have the right ones",
        f"`angular_velocity_axes = [{names}]` under [imu] {IN_LOG_CONFIG}",
        WRONG_AXES,
    )


def upright(axes: Floats, sequence: Sequence) -> Floats:
    """Axes of the Doppler log with the sign of the vertical one by the depth, which accelerations left open."""
    if np.linalg.det(axes) > 0:
        return axes
    turned = turned_dvl(sequence, axes)
    motion = BodyMotion.of(turned)
    depth = None if motion is None else DEPTH.compare(turned, motion)
    is_opposite = depth is not None and is_surely_negative(depth)
    return np.asarray(Z_NEGATED @ axes if is_opposite else axes)


def is_surely_negative(found: Match) -> bool:
    """True where the reference runs against the sensor."""
    gain = found.gain
    return gain.is_known and gain.value + CERTAIN_SIGMAS * gain.sigma < 0


def dvl_axes_finding(axes: Floats, cause: str, sequence: Sequence) -> Finding:
    """Axes of the Doppler log, as a mounting where they are turned, as a driver's where they are mirrored.

    Gravity shows that the IMU is upright: a turn about another axis than the vertical is that of the Doppler log.
    """
    body_R_dvl = sequence.calibration.dvl.mounting.rotation_matrix()
    if np.linalg.det(axes) > 0:
        rpy = gtsam.Rot3(axes @ body_R_dvl).rpy()
        cause += (
            ": the Doppler log is turned on the vehicle, or the driver has other axes"
        )
        line = f"`dvl.mounting.rpy_rad = {numbers(rpy, 4)}` {IN_CALIBRATION}"
    else:
        driver = np.round(body_R_dvl.T @ axes @ body_R_dvl)
        names = ", ".join(f'"{name}"' for name in signed_axes(driver))
        cause += ": mirrored, the driver gives an axis the wrong sign"
        line = f"`rotation = [{names}]` under [dvl] {IN_LOG_CONFIG}, after which the mounting counts"
    return contradiction(DVL_AXES, cause, line, WRONG_AXES)


def axes_cause(found: AxesMatch) -> str:
    """How much better the axes of the Doppler log fit the IMU."""
    about = f"the axes ({', '.join(signed_axes(found.dvl))})"
    if np.abs(found.dvl).max(axis=1).min() < 1.0:
        about = "turned axes"
    return f"velocity changes as the IMU measures, {found.ratio:.2g} times closer, about {about}"


def turned_dvl(sequence: Sequence, axes: Floats) -> Sequence:
    """Sequence with velocities along other axes of the body."""
    R = sequence.calibration.dvl.mounting.rotation_matrix()
    turn = R.T @ axes @ R
    dvl = sequence.dvl
    cov = turn @ dvl.velocity_cov @ turn.T
    turned = replace(dvl, velocity=dvl.velocity @ turn.T, velocity_cov=cov)
    return replace(sequence, dvl=turned)


def motion_findings(
    right: Sequence, config: LogConfig, bias: Estimates3D | None = None
) -> Findings:
    """Depth, heading, fixes and sightings against the motion of the body, and the gyros' bias about the vertical."""
    motion = BodyMotion.of(right)
    if motion is None:
        return []
    matches = {check: check.compare(right, motion) for check in CHECKS}
    against_gyros = names_of_opposite(matches, (HEADING, POSITIONS, AZIMUTH))
    found = Findings()
    # one of them may be mirrored; of two, the gyros or the Doppler log are
    rightly_turned = right
    if backwards := reversed_dvl(right, matches):
        of_dvl, axes = backwards
        found.append(of_dvl)
        rightly_turned = turned_dvl(right, axes)
    elif len(against_gyros) > 1:
        cause = f"{' and '.join(against_gyros)} turn as gyro rates about the axes (x, y, -z) would have it"
        found.append(gyro_axes_finding(Z_NEGATED, cause, right, config))
        rightly_turned = scaled_gyros(right, Z_NEGATED)
    scaled, apart = with_scale_of_heading(rightly_turned, matches[HEADING])
    if rightly_turned is right and scaled is not right:
        found += heading_findings(matches[HEADING], right, config, motion)
        rightly_turned = scaled
    if rightly_turned is not right:
        right = rightly_turned
        motion = BodyMotion.of(right)
        assert motion is not None
        matches = {check: check.compare(right, motion) for check in CHECKS}
    found += start_depth_findings(right)
    # without gravity the tilt of the vehicle is unknown; vehicles on wheels stay level
    is_rolling = right.calibration.odometry_interpolation != "linear"
    has_up = is_rolling or motion.felt is not None
    for check in (DEPTH, RANGE, AZIMUTH):
        match = matches[check]
        # the place of a landmark depends on its range
        is_range_wrong = check is AZIMUTH and any(
            f.grave and f.quantity.startswith(RANGE.name) for f in found
        )
        if match is not None and not is_range_wrong:
            match = match if has_up else Match.unknown(NO_GRAVITY)
            found += findings_of(check, match, right, config)
    named = {f.quantity for f in found}
    of_heading = [
        judged_scale(f, apart)
        for f in heading_findings(matches[HEADING], right, config, motion)
        if f.quantity not in named
    ]
    is_turn_wrong = any(f.quantity == HEADING.quantity and f.acts for f in of_heading)
    vertical = vertical_bias(right, motion, bias)
    if vertical is not None and not is_turn_wrong:
        found.append(vertical)
    found += of_heading
    # positions, where there are any, give the angle itself
    if not any(f.acts for f in of_heading):
        found += start_heading_findings(right, motion)
    of_fixes = list(position_findings(matches[POSITIONS], right, config, motion))
    found += of_fixes
    # a wrong unit of either, or scale of the fixes, makes another height too
    if not any(f.grave or (f.acts and f in of_fixes) for f in found):
        found += fix_height_findings(right, config)
    # sensors that are wrong lead elsewhere too
    if not any(f.grave for f in found):
        found += start_place_findings(right, motion)
    return found


def reversed_dvl(
    right: Sequence, matches: Mapping[Check, Match | None]
) -> tuple[Finding, Floats] | None:
    """A Doppler log against which depth and ranges run, or depths that are right, and its axes; None where it is right."""
    against = names_of_opposite(matches, (DEPTH, RANGE))
    is_z = against == [DEPTH.name] and begins_below_water(right)
    if not is_z and len(against) < 2:
        return None
    axes = Z_NEGATED if is_z else BACKWARDS
    names = ", ".join(signed_axes(axes))
    cause = f"changes of {' and '.join(against)} are as velocities about the axes ({names}) would have them"
    return dvl_axes_finding(axes, cause, right), axes


def sense_of_pair(right: Sequence) -> Finding | None:
    """Axes of a Doppler log that accelerometers and depths contradict, with which it fits both; None without such axes."""
    motion = BodyMotion.of(right)
    if motion is None:
        return None
    of_depth = {DEPTH: DEPTH.compare(right, motion)}
    if not names_of_opposite(of_depth, (DEPTH,)):
        return None
    fits = [
        axes
        for axes in (UPSIDE_DOWN, Z_NEGATED)
        if unlike_pair(turned_dvl(right, axes)) is None
    ]
    if not fits:
        return None
    names = " or ".join(f"({', '.join(signed_axes(axes))})" for axes in fits)
    cause = f"changes of depth and accelerations are as velocities about the axes {names} would have them"
    found = [dvl_axes_finding(axes, cause, right) for axes in fits]
    return replace(found[0], line="; or ".join(one.line for one in found))


def of_heading_alone(found: Finding, right: Sequence, dvl_yaw: Estimate1D) -> Finding:
    """The turn of the heading, without the line for the Doppler log where other sensors show that it is not turned.

    ``dvl_yaw``: by the accelerometers, rad.
    """
    if not found.acts:
        return found
    turn_rad = np.radians(found.estimate.value)
    sigma_rad = np.hypot(dvl_yaw.sigma, np.radians(found.estimate.sigma))
    fits = "the accelerometers"
    if not dvl_yaw.is_known or abs(turn_rad) < ACTING_SIGMAS * sigma_rad:
        pair = TurnedPair(right, np.array([0.0, 0.0, turn_rad]))
        fits = brought_apart(right, pair.as_if("dvl"))
    if not fits:
        return found
    of_heading, _, _ = found.line.partition(OR_DVL)
    cause = f"{found.cause.replace('either its', 'its')}; the Doppler log as it is fits {fits} better"
    return replace(found, cause=cause, line=of_heading)


def names_of_opposite(
    matches: Mapping[Check, Match | None], checks: Iterable[Check]
) -> list[str]:
    """Names of sensors that are mirrored, or run against their reference."""
    return [
        check.name
        for check in checks
        if (match := matches[check]) is not None
        and (match.is_mirrored or is_surely_negative(match))
    ]


def with_scale_of_heading(
    right: Sequence, of_heading: Match | None
) -> tuple[Sequence, str]:
    """The sequence with gyros scaled as the heading has it, where others bear that out, and the sensors that contradict it.

    Azimuths or fixes must agree with such gyros better, and no sensor less.
    """
    if of_heading is None or of_heading.misfit >= MOST_MISFIT:
        return right, ""
    gain = of_heading.gain
    is_off = matters(gain.minus(1.0), HEADING.least_scale)
    if not (is_off and 1 / OTHER_UNIT < gain.value < OTHER_UNIT):
        return right, ""
    scaled = scaled_gyros(right, gain.value * np.eye(3))
    apart = brought_apart(right, scaled)
    nearer = brought_apart(scaled, right)
    is_shared = AZIMUTH.name in nearer or POSITIONS.name in nearer
    return (scaled if is_shared and not apart else right), apart


def judged_scale(finding: Finding, apart: str) -> Finding:
    """The row of the heading's scale, which is its own where other sensors agree with the gyros as they are."""
    if not (apart and finding.acts and finding.quantity == HEADING.quantity):
        return finding
    cause = f"the gyros fit {apart} as they are: the heading has a wrong scale, or deviates with its direction"
    return replace(finding, cause=cause, line=unused(HEADING.role))


def dvl_findings(found: DvlMatch, sequence: Sequence, config: LogConfig) -> Findings:
    """Time offset, mounting yaw and scale of the DVL."""
    offset = with_instant(found.offset, sequence.imu)
    late = offset_row("DVL against IMU", offset, "dvl", config)
    yaw = found.turn[2]
    turn_rad = (0.0, 0.0, yaw.value if yaw.is_known else 0.0)
    rpy = turned_mounting(sequence.calibration.dvl.mounting, turn_rad)
    line = f"`dvl.mounting.rpy_rad = {numbers(rpy, 4)}` {IN_CALIBRATION}"
    cause = "turn the DVL's mounting"
    turned = Finding(YAW, in_degrees(yaw), "°", cause, line=line)
    line = scale_line("dvl", "scale", config, 1.0 / found.scale.value)
    cause = "scale the DVL's velocities"
    scaled = Finding(DVL_SCALE, found.scale, cause=cause, line=line)
    return [
        judged(late, offset, LEAST_OFFSET_S, large=LARGE_OFFSET_S),
        judged(turned, yaw, LEAST_YAW_RAD, large=LARGE_TURN_RAD),
        judged(scaled, found.scale.minus(1.0), LEAST_SCALE, large=LARGE_SCALE),
    ]


def brought_apart(before: Sequence, after: Sequence) -> str:
    """Names of sensors that agree with the motion less after a correction than before it; empty without any."""
    first = BodyMotion.of(before)
    second = BodyMotion.of(after)
    if first is None or second is None:
        return ""
    names = list[str]()
    for check in CHECKS:
        agreed = check.compare(before, first)
        agrees = check.compare(after, second)
        if agreed is None or agrees is None or not agrees.gain.is_known:
            continue
        off = agrees.gain.minus(1.0)
        error = abs(off.value) - abs(agreed.gain.value - 1.0)
        # the same rows twice, whose noise is common to both; a gain that would be right in itself decides nothing
        is_worse = error > PAIRED_SIGMAS * off.sigma and matters(off, check.least_scale)
        if is_worse or agrees.scatter > CLEARLY_BETTER * agreed.scatter:
            names.append(check.name)
    return " and ".join(names)


def contradicted(finding: Finding, names: str) -> Finding:
    """A correction of the Doppler log that other sensors contradict."""
    if not finding.acts:
        return finding
    return replace(
        finding,
        cause=f"accelerometers and gyros have it so, but the Doppler log as it is fits {names} better: gyros, "
        "accelerometers or single axes of the Doppler log are wrong",
        line="",
    )


def offset_row(name: str, offset: Estimate1D, role: str, config: LogConfig) -> Finding:
    """Row for a time offset of the stamps of a role."""
    line = shift_line(role, config, offset.value)
    quantity = f"{name}: time offset"
    return Finding(quantity, offset, "s", "shift its stamps", line=line)


def with_instant(offset: Estimate1D, imu: Imu) -> Estimate1D:
    """The offset with the uncertainty of the instant that an IMU sample stands for, uniform over an interval."""
    if len(imu) < 2:
        return offset
    interval_s = float(np.median(np.diff(imu.stamps_ns))) / NS_PER_S
    sigma = np.hypot(offset.sigma, interval_s / np.sqrt(12))
    return replace(offset, sigma=sigma)


def shifted(dvl: Dvl, offset: Estimate1D) -> Dvl:
    """The Doppler log with an offset added to its stamps, s."""
    shift_ns = round(offset.value * NS_PER_S)
    return replace(dvl, stamps_ns=dvl.stamps_ns + shift_ns)


def corrected_sequence(
    sequence: Sequence, match: DvlMatch, of_dvl: Findings
) -> Sequence:
    """Sequence with the advised changes: stamps, yaw and scale of the DVL, lever arm, sigma of the gyro bias."""
    is_late, is_turned, is_scaled = (finding.acts for finding in of_dvl)
    dvl = shifted(sequence.dvl, match.offset) if is_late else sequence.dvl
    if is_scaled:
        dvl = replace(dvl, velocity=dvl.velocity * match.scale.value)
    calibration = with_fitted(match, sequence.calibration)
    right = replace(sequence, dvl=dvl, calibration=calibration)
    turn_rad = np.array([0.0, 0.0, match.turn[2].value])
    return TurnedPair(right, turn_rad).as_if("dvl") if is_turned else right


def surest_bias(
    of_drive: Estimates3D, tilt: StartTilt
) -> tuple[Estimates3D, tuple[str, ...]]:
    """Gyro bias of the whole drive or of a rest, whichever is more certain on each axis, and its source."""
    still = tilt.gyro_bias() or of_drive
    found = list[tuple[Estimate1D, str]]()
    for at_rest, driven in zip(still, of_drive, strict=True):
        pair = [(driven, FROM_DRIVE), (at_rest, tilt.said)]
        if tilt.is_rest and (not driven.is_known or at_rest.sigma < driven.sigma):
            pair.reverse()
        (bias, source), (rival, of_rival) = pair
        apart = bias.minus(rival.value)
        # a bias that changed is one row with both numbers
        if rival.is_known and matters(apart, LEAST_BIAS_RAD_S, rival.sigma):
            source += f" ({of_rival} {with_interval(rival, 'rad/s')})"
        found.append((bias, source))
    biases, sources = zip(*found, strict=True)
    return biases, sources


def with_vertical(
    bias: Estimates3D, vertical: Estimate1D, up: Floats, allowed: float
) -> Estimates3D:
    """Biases with the weighted mean of both estimates about the vertical.

    Where these contradict each other they stay as they are, unless only the heading shows a bias that the calibration's
    sigma, ``allowed``, has: in a steady circle velocities and forces hardly show one.
    """
    if not vertical.is_known or not all(one.is_known for one in bias):
        return bias
    axis = int(np.argmax(np.abs(up)))
    before = bias[axis]
    beside = sum(one.value * up[k] for k, one in enumerate(bias) if k != axis)
    by_heading = (vertical.value - beside) / up[axis]
    apart = replace(vertical, value=by_heading - before.value)
    both = weighted([(before.value, before.sigma), (by_heading, vertical.sigma)])
    if matters(apart, LEAST_BIAS_RAD_S, before.sigma):
        both = replace(vertical, value=by_heading)
        if matters(both, LEAST_BIAS_RAD_S, allowed):
            return bias
    return tuple(both if k == axis else one for k, one in enumerate(bias))


def without_acting_bias(
    sequence: Sequence, bias: Estimates3D
) -> tuple[Sequence, Estimates3D]:
    """The sequence with the bias that its line states, and what is left of the bias."""
    imu = sequence.calibration.imu
    acting = [one.value for one in acting_bias(bias, imu)]
    left = tuple(map(Estimate1D.minus, bias, acting))
    update = {"imu": with_bias(bias, imu)}
    calibration = sequence.calibration.model_copy(update=update)
    return replace(sequence, calibration=calibration), left


def reference_findings(
    right: Sequence, config: LogConfig, tilt: StartTilt
) -> Iterator[Finding]:
    """Time offset and first headings of the reference, and the start; its line has the heading of the reference."""
    start = right.calibration.start
    reference = right.true_poses
    if reference is None:
        yield from tilt_findings(tilt, right.calibration, start.rpy_rad[2])
        return
    found = match_reference_to_imu(right.imu, reference, right.calibration)
    offset = with_instant(found.offset, right.imu)
    late = offset_row("reference against IMU", offset, "truth", config)
    yield judged(late, offset, LEAST_OFFSET_S)
    error = found.start_heading
    cause = "the reference begins with a wrong heading: leave its beginning out with `--start`"
    quantity = "first headings of the reference: error"
    jump = Finding(quantity, in_degrees(error), "°", cause)
    yield judged(jump, error, LEAST_HEADING_RAD)
    of_heading = Findings()
    yaw_rad = start.rpy_rad[2]
    # a start that is found in the map, or that defines the world, has no heading that could be wrong
    if offset.is_known and start != Start() and start.source not in ("map", "vehicle"):
        heading, true_yaw_rad = start_heading_finding(right, reference, offset, tilt)
        of_heading.append(heading)
        # rows on the start must not contradict each other
        if heading.acts:
            yaw_rad = true_yaw_rad
    yield from tilt_findings(tilt, right.calibration, yaw_rad)
    yield from of_heading


FEWEST_STATED = 20
LARGEST_STATED = 20.0
"""Stated sigma of velocities over their scatter from row to row, from which on it is in another unit."""
SECOND_DIFFERENCE = np.sqrt(6.0)
"""Sigma of ``v[k] - 2 v[k + 1] + v[k + 2]`` over that of v."""


def stated_noise(dvl: Dvl) -> Iterator[Finding]:
    """Stated sigma of velocities that exceeds their scatter and their size; nothing where it does not, or none is stated."""
    variances = np.einsum("nii->ni", dvl.velocity_cov)
    stated = np.isfinite(variances).all(axis=1)
    if np.count_nonzero(stated) < FEWEST_STATED:
        return
    velocity = dvl.velocity[stated]
    sigma_m_s = np.sqrt(np.median(variances[stated]))
    bent = np.abs(velocity[2:] - 2.0 * velocity[1:-1] + velocity[:-2])
    # a median: steps and spikes are not noise
    scatter_m_s = float(np.median(bent)) / (0.6745 * SECOND_DIFFERENCE)
    size_m_s = np.sqrt(np.mean(np.sum(velocity**2, axis=1)))
    if sigma_m_s <= max(LARGEST_STATED * scatter_m_s, size_m_s):
        return
    yield contradiction(
        "DVL noise: stated sigma",
        f"{sigma_m_s:.2g} m/s, while successive velocities of {size_m_s:.2g} m/s scatter by {scatter_m_s:.2g} m/s: mm/s "
        "instead of m/s?",
        f"`covariance = false` under [dvl] {IN_LOG_CONFIG} uses `dvl.velocity_sigma_m_s` of the calibration",
        "too large",
    )


def noise_findings(sequence: Sequence) -> Iterator[Finding]:
    """Noise densities of gyro and accelerometer, where the DVL confirms the rest: a steady drive can be as quiet."""
    yield from stated_noise(sequence.dvl)
    found = noise_densities(sequence.imu)
    imu = sequence.calibration.imu
    speed = resting_speed(sequence)
    steady = f"{found.still_s:.0f} s are steady, but at {speed:.1f} m/s"
    rows = (
        ("gyro", found.gyro, imu.gyro_noise_density, "rad/s/√Hz"),
        ("accelerometer", found.accel, imu.accel_noise_density, "m/s²/√Hz"),
    )
    for sensor, estimate, given, unit in rows:
        if estimate.is_known and speed > LARGEST_RESTING_M_S:
            estimate = replace(estimate, reason=steady)
        rest = f"from {found.still_s:.0f} s of rest"
        fits = f"{rest}; the calibration's {given:.2g} fits, {NO_NEED}"
        row = Finding(f"{sensor} noise density", estimate, unit, fits)
        is_near = (
            given / LARGEST_DENSITY_RATIO
            <= estimate.value
            <= given * LARGEST_DENSITY_RATIO
        )
        if not is_near and matters(estimate.minus(given), 0.0):
            key = sensor.removesuffix("erometer")
            line = f"`imu.{key}_noise_density = {estimate.value:.2g}` {IN_CALIBRATION}"
            cause = f"{rest}, not the calibration's {given:.2g}"
            row = replace(row, cause=cause, line=line, gravity=Gravity.ACT)
        yield row


def resting_speed(sequence: Sequence) -> float:
    """Median speed by the Doppler log during the IMU's longest rest, m/s."""
    stamps_ns = sequence.imu.stamps_ns[longest_rest(sequence.imu)]
    if not len(stamps_ns):
        return 0.0
    during = sequence.dvl.between(int(stamps_ns[0]), int(stamps_ns[-1]))
    if during is None:
        return 0.0
    return float(np.median(np.linalg.norm(during.velocity, axis=1)))
