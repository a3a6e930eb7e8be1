"""Text tables give the same sequence as arrays, whatever their units, axes, delimiters and times."""

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sonar_graph.errors import LogError
from sonar_graph.logs import read_log, write_log, write_tum
from sonar_graph.logs.convert import csv_template, read_csv
from sonar_graph.measurements import LandmarkDetections
from sonar_graph.testing import aided_world, small_world

FRD = np.array([1.0, -1.0, -1.0])
MEASURED = ("imu", "dvl", "depth", "heading", "positions", "detections")


def table(
    path: Path,
    names: str,
    *columns: np.ndarray,
    stamps_ns: np.ndarray | None = None,
    sep: str = ",",
) -> None:
    """Write columns with every bit, and stamps in seconds with every nanosecond."""
    rows = np.column_stack(columns).tolist()
    texts = [[repr(value) for value in row] for row in rows]
    if stamps_ns is not None:
        texts = [
            [f"{ns // 10**9}.{ns % 10**9:09d}", *row]
            for ns, row in zip(stamps_ns.tolist(), texts, strict=True)
        ]
    path.write_text(
        "\n".join([names.replace(",", sep), *(sep.join(row) for row in texts)]) + "\n"
    )


def world():
    """A world with everything that a table can hold, with covariances that tables do not have taken out."""
    small = small_world()
    aided = aided_world()
    seen = small.detections
    seen = LandmarkDetections(
        seen.stamps_ns, seen.range_m, seen.azimuth_rad, np.full((len(seen), 2, 2), np.nan),
        seen.candidate_ids, seen.id_probability, seen.track,
    )  # fmt: skip
    heading = replace(aided.heading, sigma_rad=np.full(len(aided.heading), np.nan))
    fixes = replace(
        aided.positions, covariance_m2=np.full((len(aided.positions), 3, 3), np.nan)
    )
    landmarks = replace(
        small.true_landmarks,
        covariances=np.full((len(small.true_landmarks), 3, 3), np.nan),
    )
    return replace(
        small,
        detections=seen,
        heading=heading,
        positions=fixes,
        true_landmarks=landmarks,
    )


def write_tables(folder: Path, s, *, frd: bool = False, sep: str = ",") -> None:
    """Tables of a sequence; with ``frd`` in degrees, g and mm, along forward, right, down and north, east, down."""
    turn, rate, force, mm = (
        (FRD, 180 / np.pi, 1 / 9.80665, 1e3) if frd else (np.ones(3), 1.0, 1.0, 1.0)
    )
    world_of = (lambda p: p[:, [1, 0, 2]] * [1, 1, -1]) if frd else (lambda p: p)
    of_imu = (s.imu.angular_velocity * turn * rate, s.imu.specific_force * turn * force)
    table(
        folder / "imu.csv",
        "t,wx,wy,wz,ax,ay,az",
        *of_imu,
        stamps_ns=s.imu.stamps_ns,
        sep=sep,
    )
    table(
        folder / "dvl.csv",
        "t,vx,vy,vz",
        s.dvl.velocity * turn * mm,
        stamps_ns=s.dvl.stamps_ns,
        sep=sep,
    )
    table(
        folder / "depth.csv",
        "t,d",
        s.depth.z_m * (-mm if frd else 1.0),
        stamps_ns=s.depth.stamps_ns,
        sep=sep,
    )
    yaw = np.degrees(np.pi / 2 - s.heading.yaw_rad) if frd else s.heading.yaw_rad
    table(folder / "heading.csv", "t,yaw", yaw, stamps_ns=s.heading.stamps_ns, sep=sep)
    place = world_of(s.positions.position_m) * mm
    table(
        folder / "fix.csv", "t,x,y,z", place, stamps_ns=s.positions.stamps_ns, sep=sep
    )
    seen = s.detections
    k = s.detections.candidate_ids.shape[1]
    azimuth = -np.degrees(seen.azimuth_rad) if frd else seen.azimuth_rad
    names = ",".join(
        [
            "t",
            "range",
            "azimuth",
            *(f"id{i}" for i in range(k)),
            *(f"p{i}" for i in range(k)),
            "track",
        ]
    )
    rows = (
        seen.range_m * mm,
        azimuth,
        seen.candidate_ids,
        seen.id_probability,
        seen.track,
    )
    table(folder / "seen.csv", names, *rows, stamps_ns=seen.stamps_ns, sep=sep)
    true = world_of(s.truth.positions) * mm
    table(
        folder / "truth.csv",
        "t,x,y,z,qx,qy,qz,qw",
        true,
        quaternions(s, frd),
        stamps_ns=s.truth.stamps_ns,
        sep=sep,
    )
    known = s.true_landmarks
    table(
        folder / "map.csv",
        "id,x,y,z",
        known.ids,
        world_of(known.positions) * mm,
        sep=sep,
    )


