"""What can be chosen about simulated images: every effect has a switch and a documented value.

No value is published for the 2014 experiment beyond the sonar's window and tilt; all are ours. Where they come from is
in docs/theory/sonar_image.md.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sonar_graph.calibration import Section

SonarName = Literal["didson", "aris3000", "oculus1200"]


class ImageOptions(Section):
    """Surroundings and faults of an imaging sonar."""

    sonar: SonarName = "didson"
    """Which sonar; the window is the same for all."""
    designs: str | None = None
    """TOML file, or folder of such files, with the landmarks that lie in the basin. It needs four; of more, those with
    the four lowest identities lie there, in the order of their identities at (5, 0), (7, -5), (2, -7) and (0, -2).
    None: those that ship."""
    speckle: Literal["world", "frame"] = "world"
    """world: scatterers stay where they are, so that speckle changes only as the vehicle moves; frame: drawn anew for
    each frame, as many simulators do."""
    side_lobes: bool = True
    """Of the beams' pattern in azimuth; off: Gaussian beams of the same width."""
    cross_talk_db: float | None = -25.0
    """Power from all beams fired together with one, against its own; None: none."""
    measured_lens: bool = True
    """Whether the log says where the beams truly point; off: it says that they are equally spaced."""
    floor_db: float = 40.0
    """Level of the floor at 2 m in the middle of the fan, over the lowest sample."""
    absorption_db_m: float = Field(0.8, ge=0)
    """One way: fresh water of 17 °C at 1.8 MHz."""
    tvg_error_db: float = Field(1.5, ge=0)
    """Sigma of the tilt from one end of the window to the other which time-varied gain leaves; 0: exact gain."""
    texture_shape: float | None = Field(5.0, gt=0)
    """Shape of the floor's K-distribution: its strength is Gamma(shape) over patches of 3 cm; None: even floor."""
    joints: bool = True
    """Bright joints between the plates of the floor, every 0.5 m."""
    shadows: bool = True
    """Behind what stands above the floor."""
    multipath: bool = True
    """Echoes by way of the surface, and by way of the floor in front of steep faces."""
    surface_path_db: float = -15.0
    """Echo by way of the surface against the direct one, after the sonar's pattern."""
    floor_reflection: float = Field(0.5, ge=0, le=1)
    """Amplitude that a floor mirrors forward."""
    noise_db: float | None = 15.0
    """Level of the receiver's noise at 2 m, in the scale of `floor_db`; None: none."""
    drop_probability: float = Field(0.01, ge=0, lt=1)
    """Share of the frames that are never recorded."""
    time_offset_s: float = 0.0
    """By how much stamps are late; estimators are not told. Real drivers: 0.02 to 0.1."""
    sound_speed_error: float = Field(0.0, gt=-0.1, lt=0.1)
    """Relative error of the sound speed with which times become ranges; estimators are not told."""
    stones: int = Field(4, ge=0, le=6)
    """Rounded stones on the route, up to 6 cm high."""
    decoys: int = Field(4, ge=0, le=6)
    """Flat rough patches on the route, as large as landmarks and as bright, of irregular outline."""
