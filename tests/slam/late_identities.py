"""Runs whose identities come late, change, or never come."""

from collections import Counter
from dataclasses import replace

import numpy as np

from sonar_graph.sequence import Sequence
from sonar_graph.slam import Isam2
from sonar_graph.states import Outcome

from .dive import NS, T0_NS, Dive, spherical
from .made import ran
from .rail import rail

FLAT = [0.2, 0.2, 0.2, 0.2]
IDS = [4, 5, 6, 7]
LATE = {Outcome.USED_LATER, Outcome.MOVED}
SURE = {i: [float(i == j) for j in IDS] for i in IDS}
BASIN = {"duration_s": 130.0, "laps": 1, "seed": 3, "tracks": True}
TROUBLES = {
    "late": {"id_delay_s": 4.0},
    "wrong": {"wrong_id_rate": 1.0, "wrong_id_share": 0.8},
    "late and wrong": {"id_delay_s": 2.0, "wrong_id_rate": 1.0, "wrong_id_share": 0.6},
}
POLICIES = {
    "robust": {},
    "gate": {"identity__policy": "gate", "identity__gate_probability": 0.99},
    "bounded": {"history__policy": "bounded", "smoother__lag_s": 3.0},
    "short": {"smoother__lag_s": 1.6},
    "associate": {"identity__unknown__policy": "associate"},
    "max-mixture": {"identity__policy": "max-mixture"},
}
OBJECTS = np.array([[4.0, 0.8, -1.4], [5.0, 0.2, -1.6], [4.5, 1.6, -1.5]])
GAP_S = 0.7


def from_the_start(sequence: Sequence) -> Sequence:
    """The same, had the last posterior of each track been its first."""
    seen = sequence.detections
    beliefs = seen.id_probability.copy()
    for number in set(seen.track.tolist()) - {-1}:
        rows = np.flatnonzero(seen.track == number)
        beliefs[rows] = beliefs[rows[-1]]
    return replace(sequence, detections=replace(seen, id_probability=beliefs))


def run(sequence: Sequence, rate_hz: float = 2.0, **params) -> Isam2:
    return ran(sequence, rate_hz, **params)[0]


def assert_outcomes_account(estimator: Isam2, sequence: Sequence) -> Counter:
    """One row a detection, in order."""
    log = estimator.detections()
    assert log.stamps_ns.tolist() == sequence.detections.stamps_ns.tolist()
    return Counter(log.outcomes)


def on_the_rail(beliefs_of_7: list[list[float]], beliefs_of_4: list[float]) -> Sequence:
    """One track a landmark; posteriors of 7 in its first, second, ... frame, the last for the rest."""
    sequence, _ = rail()
    seen = sequence.detections
    track = np.where(seen.candidate_ids[:, 0] == 7, 70, 40)
    beliefs = np.tile(np.array(beliefs_of_4), (len(seen), 1))
    for n, row in enumerate(np.flatnonzero(track == 70)):
        beliefs[row] = beliefs_of_7[min(n, len(beliefs_of_7) - 1)]
    ids = np.tile(IDS, (len(seen), 1))
    return replace(
        sequence,
        detections=replace(
            seen, candidate_ids=ids, id_probability=beliefs, track=track
        ),
    )


class Watch(Dive):
    """Three objects, each watched in every frame."""

    def watch(self, number: int, beliefs: list[list[float]]) -> None:
        z = [spherical(0.5 * number * GAP_S, p) for p in OBJECTS]
        self.show(T0_NS + round(number * GAP_S * NS), z, IDS, beliefs, np.arange(3))
        self.keyframes.update_if_due()


def see(
    dive: Dive, after_s: float, belief: list[float], track: int = 3, off_m: float = 0.0
) -> None:
    z = spherical(0.5 * after_s, OBJECTS[0]) + np.array([off_m, 0.0])
    dive.show(T0_NS + round(after_s * NS), [z], IDS, [belief], [track])
