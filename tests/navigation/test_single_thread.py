"""Hundreds of small systems are solved by one BLAS thread: more of them wait for each other."""

from __future__ import annotations

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from sonar_graph.navigation.alignment import dvl_imu as dvl_against_imu
from sonar_graph.navigation.alignment import reference_offset as reference_match
from sonar_graph.simulation.basin import BasinOptions, simulate_basin


class SearchBegunError(Exception):
    """With the number of threads at that time."""


def blas_threads() -> int:
    return max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")


def stop_and_tell(*_: object) -> None:
    raise SearchBegunError(blas_threads())


@pytest.mark.parametrize("module", [dvl_against_imu, reference_match])
def test_offsets_are_searched_by_one_thread(module, monkeypatch: pytest.MonkeyPatch):
    run = simulate_basin(BasinOptions(duration_s=120.0, laps=1, speed_m_s=0.4))
    match, other = (
        (module.match_dvl_to_imu, run.dvl) if module is dvl_against_imu else (module.match_reference_to_imu, run.truth)
    )
    monkeypatch.setattr(module, "search_offset", stop_and_tell)
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        with pytest.raises(SearchBegunError) as seen:
            match(run.imu, other, run.calibration)
    assert before == 2
    assert seen.value.args == (1,)
