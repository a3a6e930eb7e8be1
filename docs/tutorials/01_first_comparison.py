"""From a log to a report: three estimators on the same measurements.

Run it in any folder: ``python 01_first_comparison.py``. It takes some seconds and writes ``basin.mcap`` and
``comparison/``. The same by commands::

    sonar-graph simulate basin --help
    sonar-graph compare basin.mcap -o comparison
"""

from pathlib import Path

from sonar_graph.evaluation import compare
from sonar_graph.logs import read_log, write_log
from sonar_graph.report import write_report
from sonar_graph.simulation import BasinOptions, simulate_basin

# A log. One lap of four minutes around four landmarks, with the worse of the two gyros, so that there is drift to
# correct. A simulated log knows the truth; a recorded one may, and then the report has errors as well.
simulated = simulate_basin(BasinOptions(seed=1, duration_s=240.0, laps=1, imu="mti1"))
log = Path("basin.mcap")
write_log(log, simulated)

# From here on nothing is known that is not in the file: measurements, calibration, and what is called truth in it.
sequence = read_log(log)
print(
    f"{log}: {sequence.duration_s:.0f} s, {len(sequence.imu)} IMU rows, {len(sequence.dvl)} DVL rows"
)

# Every estimator sees the same measurements, cut at the same instants, and is scored at the same instants.
comparison = compare(sequence, ["isam2", "ekf-slam", "dead-reckoning"])

# Causal: what was known at each instant; a robot steers by it. Smoothed: what is known at the end about each instant; a
# map is drawn from it. A filter does not look back, so that its two columns are equal. Only causal errors compare a
# smoother with a filter fairly. In one short lap with few landmarks the errors may lie within a few millimetres of each
# other, in either order: one run does not rank estimators.
print("\n                  causal ATE   smoothed ATE     NEES   time")
for name, scores in comparison.scores.items():
    causal, smoothed = scores["causal.ate_raw_m"], scores["smoothed.ate_raw_m"]
    print(
        f"{name:16}  {causal.value:8.3f} m   {smoothed.value:10.3f} m"
        f"   {scores['causal.nees_position'].value:6.2f}   {scores['time.total_s'].value:.1f} s"
    )

# A number means nothing without the protocol that gave it. Each score carries its own.
print("\ncausal ATE: " + comparison.scores["isam2"]["causal.ate_raw_m"].protocol)

# NEES compares an error with the covariance that was claimed: 1 is honest, far above it is over-confident. One run
# says little about it, as the errors of one run hang together: benchmarks/validation/consistency.py takes fifty.
print("NEES: " + comparison.scores["isam2"]["causal.nees_position"].protocol)

# The map: landmarks by identity, with covariances.
landmarks = next(run.landmarks for run in comparison.runs if run.estimator == "isam2")
print("\nlandmark      x (m)     y (m)   1 sigma (m)")
for landmark, position, covariance in zip(
    landmarks.ids, landmarks.positions, landmarks.covariances, strict=True
):
    sigma = (covariance[0, 0] + covariance[1, 1]) ** 0.5
    print(f"{landmark:8} {position[0]:10.3f} {position[1]:9.3f} {sigma:13.3f}")

# Everything as files, and one page that shows it.
page = write_report(comparison, "comparison")
print(f"\nreport: {page}")

# The page from top to bottom: what was found, in a sentence; the scores, each with its protocol under it; the map, true
# and estimated, with 95 % ellipses; errors over time within the three sigma that the estimator claimed; NEES over time;
# time of each update; what became of each detection; and, at the end, all settings, noise parameters and versions.
