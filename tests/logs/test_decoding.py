from __future__ import annotations

from typing import Any

from sonar_graph.logs.adapters.landmark_messages import LandmarkMapAdapter
from sonar_graph.logs.mcap.reader import scan
from sonar_graph.logs.mcap.topic import Keep

from .conftest import Bench, header


def landmark_map(bench: Bench, ids: list[int]) -> dict[str, Any]:
    count = len(ids)
    lists = {"ids": ids, "position": [0.5] * 3 * count, "covariance": [0.0] * 9 * count}
    return {"header": header(bench.t0_ns, "map"), **lists}


def test_the_last_map_counts_whatever_the_lengths_of_those_before(bench: Bench) -> None:
    for last in ([4], [4, 5], [4, 5, 6]):
        maps = [landmark_map(bench, ids) for ids in ([1, 2], [3], last)]
        topic = scan(bench.write(("/truth/landmarks", "map", maps)), lambda _: Keep.ALL).topics["/truth/landmarks"]
        found, _ = LandmarkMapAdapter(type=topic.type_name).read(topic)
        assert found is not None
        assert found.ids.tolist() == last
