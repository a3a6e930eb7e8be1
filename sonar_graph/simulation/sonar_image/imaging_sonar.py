"""Imaging sonars (beams, lens, window, scale) and the options of simulated images.

The two-way pattern of a focused lens of width D is ``w(t) = sinc²(D sin(t) / wavelength)``, with D from the one-way
width of a beam at half power, ``D = 0.886 wavelength / width``: its first side lobe lies at -26 dB. Sources of all
values: docs/theory/sonar_image.md.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from sonar_graph.measurements import Floats
from sonar_graph.simulation.sonar_image.conditions import SceneConditions

SOUND_SPEED_M_S = 1480.0
"""Fresh water of 20 °C; nothing here depends on it strongly."""
_FINE_DEG = np.linspace(-20, 20, 8001)


@dataclass(frozen=True)
class ImagingSonar:
    """Parameters of a multibeam imaging sonar."""

    frequency_hz: float
    beams: int
    azimuth_span_rad: float
    """Of all beams together, where the lens is linear."""
    beam_width_rad: float
    """Of one beam, one way, between half powers."""
    elevation_span_rad: float
    """One way, between half powers."""
    bins: int
    range_start_m: float
    range_length_m: float
    range_resolution_m: float
    """Length of a pulse in range, between half powers."""
    firing_groups: int = 1
    """Beams whose numbers are equal modulo this are fired together."""
    lens_cubic: tuple[float, float, float, float] | None = None
    """Beam number, from 1 at the left, as a cubic of degrees to the right, lowest order last; None: beams are equally
    spaced."""
    decibel_span: float = 80.0
    """Decibels over the 255 counts of a sample."""

    @property
    def wavelength_m(self) -> float:
        """Wavelength in water."""
        return SOUND_SPEED_M_S / self.frequency_hz

    @property
    def aperture_m(self) -> float:
        """Width of the lens."""
        return 0.886 * self.wavelength_m / self.beam_width_rad

    def ranges_m(self) -> Floats:
        """Middle of each range bin, shape (bins,)."""
        return (
            self.range_start_m
            + (np.arange(self.bins) + 0.5) * self.range_length_m / self.bins
        )

    def linear_azimuths_rad(self) -> Floats:
        """Equally spaced beams over the span, rightmost first, shape (beams,)."""
        return (
            (np.arange(self.beams) + 0.5) / self.beams - 0.5
        ) * self.azimuth_span_rad

    def azimuths_rad(self) -> Floats:
        """True azimuth of each beam, positive to the left, rightmost first, shape (beams,)."""
        if self.lens_cubic is None:
            return self.linear_azimuths_rad()
        # the cubic gives the beam of an angle; the inverse is needed
        numbers = np.polyval(self.lens_cubic, _FINE_DEG)
        return np.radians(
            -np.interp(np.arange(1, self.beams + 1), numbers, _FINE_DEG)[::-1]
        )

    def two_way_pattern(self, offset_rad: Floats, side_lobes: bool) -> Floats:
        """Amplitude over the angle from a beam's centre, 1 there; without side lobes a Gaussian of equal width."""
        if side_lobes:
            return (
                # the same aperture sends and receives: the one-way pattern squared
                np.sinc(self.aperture_m * np.sin(offset_rad) / self.wavelength_m) ** 2
            )
        return np.exp2(-((2 * offset_rad / self.beam_width_rad) ** 2))

    def elevation_pattern(self, elevation_rad: Floats) -> Floats:
        """Two-way amplitude over elevation, 1 at 0: ``sinc²(0.886 sin e / sin span)``."""
        return (
            np.sinc(0.886 * np.sin(elevation_rad) / np.sin(self.elevation_span_rad))
            ** 2
        )


DIDSON = ImagingSonar(
    frequency_hz=1.8e6,
    beams=96,
    azimuth_span_rad=np.radians(28.8),
    beam_width_rad=np.radians(0.3),
    elevation_span_rad=np.radians(14.0),
    bins=512,
    range_start_m=1.26,
    range_length_m=1.25,
    range_resolution_m=0.004,
    firing_groups=8,
    lens_cubic=(1.012 * 0.0030, 1.012 * -0.0055, 1.012 * 2.6829, 1.012 * 48.04 + 1),
)
"""High frequency, shortest extended window. The lens is the measured one: beams 0.37° apart at the centre, 0.21° at the
edge. Length of the pulse: ours."""


