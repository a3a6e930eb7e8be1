"""Estimators by the rules of other projects, which take part in the open bench."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

from sonar_graph.testing import check_estimator

FILE = (
    Path(__file__).parents[1] / "benchmarks" / "published_rules" / "published_rules.py"
)


@pytest.fixture(scope="module")
def rules() -> ModuleType:
    spec = importlib.util.spec_from_file_location("published_rules", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("name", ["PlainIsam2", "HeldVelocity", "NewestVelocity"])
def test_a_published_rule_keeps_the_contract_of_estimators(rules, name):
    check_estimator(getattr(rules, name))
