"""Planar robots by their files, DLR, Victoria Park and MRCLAM; and what is refused of any data set."""

from itertools import accumulate
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.linalg import expm

from sonar_graph.errors import DatasetError
from sonar_graph.logs.convert import (
    read_akit,
    read_dlr,
    read_mrclam,
    read_victoria_park,
)
from sonar_graph.logs.convert.text_tables import read_table

COV = "1e-5 2e-6 2e-5 3e-6 4e-6"
STRAIGHT = f"STEP image 0 -1 0 {COV} 1e-4"
RIGHT = f"STEP image 0 -1 {np.pi / 2} {COV}"


def chain(motions):
    """Poses reached by composing relative motions from the identity, shape (n + 1, 3, 3)."""
    return np.array(list(accumulate(motions, np.matmul, initial=np.eye(3))))


def hold_past_motions(sequence):
    """Motion over each interval between rows: the matrix exponential of the twist at its end, shape (n, 3, 3)."""
    assert np.array_equal(sequence.imu.stamps_ns, sequence.dvl.stamps_ns)
    duration = np.diff(sequence.imu.stamps_ns) * 1e-9
    twists = np.zeros((len(duration), 3, 3))
    twists[:, 1, 0] = sequence.imu.angular_velocity[1:, 2]
    twists[:, 0, 1] = -twists[:, 1, 0]
    twists[:, :2, 2] = sequence.dvl.velocity[1:, :2]
    return expm(twists * duration[:, None, None])


# ---- axes and identities of DLR


def dlr(folder, *lines):
    (folder / "map.circles").write_text("# a header\n" + "\n".join(lines) + "\n")
    return read_dlr(folder)


def test_ahead_is_minus_y_and_angles_grow_to_the_right_in_the_file(tmp_path):
    """By hand: forward variance is the file's c_yy, leftward its c_xx; the reflection leaves c_xy."""
    s = dlr(tmp_path, STRAIGHT, "LANDMARK_C 0 -2 0.9 1e-3 2e-4 5e-3 4", f"{RIGHT} 2e-4", "LANDMARK_C 1 -2 1 1 0 1 4",
               f"{RIGHT} 3e-4")  # fmt: skip
    poses = chain(hold_past_motions(s))
    seen = s.detections
    assert np.allclose(poses[2], [[0, 1, 2], [-1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert np.allclose(poses[3][:2, 2], [2, -1], atol=1e-12)
    assert np.allclose(s.dvl.velocity_cov[:2, :2, :2], [[2e-5, 2e-6], [2e-6, 1e-5]])
    # a millimetre a second
    assert s.dvl.velocity_cov[:, 2, 2] == pytest.approx([1e-6] * 4)
    # the mean over the steps
    assert s.calibration.imu.gyro_noise_density**2 == pytest.approx(2e-4)
    # it begins at rest
    assert not np.any([s.dvl.velocity[0], s.imu.angular_velocity[0]])
    assert np.isnan(s.imu.specific_force).all()
    expected = [[5e-3, 2e-4 / 2], [2e-4 / 2, 1e-3 / 4]]
    assert np.allclose(seen.range_azimuth_cov[0], expected)
    assert seen.range_m == pytest.approx([2, np.sqrt(5)])
    assert seen.azimuth_rad == pytest.approx([0, -np.arctan(0.5)])
    assert seen.stamps_ns.tolist() == [10**9, 2 * 10**9]


# ---- the recorded runs


@pytest.fixture(
    scope="module", params=[pytest.param("dlr", marks=pytest.mark.recording), "park"]
)
def recorded(request):
    """Kind of lines of the file with their first number, lines, sequence, and body_R_file."""
    path = Path(gtsam.findExampleDataFile("victoria_park.txt"))
    if is_dlr := request.param == "dlr":
        folder = request.getfixturevalue("unpacked")("dlr.tar.xz")
        path = next(folder.rglob("map.circles"))
    lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
    if is_dlr:
        body_R_file = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, 1]])
        return "STEP", 2, lines, read_dlr(path.parent), body_R_file
    return "ODOMETRY", 3, lines, read_victoria_park(), np.eye(3)


