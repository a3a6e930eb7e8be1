"""Landmark messages of this package itself: nothing in them is open, but for the topic."""

from __future__ import annotations

from sonar_graph.logs.adapters.adapter import Adapter


class LandmarkMapAdapter(Adapter):
    """``sonar_graph_msgs/LandmarkMap``: true positions of landmarks."""


class DetectionListsAdapter(Adapter):
    """``sonar_graph_msgs/LandmarkDetections``: range, azimuth, covariance and posterior, in flat lists."""
