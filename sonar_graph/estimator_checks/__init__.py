"""The contract of an estimator as tests that its author can run.

Each check takes something that makes an estimator from a calibration, such as its class, and raises
`ContractError` where the contract is broken. With pytest::

    import pytest
    from sonar_graph.estimator_checks import CHECKS

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_my_filter_keeps_the_contract(check):
        check(MyFilter)

and without: ``check_estimator(MyFilter)``. A filter, or whatever else never iterates, should pass `FILTER_CHECKS` as
well. The checks bring their own small world, a vehicle that turns gently to the
left past three landmarks at its own depth, so that they need no data and no simulator.
"""

from __future__ import annotations

from sonar_graph.estimator_checks.laws import CHECKS, FILTER_CHECKS, Check
from sonar_graph.estimator_checks.outcome import ContractError, MakeEstimator

__all__ = ["CHECKS", "FILTER_CHECKS", "Check", "ContractError", "MakeEstimator", "check_estimator"]


def check_estimator(make: MakeEstimator) -> None:
    """Run every check of `CHECKS`.

    Raises
    ------
    ContractError
        At the first check that fails, with its name; also where the estimator itself raises.
    """
    for check in CHECKS:
        try:
            check(make)
        except ContractError as violation:
            raise ContractError(f"{check.__name__}: {violation}") from violation
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
            raise ContractError(
                f"{check.__name__}: the estimator raised {said}; any block of Measurements may be None"
            ) from error
