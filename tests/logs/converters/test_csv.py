"""Text tables give the same sequence as arrays, whatever their units, axes, delimiters and times."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sonar_graph.errors import LogError
from sonar_graph.logs import write_tum
from sonar_graph.logs.convert import csv_template, read_csv
from sonar_graph.testing import aided_world, small_world

FRD = np.array([1.0, -1.0, -1.0])
MEASURED = ("imu", "dvl", "depth", "heading", "positions", "detections")


def world():
    """A world with everything that a table can hold."""
    aided = aided_world()
    return replace(small_world(), heading=aided.heading, positions=aided.positions)


def columns_of(s, frd: bool) -> dict:
    """Stamps, names and columns by role; with ``frd`` in degrees, g and mm, along forward, right, down and NED."""
    turn, rate, force, mm = (
        (FRD, 180 / np.pi, 1 / 9.80665, 1e3) if frd else (np.ones(3), 1.0, 1.0, 1.0)
    )

    def place(p: np.ndarray) -> np.ndarray:
        return mm * (p[:, [1, 0, 2]] * [1, 1, -1] if frd else p)

    seen = s.detections
    known = s.true_landmarks
    azimuth = seen.azimuth_rad
    yaw = s.heading.yaw_rad
    turns = s.truth.quaternions_xyzw
    if frd:
        azimuth = -np.degrees(azimuth)
        yaw = np.degrees(np.pi / 2 - yaw)
        # world_R_body of forward, right, down in north, east, down
        turned = s.truth.matrices[:, [1, 0, 2]] * FRD * [[1], [1], [-1]]
        turns = Rotation.from_matrix(turned).as_quat()
    of_imu = s.imu.angular_velocity * turn * rate, s.imu.specific_force * turn * force
    of_sonar = seen.range_m * mm, azimuth, seen.candidate_ids, seen.id_probability
    return {
        "imu": (s.imu, "wx,wy,wz,ax,ay,az", *of_imu),
        "dvl": (s.dvl, "vx,vy,vz", s.dvl.velocity * turn * mm),
        "depth": (s.depth, "d", s.depth.z_m * (-mm if frd else 1.0)),
        "heading": (s.heading, "yaw", yaw),
        "positions": (s.positions, "x,y,z", place(s.positions.position_m)),
        "detections": (seen, "range,azimuth,id,p,track", *of_sonar, seen.track),
        "truth": (s.truth, "x,y,z,qx,qy,qz,qw", place(s.truth.positions), turns),
        "true_landmarks": (None, "id,x,y,z", known.ids, place(known.positions)),
    }


def write_tables(folder: Path, s, *, frd: bool = False, sep: str = ",") -> None:
    """Write columns with every bit, and stamps in seconds with every nanosecond."""
    for role, (stamped, names, *columns) in columns_of(s, frd).items():
        lines = [names.split(",")]
        lines += [list(map(repr, row)) for row in np.column_stack(columns).tolist()]
        if stamped is not None:
            stamps = (divmod(ns, 10**9) for ns in stamped.stamps_ns.tolist())
            times = ["t", *(f"{s}.{ns:09d}" for s, ns in stamps)]
            lines = [[t, *line] for t, line in zip(times, lines, strict=True)]
        text = "\n".join(map(sep.join, lines))
        (folder / f"{role}.csv").write_text(text + "\n")


OURS = """
stamp = "t"
[imu]
file = "imu.csv"
angular_velocity = ["wx", "wy", "wz"]
linear_acceleration = ["ax", "ay", "az"]
[dvl]
file = "dvl.csv"
velocity = ["vx", "vy", "vz"]
[depth]
file = "depth.csv"
height = "d"
[heading]
file = "heading.csv"
yaw = "yaw"
[positions]
file = "positions.csv"
position = ["x", "y", "z"]
[detections]
file = "detections.csv"
range = "range"
azimuth = "azimuth"
ids = ["id"]
probabilities = ["p"]
track = "track"
[truth]
file = "truth.csv"
position = ["x", "y", "z"]
orientation = ["qx", "qy", "qz", "qw"]
[true_landmarks]
file = "true_landmarks.csv"
id = 1
position = [2, 3, 4]
"""
FOREIGN = """
imu.angular_velocity_scale = "deg/s"
imu.linear_acceleration_scale = "g"
imu.rotation = "frd"
dvl.scale = "mm/s"
dvl.rotation = "frd"
depth.scale = -0.001
heading.scale = "deg"
heading.world = "ned"
positions.scale = "mm"
positions.world = "ned"
detections.range_scale = "mm"
detections.azimuth_scale = "deg"
detections.rotation = "frd"
truth.scale = "mm"
truth.world = "ned"
truth.rotation = "frd"
true_landmarks.scale = "mm"
true_landmarks.world = "ned"
"""
"""Units and axes of a foreign vehicle."""


def assert_same(found, expected, atol: float) -> None:
    """But for what no table says: variances and covariances."""
    names = {role: vars(getattr(expected, role)) for role in MEASURED}
    names["truth"] = ["stamps_ns", "positions", "matrices"]
    names["true_landmarks"] = ["ids", "positions"]
    for role, columns in names.items():
        for name in columns:
            got, wanted = (getattr(getattr(s, role), name) for s in (found, expected))
            if "cov" not in name and "sigma" not in name:
                np.testing.assert_allclose(got, wanted, rtol=0, atol=atol, err_msg=role)


@pytest.mark.parametrize("sep", [",", ";", "\t", " "])
def test_a_log_from_tables_equals_that_from_arrays_bit_for_bit(tmp_path, sep):
    expected = world()
    write_tables(tmp_path, expected, sep=sep)
    found = read_csv(tmp_path, tomllib.loads(OURS))
    assert_same(found, expected, 0.0)
    assert np.isnan(found.heading.sigma_rad).all()
    assert np.isnan(found.detections.range_azimuth_cov).all()


def test_units_and_axes_of_a_foreign_vehicle_are_turned_into_ours(tmp_path):
    expected = world()
    write_tables(tmp_path, expected, frd=True)
    config = tomllib.loads(OURS)
    # negative control: the same tables without units and axes
    with pytest.raises(AssertionError):
        assert_same(read_csv(tmp_path, config), expected, 1e-9)
    for role, keys in tomllib.loads(FOREIGN).items():
        config[role] |= keys
    assert_same(read_csv(tmp_path, config), expected, 1e-9)


TRIPLE = ["a", "b", "c"]
ODOMETRY = {
    "imu": dict.fromkeys(["angular_velocity", "linear_acceleration"], TRIPLE),
    "dvl": {"velocity": TRIPLE},
}
"""Of one table, imu.csv."""
for table in ODOMETRY.values():
    table["file"] = "imu.csv"


@pytest.mark.parametrize(
    ("unit", "number"),
    [("s", "1893456000.123456789"), ("ms", "1893456000123.456789"), ("us", "1893456000123456.789"),
     ("ns", "1893456000123456789"), ("s", "2030-01-01T00:00:00.123456789Z"),
     ("s", "2030-01-01 01:00:00.123456789+01:00"),
     ("s", "31.12.2029 23:00:00.123456789 -01:00"), ("s", "31-Dec-2029 23:00:00.123456789-01:00")],
)  # fmt: skip
def test_stamps_of_every_unit_keep_their_nanoseconds(tmp_path, unit, number):
    (tmp_path / "imu.csv").write_text(f"time,a,b,c\n{number},0,0,1\n")
    found = read_csv(
        tmp_path, ODOMETRY | {"stamp_unit_s": unit, "stamp_offset_s": -0.5}
    )
    for role in (found.imu, found.dvl):
        assert role.stamps_ns.tolist() == [1893456000123456789 - 500_000_000]


@pytest.fixture
def headed(tmp_path) -> Path:
    for name, text in HEADED.items():
        (tmp_path / name).write_text(text)
    return tmp_path


HEADED = {
    "vehicle_imu.csv": "timestamp_us,gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s],acc_x [g],acc_y [g],acc_z [g]\n"
    "1900000000000000,.5,.5,.5,.5,.5,.5\n1900000001000000,.5,.5,.5,.5,.5,.5\n",
    "dvl.csv": "time;vel_x_mm_s;vel_y_mm_s;vel_z_mm_s;valid\n1900000000;.5;.5;.5;1\n1900000001;.5;.5;.5;1\n",
    "ctd.csv": "unix time (ms),depth (cm),heading (deg)\n1900000000000,.5,.5\n1900000001000,.5,.5\n",
    "beacons.csv": "time,range_mm,bearing_deg,landmark_id,posterior\n1900000000,2000,90,7,.9\n1900000001,2000,90,7,.9\n",
    "ground_truth.csv": "# time, x, y, z, qx, qy, qz, qw\n"
    "1900000000,.5,.5,.5,.5,.5,.5,.5\n1900000001,.5,.5,.5,.5,.5,.5,.5\n",
    "usbl.csv": "time,lat,lon\n1900000000,.5,.5\n1900000001,.5,.5\n",
    "map.csv": "id,x,y,z\n7,1,2,3\n",
}


def test_poses_in_the_format_of_tum_are_found_as_the_truth(headed):
    (headed / "ground_truth.csv").unlink()
    write_tum(headed / "own.tum", small_world().true_poses.rows(slice(5)))
    table = tomllib.loads(csv_template([headed]))["truth"]
    assert table["file"] == "own.tum"
    assert table["position"] == ["x", "y", "z"]
    assert table["orientation"] == ["qx", "qy", "qz", "qw"]
    (headed / "map.csv").write_text("".join(f"{k} 1 2 3 4 5 6 7\n" for k in range(9)))
    assert "columns" not in csv_template([headed / "map.csv"]).split("[truth]")[1]


def test_a_template_of_tables_with_names_and_units_reads_them_unedited(headed):
    (headed / "notes.md").write_text("no table at all\n")
    text = csv_template([headed])
    assert "# not a table:" in text
    assert "notes.md: has no line with numbers" in text
    found = read_csv(list(headed.glob("*.csv")), tomllib.loads(text))
    seen = found.detections
    for value, expected in (
        (found.imu.angular_velocity[0, 0], np.radians(0.5)),
        (found.imu.specific_force[0, 2], 0.5 * 9.80665),
        (found.dvl.velocity[0, 0], 0.0005),
        (found.depth.z_m[0], -0.005),
        (found.heading.yaw_rad[0], np.pi / 2 - np.radians(0.5)),
        (seen.range_m[0], 2.0),
        (seen.azimuth_rad[0], np.pi / 2),
        (seen.id_probability[0, 0], 0.9),
    ):
        assert value == pytest.approx(expected)
    assert seen.most_probable()[0].tolist() == [7, 7]
    assert found.truth.has_orientation
    assert found.true_landmarks.ids.tolist() == [7]
    for role in (found.imu, found.dvl, found.depth, found.truth, found.positions):
        assert role.stamps_ns[0] == 1_900_000_000 * 10**9


@pytest.mark.parametrize(
    ("unit", "rows", "largest"),
    [
        ("ddmm.mmmm", "4212.0,306.0 4213.0,306.0", "4213"),
        ("degE7", "422000000,31000000 422166667,31000000", "4.22167e[+]08"),
    ],
)
def test_truth_from_roll_pitch_yaw_and_units_of_receivers(
    tmp_path, unit, rows, largest
):
    (tmp_path / "imu.csv").write_text("time,a,b,c\n0,0,0,1\n9,0,0,1\n")
    first, last = rows.split()
    text = f"time,lat,lon,r,p,y\n0,{first},0,0,90\n9,{last},10,20,-30\n"
    (tmp_path / "gt.csv").write_text(text)
    geodetic = {"latitude": "lat", "longitude": "lon", "unit": unit}
    table = {"geodetic": geodetic, "rpy": ["r", "p", "y"], "rpy_scale": "deg"}
    config = ODOMETRY | {"truth": table | {"file": "gt.csv"}}
    truth = read_csv(tmp_path, config).truth
    assert truth.positions[1] == pytest.approx([0, 1852, 0], abs=3)
    yaw_pitch_roll_deg = truth.rotations().as_euler("ZYX", degrees=True)
    assert yaw_pitch_roll_deg == pytest.approx(np.array([[90, 0, 0], [-30, 20, 10]]))
    del geodetic["unit"]
    message = rf'gt\.csv: \[truth\] none of its 2 rows .* \(lat is up to {largest}: unit = "{unit}'
    with pytest.raises(LogError, match=message):
        read_csv(tmp_path, config)