def quaternions(s, frd: bool) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    if not frd:
        return s.truth.quaternions_xyzw
    enu_R_ned = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return Rotation.from_matrix(enu_R_ned.T @ s.truth.matrices @ np.diag(FRD)).as_quat()


def configuration(s, *, frd: bool = False) -> dict:
    k = s.detections.candidate_ids.shape[1]
    tables = {
        "imu": {
            "angular_velocity": ["wx", "wy", "wz"],
            "linear_acceleration": ["ax", "ay", "az"],
        },
        "dvl": {"velocity": ["vx", "vy", "vz"]},
        "depth": {"height": "d"},
        "heading": {"yaw": "yaw"},
        "positions": {"file": "fix.csv", "position": ["x", "y", "z"]},
        "detections": {
            "file": "seen.csv",
            "range": "range",
            "azimuth": "azimuth",
            "track": "track",
        }
        | {
            "ids": [f"id{i}" for i in range(k)],
            "probabilities": [f"p{i}" for i in range(k)],
        },
        "truth": {"position": ["x", "y", "z"], "orientation": ["qx", "qy", "qz", "qw"]},
        "true_landmarks": {"file": "map.csv", "id": 1, "position": [2, 3, 4]},
    }
    if frd:
        tables["imu"] |= {
            "angular_velocity_scale": "deg/s",
            "linear_acceleration_scale": "g",
            "rotation": "frd",
        }
        tables["dvl"] |= {"scale": "mm/s", "rotation": "frd"}
        tables["depth"] |= {"scale": -0.001}
        tables["heading"] |= {"scale": "deg", "world": "ned"}
        tables["positions"] |= {"scale": "mm", "world": "ned"}
        tables["detections"] |= {
            "range_scale": "mm",
            "azimuth_scale": "deg",
            "rotation": "frd",
        }
        tables["truth"] |= {"scale": "mm", "world": "ned", "rotation": "frd"}
        tables["true_landmarks"] |= {"scale": "mm", "world": "ned"}
    return {"stamp": "t"} | {
        role: {"file": f"{role}.csv"} | keys for role, keys in tables.items()
    }


def assert_same(found, expected, atol: float) -> None:
    for role in MEASURED:
        for name, column in vars(getattr(expected, role)).items():
            np.testing.assert_allclose(
                getattr(getattr(found, role), name),
                column,
                rtol=0,
                atol=atol,
                err_msg=role,
            )
    np.testing.assert_array_equal(found.truth.stamps_ns, expected.truth.stamps_ns)
    np.testing.assert_allclose(
        found.truth.positions, expected.truth.positions, rtol=0, atol=atol
    )
    np.testing.assert_allclose(
        found.truth.matrices, expected.truth.matrices, rtol=0, atol=atol
    )
    np.testing.assert_array_equal(found.true_landmarks.ids, expected.true_landmarks.ids)
    np.testing.assert_allclose(
        found.true_landmarks.positions,
        expected.true_landmarks.positions,
        rtol=0,
        atol=atol,
    )


