"""A start that the truth or the true landmarks contradict is grave; one that agrees, or that defines the world, is not."""

from dataclasses import replace

import numpy as np
import pytest

from sonar_graph.calibration import Start
from sonar_graph.diagnosis import Finding
from sonar_graph.diagnosis.motion_signals import BodyMotion
from sonar_graph.diagnosis.start_place import start_place_findings
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin

from .runs import grave, names, started

BASIN = simulate_basin(BasinOptions(seed=3, duration_s=120.0, laps=1))
UNKNOWN = replace(BASIN, truth=None)
PLACE = BASIN.calibration.start.position_m


def stated(
    east_m: float = 0.0, turn_rad: float = 0.0, yaw_sigma_rad: float = 0.01
) -> Start:
    """The right start, moved and turned."""
    return Start(
        rpy_sigma_rad=(0.01, 0.01, yaw_sigma_rad),
        position_m=tuple(np.add(PLACE, [east_m, 0.0, 0.0])),
        rpy_rad=tuple(np.add(BASIN.calibration.start.rpy_rad, [0.0, 0.0, turn_rad])),
    )


def of_place(run: Sequence) -> list[Finding]:
    """Findings about the place of the start alone."""
    return list(start_place_findings(run, BodyMotion.of(run)))


def test_a_start_that_agrees_is_not_named():
    assert grave(started(BASIN, stated(east_m=0.3))) == []
    assert of_place(started(UNKNOWN, stated(east_m=0.3))) == []


def test_a_start_far_from_the_truth_is_named_with_the_line_that_mends_it():
    found, *_ = grave(started(BASIN, stated(east_m=-2.0)))
    assert found.quantity == "start position: distance from the truth"
    assert found.estimate.value == pytest.approx(2.0, abs=0.05)
    assert "`start.position_m = [" in found.line


def test_without_a_truth_the_map_contradicts_a_wrong_start():
    run = started(UNKNOWN, stated(east_m=2.0))
    assert names(grave(run)) == ["start pose"]
    assert of_place(replace(run, true_landmarks=None)) == []


@pytest.mark.parametrize(("yaw_sigma_rad", "is_named"), [(0.01, True), (1.0, False)])
def test_the_yaw_sigma_of_a_start_makes_the_places_of_landmarks_unsure(
    yaw_sigma_rad, is_named
):
    start = stated(turn_rad=1.0, yaw_sigma_rad=yaw_sigma_rad)
    assert bool(of_place(started(UNKNOWN, start))) == is_named


def test_a_start_that_defines_the_world_contradicts_nothing():
    anywhere = Start(position_m=(20.0, 0.0, PLACE[2]), source="vehicle")
    assert of_place(started(UNKNOWN, anywhere)) == []
