from __future__ import annotations

from typing import Any

import numpy as np
import pytest

PRESSURE = "sensor_msgs/msg/FluidPressure"
ONE_ATMOSPHERE = 101_325.0
TEN_METRES_OF_SEA = 1025 * 9.80665 * 10


def pressures(foreign: Any, values: list[float], variance: float = 0.0) -> tuple[str, str, list[dict[str, Any]]]:
    rows = [
        {"header": foreign.header(i), "fluid_pressure": value, "variance": variance} for i, value in enumerate(values)
    ]
    return "/bar30", PRESSURE, rows


@pytest.mark.parametrize(
    ("settings", "values"),
    [
        ("water_density_kg_m3 = 1025", [ONE_ATMOSPHERE, ONE_ATMOSPHERE + TEN_METRES_OF_SEA]),
        ("water_density_kg_m3 = 1025\natmosphere_pa = 0", [0.0, TEN_METRES_OF_SEA]),
        ("water_density_kg_m3 = 1025\nscale = 100", [1013.25, 1013.25 + TEN_METRES_OF_SEA / 100]),
    ],
)
def test_pressure_becomes_height_in_any_water_and_unit(
    foreign: Any, read: Any, settings: str, values: list[float]
) -> None:
    sequence = read(foreign.imu(), foreign.dvl(), pressures(foreign, values), toml=f"[depth]\n{settings}")
    np.testing.assert_allclose(sequence.depth.z_m, [0, -10], atol=1e-9)
    assert "1025 kg/m3" in sequence.notes["log.depth"]
    assert "fresh" not in sequence.notes["log.depth"]


def test_a_variance_is_scaled_with_its_pressure(foreign: Any, read: Any) -> None:
    deviation_m = 0.05
    deviation_mbar = deviation_m * 1000 * 9.80665 / 100
    entry = pressures(foreign, [1500.0], variance=deviation_mbar**2)
    sequence = read(foreign.imu(), foreign.dvl(), entry, toml="[depth]\nscale = 100")
    np.testing.assert_allclose(sequence.depth.variance_m2, [deviation_m**2])


def test_a_pressure_that_is_no_absolute_one_in_pascals_is_mentioned(foreign: Any, read: Any) -> None:
    sequence = read(foreign.imu(), foreign.dvl(), pressures(foreign, [1013.25, 1500.0]))
    assert "less than the atmosphere's: give scale (100 for hPa or mbar)" in sequence.notes["log.warnings"]
    sound = read(foreign.imu(), foreign.dvl(), pressures(foreign, [ONE_ATMOSPHERE, 1.5e5]))
    assert "atmosphere" not in sound.notes["log.warnings"]


@pytest.mark.parametrize(("meaning", "expected"), [("variance", 0.04), ("standard deviation", 0.04**2)])
def test_poses_are_depths_with_a_variance_or_what_stands_for_it(
    foreign: Any, read: Any, meaning: str, expected: float
) -> None:
    covariance = np.zeros(36)
    covariance[14] = 0.04
    pose = {"pose": {"position": foreign.vector(7, 8, -3)}, "covariance": covariance.tolist()}
    messages = [{"header": foreign.header(i), "pose": pose} for i in range(3)]
    entry = ("/waterlinked_dvl/dead_reckoning_report", "geometry_msgs/msg/PoseWithCovarianceStamped", messages)
    toml = f'[depth]\ntopic = "{entry[0]}"\nvariance = {{meaning = "{meaning}"}}'
    sequence = read(foreign.imu(), foreign.dvl(), entry, toml=toml)
    assert sequence.depth.z_m.tolist() == [-3] * 3
    assert "depth" not in sequence.notes["log.calibration"]  # a pose in the world has no port to mount
    np.testing.assert_allclose(sequence.depth.variance_m2, expected)


def test_a_bare_number_counted_downwards_is_a_depth(foreign: Any, read: Any) -> None:
    entry = ("/depth", "std_msgs/msg/Float64", [{"data": float(i)} for i in range(3)])
    toml = '[depth]\ntype = "std_msgs/msg/Float64"\nheight = "data"\nscale = -1\nstamp = "log"\nframe_id_field = false'
    sequence = read(foreign.imu(), foreign.dvl(), entry, toml=toml)
    assert sequence.depth.z_m.tolist() == [0, -1, -2]
    assert np.isnan(sequence.depth.variance_m2).all()
    assert "log.depth" not in sequence.notes
