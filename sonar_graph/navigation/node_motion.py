"""Motion from a node of the odometry, over whatever lies behind it: Doppler samples, and gaps without them."""

from __future__ import annotations

from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion, Preintegrator
from sonar_graph.navigation.odometry import Odometry


def motion_between_nodes(
    odometry: Odometry,
    preintegrator: Preintegrator,
    start_ns: int,
    end_ns: int,
    bias: Floats,
    earth_rate: Floats | None,
) -> PreintegratedMotion:
    """Final motion from one node to a later, reached one; each gap in between is bridged with both its ends known.

    Parameters
    ----------
    bias
        Gyro bias in the body frame to remove, shape (3,), rad/s.
    earth_rate
        Earth's rotation in the body frame at the first node, shape (3,), rad/s; None: not removed.
    """
    gaps = odometry.gaps(start_ns, end_ns) if preintegrator.gap else []
    if not gaps:
        return preintegrator.integrate(odometry.steps_between_nodes(start_ns, end_ns), bias, earth_rate)
    total, at_ns = None, start_ns
    for lost_ns, found_ns in [*gaps, (end_ns, end_ns)]:
        if at_ns < lost_ns:
            steps = odometry.steps_between_nodes(at_ns, lost_ns)
            total = _then(total, preintegrator.integrate(steps, bias, _turned(earth_rate, total)))
        if lost_ns < found_ns:
            gap = preintegrator.bridge(odometry.columns(), lost_ns, found_ns, True, bias, _turned(earth_rate, total))
            total = _then(total, gap)
        at_ns = found_ns
    assert total is not None
    return total


def motion_since_node(
    odometry: Odometry,
    preintegrator: Preintegrator,
    node_ns: int,
    until_ns: int,
    bias: Floats,
    earth_rate: Floats | None,
) -> PreintegratedMotion:
    """Provisional motion from the newest node reached to an instant, from rows stamped no later than that."""
    if preintegrator.gap and odometry.is_gap(node_ns, until_ns):
        return preintegrator.bridge(odometry.columns(), node_ns, until_ns, False, bias, earth_rate)
    return preintegrator.integrate(odometry.steps_since_node(node_ns, until_ns), bias, earth_rate)


def _then(before: PreintegratedMotion | None, motion: PreintegratedMotion) -> PreintegratedMotion:
    return motion if before is None else before.then(motion)


def _turned(earth_rate: Floats | None, motion: PreintegratedMotion | None) -> Floats | None:
    """Earth's rotation after a motion."""
    if earth_rate is None or motion is None:
        return earth_rate
    return motion.i_T_j.rotation().unrotate(earth_rate)
