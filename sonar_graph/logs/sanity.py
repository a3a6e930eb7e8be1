"""What a log's numbers say against the axes that are assumed for its sensors."""

from __future__ import annotations

import numpy as np

from sonar_graph.calibration import Mounting
from sonar_graph.logs.adapters.adapter import Adapter
from sonar_graph.logs.adapters.shipped import Z_DOWN_TYPES
from sonar_graph.measurements import Floats

_LEAST_PART_UPWARDS = 0.7
_MOST_OF_GRAVITY = 0.2


def gravity_warning(specific_force: Floats, mounting: Mounting, gravity_m_s2: float) -> str | None:
    """What is wrong when the typical specific force, shape (n, 3), does not point up in the body; None: nothing.

    Vehicles that can be navigated at all are near level for most of the time. A force that differs from gravity by
    more than a fifth says nothing about axes, but something about units.
    """
    measured = specific_force[np.isfinite(specific_force).all(axis=1)]
    if not len(measured):
        return None
    typical = mounting.pose().rotation().matrix() @ np.median(measured, axis=0)
    length = float(np.linalg.norm(typical))
    if abs(length - gravity_m_s2) > _MOST_OF_GRAVITY * gravity_m_s2:
        return (
            f"the typical specific force is {length:.3g} m/s2 instead of {gravity_m_s2:.3g}: give its scale (9.80665 "
            f"where it is in g), or turn off use_gravity in the calibration where gravity was taken out"
        )
    if typical[2] >= _LEAST_PART_UPWARDS * length:
        return None
    axis = int(np.argmax(np.abs(typical)))
    sign, advice = ("-" if typical[axis] < 0 else "+"), _ROTATIONS[axis, bool(typical[axis] < 0)]
    return f"gravity is felt along {sign}{'xyz'[axis]} ({typical[axis]:.2f} m/s2) instead of the body's +z: {advice}"


_ROTATIONS = {
    (0, False): "give rotation = [0, -90, 0] or the IMU's mounting",
    (0, True): "give rotation = [0, 90, 0] or the IMU's mounting",
    (1, False): "give rotation = [90, 0, 0] or the IMU's mounting",
    (1, True): "give rotation = [-90, 0, 0] or the IMU's mounting",
    (2, True): 'give rotation = "frd", or linear_acceleration_scale = -1 where only the sign is wrong',
}
"""By axis and whether gravity is felt against it."""


def axes_warning(adapter: Adapter) -> str | None:
    """That a driver may keep to its message's definition, where that has z down and nothing else is known."""
    if adapter.type not in Z_DOWN_TYPES or adapter.rotation != "flu":
        return None
    return (
        f"by its definition {adapter.type} has z downwards, and no mounting says how the instrument sits; it is read "
        f'as x forward, y left, z up: give rotation = "frd" where the driver keeps to the definition'
    )
