import re
from dataclasses import replace
from importlib.metadata import EntryPoint
from typing import ClassVar

import numpy as np
import pytest

from baselines.dead_reckoning import DeadReckoning
from sonar_graph import estimator as module
from sonar_graph.calibration import Calibration, Section
from sonar_graph.errors import (
    EstimatorError,
    SonarGraphError,
    UnknownEstimatorError,
)
from sonar_graph.estimator import (
    installed_estimators,
    known_map_of,
    load_estimator,
    make_params,
    newest_landmarks_of,
)
from sonar_graph.evaluation import (
    compare,
    run_estimator,
)
from sonar_graph.navigation import Odometry
from sonar_graph.testing import small_world


class Nothing:
    """The least that loads."""

    class Params(Section):
        gain: float = 1.0
        name: str = "x"

    def process(self, measurements: object) -> None: ...
    def trajectory(self) -> None: ...
    def landmarks(self) -> None: ...
    def detections(self) -> None: ...


class OnlyTrajectory:
    Params: ClassVar[type[Section]] = Section
    trajectory = None


class Bare(DeadReckoning):
    """Without the optional parts of the contract, which its base may have."""

    refused_rows = None
    withheld = None
    newest_landmarks = None
    known_map = None


def announce(monkeypatch: pytest.MonkeyPatch, **values: str) -> None:
    """Let entry points with these names and values be installed."""
    points = [
        EntryPoint(name.replace("_", "-"), value, module.ENTRY_POINT_GROUP)
        for name, value in values.items()
    ]
    monkeypatch.setattr(
        module,
        "entry_points",
        lambda group: points if group == module.ENTRY_POINT_GROUP else [],
    )


def test_those_that_come_along_load_with_default_settings():
    names = {"dead-reckoning", "ekf-slam", "invariant-ekf", "isam2"}
    assert names <= set(installed_estimators())
    for name in names:
        kind = load_estimator(name)
        assert make_params(kind, {}, name) == kind.Params()


def test_third_party_is_found_by_its_name_without_being_imported(monkeypatch):
    announce(monkeypatch, broken="no_such_package:X", one="fractions:Fraction")
    assert list(installed_estimators()) == ["broken", "one"]
    with pytest.raises(UnknownEstimatorError, match="'three'; installed: broken, one"):
        load_estimator("three")
    with pytest.raises(
        EstimatorError,
        match=r"broken \(no_such_package:X\) cannot be loaded: .*no_such_package",
    ):
        load_estimator("broken")


def test_optional_methods_set_to_none_count_as_missing():
    run = run_estimator(small_world(), Bare)
    assert run.status == "ok"
    assert run.refused == []
    world = small_world()
    bare = Bare(world.calibration, Odometry(world.calibration))
    assert len(newest_landmarks_of(bare)) == 0
    with pytest.raises(EstimatorError, match=r"Bare has no known_map\(\)"):
        known_map_of(bare)


def test_missing_methods_are_named(monkeypatch):
    announce(monkeypatch, half="irrelevant:X")
    monkeypatch.setattr(EntryPoint, "load", lambda _: OnlyTrajectory)
    with pytest.raises(EstimatorError, match="lacks process, landmarks, detections of"):
        load_estimator("half")


def test_settings_replace_defaults_and_a_wrong_one_is_refused():
    assert make_params(Nothing, {"gain": 2}, "nothing") == Nothing.Params(gain=2.0)  # type: ignore[arg-type]
    for settings, said in (
        ({"gian": 1}, r"gian: .* did you mean gain\? it has: gain, name"),
        ({"gain": "high"}, r"gain: expected a number, not 'high'"),
    ):
        with pytest.raises(EstimatorError, match=f"settings of nothing: {said}"):
            make_params(Nothing, settings, "nothing")  # type: ignore[arg-type]


class Silent(Nothing):
    """Keeps the contract in name: every method returns nothing."""

    def __init__(self, calibration, odometry, params=None): ...


class Asleep(DeadReckoning):
    """Never has an estimate."""

    def process(self, measurements):
        super().process(measurements)


class NoMap(DeadReckoning):
    """Returns nothing where an empty map belongs."""

    def landmarks(self): ...


class Tuples(DeadReckoning):
    """Returns a pose where an estimate belongs."""

    def process(self, measurements):
        return (measurements.end_ns, None)