@pytest.mark.parametrize("sep", [",", ";", "\t", " "])
def test_a_log_from_tables_equals_that_from_arrays_bit_for_bit(tmp_path, sep):
    expected = world()
    write_tables(tmp_path, expected, sep=sep)
    found = read_csv(tmp_path, configuration(expected))
    assert_same(found, expected, 0.0)
    write_log(tmp_path / "csv.mcap", found)
    write_log(
        tmp_path / "arrays.mcap", replace(expected, calibration=found.calibration)
    )
    assert_same(
        read_log(tmp_path / "csv.mcap"), read_log(tmp_path / "arrays.mcap"), 0.0
    )


def test_units_and_axes_of_a_foreign_vehicle_are_turned_into_ours(tmp_path):
    expected = world()
    write_tables(tmp_path, expected, frd=True)
    found = read_csv(tmp_path, configuration(expected, frd=True))
    assert_same(found, expected, 1e-9)
    with pytest.raises(
        AssertionError
    ):  # negative control: the same tables without units and axes
        assert_same(read_csv(tmp_path, configuration(expected)), expected, 1e-9)


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
    triple = ["a", "b", "c"]
    config = {
        "stamp_unit_s": unit,
        "imu": {
            "file": "imu.csv",
            "angular_velocity": triple,
            "linear_acceleration": triple,
        },
    }
    config |= {"stamp_offset_s": -0.5, "dvl": {"file": "dvl.csv", "velocity": triple}}
    found = read_csv(tmp_path, config)
    assert (
        found.imu.stamps_ns.tolist()
        == found.dvl.stamps_ns.tolist()
        == [1893456000123456789 - 500_000_000]
    )


HEADED = {
    "vehicle_imu.csv": "timestamp_us,gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s],acc_x [g],acc_y [g],acc_z [g]",
    "dvl.csv": "time;vel_x_mm_s;vel_y_mm_s;vel_z_mm_s;valid",
    "ctd.csv": "unix time (ms),depth (cm),heading (deg)",
    "beacons.csv": "time,range_mm,bearing_deg,landmark_id,posterior",
    "ground_truth.csv": "# time, x, y, z, qx, qy, qz, qw",
    "usbl.csv": "time,lat,lon",
    "map.csv": "id,x,y,z",
}


def write_headed(folder: Path) -> None:
    stamps = {"vehicle_imu.csv": 1e6, "ctd.csv": 1e3}
    for name, header in HEADED.items():
        sep = ";" if ";" in header else ","
        count = len(re.split("[,;]", header))
        base = 1_900_000_000
        rows = [
            [repr(round((base + k) * stamps.get(name, 1))), *["0.5"] * (count - 1)]
            for k in range(3)
        ]
        if name == "map.csv":
            rows = [["7", "1", "2", "3"]]
        if name == "dvl.csv":
            rows = [[*row[:-1], "1"] for row in rows]
        if name == "beacons.csv":
            rows = [[row[0], "2000", "90", "7", "0.9"] for row in rows]
        (folder / name).write_text(
            "\n".join([header, *(sep.join(row) for row in rows)]) + "\n"
        )


def test_poses_in_the_format_of_tum_are_found_as_the_truth(
    tmp_path: Path,
) -> None:
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
    assert found.detections.most_probable()[0].tolist() == [7, 7, 7]
    assert found.detections.id_probability[0, 0] == 0.9
    assert found.truth.has_orientation
    assert found.true_landmarks.ids.tolist() == [7]
    assert len(found.positions) == 3
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
    triple = ["a", "b", "c"]
    config = {
        "imu": {
            "file": "imu.csv",
            "angular_velocity": triple,
            "linear_acceleration": triple,
        },
        "dvl": {"file": "imu.csv", "velocity": triple},
        "truth": {
            "file": "gt.csv",
            "geodetic": {"latitude": "lat", "longitude": "lon", "unit": unit},
        }
        | {"rpy": ["r", "p", "y"], "rpy_scale": "deg"},
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
