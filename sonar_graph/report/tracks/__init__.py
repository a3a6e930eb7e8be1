"""The page of tracks and candidates, with what became of each."""

from sonar_graph.report.tracks.track_page import write_track_page

__all__ = ["write_track_page"]
