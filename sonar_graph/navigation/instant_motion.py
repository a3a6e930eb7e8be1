"""Motion between any two instants, from what is stamped no later than the second.

Nodes are the stamps of the Doppler log (`sonar_graph.navigation.odometry`). Without a gap of the log the motion runs
over the steps between the instants. A gap that has ended between two nodes is bridged with both its ends known. In one
that has not, both instants are reached from the node at which bottom lock was lost, and the motion between them is::

    M = M_1^-1 M_2,    P = P_2 - Ad(M^-1) P_1 Ad(M^-1)^T

P is what the error grew by, so that motions which follow each other, taken as independent, add up to that since the
node. What they share makes a single one surer than P says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion, Preintegrator
from sonar_graph.navigation.interpolation import rows_until
from sonar_graph.navigation.node_motion import motion_between_nodes, motion_since_node
from sonar_graph.navigation.odometry import Odometry
from sonar_graph.navigation.stamped_rows import EARLIEST_NS
from sonar_graph.navigation.steps import Steps, merge_rows


def motion_between(
    odometry: Odometry, preintegrator: Preintegrator, start_ns: int, end_ns: int, bias: Floats
) -> PreintegratedMotion:
    """Provisional motion from one instant to a later one, the first not before the first node.

    Parameters
    ----------
    bias
        Gyro bias in the body frame to remove, shape (3,), rad/s.
    """
    newest_ns = odometry.newest_node(start_ns, end_ns)
    if newest_ns is None:
        return _without_a_node(odometry, preintegrator, start_ns, end_ns, bias)
    first_ns = int(odometry.nodes(start_ns - 1, end_ns)[0])
    if not (odometry.gaps(first_ns, newest_ns) or odometry.is_gap(newest_ns, end_ns)):
        return _over_steps(odometry, preintegrator, start_ns, end_ns, end_ns, bias)
    motion = motion_between_nodes(odometry, preintegrator, first_ns, newest_ns, bias, None)
    if start_ns < first_ns:
        motion = _over_steps(odometry, preintegrator, start_ns, first_ns, end_ns, bias).then(motion)
    if newest_ns < end_ns:
        motion = motion.then(motion_since_node(odometry, preintegrator, newest_ns, end_ns, bias, None))
    return motion


def _without_a_node(
    odometry: Odometry, preintegrator: Preintegrator, start_ns: int, end_ns: int, bias: Floats
) -> PreintegratedMotion:
    """No node after the first instant is reached at the second."""
    node_ns = odometry.newest_node(EARLIEST_NS, end_ns)
    if node_ns is None or start_ns == end_ns or not odometry.is_gap(node_ns, end_ns):
        return _over_steps(odometry, preintegrator, start_ns, end_ns, end_ns, bias)
    whole = motion_since_node(odometry, preintegrator, node_ns, end_ns, bias, None)
    if node_ns == start_ns:
        return whole
    return _rest(motion_since_node(odometry, preintegrator, node_ns, start_ns, bias, None), whole)


def _rest(before: PreintegratedMotion, whole: PreintegratedMotion) -> PreintegratedMotion:
    """What is left of a motion after another that begins where it begins."""
    motion = before.i_T_j.between(whole.i_T_j)
    adjoint = motion.inverse().AdjointMap()
    grown = whole.covariance - adjoint @ before.covariance @ adjoint.T
    variances, axes = np.linalg.eigh(0.5 * (grown + grown.T))
    impulse = whole.mean_specific_force * whole.duration_s - before.mean_specific_force * before.duration_s
    duration_s = whole.duration_s - before.duration_s
    return replace(
        whole,
        i_T_j=motion,
        covariance=(axes * np.maximum(variances, 0.0)) @ axes.T,
        D_bias=whole.D_bias - adjoint @ before.D_bias,
        duration_s=duration_s,
        mean_specific_force=before.i_T_j.rotation().unrotate(impulse / duration_s),
    )


def _over_steps(
    odometry: Odometry, preintegrator: Preintegrator, start_ns: int, end_ns: int, known_ns: int, bias: Floats
) -> PreintegratedMotion:
    """Over linear or held velocities, by rows stamped until an instant not before the end."""
    columns = odometry.columns()
    rows = rows_until(columns[0], known_ns), rows_until(columns[3], known_ns)
    return preintegrator.integrate(Steps(*merge_rows(columns, *rows, start_ns, end_ns)), bias)
