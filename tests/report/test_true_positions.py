"""Comparisons whose truth has positions only, and of estimators that take no headings or fixes."""

import json
from dataclasses import replace

from sonar_graph.evaluation import (
    compare,
    write_comparison,
    write_viewer_files,
)
from sonar_graph.report import summary, write_report
from sonar_graph.states import Trajectory
from sonar_graph.testing import aided_world
from tests.logs.conftest import decode


def test_nothing_about_a_true_heading_is_written(tmp_path):
    world = aided_world()
    positions = Trajectory.of_positions(world.truth.stamps_ns, world.truth.positions)
    comparison = compare(replace(world, truth=positions), ["dead-reckoning"])
    write_comparison(comparison, tmp_path)
    write_viewer_files(comparison, tmp_path)
    page = write_report(comparison, tmp_path).read_text()
    assert "with true positions, but no true orientation" in page
    assert "yaw error" not in page
    runs = json.loads((tmp_path / "comparison.json").read_text())["runs"]
    told = runs["dead-reckoning"]["scores"]
    assert "causal.ate_se2_m" in told
    assert not any(word in key for key in told for word in (".yaw", "nees_yaw", "rpe"))
    columns = summary(comparison).renderables[1].columns
    assert not any(str(column.header).startswith("yaw") for column in columns)
    topics = decode(tmp_path / "result.mcap")
    assert "/ground_truth/odometry" not in topics
    point = topics["/ground_truth/point"][-1].point
    assert [point.x, point.y, point.z] == world.truth.positions[-1].tolist()
    paths = topics["/ground_truth/path"]
    turns = [pose.pose.orientation for path in paths for pose in path.poses]
    assert {(q.x, q.y, q.z, q.w) for q in turns} == {(0.0, 0.0, 0.0, 1.0)}
    frames = [t.child_frame_id for m in topics["/tf"] for t in m.transforms]
    assert not any(frame.startswith("ground_truth") for frame in frames)
