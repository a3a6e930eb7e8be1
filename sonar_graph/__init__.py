"""Landmark SLAM for underwater vehicles: iSAM2 and EKF-SLAM on the same sonar, IMU and Doppler log.

From a log to a report::

    import sonar_graph as sg

    sequence = sg.read_log("dive.mcap")  # IMU, DVL, depth, heading, fixes, detections, truth: those there are
    sequence = sg.recognise("dive.mcap")  # or: with landmarks recognised in its sonar images
    result = sg.run_estimator(sequence, "isam2")  # one estimator
    comparison = sg.compare(sequence, ["isam2", "ekf-slam", MyFilter])  # several, and your own class
    sg.write_report(comparison, "comparison")  # page, numbers, trajectories, log for viewers

The rooms: `sonar_graph.navigation` (motion from IMU and DVL), `sonar_graph.slam` (models, factors, iSAM2),
`sonar_graph.sonar` (recognition in images), `sonar_graph.simulation`, `sonar_graph.evaluation` (scores),
`sonar_graph.testing` (checks for your own estimators and factors). Filters: `baselines.ekf_slam`,
`baselines.invariant_ekf`, `baselines.dead_reckoning`.

Names
-----
Read and write
    ``read_log``            measurements of an MCAP log, as a `Sequence`
    ``recognise``           the same, with landmarks recognised in the sonar images of the log
    ``inspect_log``         contents of a log, and what is wrong with it
    ``write_log``           a sequence as an MCAP log
    ``simulate_basin``      a simulated run in a basin with four landmarks
    ``TimeWindow``          part of a log to read
    ``LogConfig``           topics and fields of a log that are not found by themselves
Run and compare
    ``run_estimator``       one estimator on a sequence, as a `RunResult`
    ``compare``             several estimators on a sequence, as a `Comparison` with scores
    ``write_report``        page, numbers, trajectories and a log for viewers of a comparison
    ``run_suite``           many runs from a file, and their tables
    ``RunResult``           estimates, map, outcomes and times of one run
    ``Comparison``          runs on one sequence, their scores and errors against the truth
Measurements
    ``Sequence``            a run: calibration, measurements, truth
    ``Calibration``         noise, mountings, start and floor
    ``Measurements``        measurements of one step, as an estimator receives them
    ``Imu``                 rows of angular velocity and specific force
    ``Dvl``                 rows of velocity from the Doppler log
    ``Depth``               rows of height
    ``Heading``             rows of yaw
    ``PositionFixes``       rows of position
    ``LandmarkDetections``  rows of range, azimuth and identity posterior
    ``SonarFrames``         sonar images
An estimator of your own
    ``Estimator``           the contract: five methods
    ``Section``             base class of settings
    ``Odometry``            motion between two instants from IMU and Doppler log, with covariance
    ``Estimate``            pose and covariance at one instant
    ``Trajectory``          poses over time
    ``LandmarkMap``         positions of landmarks
    ``DetectionLog``        outcomes of detections
    ``CausalEstimates``     collects estimates, and gives them as a trajectory
    ``DetectionJournal``    collects outcomes of detections, and gives them as a log
    ``Outcome``             outcome of one detection, such as ``Outcome.USED``
    ``load_estimator``      class of an installed estimator

Conventions
-----------
Every docstring in this package uses these frames, names and units without repeating them.

Frames (REP-103)
    ``world``  local, z up, x and y horizontal. The data set or the start pose sets its origin.
    ``body``   fixed to the vehicle: x forward, y left, z up.
    ``imu``, ``dvl``  the sensors' own axes, x forward, y left, z up unless their mounting says otherwise.
    ``sonar``  x along the centre beam; azimuth positive to the left, elevation positive up.

Names
    ``world_T_body``   the pose of the body in the world: ``p_world = world_T_body @ p_body``; frames cancel by eye.
    ``world_R_body``   its rotation.
    ``*_m``, ``*_rad``, ``*_ns``  units, wherever they could be mistaken.
    ``*_sigma``        a standard deviation; ``*_cov`` a covariance; never one in the name of the other.
    ``*_density``      root spectral density of white noise: the sigma of its integral over T is ``density * sqrt(T)``.

Units
    Metres, radians, seconds, m/s, rad/s, m/s². Time stamps are integer nanoseconds of the sensor's own clock;
    floating-point seconds are used for differences only.

Tangent space
    Poses are perturbed on the right, in the body frame, rotation before translation (GTSAM's order):
    ``world_T_body = mean @ Exp([theta, rho])``, ``theta`` in radians, ``rho`` in metres.
    A pose covariance is the 6 × 6 covariance of ``[theta, rho]``.

Azimuth and range
    For a point ``q`` in the sonar frame: ``range = |q|`` and ``azimuth = atan2(q_y, q_x)``.
    Elevation is not measured; it is known only to lie within the sonar's aperture.

Glossary
--------
block           rows of one sensor as columns with a stamp each; n >= 1
bottom lock     state in which a DVL measures velocity over the bottom
candidate       region of one sonar frame that stands out of its background
causal          known at an instant from what was measured until then; *smoothed*: known at the end
design          shape, size and brightness of an artificial landmark
detection       range, azimuth and identity posterior of a landmark in one sonar frame
DVL             Doppler velocity log
DVL gap         time without bottom lock, bridged by accelerometers or a random walk
epoch           stamp of a DVL row at which motions begin and end
fix             position of an antenna or transponder, from satellites or acoustics (USBL)
gate            threshold on the squared Mahalanobis distance of an innovation
heading         yaw of the body, measured by a compass, an attitude reference (AHRS) or a gyrocompass
identity        number of a landmark; the recogniser gives a posterior over identities
IMU hole        time without IMU rows
innovation      measured minus predicted
keyframe        pose in the graph
lever arm       translation of a mounting, in the body frame
NEES, NIS       normalised squared error of a state, of an innovation; 1 per degree of freedom if consistent
preintegration  motion between two instants with covariance and bias derivatives, independent of the start state
sequence        a run: calibration, measurements, truth
sighting        a detection tied to a keyframe, and the factors made of it
suite, batch    file that says which runs are wanted; the runs and their table
track           succession of detections of one object
window          part of the graph that is still optimised
"""

