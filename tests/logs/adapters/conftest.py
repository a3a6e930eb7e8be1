"""Logs as third-party drivers write them: their own message definitions, encoded by another library than ours."""

import re
from collections.abc import Iterable
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.logs import read_log
from sonar_graph.logs.adapters import read_log_config
from sonar_graph.logs.cdr import DEFINITIONS as ROS
from tests.logs.conftest import Bench, Entry, header, vector

T0_NS = 1_700_000_000_000_000_000
STEP_NS = 10**8
IMU = "sensor_msgs/msg/Imu"


def interface(fields: str, **own: str) -> str:
    """Interface text of a driver: its fields, its own types (``package__Type``), and those of ROS that it may use."""
    common = {
        name: text
        for name, text in ROS.items()
        if name.startswith(("builtin", "std_msgs/H", "geometry_msgs"))
    }
    used = {
        name.replace("__", "/"): text.replace(", ", "\n") for name, text in own.items()
    } | common
    sections = (f"\n{'=' * 80}\nMSG: {name}\n{text}" for name, text in used.items())
    return "".join([fields.replace(", ", "\n"), *sections, "\n"])


def water_linked_text(covariance: str = "float64 temperature") -> str:
    """dvl_msgs/DVL; the forks add a covariance after the figure of merit."""
    return interface(
        f"std_msgs/Header header, float64 time, geometry_msgs/Vector3 velocity, float64 fom, {covariance}, "
        "float64 altitude, DVLBeam[] beams, bool velocity_valid, int64 status, string form",
        dvl_msgs__DVLBeam="int64 id, float64 velocity, float64 distance, float64 rssi, float64 nsd, bool valid",
    )


DEFINITIONS = {
    "dvl_msgs/msg/DVL": water_linked_text(),
    "stonefish_ros2/msg/DVL": interface(
        "std_msgs/Header header, geometry_msgs/Vector3 velocity, float64[9] velocity_covariance, float64 altitude, "
        "DVLBeam[] beams",
        stonefish_ros2__DVLBeam="float64 range, float64 range_covariance, float64 velocity, float64 velocity_cov",
    ),
    "geometry_msgs/msg/TwistWithCovarianceStamped": interface(
        "std_msgs/Header header, geometry_msgs/TwistWithCovariance twist"
    ),
    "vision_msgs/msg/Detection3DArray": interface(
        "std_msgs/Header header, vision_msgs/Detection3D[] detections",
        vision_msgs__Detection3D="std_msgs/Header header, vision_msgs/ObjectHypothesisWithPose[] results, "
        "vision_msgs/BoundingBox3D bbox, string id",
        vision_msgs__ObjectHypothesisWithPose="vision_msgs/ObjectHypothesis hypothesis, "
        "geometry_msgs/PoseWithCovariance pose",
        vision_msgs__ObjectHypothesis="string class_id, float64 score",
        vision_msgs__BoundingBox3D="geometry_msgs/Pose center, geometry_msgs/Vector3 size",
    ),
    "oculus_interfaces/msg/Ping": interface(
        "std_msgs/Header header, uint32 ping_id, uint32 ping_firing_date, float64 range, float64 gain_percent, "
        "float64 frequency, float64 speed_of_sound_used, float64 range_resolution, float64 temperature, "
        "float64 pressure, uint8 master_mode, bool has_gains, uint16 n_ranges, uint16 n_beams, uint32 step, "
        "uint8 sample_size, int16[] bearings, uint8[] ping_data"
    ),
    "provider_dvl/msg/PD0Packet": "float64 timestamp\nfloat64[4] range\nfloat64[4] velocity\n",
    "std_msgs/msg/Float64": "float64 data\n",
}
Case = tuple[list[Entry], str, dict[str, Any]]
"""Entries, configuration, and what is expected: values by their path in the sequence, and parts of notes by their names
(``log.dropped``), None: no such note."""


def rows_of(
    topic: str,
    kind: str,
    rows: Iterable[dict[str, Any]],
    frame_id: str = "sensor",
    **common: Any,
) -> Entry:
    """Messages with a header each, a tenth of a second apart."""
    return (
        topic,
        kind,
        [{"header": at(i, frame_id), **common, **row} for i, row in enumerate(rows)],
    )


def at(row: int, frame_id: str = "sensor") -> dict[str, Any]:
    return header(T0_NS + row * STEP_NS, frame_id)


def imu(
    rows: int = 5,
    force: tuple[float, ...] = (0, 0, 9.8),
    rate: tuple[float, ...] = (0, 0, 0),
    **changes: Any,
) -> Entry:
    """Messages that are alike, but for the fields of some rows (``at_2={...}``)."""
    common = {"angular_velocity": vector(*rate), "linear_acceleration": vector(*force)}
    return rows_of(
        "/imu",
        IMU,
        [changes.get(f"at_{i}", {}) for i in range(rows)],
        "imu_link",
        **common,
    )


def dvl(rows: int = 5, **fields: Any) -> Entry:
    message = {
        "velocity": vector(1, 2, 3),
        "velocity_mode": 1,
        "num_good_beams": 4,
        **fields,
    }
    return rows_of("/dvl", "marine_acoustic_msgs/msg/Dvl", [message] * rows)


def pressures(*values: float, variance: float = 0.0) -> Entry:
    rows = [{"fluid_pressure": value} for value in values]
    return rows_of("/bar30", "sensor_msgs/msg/FluidPressure", rows, variance=variance)


def about_values(warnings: str) -> str:
    """Warnings without those about frames: those of most of these messages hang on no tree (`test_vehicle_setup`)."""
    return re.sub(
        r"\w+: no (?:transform|frame) .*? for --calibration(, or frame_id .*? configuration)?(; )?",
        "",
        warnings,
    )


class Foreign(Bench):
    """Writes and reads logs of other people's messages."""

    t0_ns = T0_NS
    definitions = DEFINITIONS

    @staticmethod
    def stamps(rows: int) -> np.ndarray:
        """Stamps of the messages that `rows_of` makes, nanoseconds."""
        return T0_NS + np.arange(rows) * STEP_NS

    def config(self, text: str) -> Path:
        path = self._folder / "log.toml"
        path.write_text(text, encoding="utf-8")
        return path

    def read(self, *entries: Entry, toml: str = "", **settings: Any) -> Any:
        """The sequence of a log of these entries, of IMU and DVL too where no IMU is among them."""
        if not any(kind == IMU for _, kind, *_ in entries):
            entries = (imu(), dvl(), *entries)
        return read_log(
            self.write(*entries), config=read_log_config(self.config(toml)), **settings
        )

    def check(
        self,
        entries: list[Entry],
        toml: str,
        expected: dict[str, Any],
        atol: float = 1e-12,
    ) -> Any:
        """Read entries, and compare values, to single precision, and notes."""
        sequence = self.read(*entries, toml=toml)
        for path, values in expected.items():
            if path.startswith("log."):
                said = about_values(sequence.notes.get(path, ""))
                assert bool(said) == (values is not None)
                assert (values or "") in said
            else:
                found = attrgetter(path)(sequence)
                np.testing.assert_allclose(
                    found, values, rtol=2e-7, atol=atol, err_msg=path
                )
        return sequence


@pytest.fixture
def foreign(tmp_path: Path) -> Foreign:
    return Foreign(tmp_path)
