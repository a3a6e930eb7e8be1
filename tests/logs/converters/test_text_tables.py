import numpy as np
import pytest

from sonar_graph.logs.convert.akit import read_akit
from sonar_graph.logs.convert.mrclam import read_mrclam
from sonar_graph.logs.convert.step_files import read_dlr, read_victoria_park
from sonar_graph.logs.convert.text_tables import read_table

from .builders import assert_refused


def test_comments_and_blank_lines_are_passed_over(tmp_path):
    path = tmp_path / "t.dat"
    path.write_text("# time value\n\n  1.5 \t -2\n # again\n2.5 3e1\n")
    table = read_table(path, ("time", "value"))
    assert table.first == ["1.5", "2.5"]
    assert np.array_equal(table.values, [[1.5, -2.0], [2.5, 30.0]])
    assert table.stamps_ns().tolist() == [1_500_000_000, 2_500_000_000]


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        (None, ("No such file", "rows of time, value")),
        (b"\xff\xfe\x00\x81", ("cannot be read as text",)),
        (b"", ("holds no data", "time, value")),
        (b"# only a comment\n", ("holds no data",)),
        (b"1 2\n\n1\n", ("line 3", "1 fields", "2 numbers: time, value")),
        (b"1 2\n1 two\n", ("line 2", "two")),
        (b"1 nan\n", ("line 1", "not finite")),
    ],
)
def test_a_bad_table_is_refused_by_file_and_line(tmp_path, content, fragments):
    path = tmp_path / "bad.dat"
    if content is not None:
        path.write_bytes(content)
    assert_refused(lambda: read_table(path, ("time", "value")), path, *fragments)


COV = "1e-5 2e-6 2e-5 3e-6 4e-6 1e-4"
STEP, EDGE = f"STEP image 0 0 0 {COV}\n", "ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\n"
IMU, DVL, GT = (f"Trajectory2/{kind}_trajectory2.csv" for kind in ("IMU", "DVL", "GT"))
AKIT = {IMU: "h\n0,1,2,3,4,5,6\n", DVL: "h\n0,1,2,3\n", GT: "h\n" + "0,1,0.5,0,0,0,0,0,0,0\n" * 3}
ODOMETRY, SEEN, BARCODES, MARKS = (
    f"{name}.dat" for name in ("Robot1_Odometry", "Robot1_Measurement", "Barcodes", "Landmark_Groundtruth")
)
MRCLAM = {ODOMETRY: "1 0 0\n", "Robot3_Odometry.dat": "1 0 0\n", SEEN: "1 63 1 0\n", BARCODES: "6 63\n"}
MRCLAM |= {MARKS: "6 1 1 0 0\n"}
READERS = {
    "dlr": (lambda folder: read_dlr(folder / "map.circles"), {"map.circles": STEP}),
    "dlr folder": (read_dlr, {}),
    "park": (lambda folder: read_victoria_park(folder / "park.txt"), {"park.txt": EDGE}),
    "akit": (lambda folder: read_akit(folder, 2), AKIT),
    "akit 5": (lambda folder: read_akit(folder, 5), AKIT),
    "akit absent": (lambda folder: read_akit(folder / "absent", 1), AKIT),
    "akit inside": (lambda folder: read_akit(folder / "Trajectory2", 2), AKIT),
    "mrclam": (lambda folder: read_mrclam(folder, 1), MRCLAM),
    "mrclam 7": (lambda folder: read_mrclam(folder, 7), MRCLAM),
    "mrclam absent": (lambda folder: read_mrclam(folder / "absent", 1), MRCLAM),
    "mrclam inside": (lambda folder: read_mrclam(folder / "empty", 1), MRCLAM | {"empty/a": ""}),
}


@pytest.mark.parametrize("name", ["dlr", "park", "akit", "mrclam"])
def test_the_data_sets_that_are_made_faulty_below_are_whole(tmp_path, name):
    read, files = READERS[name]
    write(tmp_path, files)
    assert len(read(tmp_path).imu) > 0


@pytest.mark.parametrize(
    ("reader", "changed", "fragments"),
    [
        ("dlr", {"map.circles": ""}, ("map.circles", "holds no data", "STEP")),
        ("dlr", {"map.circles": "#\nLANDMARK_C 0 1 1 1 0 1 4"}, ("map.circles", "line 2", "before the first STEP")),
        ("dlr", {"map.circles": "#\nSTEP image 1 2"}, ("line 2", "2 fields", "9 numbers")),
        ("dlr", {"map.circles": STEP + "LANDMARK_C 0 1 1 1 0 1"}, ("line 2", "no landmark ID")),
        ("dlr", {"map.circles": STEP + "LANDMARK_C 0 1 1 1 0 1 4.5"}, ("line 2", "4.5", "whole numbers")),
        ("dlr", {"map.circles": STEP + "CIRCLE 1"}, ("line 2", "CIRCLE")),
        ("dlr", {"map.circles": None}, ("map.circles", "No such file", "STEP")),
        ("dlr folder", {}, ("map.circles", "STEP", "give the folder that does, or the file itself")),
        ("park", {"park.txt": ""}, ("park.txt", "holds no data", "ODOMETRY")),
        ("park", {"park.txt": EDGE + "EDGE 1 2"}, ("park.txt", "line 2", "EDGE")),
        ("park", {"park.txt": EDGE + "ODOMETRY 1 2 1 0"}, ("line 2", "4 fields", "11 numbers")),
        ("park", {"park.txt": EDGE + "ODOMETRY 0 2 1 0 0 1 0 0 1 0 1"}, ("line 2", "newest pose is 1")),
        ("park", {"park.txt": EDGE + "LANDMARK 0 7 1 0 1 0 1"}, ("line 2", "newest pose is 1")),
        ("park", {"park.txt": "LANDMARK 0 7 1 0 1 0 1"}, ("no ODOMETRY",)),
        ("akit", {DVL: "h\n0,1,2,3\n1,2,3\n"}, ("DVL_trajectory2.csv", "line 3", "DVL Z")),
        ("akit", {GT: None}, ("GT_trajectory2.csv", "Longitude")),
        ("akit", {GT: "h\n0,1,0.5,0,0,0,0,0,0,0\n"}, ("fewer than two rows",)),
        ("akit 5", {}, ("no trajectory 5", "it has 2")),
        ("akit inside", {}, ("holds no TrajectoryN",)),
        ("akit absent", {}, ("absent", "not a folder")),
        ("mrclam", {ODOMETRY: "1 0.1 0\n2 0.1\n"}, ("Robot1_Odometry.dat, line 2", "angular velocity")),
        *(("mrclam", {name: None}, (name,)) for name in (SEEN, BARCODES, MARKS)),
        ("mrclam 7", {}, ("no robot 7", "1, 3")),
        ("mrclam inside", {}, ("RobotN_Odometry.dat", "Barcodes.dat")),
        ("mrclam absent", {}, ("absent", "not a folder")),
    ],
)
def test_a_bad_data_set_is_refused_by_file_and_line(tmp_path, reader, changed, fragments):
    read, files = READERS[reader]
    write(tmp_path, files | changed)
    assert_refused(lambda: read(tmp_path), *fragments)


def write(folder, files):
    for name, text in files.items():
        if text is not None:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)