def test_chain_of_relative_poses_is_the_composition_of_the_files_steps(recorded):
    """Composed in the file's own axes, and reflected once at the end; velocities taken as chords break the chain."""
    kind, first, lines, sequence, body_R_file = recorded
    steps = [line[first : first + 3] for line in lines if line[0] == kind]
    got = chain(hold_past_motions(sequence))
    assert len(got) == {"STEP": 3298, "ODOMETRY": 6969}[kind]
    of_file = chain(gtsam.Pose2(*map(float, step)).matrix() for step in steps)
    assert np.abs(got - body_R_file @ of_file @ body_R_file).max() < 1e-9
    velocity = sequence.dvl.velocity[1:, :2]
    chords = np.column_stack([velocity, sequence.imu.angular_velocity[1:, 2]])
    of_chords = chain(gtsam.Pose2(*chord).matrix() for chord in chords)
    assert np.abs(got - of_chords).max() > 0.05


# ---- MRCLAM: commands and barcodes

T0 = 1248444187


RUN = {
    "Barcodes.dat": "1 \t 5\n2 \t 14\n6 \t 63\n20 \t 25\n",
    "Landmark_Groundtruth.dat": "20 1.5 -2.5 0.001 0.002\n6 3.0 4.0 0.003 0.004\n",
    "Robot1_Odometry.dat": f"{T0}.100 0.1 0.0\n{T0}.300 0.2 0.5\n{T0}.400 0.0 0.0\n",
    "Robot1_Groundtruth.dat": f"{T0}.2 3 2 1\n{T0}.3 3 2 1\n",
    # the first is of another robot
    "Robot1_Measurement.dat": f"{T0}.2 14 1 0\n{T0}.3 63 2.5 -0.4\n",
}


def test_mrclam_starts_at_its_truth_and_without_one_at_the_origin(tmp_path):
    for name, text in RUN.items():
        (tmp_path / name).write_text(f"# Data Format:\n{text}")
    late = read_mrclam(tmp_path, 1)
    assert len(late.truth) == 2
    assert "origin" in late.notes["start"]
    # a command holds until the next
    assert late.dvl.velocity[:, 0].tolist() == [0.1, 0.1, 0.2]
    # bearings grow to the left, as azimuths do; bar codes are subjects
    seen = late.detections
    assert (seen.range_m, seen.azimuth_rad, seen.candidate_ids) == ([2.5], [-0.4], [6])
    is_six = late.true_landmarks.ids == 6
    assert late.true_landmarks.positions[is_six].tolist() == [[3, 4, 0]]
    reference = tmp_path / "Robot1_Groundtruth.dat"
    reference.write_text(f"{T0}.0 3 2 1\n{T0}.3 3 2 1\n")
    start = read_mrclam(tmp_path, 1).calibration.start
    assert (*start.position_m, start.rpy_rad[2]) == pytest.approx((3, 2, 0, 1))
    reference.unlink()
    never = read_mrclam(tmp_path, 1)
    assert never.truth is None
    assert never.true_landmarks is not None
    assert "no robot truth" in never.notes["truth"]
    for sequence in (late, never):
        assert sequence.calibration.start.position_m == (0.0, 0.0, 0.0)


# ---- what is refused


