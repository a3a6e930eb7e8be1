"""Motion since a node, asked for at one instant after another, without integrating twice what is final."""

from __future__ import annotations

from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion, Preintegrator
from sonar_graph.navigation.node_motion import motion_between_nodes, motion_since_node
from sonar_graph.navigation.odometry import Odometry


class RunningMotion:
    """Motion from one node to later and later instants.

    Motion between nodes is final and is kept; only what follows the newest reached node is integrated at each call.

    Parameters
    ----------
    start_ns
        The node.
    bias
        Gyro bias to remove, shape (3,), rad/s.
    earth_rate
        Earth's rotation in the body frame at the node, shape (3,), rad/s; None: not removed.
    """

    def __init__(
        self,
        odometry: Odometry,
        preintegrator: Preintegrator,
        start_ns: int,
        bias: Floats,
        earth_rate: Floats | None,
    ) -> None:
        self._odometry = odometry
        self._preintegrator = preintegrator
        self._bias = bias
        self._earth_rate = earth_rate
        self._reached_ns = start_ns
        self._reached: PreintegratedMotion | None = None

    def until(self, instant_ns: int) -> PreintegratedMotion:
        """Provisional motion to an instant not before that of any earlier call."""
        newest_ns = self._odometry.newest_node(self._reached_ns, instant_ns)
        if newest_ns is not None:
            motion = motion_between_nodes(*self._from_reached(newest_ns))
            self._reached = motion if self._reached is None else self._reached.then(motion)
            self._reached_ns = newest_ns
        if instant_ns == self._reached_ns and self._reached is not None:
            return self._reached
        motion = motion_since_node(*self._from_reached(instant_ns))
        return motion if self._reached is None else self._reached.then(motion)

    def _from_reached(self, until_ns: int) -> tuple[Odometry, Preintegrator, int, int, Floats, Floats | None]:
        """What a motion from the newest node reached needs."""
        earth_rate = self._earth_rate
        if earth_rate is not None and self._reached is not None:
            earth_rate = self._reached.i_T_j.rotation().unrotate(earth_rate)
        return self._odometry, self._preintegrator, self._reached_ns, until_ns, self._bias, earth_rate
