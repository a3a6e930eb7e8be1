from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sonar_graph.logs.mcap.writer import write_recording
from sonar_graph.logs.viewer_messages import landmark_cloud
from sonar_graph.states import LandmarkMap

IDS = [3, 2**40 + 1]
POSITIONS = np.array([[1.5, -2.25, 0.1], [4000.0, 5.0, -6.0]])
COVARIANCES = np.array([[[1, 0.1, 0.2], [0.1, 2, 0.3], [0.2, 0.3, 3]], np.full((3, 3), np.nan)])
FORMATS = {1: "b", 2: "B", 3: "h", 4: "H", 5: "i", 6: "I", 7: "f", 8: "d"}
"""By sensor_msgs/PointField."""


@pytest.fixture
def cloud(tmp_path: Path, decoded: Callable[[Path], dict[str, list[Any]]]) -> Any:
    landmarks = LandmarkMap(np.array(IDS), POSITIONS, COVARIANCES)
    write_recording(tmp_path / "cloud.mcap", [landmark_cloud("/cloud", landmarks, 5)], {})
    (message,) = decoded(tmp_path / "cloud.mcap")["/cloud"]
    return message


def values(cloud: Any, point: int) -> dict[str, float]:
    """As a reader that follows the fields sees a point."""
    start = point * cloud.point_step
    data = bytes(cloud.data)
    return {
        field.name: struct.unpack_from("<" + FORMATS[field.datatype], data, start + field.offset)[0]
        for field in cloud.fields
    }


def test_a_reader_of_the_fields_finds_position_identity_and_covariance(cloud: Any) -> None:
    first, second = values(cloud, 0), values(cloud, 1)
    assert [first[name] for name in "xyz"] == [1.5, -2.25, np.float32(0.1)]
    assert [second[name] for name in "xyz"] == [4000, 5, -6]
    assert [first["id"], second["id"]] == IDS
    upper = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
    assert [first[name] for name in upper] == [1, 0.1, 0.2, 2, 0.3, 3]
    assert all(np.isnan(second[name]) for name in upper)
    assert set(first) == {"x", "y", "z", "id", *upper}


def test_the_cloud_keeps_the_rules_of_its_type(cloud: Any) -> None:
    assert (cloud.height, cloud.width, cloud.is_bigendian) == (1, 2, False)
    assert cloud.row_step == cloud.width * cloud.point_step == len(cloud.data)
    places = [(f.offset, f.offset + struct.calcsize(FORMATS[f.datatype])) for f in cloud.fields]
    assert all(end <= start for (_, end), (start, _) in pairwise(places))
    assert places[-1][1] <= cloud.point_step
    assert {f.count for f in cloud.fields} == {1}


def test_coordinates_are_what_rviz_reads(cloud: Any) -> None:
    float32 = 7
    assert {f.datatype for f in cloud.fields if f.name in "xyz"} == {float32}
