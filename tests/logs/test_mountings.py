from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.calibration import Calibration, DepthCalibration, DvlCalibration, Mounting
from sonar_graph.logs.mcap.reader import scan
from sonar_graph.logs.mcap.topic import Keep
from sonar_graph.logs.mcap.writer import write_recording
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.roles import TF
from sonar_graph.logs.vehicle_setup import encode_mountings, mounting_of, static_frames
from sonar_graph.logs.writing import dvl_messages, imu_messages, static_message

ANGLES = st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
OFFSETS = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-5, 5))


@given(ANGLES, OFFSETS, OFFSETS)
def test_mountings_survive_tf_static(
    make_sequence: Any, tmp_path_factory: Any, rpy: tuple[float, ...], lever: tuple[float, ...], port: tuple[float, ...]
) -> None:
    mounting = Mounting(translation_m=lever, rpy_rad=rpy)
    calibration = Calibration(dvl=DvlCalibration(mounting=mounting), depth=DepthCalibration(port_m=port))
    sequence = make_sequence()
    tree = static_message("/tf_static", TF, 0, encode_mountings(calibration))
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    write_recording(path, [tree, imu_messages("/imu", sequence.imu), dvl_messages("/dvl", sequence.dvl)], {})
    found = read_log(path).calibration
    assert found.dvl.mounting.pose().equals(mounting.pose(), 1e-9)
    assert found.imu.mounting.pose().equals(gtsam.Pose3(), 1e-9)
    assert mounting_of("depth", static_frames(scan(path, lambda _: Keep.ALL))).translation_m == port


def test_a_frame_that_does_not_hang_on_the_body_has_no_mounting() -> None:
    step = gtsam.Pose3(gtsam.Rot3(), np.array([1.0, 0, 0]))
    frames = {"a": ("base_link", step), "b": ("elsewhere", step), "c": ("d", step), "d": ("c", step)}
    assert mounting_of("a", frames) == Mounting(translation_m=(1, 0, 0))
    assert mounting_of("/a", frames) == mounting_of("a", frames)
    assert mounting_of("base_link", frames) == Mounting()
    assert mounting_of("b", frames) is None
    assert mounting_of("c", frames) is None, "a loop ends"


def test_a_log_without_tf_static_has_no_frames(bench: Any) -> None:
    path: Path = bench.write(*bench.basics())
    assert static_frames(scan(path, lambda _: Keep.ALL)) == {}