import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from sonar_graph.version import __version__ as __version__

if TYPE_CHECKING:
    from sonar_graph.batch import run_suite
    from sonar_graph.calibration import Calibration, Section
    from sonar_graph.estimator import Estimator, load_estimator
    from sonar_graph.evaluation import Comparison, RunResult, compare, run_estimator
    from sonar_graph.logs import inspect_log, read_log, write_log
    from sonar_graph.logs.adapters import LogConfig
    from sonar_graph.logs.mcap import TimeWindow
    from sonar_graph.images import SonarFrames
    from sonar_graph.measurements import (
        Depth,
        Dvl,
        Heading,
        Imu,
        LandmarkDetections,
        Measurements,
        PositionFixes,
    )
    from sonar_graph.navigation import Odometry
    from sonar_graph.recognition import recognise
    from sonar_graph.report import write_report
    from sonar_graph.sequence import Sequence
    from sonar_graph.simulation import simulate_basin
    from sonar_graph.states import (
        CausalEstimates,
        DetectionJournal,
        DetectionLog,
        Estimate,
        LandmarkMap,
        Outcome,
        Trajectory,
    )

__all__ = [
    "Calibration",
    "CausalEstimates",
    "Comparison",
    "Depth",
    "DetectionJournal",
    "DetectionLog",
    "Dvl",
    "Estimate",
    "Estimator",
    "Heading",
    "Imu",
    "LandmarkDetections",
    "LandmarkMap",
    "LogConfig",
    "Measurements",
    "Odometry",
    "Outcome",
    "PositionFixes",
    "RunResult",
    "Section",
    "Sequence",
    "SonarFrames",
    "TimeWindow",
    "Trajectory",
    "compare",
    "inspect_log",
    "load_estimator",
    "read_log",
    "recognise",
    "run_estimator",
    "run_suite",
    "simulate_basin",
    "write_log",
    "write_report",
]


def at_first_use(
    package: str,
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package whose names are imported when they are first used (PEP 562).

    Its ``__init__`` lists them once, as imports under ``if TYPE_CHECKING``.
    """

    def find(name: str) -> Any:
        import ast
        from pathlib import Path

        # the imports under TYPE_CHECKING are the one list of names; here they are read, not run
        module = sys.modules[package]
        tree = ast.parse(Path(str(module.__file__)).read_text("utf-8"))
        listed = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        places = {
            alias.name: str(node.module) for node in listed for alias in node.names
        }
        if places.get(name, "").startswith(f"{package}."):
            setattr(module, name, getattr(import_module(places[name]), name))
            return getattr(module, name)
        # a submodule, as after an import of it
        if find_spec(f"{package}.{name}"):
            return import_module(f"{package}.{name}")
        raise AttributeError(
            f"{package} has no {name!r}; it has: {', '.join(module.__all__)}"
        )

    def listed() -> list[str]:
        return sorted(sys.modules[package].__all__)

    return find, listed


if not TYPE_CHECKING:
    __getattr__, __dir__ = at_first_use(__name__)