class Flat(DeadReckoning):
    """Is sure of x, y and heading only."""

    def process(self, measurements):
        estimate = super().process(measurements)
        return None if estimate is None else replace(estimate, covariance=np.eye(3))


class OfCalibration(DeadReckoning):
    """Takes no source of motion."""

    def __init__(self, calibration): ...


def tilted(calibration, odometry):
    """Dead reckoning with a setting of its own."""
    return DeadReckoning(calibration, odometry, DeadReckoning.Params())


def test_classes_and_functions_stand_where_names_do():
    found = compare(
        small_world(),
        ["dead-reckoning", tilted],
        {"dead-reckoning": {"gravity_interval_s": 2.0}},
    )
    assert [(run.estimator, run.status) for run in found.runs] == [
        ("dead-reckoning", "ok"),
        ("tilted", "ok"),
    ]
    assert found.runs[0].params == {"gravity_interval_s": 2.0}
    assert found.runs[1].params == {}
    class_run = run_estimator(small_world(), DeadReckoning)
    named_run = run_estimator(small_world(), "dead-reckoning")
    assert class_run.estimator == "dead-reckoning"  # under which it is installed
    np.testing.assert_array_equal(
        class_run.causal.positions, named_run.causal.positions
    )
    own = run_estimator(small_world(), NoSetting, {"gravity_interval_s": 3.0})
    assert (own.estimator, own.params) == ("NoSetting", {"gravity_interval_s": 3.0})


class NoSetting(DeadReckoning):
    """An estimator of another name."""


def test_what_is_no_estimator_is_refused_before_anything_runs():
    instance = DeadReckoning(Calibration(), Odometry(Calibration()))
    for asked, said in (
        ([instance], "a function that makes one, not <.*DeadReckoning object"),
        ([None], "a function that makes one, not None"),
        ([{"isam2": {}}], "a function that makes one, not {'isam2'"),
        ([OnlyTrajectory], "OnlyTrajectory lacks process, landmarks, detections of"),
        ([lambda *_: instance], "needs a name for the results"),
        ([OfCalibration], r"\(calibration\) is called as \(calibration, odometry, par"),
        ([small_world], r"small_world\(.*\) .* is called as \(calibration, odometry\)"),
        (["dead-reckoning", DeadReckoning], "more than once: dead-reckoning"),
        ("isam2", r"estimators is a list: give \['isam2'\]"),
        (DeadReckoning, r"estimators is a list: give \[DeadReckoning\]"),
        (
            {"isam2": {}, "ekf-slam": {}},
            r"give \['isam2', 'ekf-slam'\], and settings after it",
        ),
        (7, r"give \[\"isam2\"\], not 7"),
    ):
        with pytest.raises(SonarGraphError, match=said):
            compare(small_world(), asked)
    with pytest.raises(EstimatorError, match="settings of tilted: a function takes no"):
        compare(small_world(), [tilted], {"tilted": {"gravity_interval_s": 2.0}})


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Silent, "process never returned an estimate"),
        (Asleep, "process never returned an estimate"),
        (NoMap, r"landmarks\(\) returned None, .* return LandmarkMap.empty\(\)"),
        (Tuples, "process returned a tuple, not an Estimate"),
        (Flat, r"a covariance of shape \(3, 3\); expected \(6, 6\)"),
        (lambda *_: None, "what was made is None, which lacks process, trajectory"),
    ],
)
def test_what_an_estimator_does_not_return_is_the_reason_of_its_failure(kind, said):
    kind.__name__ = getattr(kind, "__name__", "").strip("<>").replace("lambda", "none")
    run = run_estimator(small_world(), kind)
    assert run.status == "failed"
    assert re.search(said, run.reason), run.reason


def test_two_packages_that_bring_one_name_are_named(monkeypatch):
    points = [
        EntryPoint("mine", "one.filter:A", module.ENTRY_POINT_GROUP),
        EntryPoint("mine", "other.filter:B", module.ENTRY_POINT_GROUP),
    ]
    monkeypatch.setattr(module, "entry_points", lambda group: points if group else [])
    with pytest.raises(
        UnknownEstimatorError, match=r"one.filter:A\) and a package \(other.filter:B"
    ):
        compare(small_world(), ["mine"])
