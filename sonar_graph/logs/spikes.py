"""Angular rates of single samples that no vehicle turns with."""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Imu

LEAST_RAD_S = 1.0
LEAST_RATIO = 20.0
"""A spike stands out by more than this times what is exceeded by one sample in a hundred."""


def spike_warning(imu: Imu) -> str | None:
    """Samples that differ from both their neighbours, which agree; None: there is none.

    ``e_k = |w_k - (w_k-1 + w_k+1) / 2|`` is a spike above `LEAST_RAD_S` and `LEAST_RATIO` times its 99 % quantile,
    where ``|w_k+1 - w_k-1| < e_k / 2``.
    """
    rate = imu.angular_velocity
    if len(rate) < 3:
        return None
    off = np.linalg.norm(rate[1:-1] - (rate[:-2] + rate[2:]) / 2, axis=1)
    agree = np.linalg.norm(rate[2:] - rate[:-2], axis=1) < off / 2
    spikes = np.flatnonzero(agree & (off > max(LEAST_RAD_S, LEAST_RATIO * float(np.quantile(off, 0.99))))) + 1
    if not spikes.size:
        return None
    largest = int(spikes[np.argmax(off[spikes - 1])])
    at_s = (imu.stamps_ns[largest] - imu.stamps_ns[0]) * 1e-9
    count = "1 angular rate stands" if len(spikes) == 1 else f"{len(spikes)} angular rates stand"
    return (
        f"{count} out from both neighbours, by {off[largest - 1]:.3g} rad/s at most, {at_s:.3f} s after the first: "
        f"heading is wrong from there on, leave such messages out"
    )
