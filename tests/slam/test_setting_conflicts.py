"""Settings that exclude each other, or do nothing, are refused where they are read, field by field."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from sonar_graph.slam.isam2 import Isam2Params

EXCLUDING = {
    "max-mixture in a bounded history": (
        {"identity_policy": "max-mixture", "history": "bounded"},
        "history",
        'identity_policy = "max-mixture" chooses anew in the whole history; give it history = "whole", or',
    ),
    "gnc in a bounded history": (
        {"identity_policy": "gnc", "history": "bounded"},
        "history",
        'identity_policy = "gnc" chooses anew',
    ),
    "max-mixture with landmarks that have no name": (
        {"identity_policy": "max-mixture", "unknown_landmarks": "associate"},
        "unknown_landmarks",
        'begins no landmark without a name; give it unknown_landmarks = "ignore", or',
    ),
}
IDLE: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "gate_probability": ({"gate_probability": 0.99}, {"identity_policy": "gate"}),
    "wrong_id_probability": ({"wrong_id_probability": 0.2}, {"identity_policy": "gnc"}),
    "view_range_m": ({"view_range_m": 5.0}, {"identity_policy": "max-mixture"}),
    "view_azimuth_rad": ({"view_azimuth_rad": 1.0}, {"identity_policy": "max-mixture"}),
    "longest_wait_s": ({"longest_wait_s": 3.0, "deferred_identity": False}, {"deferred_identity": True}),
    "identity_probability": ({"identity_probability": 0.9, "identity_policy": "gnc"}, {"identity_policy": "robust"}),
    "deferred_identity": ({"deferred_identity": False, "identity_policy": "gnc"}, {"identity_policy": "robust"}),
    "unknown_gate_probability": ({"unknown_gate_probability": 0.9}, {"unknown_landmarks": "associate"}),
    "unknown_density_m2": ({"unknown_density_m2": 1.0}, {"unknown_landmarks": "associate"}),
    "unknown_sightings": ({"unknown_sightings": 3}, {"unknown_landmarks": "associate"}),
    "unknown_wait_s": ({"unknown_wait_s": 3.0}, {"unknown_landmarks": "associate"}),
    "kernel_width": ({"kernel_width": 2.0, "kernel": "none"}, {"kernel": "huber"}),
    "remembered_s": ({"remembered_s": 30.0}, {"history": "bounded"}),
}


@pytest.mark.parametrize(("settings", "field", "reason"), EXCLUDING.values(), ids=EXCLUDING)
def test_what_excludes_each_other_is_refused_at_its_field(settings: dict[str, Any], field: str, reason: str) -> None:
    with pytest.raises(ValidationError) as fault:
        Isam2Params(**settings)
    (error,) = fault.value.errors()
    assert error["loc"] == (field,)
    assert reason in error["msg"]


@pytest.mark.parametrize(("setting", "cases"), IDLE.items(), ids=IDLE)
def test_a_setting_without_effect_is_refused_until_it_has_one(setting: str, cases: tuple[Any, Any]) -> None:
    idle, made_to_work = cases
    with pytest.raises(ValidationError) as fault:
        Isam2Params(**idle)
    (error,) = fault.value.errors()
    assert error["loc"] == (setting,)
    assert error["msg"].startswith(f"{setting} is of no effect with ")
    assert getattr(Isam2Params(**(idle | made_to_work)), setting) == idle[setting]


def test_defaults_are_never_in_the_way() -> None:
    for policy in ("gate", "robust", "max-mixture", "gnc"):
        Isam2Params(identity_policy=policy, kernel="none")
    Isam2Params(deferred_identity=False)
    Isam2Params(gate_probability=1.0, remembered_s=None, identity_policy="gnc", deferred_identity=True)
