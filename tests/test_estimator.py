from importlib.metadata import EntryPoint
from typing import ClassVar

import pytest

from sonar_graph import estimator as module
from sonar_graph.calibration import Calibration, Section
from sonar_graph.errors import EstimatorError, UnknownEstimatorError
from sonar_graph.estimator import (
    Estimator,
    installed_estimators,
    load_estimator,
    make_params,
)
from sonar_graph.evaluation import compare, run_estimator
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


def test_missing_methods_are_named(monkeypatch):
    announce(monkeypatch, half="irrelevant:X")
    monkeypatch.setattr(EntryPoint, "load", lambda _: OnlyTrajectory)
    with pytest.raises(EstimatorError, match="lacks process, landmarks, detections of"):
        load_estimator("half")


def test_settings_replace_defaults_one_by_one_and_a_wrong_one_is_refused_with_those_that_exist():
    assert make_params(Nothing, {"gain": 2}, "nothing") == Nothing.Params(gain=2.0)  # type: ignore[arg-type]
    for settings, said in (
        ({"gian": 1}, r"gian: .* did you mean gain\? it has: gain, name"),
        ({"gain": "high"}, r"gain: expected a number, not 'high'"),
    ):
        with pytest.raises(EstimatorError, match=f"settings of nothing: {said}"):
            make_params(Nothing, settings, "nothing")  # type: ignore[arg-type]


def test_protocol_is_told_apart_by_its_methods():
    assert isinstance(Nothing(), Estimator)
    assert not isinstance(OnlyTrajectory(), Estimator)


def test_a_class_or_an_instance_in_the_place_of_a_name_is_answered_with_its_name():
    kind = load_estimator("ekf-slam")
    for asked, said in (
        (kind, "not the class EkfSlam; give 'ekf-slam', or announce"),
        (
            kind(Calibration(), Odometry(Calibration())),
            "not <.*EkfSlam object.*; give 'ekf-slam', or",
        ),
        (Nothing, "not the class Nothing; give 'dead-reckoning' or 'ekf-slam' or"),
        (None, "not None; give 'dead-reckoning'"),
    ):
        for run in (
            lambda name: run_estimator(small_world(), name),
            lambda name: compare(small_world(), [name]),
        ):
            with pytest.raises(
                UnknownEstimatorError,
                match=f"expected the name of an installed estimator, {said}",
            ):
                run(asked)
    for settings, said in (
        ("gain=2", 'not str; give {"name": value}'),
        (kind.Params(), r"give params.model_dump\(\)"),
    ):
        with pytest.raises(
            EstimatorError, match=f"settings of ekf-slam: expected a dict, .*{said}"
        ):
            run_estimator(small_world(), "ekf-slam", settings)  # type: ignore[arg-type]
