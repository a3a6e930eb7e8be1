"""What can be chosen about any simulated run."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from sonar_graph.calibration import Section
from sonar_graph.simulation.presets import DvlName, ImuName


class SimulationOptions(Section):
    """Sensors and their faults, and how often the landmark recogniser is right."""

    model_config = ConfigDict(allow_inf_nan=False)

    seed: int = Field(0, ge=0)
    """Of everything random; equal options give equal bits."""
    imu: ImuName = "hg1700"
    """IMU preset."""
    dvl: DvlName = "workhorse"
    """Doppler log preset."""
    gyro_bias_scale: float = Field(1.0, ge=0)
    """Times the preset's gyro bias and its random walk; 0: none, and estimators are told so."""
    accel_bias_scale: float = Field(1.0, ge=0)
    """Times the preset's accelerometer bias; 0: none, and estimators are told so."""
    dvl_scale_error: float = Field(0.0, gt=-0.5, lt=0.5)
    """Relative error of all velocities (0.007 reads 0.7 % too fast); estimators are not told."""
    dvl_dropouts_per_hour: float = Field(0.0, ge=0)
    """Losses of bottom lock."""
    dvl_dropout_s: float = Field(3.0, gt=0)
    """How long each loss lasts."""
    frame_rate_hz: float = Field(5.0, gt=0, le=30)
    """Sonar frames a second."""
    range_sigma_m: float = Field(0.015, gt=0)
    """White noise of a detection's range."""
    azimuth_sigma_rad: float = Field(0.007, gt=0)
    """White noise of a detection's azimuth (0.4 degrees)."""
    detection_probability: float = Field(0.9, ge=0, le=1)
    """Of a landmark inside the fan, in each frame."""
    wrong_id_rate: float = Field(0.0, ge=0, le=1)
    """Share of the detected landmarks taken confidently for another one; with ``tracks``, share of the tracks."""
    tracks: bool = False
    """Whether the recogniser watches landmarks over frames: detections then carry the number of their track."""
    id_delay_s: float = Field(0.0, ge=0)
    """With ``tracks``: nothing is believed of a track until it is that old."""
    wrong_id_share: float = Field(0.5, ge=0, le=1)
    """With ``tracks``: share of a track, once something is believed, in which a wrong identity is; 1: to its end."""
    anonymous_share: float = Field(0.0, ge=0, le=1)
    """Share of all detections, false ones as well, that come without any identity."""
    false_detections_per_frame: float = Field(0.02, ge=0)
    """Mean number of detections of nothing."""
    confident_false_fraction: float = Field(0.0, ge=0, le=1)
    """Share of the false detections taken confidently for a landmark."""
    start_position_sigma_m: float = Field(0.01, gt=0)
    """The start which estimators are given is drawn about the true one with this sigma on each axis."""
    start_rotation_sigma_rad: float = Field(0.005, gt=0)
    """The same for its rotation, about each body axis."""
    floor_sigma_m: float = Field(0.01, gt=0)
    """Landmark heights are drawn about the floor with this sigma, and estimators are told so."""
