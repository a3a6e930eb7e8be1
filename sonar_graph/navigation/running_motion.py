"""Motion since a node, asked for at one instant after another, without integrating twice what is final."""

from __future__ import annotations

from sonar_graph.measurements import Floats
from sonar_graph.navigation.dvl_preintegration import PreintegratedMotion, Preintegrator
from sonar_graph.navigation.odometry import Odometry, Steps


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
            self._reached = self._after(self._odometry.steps_between_nodes(self._reached_ns, newest_ns))
            self._reached_ns = newest_ns
        if instant_ns == self._reached_ns and self._reached is not None:
            return self._reached
        return self._after(self._odometry.steps_since_node(self._reached_ns, instant_ns))

    def _after(self, steps: Steps) -> PreintegratedMotion:
        if self._reached is None:
            return self._preintegrator.integrate(steps, self._bias, self._earth_rate)
        earth_rate = None if self._earth_rate is None else self._reached.i_T_j.rotation().unrotate(self._earth_rate)
        return self._reached.then(self._preintegrator.integrate(steps, self._bias, earth_rate))
