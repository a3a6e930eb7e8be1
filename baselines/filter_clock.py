"""The clock of a filter: integers that compiled code writes to."""

from __future__ import annotations

from sonar_graph.measurements import Ints
from sonar_graph.navigation.kernels import inlined

NODE, OPENED, DEPTHS, SIGHTINGS, LOST = 0, 1, 2, 3, 4
"""Places in the clock: stamp of the state, stamp at which the running gravity interval began, how many depth samples
and detections were used since the Doppler log lost the bottom, and whether it ever did (0 or 1)."""
CLOCK = 5
"""Numbers of the clock."""


@inlined
def reach_node(clock: Ints, node_ns: int) -> None:
    """The state is at a node; what was told over a gap before it counts no longer."""
    clock[NODE] = node_ns
    clock[DEPTHS:LOST] = 0
