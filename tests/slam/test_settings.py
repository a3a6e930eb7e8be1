"""Settings of isam2: sections that refuse what they do not read, and old names that say the new one."""

from typing import Any

import pytest

from sonar_graph.errors import EstimatorError
from sonar_graph.estimator import make_params
from sonar_graph.settings import nested, settings_of
from sonar_graph.slam import Isam2, Isam2Params
from sonar_graph.slam.isam2 import OLD_NAMES

REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "gate without its policy": (
        {"identity.gate_probability": 0.9},
        'identity.gate_probability: there is no such field with policy = "robust"; identity.policy = "gate" has it',
    ),
    "mixture without its policy": ({"identity.view_range_m": 5.0}, 'policy = "max-mixture" or "gnc" has it'),
    "unknown landmarks in a mixture": (
        {"identity.policy": "gnc", "identity.unknown.policy": "associate"},
        'identity.unknown: there is no such field with policy = "gnc"; identity.policy = "robust" or "gate" has it',
    ),
    "association without its policy": ({"identity.unknown.sightings": 3}, 'identity.unknown.policy = "associate" has'),
    "belief in a mixture": ({"identity.policy": "max-mixture", "identity.minimum_probability": 0.9}, '"gate" has it'),
    "memory of a whole history": ({"history.remembered_s": 30.0}, 'history.policy = "bounded" has it'),
    "width of no kernel": ({"kernel.shape": "none", "kernel.width": 2.0}, 'kernel.shape = "huber" or "cauchy" has it'),
    "mixture in a bounded history": (
        {"identity.policy": "max-mixture", "history.policy": "bounded"},
        'history.policy = "bounded" cannot be with identity.policy = "max-mixture", which chooses anew in the whole',
    ),
    "gnc in a bounded history": ({"identity.policy": "gnc", "history.policy": "bounded"}, 'policy = "gnc", which'),
    "no such policy": ({"identity.policy": "gcn"}, "identity.policy: there is no 'gcn'; there are: robust, gate, max-"),
    "a policy for its section": ({"identity": "gnc"}, 'identity: expected a section with policy = "gnc"'),
    "no such section": ({"smother.lag_s": 3}, "smother: there is no such field; did you mean smoother?"),
    "no such setting": ({"smoother.lag": 3}, "smoother.lag: there is no such field; did you mean lag_s? smoother has"),
    "out of range": ({"identity.policy": "gate", "identity.gate_probability": 2}, "identity.gate_probability: Input"),
}


@pytest.mark.parametrize(("given", "fault"), REFUSED.values(), ids=REFUSED)
def test_what_a_policy_does_not_read_is_refused_by_name(given: dict[str, Any], fault: str) -> None:
    with pytest.raises(EstimatorError) as refused:
        make_params(Isam2, nested(given), "isam2")
    assert fault in str(refused.value)


@pytest.mark.parametrize("old", OLD_NAMES)
def test_an_old_name_says_the_new_one(old: str) -> None:
    with pytest.raises(EstimatorError) as refused:
        make_params(Isam2, {old: "x"}, "isam2")
    new = OLD_NAMES[old]
    assert str(refused.value) == f"settings of isam2: {old} is now {new}"
    assert new.split(",")[0] in {setting.name for setting in settings_of(Isam2Params)}


def test_a_section_keeps_its_default_policy_where_none_is_given() -> None:
    params = Isam2Params(**nested({"identity.longest_wait_s": 3.0, "kernel.width": 2.0}))
    assert params.identity.policy == "robust"
    assert params.identity.longest_wait_s == 3.0
    assert params.model_dump()["kernel"] == {"shape": "cauchy", "width": 2.0}
    assert Isam2Params(**params.model_dump(mode="json")) == params


def test_the_listing_has_every_setting_once_with_its_policy() -> None:
    listed = {setting.name: setting for setting in settings_of(Isam2Params)}
    assert len(listed) == len(settings_of(Isam2Params)) == 23
    assert listed["smoother.lag_s"].default == 15.0
    assert listed["identity.policy"].default == "robust"
    assert listed["identity.gate_probability"].meaning.endswith('Only with policy = "gate".')
    assert listed["identity.minimum_probability"].meaning.endswith('Only with policy = "robust" or "gate".')


def test_settings_are_given_by_dotted_names_or_nested() -> None:
    given: list[dict[str, object]] = [{"identity.policy": "gate"}, {"identity": {"policy": "gate"}}]
    first, second = (make_params(Isam2, values, "isam2") for values in given)
    assert first == second != Isam2.Params()
