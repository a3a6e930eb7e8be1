"""The calibration with which a live run goes on from its record."""

from sonar_graph.calibration import Calibration, DepthCalibration, FloorPrior, Start
from sonar_graph.logs import LiveRecord, PartialCalibration


def test_a_resumed_run_merges_its_record_with_the_user_s_calibration(
    tmp_path,
):
    """A depth sensor that did not come may still bring its place; the floor stays, and the user moves the start."""
    start = Start(position_m=(1.0, 2.0, -0.7))
    calibration = Calibration(
        start=start,
        floor=FloorPrior(z_m=-1.7, sigma_m=0.01),
        depth=DepthCalibration(sigma_m=0.3),
    )
    for is_used in (True, False):
        path = tmp_path / f"{is_used}.mcap"
        with LiveRecord(path) as record:
            tables = {
                "imu": {"topic": "/imu"},
                "depth": {"topic": "/depth"} if is_used else {"use": False},
            }
            record.describe("dive", calibration, tables, {}, 0)
        found = LiveRecord.resumed_calibration(path, None).values
        assert found["start"]["position_m"] == [1.0, 2.0, -0.7]
        assert found["floor"]["z_m"] == -1.7
        assert ("depth" in found) == is_used
        given = PartialCalibration.parse(
            {"start": {"position_m": [5.0, 5.0, 5.0]}}, "mine.toml"
        )
        moved = LiveRecord.resumed_calibration(path, given)
        assert moved.values["start"]["position_m"] == [5.0, 5.0, 5.0]
        assert moved.values["floor"]["z_m"] == -1.7
        assert moved.source == f"mine.toml, else {path}"


def test_a_record_without_a_calibration_leaves_what_the_user_gives(tmp_path):
    with LiveRecord(tmp_path / "record.mcap"):
        pass
    assert LiveRecord.resumed_calibration(tmp_path / "record.mcap", None) is None
