"""Measuring the model of recognition on logs with known truth: `sonar-graph calibrate`.

Sightings are labelled by the true landmarks: within 8 cm of one it is that landmark, more than 40 cm from all it is
none, in between (such as a piece of a landmark) it is left out. `estimate_confusion` then fits sharpness and threshold
of the soft scores, the confusion matrix and the accuracy of range and azimuth. Derivation: docs/theory/recognition.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.special import expit

from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.errors import CalibrationError, LogError
from sonar_graph.files import spelt
from sonar_graph.logs import read_sonar_frames
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Floats, Ints
from sonar_graph.recognition.session import RecognitionSession, no_images
from sonar_graph.sequence import Sequence as Run
from sonar_graph.sonar import (
    Confusion,
    ObjectSighting,
    Recogniser,
    RecogniserParams,
    mark_of,
    posterior_mean_rows,
    soft_scores,
    virtual_evidence,
)

SAME_M, APART_M = 0.08, 0.40
NO_LABEL = -2
NONE = -1
LEAST_FRAMES = 20
"""Labelled frames that every class needs."""
MOST_CORRELATED = 0.99
"""Upper limit of the correlation: some 200 frames for each detection."""
ONE_STANDARD_ERROR_NATS = 0.5
"""Rise of the total loss at one sigma of a Gaussian likelihood."""


@dataclass(frozen=True, eq=False)
class LabelledFits:
    """Fits of designs to patches whose class is known."""

    correlation: Floats
    """Of each design with the patch, shape (n, ids)."""
    visible: Floats
    """Share of the template in view, shape (n,)."""
    label: Ints
    """Index of the true class; the number of ids for "none of them", shape (n,)."""
    track: Ints
    """Track of each patch, shape (n,); frames of one track are not independent."""
    range_azimuth_error: Floats
    """Measured minus true (m, rad), shape (n, 2); NaN where there is no landmark."""


class LabelledSightings:
    """Sightings with their true classes, for designs with these identities in order."""

    def __init__(self, ids: tuple[int, ...]) -> None:
        self.ids = ids
        self._rows: list[tuple[Floats, float, int, tuple[int, int], tuple[float, float]]] = []

    def add(
        self, sighting: ObjectSighting, track: tuple[int, int], ids: Ints, range_m: Floats, azimuth_rad: Floats
    ) -> None:
        """Add a sighting of a track (log, number), given the true range and azimuth of every landmark, shapes (m,)."""
        label, at = label_of(sighting, ids, range_m, azimuth_rad)
        known = label != NONE
        if sighting.fit is None or label == NO_LABEL or (known and label not in self.ids):
            return
        error = np.nan, np.nan
        if known and sighting.is_fitted:
            error = sighting.range_m - range_m[at], sighting.azimuth_rad - azimuth_rad[at]
        row = self.ids.index(label) if known else len(self.ids)
        self._rows.append((sighting.fit.correlation, sighting.fit.visible, row, track, error))

    def fits(self) -> LabelledFits:
        """All of them as columns."""
        correlation, visible, label, track, error = zip(*self._rows, strict=True) if self._rows else [()] * 5
        return LabelledFits(
            np.array(correlation, float).reshape(-1, len(self.ids)),
            np.array(visible, float),
            np.array(label, np.int64),
            np.unique(np.reshape(track, (-1, 2)), axis=0, return_inverse=True)[1].ravel(),
            np.array(error, float).reshape(-1, 2),
        )


def label_of(sighting: ObjectSighting, ids: Ints, range_m: Floats, azimuth_rad: Floats) -> tuple[int, int]:
    """Identity of the landmark that was seen, `NONE` or `NO_LABEL`, and its row."""
    off = np.hypot(range_m - sighting.range_m, range_m * np.sin(azimuth_rad - sighting.azimuth_rad))
    off = np.where(np.abs(azimuth_rad - sighting.azimuth_rad) < np.pi / 2, off, np.inf)
    at = int(np.argmin(off))
    if off[at] <= SAME_M:
        return int(ids[at]), at
    return (NONE if off[at] > APART_M else NO_LABEL), at


def true_ranges_azimuths(run: Run, stamp_ns: int) -> tuple[Floats, Floats]:
    """True range and azimuth of every landmark at an instant, shapes (m,)."""
    assert run.true_poses is not None
    assert run.true_landmarks is not None
    pose = run.true_poses.at(np.array([stamp_ns]))
    mounting = run.calibration.sonar.mounting.pose()
    world_R_body = pose.matrices[0]
    origin = pose.positions[0] + world_R_body @ mounting.translation()
    q = (run.true_landmarks.positions - origin) @ (world_R_body @ mounting.rotation().matrix())
    return np.linalg.norm(q, axis=1), np.arctan2(q[:, 1], q[:, 0])


def calibrate(
    logs: Sequence[tuple[Path, Run]],
    *,
    topic: str | None = None,
    config: LogConfig | None = None,
    designs: Sequence[LandmarkDesign] | None = None,
    params: RecogniserParams | None = None,
    salvage: bool = False,
) -> Confusion:
    """Measure the model of recognition on logs with images, true trajectory and true landmarks.

    Parameters
    ----------
    logs
        Each with the sequence that was read from it.
    topic, config
        As of `read_sonar_frames`.
    designs
        The landmarks; None: those that ship.
    params
        Of the recogniser that will use the model; None: the defaults.
    salvage
        As of `read_log`, and as the sequences were read.

    Raises
    ------
    CalibrationError
        When a log has no truth, has none of the landmarks, or a landmark was seen too rarely.
    LogError
        When a log has no images, or they cannot be read.
    """
    designs = tuple(designs or DEFAULT_DESIGNS)
    gathered = LabelledSightings(tuple(design.id for design in designs))
    for log, (path, run) in enumerate(logs):
        truth = run.true_poses
        if truth is None or run.true_landmarks is None:
            raise CalibrationError(f"{path}: without true poses and true landmarks nothing in it can be labelled")
        in_log = run.true_landmarks.ids.tolist()
        if not set(gathered.ids) & set(in_log):
            true, known = (", ".join(map(str, sorted(ids))) for ids in (in_log, gathered.ids))
            raise CalibrationError(
                f"{path}: its true landmarks are {true}, the designs are {known}: none can be measured; "
                "give the designs of the log's landmarks with --designs (designs in Python)"
            )
        recogniser = Recogniser(run.calibration, designs, params)
        session = RecognitionSession(run, recogniser=recogniser, pictures=False)
        for stamp_ns in session.run(read_sonar_frames(path, topic, config, salvage=salvage)):
            if recogniser.stamp_ns != stamp_ns or not truth.stamps_ns[0] <= stamp_ns <= truth.stamps_ns[-1]:
                continue
            range_m, azimuth_rad = true_ranges_azimuths(run, stamp_ns)
            for track, sighting in zip(recogniser.track_ids.tolist(), recogniser.sightings, strict=True):
                if sighting is not None:
                    gathered.add(sighting, (log, track), run.true_landmarks.ids, range_m, azimuth_rad)
        if not session.result.frames:
            raise LogError(no_images(path))
    names = spelt(", ".join(path.name for path, _ in logs))
    kinds = "; ".join(dict.fromkeys(run.notes.get("ours", "recorded") for _, run in logs))
    return estimate_confusion(gathered.fits(), gathered.ids, {"logs": names, "what they are": kinds}, designs)


def estimate_confusion(
    fits: LabelledFits, ids: tuple[int, ...], provenance: dict[str, str], designs: Sequence[LandmarkDesign] = ()
) -> Confusion:
    """Fit the model to labelled frames, all classes weighing the same, for designs with these ids in their order.

    Without the designs themselves, as measured, no recogniser accepts the model.

    Raises `CalibrationError` when a class has too few frames, naming it.
    """
    counts = np.bincount(fits.label, minlength=len(ids) + 1)
    names = [*(f"landmark {i}" for i in ids), "no landmark"]
    poor = [f"{name}: {count}" for name, count in zip(names, counts.tolist(), strict=True) if count < LEAST_FRAMES]
    if poor:
        raise CalibrationError(
            f"too few labelled frames ({'; '.join(poor)}; needed {LEAST_FRAMES} of each): give longer or more logs"
        )
    tracks = np.array([len(np.unique(fits.track[fits.label == k])) for k in range(len(counts))])
    trials = np.append(np.full(len(ids), tracks[:-1].sum()), tracks[-1])  # landmarks share the two fitted numbers
    targets = posterior_mean_rows(np.eye(len(counts)), trials)
    targets = targets[fits.label] / (counts[fits.label] * len(counts))[:, None]
    sharpness, threshold = fit_scores(fits, targets, trials, int(tracks.sum()))
    matrix = confusion_rows(soft_scores(fits.correlation, fits.visible, sharpness, threshold), fits.label, trials)
    sigmas = np.sqrt(np.nanmean((fits.range_azimuth_error * fits.visible[:, None] ** 2) ** 2, axis=0))
    return Confusion(
        ids=ids,
        designs=tuple(map(mark_of, designs)),
        matrix=tuple(map(tuple, matrix.tolist())),
        sharpness=sharpness,
        threshold=threshold,
        range_sigma_m=float(sigmas[0]),
        azimuth_sigma_rad=float(sigmas[1]),
        error_correlation=error_correlation(fits),
        provenance=provenance
        | {f"frames of {n}": str(c) for n, c in zip(names, counts.tolist(), strict=True)}
        | {f"tracks of {n}": str(c) for n, c in zip(names, tracks.tolist(), strict=True)},
    )


def error_correlation(fits: LabelledFits) -> float:
    """Correlation of the errors of a track's successive frames, at least 0: the mean of range's and azimuth's.

    No mean is taken from the errors: one that all frames of a track share is what they have in common.
    """
    error, known = fits.range_azimuth_error, np.isfinite(fits.range_azimuth_error).all(axis=1)
    products, squares = np.zeros(2), np.zeros(2)
    for track in np.unique(fits.track[known]):
        own = error[known & (fits.track == track)]
        products += (own[1:] * own[:-1]).sum(axis=0)
        squares += 0.5 * (own[1:] ** 2 + own[:-1] ** 2).sum(axis=0)
    return float(np.clip(np.mean(products / np.maximum(squares, np.finfo(float).tiny)), 0.0, MOST_CORRELATED))


def confusion_rows(scores: Floats, label: Ints, trials: Ints) -> Floats:
    """Confusion matrix from the soft scores of frames, for classes with these numbers of trials.

    Frames of a track repeat each other, so that tracks are the trials, not frames.
    """
    means = np.array([scores[label == k].mean(axis=0) for k in range(scores.shape[1])])
    return posterior_mean_rows(means, trials)


def fit_scores(fits: LabelledFits, targets: Floats, trials: Ints, tracks: int) -> tuple[float, float]:
    """Sharpness and threshold for which the posterior of one frame fits weighted targets, shape (n, classes).

    The posterior counts, after the confusion matrix and from equal priors: doubt in the scores would count twice.
    Where nothing was ever confused, any large sharpness fits. So the least sharpness is taken whose loss is within one
    standard error of the best, each track counting as one observation (Breiman et al. 1984, section 3.4.3).
    """
    classes = targets.shape[1]
    equal, news = np.full((len(targets), classes), 1.0 / classes), np.ones(len(targets))

    def loss(log_sharpness: float, logit: float) -> float:
        scores = soft_scores(fits.correlation, fits.visible, float(np.exp(log_sharpness)), float(expit(logit)))
        matrix = confusion_rows(scores, fits.label, trials)
        posterior = virtual_evidence(equal, scores, matrix, matrix.mean(axis=0), news)
        return float(-np.sum(targets * np.log(np.maximum(posterior, 1e-12))))

    def loss_of_both(unbounded: Floats) -> float:
        return loss(float(unbounded[0]), float(unbounded[1]))

    best = minimize(loss_of_both, np.array([np.log(10.0), 1.0]), method="Nelder-Mead")
    allowed = best.fun + ONE_STANDARD_ERROR_NATS / tracks

    def least(log_sharpness: float) -> tuple[float, float]:
        """Loss and logit of the best threshold for a sharpness."""
        found = minimize_scalar(lambda x: loss(log_sharpness, x), bounds=(-2.0, 5.0), method="bounded")
        return float(found.fun), float(found.x)

    blunt = float(best.x[0]) - 1.0
    while least(blunt)[0] <= allowed:
        blunt -= 1.0
    chosen = float(brentq(lambda x: least(x)[0] - allowed, blunt, float(best.x[0]), xtol=1e-3))
    return float(np.exp(chosen)), float(expit(least(chosen)[1]))
