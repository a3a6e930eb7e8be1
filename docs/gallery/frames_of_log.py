"""Draw the first sonar frame of each log as a fan: ``python frames_of_log.py PICTURE.png LOG.mcap ...``."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sonar_graph.logs import read_sonar_frames

picture, *logs = map(Path, sys.argv[1:])
figure, panels = plt.subplots(
    1, len(logs), figsize=(3.6 * len(logs), 4.2), layout="constrained", squeeze=False
)
for panel, log in zip(panels[0], logs, strict=True):
    frames = next(iter(read_sonar_frames(log)))
    azimuth, range_m = np.meshgrid(frames.azimuths_rad, frames.ranges_m, indexing="ij")
    # azimuth is positive to the left
    x, y = (
        -range_m * np.sin(azimuth),
        range_m * np.cos(azimuth),
    )
    panel.pcolormesh(x, y, frames.intensity[0], cmap="bone", shading="gouraud")
    panel.set(title=log.stem, xlabel="across (m)", ylabel="ahead (m)", aspect="equal")
figure.savefig(picture, dpi=110)
print(picture)