def same_window(**changes: Any) -> ImagingSonar:
    """A sonar over the window of the DIDSON, with beams equally spaced."""
    return replace(DIDSON, lens_cubic=None, **changes)


ARIS_3000 = same_window(
    frequency_hz=3.0e6,
    beams=128,
    azimuth_span_rad=np.radians(30.0),
    beam_width_rad=np.radians(0.2),
    elevation_span_rad=np.radians(15.0),
)
"""ARIS Explorer 3000 with all beams; its lens is not simulated."""
OCULUS_M1200D = same_window(
    frequency_hz=2.1e6,
    beams=512,
    azimuth_span_rad=np.radians(60.0),
    beam_width_rad=np.radians(0.4),
    elevation_span_rad=np.radians(12.0),
    firing_groups=1,
)
"""Oculus M1200d, high frequency; an electronic array, which forms all beams from one ping."""
SonarName = Literal["didson", "aris3000", "oculus1200"]
SONARS: dict[SonarName, ImagingSonar] = {
    "didson": DIDSON,
    "aris3000": ARIS_3000,
    "oculus1200": OCULUS_M1200D,
}


class ImageOptions(SceneConditions):
    """Surroundings and faults of an imaging sonar, and the conditions of the scene."""

    sonar: SonarName = "didson"
    """Sonar model; the window is the same for all."""
    window_m: float | None = Field(None, ge=0.5, le=20)
    """Length of the window in range; None: 1.25 m. It keeps its number of bins, and pulses are as many bins long."""
    designs: str | None = None
    """TOML file, or folder of such files, with the landmarks that lie in the basin. It needs four; of more, those with
    the four lowest identities lie there, in the order of their identities at (5, 0), (7, -5), (2, -7) and (0, -2).
    None: those that ship."""
    speckle: Literal["world", "frame"] = "world"
    """world: scatterers stay where they are, so that speckle changes only as the vehicle moves; frame: drawn for
    each frame, as many simulators do."""
    side_lobes: bool = True
    """Side lobes of the beams in azimuth; off: Gaussian beams of the same width."""
    cross_talk_db: float | None = -25.0
    """Power from all beams fired together with one, against its own; None: none."""
    measured_lens: bool = True
    """The log has the true azimuths of the beams; off: it has equally spaced ones."""
    floor_db: float = 40.0
    """Level of the floor at 2 m in the middle of the fan, over the lowest sample."""
    absorption_db_m: float = Field(0.8, ge=0)
    """One way: fresh water of 17 °C at 1.8 MHz."""
    tvg_error_db: float = Field(1.5, ge=0)
    """Sigma of the tilt from one end of the window to the other which time-varied gain leaves; 0: exact gain."""
    joints: bool = True
    """Bright joints between the plates of the floor, every 0.5 m."""
    shadows: bool = True
    """Shadows behind objects that stand above the floor."""
    multipath: bool = True
    """Echoes by way of the surface, and by way of the floor in front of steep faces."""
    surface_path_db: float = -15.0
    """Echo by way of the surface against the direct one, after the sonar's pattern."""
    floor_reflection: float = Field(0.5, ge=0, le=1)
    """Amplitude that a floor mirrors forward."""
    drop_probability: float = Field(0.01, ge=0, lt=1)
    """Share of the frames that are never recorded."""
    time_offset_s: float = 0.0
    """Delay of the stamps; estimators do not know it. Real drivers: 0.02 to 0.1."""
    sound_speed_error: float = Field(0.0, gt=-0.1, lt=0.1)
    """Relative error of the sound speed with which times become ranges; estimators do not know it."""
    stones: int = Field(4, ge=0, le=6)
    """Rounded stones on the route, up to 6 cm high."""
    decoys: int = Field(4, ge=0, le=6)
    """Flat rough patches on the route, as large as landmarks and as bright, of irregular outline."""

    def imaging_sonar(self) -> ImagingSonar:
        """The sonar with its window."""
        sonar = SONARS[self.sonar]
        length_m = self.window_m or sonar.range_length_m
        # real sonars lengthen their pulse with the window
        resolution_m = sonar.range_resolution_m * length_m / sonar.range_length_m
        return replace(sonar, range_length_m=length_m, range_resolution_m=resolution_m)
