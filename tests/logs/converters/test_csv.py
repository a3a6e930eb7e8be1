"""Text tables give the same sequence as arrays, whatever their units, axes, delimiters and times."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.logs import read_log, write_log, write_tum
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
    azimuth = -np.degrees(seen.azimuth_rad) if frd else seen.azimuth_rad
    of_imu = s.imu.angular_velocity * turn * rate, s.imu.specific_force * turn * force
    of_sonar = seen.range_m * mm, azimuth, seen.candidate_ids, seen.id_probability
    yaw = np.degrees(np.pi / 2 - s.heading.yaw_rad) if frd else s.heading.yaw_rad
    poses = place(s.truth.positions), quaternions(s, frd)
    known = s.true_landmarks
    return {
        "imu": (s.imu, "wx,wy,wz,ax,ay,az", *of_imu),
        "dvl": (s.dvl, "vx,vy,vz", s.dvl.velocity * turn * mm),
        "depth": (s.depth, "d", s.depth.z_m * (-mm if frd else 1.0)),
        "heading": (s.heading, "yaw", yaw),
        "positions": (s.positions, "x,y,z", place(s.positions.position_m)),
        "detections": (seen, "range,azimuth,id,p,track", *of_sonar, seen.track),
        "truth": (s.truth, "x,y,z,qx,qy,qz,qw", *poses),
        "true_landmarks": (None, "id,x,y,z", known.ids, place(known.positions)),
    }


def write_tables(folder: Path, s, *, frd: bool = False, sep: str = ",") -> None:
    """Write columns with every bit, and stamps in seconds with every nanosecond."""
    for role, (stamped, names, *columns) in columns_of(s, frd).items():
        lines = [names.split(",")]
        lines += [list(map(repr, row)) for row in np.column_stack(columns).tolist()]
        if stamped is not None:
            stamps = [
                f"{n // 10**9}.{n % 10**9:09d}" for n in stamped.stamps_ns.tolist()
            ]
            lines = [[t, *line] for t, line in zip(["t", *stamps], lines, strict=True)]
        text = "\n".join(map(sep.join, lines))
        (folder / f"{role}.csv").write_text(text + "\n")


def quaternions(s, frd: bool) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    if not frd:
        return s.truth.quaternions_xyzw
    enu_R_ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return Rotation.from_matrix(enu_R_ned.T @ s.truth.matrices @ np.diag(FRD)).as_quat()


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
            if "cov" in name or "sigma" in name:
                continue
            got, wanted = (getattr(getattr(s, role), name) for s in (found, expected))
            np.testing.assert_allclose(got, wanted, rtol=0, atol=atol, err_msg=role)


@pytest.mark.parametrize("sep", [",", ";", "\t", " "])
def test_a_log_from_tables_equals_that_from_arrays_bit_for_bit(tmp_path, sep):
    expected = world()
    write_tables(tmp_path, expected, sep=sep)
    found = read_csv(tmp_path, tomllib.loads(OURS))
    assert_same(found, expected, 0.0)
    assert np.isnan(found.heading.sigma_rad).all()
    assert np.isnan(found.detections.range_azimuth_cov).all()
    write_log(tmp_path / "csv.mcap", found)
    assert_same(read_log(tmp_path / "csv.mcap"), expected, 0.0)


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
OF_IMU = {
    "file": "imu.csv",
    "angular_velocity": TRIPLE,
    "linear_acceleration": TRIPLE,
}


@pytest.mark.parametrize(
    ("unit", "number"),
    [("s", "1893456000.123456789"), ("ms", "1893456000123.456789"), ("us", "1893456000123456.789"),
     ("ns", "1893456000123456789"), ("s", "2030-01-01T00:00:00.123456789Z"),
     ("s", "2030-01-01 01:00:00.123456789+01:00"),
     ("s", "31.12.2029 23:00:00.123456789 -01:00"), ("s", "31-Dec-2029 23:00:00.123456789-01:00")],
)  # fmt: skip
def test_stamps_of_every_unit_keep_their_nanoseconds(tmp_path, unit, number):
    for name in ("imu", "dvl"):
        (tmp_path / f"{name}.csv").write_text(f"time,a,b,c\n{number},0,0,1\n")
    config = {"stamp_unit_s": unit, "stamp_offset_s": -0.5, "imu": OF_IMU}
    config |= {"dvl": {"file": "dvl.csv", "velocity": TRIPLE}}
    found = read_csv(tmp_path, config)
    assert (
        found.imu.stamps_ns.tolist()
        == found.dvl.stamps_ns.tolist()
        == [1893456000123456789 - 500_000_000]
    )


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


def write_headed(folder: Path) -> None:
    for name, text in HEADED.items():
        (folder / name).write_text(text)


def test_poses_in_the_format_of_tum_are_found_as_the_truth(tmp_path):
    write_headed(tmp_path)
    (tmp_path / "ground_truth.csv").unlink()
    truth = small_world().true_poses.rows(slice(5))
    write_tum(tmp_path / "own.tum", truth)
    table = tomllib.loads(csv_template([tmp_path]))["truth"]
    assert table["file"] == "own.tum"
    assert table["position"] == ["x", "y", "z"]
    assert table["orientation"] == ["qx", "qy", "qz", "qw"]
    (tmp_path / "map.csv").write_text("".join(f"{k} 1 2 3 4 5 6 7\n" for k in range(9)))
    assert "columns" not in csv_template([tmp_path / "map.csv"]).split("[truth]")[1]


def test_a_template_of_tables_with_names_and_units_reads_them_unedited(tmp_path):
    write_headed(tmp_path)
    (tmp_path / "notes.md").write_text("no table at all\n")
    text = csv_template([tmp_path])
    (tmp_path / "dive.toml").write_text(text)
    found = read_csv(
        [path for path in tmp_path.iterdir() if path.suffix == ".csv"],
        tmp_path / "dive.toml",
    )
    assert found.imu.angular_velocity[0, 0] == pytest.approx(np.radians(0.5))
    assert found.imu.specific_force[0, 2] == pytest.approx(0.5 * 9.80665)
    assert found.dvl.velocity[0, 0] == pytest.approx(0.0005)
    assert found.depth.z_m[0] == pytest.approx(-0.005)
    assert found.heading.yaw_rad[0] == pytest.approx(np.pi / 2 - np.radians(0.5))
    assert (
        found.detections.range_m[0],
        found.detections.azimuth_rad[0],
    ) == pytest.approx((2.0, np.pi / 2))
    assert found.detections.most_probable()[0].tolist() == [7, 7]
    assert found.detections.id_probability[0, 0] == 0.9
    assert found.truth.has_orientation
    assert found.true_landmarks.ids.tolist() == [7]
    assert len(found.positions) == 2
    for role in (found.imu, found.dvl, found.depth, found.truth, found.positions):
        assert role.stamps_ns[0] == 1_900_000_000 * 10**9
    assert "# not a table:" in text
    assert "notes.md: has no line with numbers" in text


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
    (tmp_path / "gt.csv").write_text(
        f"time,lat,lon,r,p,y\n0,{first},0,0,90\n9,{last},10,20,-30\n"
    )
    geodetic = {"latitude": "lat", "longitude": "lon", "unit": unit}
    config = {
        "imu": OF_IMU,
        "dvl": {"file": "imu.csv", "velocity": TRIPLE},
        "truth": {"file": "gt.csv", "geodetic": geodetic, "rpy_scale": "deg"}
        | {"rpy": ["r", "p", "y"]},
    }
    truth = read_csv(tmp_path, config).truth
    assert truth.positions[1] == pytest.approx([0, 1852, 0], abs=3)
    assert np.degrees(truth.rotations().as_euler("ZYX"))[:, ::-1] == pytest.approx(
        np.array([[0, 0, 90], [10, 20, -30]])
    )
    del config["truth"]["geodetic"]["unit"]
    with pytest.raises(
        LogError,
        match=rf'gt\.csv: \[truth\] none of its 2 rows .* \(lat is up to {largest}: unit = "{unit}',
    ):
        read_csv(tmp_path, config)