STEP = f"STEP image 0 0 0 {COV} 1e-4\n"
EDGE = "ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n"
DVL, GT = (f"Trajectory2/{kind}_trajectory2.csv" for kind in ("DVL", "GT"))
FILES = {
    "bad.dat": "1 2\n",
    "map.circles": STEP,
    "park.txt": EDGE,
    "Trajectory2/IMU_trajectory2.csv": "h\n0,1,2,3,4,5,6\n",
    DVL: "h\n0,1,2,3\n",
    GT: "h\n" + "0,1,0.5,0,0,0,0,0,0,0\n" * 3,
    "Robot1_Odometry.dat": "1 0 0\n",
    "Robot3_Odometry.dat": "1 0 0\n",
    "Robot1_Measurement.dat": "1 63 1 0\n",
    "Barcodes.dat": "6 63\n",
    "Landmark_Groundtruth.dat": "6 1 1 0 0\n",
}
READERS = {
    "table": lambda folder: read_table(folder / "bad.dat", ("time", "value")),
    "dlr": lambda folder: read_dlr(folder / "map.circles"),
    "dlr folder": read_dlr,
    "park": lambda folder: read_victoria_park(folder / "park.txt"),
    "akit": lambda folder: read_akit(folder, 2),
    "akit 5": lambda folder: read_akit(folder, 5),
    "akit inside": lambda folder: read_akit(folder / "Trajectory2", 2),
    "mrclam": lambda folder: read_mrclam(folder, 1),
    "mrclam 7": lambda folder: read_mrclam(folder, 7),
    "mrclam absent": lambda folder: read_mrclam(folder / "absent", 1),
}


# fmt: off
REFUSED = [
    ("table", {"bad.dat": "1 2\n\n1\n"}, r"bad\.dat, line 3: has 1 cells; expected 2.*time, value"),
    ("table", {"bad.dat": "1 nan\n"}, r"bad\.dat, line 1: value is no finite number"),
    ("dlr", {"map.circles": ""}, r"map\.circles: holds no STEP line"),
    ("dlr", {"map.circles": "#\nLANDMARK_C 0 1 1 1 0 1 4"}, r"map\.circles, line 2: .*before the first STEP"),
    ("dlr", {"map.circles": "#\nSTEP image 1 2"}, "line 2: 2 fields.*9 finite numbers"),
    ("dlr", {"map.circles": STEP + "LANDMARK_C 0 1 1 1 0 1 4.5"}, r"line 2: .*4\.5.*whole numbers"),
    ("dlr", {"map.circles": STEP + "CIRCLE 1"}, "line 2: .*CIRCLE"),
    ("dlr folder", {"map.circles": None}, r"map\.circles.*STEP.*give the folder that does, or the file itself"),
    ("park", {"park.txt": ""}, r"park\.txt: holds no ODOMETRY line"),
    ("park", {"park.txt": EDGE + "ODOMETRY 1 2 1 0"}, "line 2: 4 fields.*11 finite numbers"),
    ("park", {"park.txt": EDGE + "ODOMETRY 0 2 1 0 0 1 0 0 1 0 1"}, "line 2: .*newest pose is 1"),
    ("akit", {DVL: "h\n0,1,2,3\n1,2,3\n"}, r"DVL_trajectory2\.csv, line 3: .*DVL Z"),
    ("akit", {GT: "h\n0,1,0.5,0,0,0,0,0,0,0\n"}, "fewer than two rows"),
    ("akit 5", {}, "Trajectory5: does not exist; .* has Trajectory2"),
    ("akit inside", {}, "no such run; .*holds TrajectoryN"),
    ("mrclam", {"Robot1_Odometry.dat": "1 0.1 0\n2 0.1\n"}, r"Robot1_Odometry\.dat, line 2: .*angular velocity"),
    ("mrclam", {"Barcodes.dat": None}, r"Barcodes\.dat"),
    ("mrclam", {"Robot1_Measurement.dat": None}, r"Robot1_Measurement\.dat"),
    ("mrclam 7", {}, r"Robot7_Odometry\.dat: does not exist; .* has Robot1_Odometry\.dat, Robot3"),
    ("mrclam absent", {}, "absent.*does not exist"),
]
# fmt: on


@pytest.mark.parametrize(("reader", "changed", "said"), REFUSED)
def test_a_bad_table_or_data_set_is_refused_by_file_and_line(
    tmp_path, reader, changed, said
):
    for name, text in (FILES | changed).items():
        if text is not None:
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).write_text(text)
    with pytest.raises(DatasetError, match=said) as caught:
        READERS[reader](tmp_path)
    assert "\n" not in str(caught.value)
