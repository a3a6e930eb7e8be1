import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonar_graph.calibration import Calibration
from sonar_graph.errors import MeasurementError
from sonar_graph.measurements import NS_PER_S, Depth, Dvl, Heading, Imu, PositionFixes
from sonar_graph.sequence import Sequence


def recording(
    imu_s: tuple[float, float] = (0.0, 10.0), dvl_s: tuple[float, float] = (0.0, 10.0)
) -> Sequence:
    """IMU at 50 Hz and DVL at 7 Hz between the given times, depth at 10 Hz from before to after."""
    epoch_ns = 1_700_000_000 * NS_PER_S

    def stamps(between_s: tuple[float, float], rate_hz: float) -> np.ndarray:
        seconds = np.arange(between_s[0], between_s[1] + 1e-9, 1 / rate_hz)
        return epoch_ns + np.round(seconds * NS_PER_S).astype(np.int64)

    imu = stamps(imu_s, 50)
    dvl = stamps(dvl_s, 7)
    depth = stamps((-2.0, 12.0), 10)
    zero = np.zeros((len(imu), 3))
    level = np.zeros(len(depth))
    still = np.zeros((len(dvl), 3))
    unknown = np.full((len(dvl), 3, 3), np.nan)
    return Sequence(
        "test",
        Calibration(),
        Imu(imu, zero, zero),
        Dvl(dvl, still, unknown),
        Depth(depth, level, level + np.nan),
        heading=Heading(depth + 1, level, level + np.nan),
        positions=PositionFixes(dvl + 2, still, unknown),
    )


def test_start_and_end_have_both_imu_and_dvl():
    sequence = recording(imu_s=(0.5, 9.0), dvl_s=(1.0, 8.0))
    assert sequence.start_ns == sequence.dvl.stamps_ns[0]
    assert sequence.end_ns == sequence.dvl.stamps_ns[-1]
    assert sequence.duration_s == pytest.approx(7.0)
    late = recording(imu_s=(2.0, 9.0))
    assert late.start_ns == late.imu.stamps_ns[0]


@given(st.floats(0.3, 40))
def test_instants_are_equally_spaced_inside_the_sequence(rate_hz):
    sequence = recording()
    instants = sequence.instants(rate_hz)
    step_ns = round(NS_PER_S / rate_hz)
    assert instants[0] == sequence.start_ns + step_ns
    assert sequence.end_ns - step_ns < instants[-1] <= sequence.end_ns
    assert set(np.diff(instants).tolist()) <= {step_ns}


@given(st.floats(0.3, 40))
def test_replay_hands_out_every_row_once_and_in_time(rate_hz):
    """Also those before the start."""
    sequence = recording()
    steps = list(sequence.replay(sequence.instants(rate_hz)))
    last_ns = steps[-1].end_ns
    for name in ("imu", "dvl", "depth", "heading", "positions"):
        blocks = [getattr(step, name) for step in steps]
        handed = [block.stamps_ns for block in blocks if block is not None]
        all_ns = getattr(sequence, name).stamps_ns
        np.testing.assert_array_equal(np.concatenate(handed), all_ns[all_ns <= last_ns])
    for before, step in itertools.pairwise(steps):
        if step.imu is not None:
            assert before.end_ns < step.imu.stamps_ns[0]
            assert step.imu.stamps_ns[-1] <= step.end_ns


NO_RATES = {
    1e8: r"are \d+ instants, and at most 10000000 .*--start and --end",
    0.05: r"too short for 0\.05 Hz",
}
NO_RATES |= dict.fromkeys([0.0, -1.0, float("inf"), float("nan"), 3e9], "Hz is no rate")


@pytest.mark.parametrize(("rate_hz", "said"), NO_RATES.items())
def test_a_rate_that_is_none_or_does_not_fit_the_duration_is_refused(rate_hz, said):
    with pytest.raises(MeasurementError, match=said):
        recording().instants(rate_hz)
