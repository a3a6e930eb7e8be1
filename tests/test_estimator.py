from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import ClassVar

import pytest

from sonar_graph import estimator as module
from sonar_graph.calibration import Section
from sonar_graph.errors import EstimatorError, UnknownEstimatorError
from sonar_graph.estimator import Estimator, installed_estimators, load_estimator, make_params


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
    points = [EntryPoint(name.replace("_", "-"), value, module.ENTRY_POINT_GROUP) for name, value in values.items()]
    monkeypatch.setattr(module, "entry_points", lambda group: points if group == module.ENTRY_POINT_GROUP else [])


def test_those_that_come_along_are_announced():
    assert {"dead-reckoning", "ekf-slam", "invariant-ekf", "isam2"} <= set(installed_estimators())


@pytest.mark.parametrize("name", ["dead-reckoning", "ekf-slam", "invariant-ekf", "isam2"])
def test_what_comes_along_loads_with_default_settings(name):
    kind = load_estimator(name)
    assert make_params(kind, {}, name) == kind.Params()


def test_third_party_is_found_by_its_name(monkeypatch):
    announce(monkeypatch, fractions="fractions:Fraction")
    assert list(installed_estimators()) == ["fractions"]


def test_nothing_is_imported_by_looking(monkeypatch):
    announce(monkeypatch, broken="no_such_package:X")
    assert "broken" in installed_estimators()


def test_unknown_name_is_refused_with_those_that_exist(monkeypatch):
    announce(monkeypatch, one="a:A", two="b:B")
    with pytest.raises(UnknownEstimatorError, match="'three'; installed: one, two"):
        load_estimator("three")


def test_broken_package_is_named(monkeypatch):
    announce(monkeypatch, broken="no_such_package:X")
    with pytest.raises(EstimatorError, match=r"broken \(no_such_package:X\) cannot be loaded: .*no_such_package"):
        load_estimator("broken")


def test_missing_methods_are_named(monkeypatch):
    announce(monkeypatch, half="irrelevant:X")
    monkeypatch.setattr(EntryPoint, "load", lambda _: OnlyTrajectory)
    with pytest.raises(EstimatorError, match="lacks process, landmarks, detections of"):
        load_estimator("half")


def test_settings_replace_defaults_one_by_one():
    settings = make_params(Nothing, {"gain": 2}, "nothing")  # type: ignore[arg-type]
    assert settings == Nothing.Params(gain=2.0)


def test_wrong_setting_is_refused_with_those_that_exist():
    with pytest.raises(EstimatorError, match=r"settings of nothing: gian: .* did you mean gain\? it has: gain, name"):
        make_params(Nothing, {"gian": 1}, "nothing")  # type: ignore[arg-type]
    with pytest.raises(EstimatorError, match=r"settings of nothing: gain: .* number, .* not 'high'"):
        make_params(Nothing, {"gain": "high"}, "nothing")  # type: ignore[arg-type]


def test_protocol_is_told_apart_by_its_methods():
    assert isinstance(Nothing(), Estimator)
    assert not isinstance(OnlyTrajectory(), Estimator)
