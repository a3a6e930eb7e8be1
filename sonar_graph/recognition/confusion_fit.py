"""Measuring the model of recognition on logs with known truth: `sonar-graph calibrate`.

Sightings are labelled by the true landmarks: within 8 cm of one it is that landmark, more than 40 cm from all it is
none, in between (such as a piece of a landmark) it is left out. `estimate_confusion` then fits the weights of the
evidence and the number of looks to whole tracks, the confusion matrix, and the accuracy of range and azimuth.
Derivation: docs/theory/recognition.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import log_softmax

from sonar_graph.devices import DEFAULT_DESIGNS, LandmarkDesign
from sonar_graph.errors import CalibrationError, LogError
from sonar_graph.files import spelt
from sonar_graph.logs import read_sonar_frames
from sonar_graph.logs.adapters import LogConfig
from sonar_graph.measurements import Floats, Ints
from sonar_graph.recognition.session import RecognitionSession, no_images
from sonar_graph.sequence import Sequence as Run
from sonar_graph.sonar import (
    EVIDENCE,
    SHIPPED,
    Accuracy,
    Confusion,
    IdentityParams,
    ObjectSighting,
    Recogniser,
    RecogniserParams,
    TrackInFrame,
    confusion_for,
    mark_of,
    read_confusion,
    soft_scores,
)

SAME_M = 0.08
APART_M = 0.40
NO_LABEL = -2
NONE = -1
LEAST_FRAMES = 3
"""Labelled frames from which a class is measured."""
LEAST_FOR_ENDS = 40
"""So many tracks have one beyond each end of the range that holds 95 %."""
JEFFREYS = 0.5
"""Prior count of each feature of the confusion matrix."""
PRIOR_SHARE = 0.25
"""Standard deviation of what is fitted about the shipped model, as a share of it; of looks, of their logarithm."""


@dataclass(frozen=True, eq=False)
class LabelledFits:
    """Fits of designs to patches whose class is known."""

    evidence: Floats
    """For each design, in the columns of `EVIDENCE`, shape (n, ids, 11)."""
    bound_m: Floats
    """`ObjectSighting.bound_m`, shape (n, 2)."""
    moved_m: Floats
    """`ObjectSighting.moved_m`, shape (n, 2)."""
    label: Ints
    """Index of the true class; the number of ids for "none of them", shape (n,)."""
    track: Ints
    """Track of each patch, shape (n,); frames of one track are not independent."""
    independent_share: Floats
    """Of each frame for its track, shape (n,)."""
    error_m: Floats
    """Measured minus true along the ray and across it, shape (n, 2); NaN where there is no landmark."""
    range_per_height: Floats
    """`ObjectSighting.range_per_height`, shape (n,)."""
    stamp_ns: Ints
    """Stamp of each frame, shape (n,)."""


class TrueObjects(NamedTuple):
    """Landmarks where they truly are, in the sonar's axes."""

    ids: Ints
    """Shape (m,)."""
    range_m: Floats
    """Shape (m,)."""
    azimuth_rad: Floats
    """Shape (m,)."""

    def label_of(self, sighting: ObjectSighting) -> tuple[int, int]:
        """Identity of the landmark that was seen, `NONE` or `NO_LABEL`, and its row."""
        turned = self.azimuth_rad - sighting.azimuth_rad
        off_m = np.hypot(self.range_m - sighting.range_m, self.range_m * np.sin(turned))
        # a landmark behind the sonar is not near, however small the sine
        off_m = np.where(np.abs(turned) < np.pi / 2, off_m, np.inf)
        at = int(np.argmin(off_m))
        if off_m[at] <= SAME_M:
            return int(self.ids[at]), at
        return (NONE if off_m[at] > APART_M else NO_LABEL), at


class LabelledSighting(NamedTuple):
    """Row of `LabelledFits`; its track with the number of its log."""

    sighting: ObjectSighting
    label: int
    track: tuple[int, int]
    independent_share: float
    error_m: tuple[float, float]
    stamp_ns: int


class LabelledSightings:
    """Sightings with their true classes, for designs with these identities in order."""

    def __init__(self, ids: tuple[int, ...]) -> None:
        self.ids = ids
        self._rows: list[LabelledSighting] = []

    def add(
        self, stamp_ns: int, log: int, track: TrackInFrame, truth: TrueObjects
    ) -> None:
        """Add the sighting of a track in a frame of a log, if its class is known."""
        sighting = track.sighting
        if sighting is None or sighting.fit is None:
            return
        label, at = truth.label_of(sighting)
        is_landmark = label != NONE
        if label == NO_LABEL or (is_landmark and label not in self.ids):
            return
        error_m = (np.nan, np.nan)
        if is_landmark:
            range_m = truth.range_m[at]
            turned = sighting.azimuth_rad - truth.azimuth_rad[at]
            error_m = (sighting.range_m - range_m, range_m * turned)
        self._rows.append(
            LabelledSighting(
                sighting=sighting,
                label=self.ids.index(label) if is_landmark else len(self.ids),
                track=(log, track.id),
                independent_share=track.independent_share,
                error_m=error_m,
                stamp_ns=stamp_ns,
            )
        )

    def extend(self, other: LabelledSightings) -> None:
        """Add all sightings of other logs, with the same designs."""
        self._rows += other._rows

    def fits(self) -> LabelledFits:
        """All of them as columns."""

        def column(path: str, *shape: int) -> Floats:
            return np.reshape(list(map(attrgetter(path), self._rows)), (-1, *shape))

        _, track = np.unique(column("track", 2), axis=0, return_inverse=True)
        return LabelledFits(
            evidence=column("sighting.fit.evidence", len(self.ids), len(EVIDENCE)),
            bound_m=column("sighting.bound_m", 2),
            moved_m=column("sighting.moved_m", 2),
            label=column("label").astype(np.int64),
            track=track.ravel(),
            independent_share=column("independent_share"),
            error_m=column("error_m", 2),
            range_per_height=column("sighting.range_per_height"),
            stamp_ns=column("stamp_ns").astype(np.int64),
        )


def true_objects(run: Run, stamp_ns: int) -> TrueObjects:
    """True landmarks of a run with truth, as the sonar sees them at an instant."""
    assert run.true_poses is not None
    assert run.true_landmarks is not None
    pose = run.true_poses.at(np.array([stamp_ns]))
    mounting = run.calibration.sonar.mounting.pose()
    world_R_body = pose.matrices[0]
    origin = pose.positions[0] + world_R_body @ mounting.translation()
    # row vectors: q = R^T (p - origin)
    q = (run.true_landmarks.positions - origin) @ (
        world_R_body @ mounting.rotation().matrix()
    )
    return TrueObjects(
        run.true_landmarks.ids,
        np.linalg.norm(q, axis=1),
        np.arctan2(q[:, 1], q[:, 0]),
    )


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
        When a log has no truth, has none of the landmarks, or too few frames of landmarks or of other things.
    LogError
        When a log has no images, or they cannot be read.
    """
    designs = tuple(designs or DEFAULT_DESIGNS)
    gathered = LabelledSightings(tuple(design.id for design in designs))
    for log, (path, run) in enumerate(logs):
        if run.true_poses is None or run.true_landmarks is None:
            raise CalibrationError(
                f"{path}: has no true poses and true landmarks; `sonar-graph label {path} -o labels.json` and "
                "`calibrate --labels labels.json` measure the model by some twenty clicks"
            )
        # labels of other landmarks would be taken for other things
        in_log = run.true_landmarks.ids.tolist()
        if not set(gathered.ids) & set(in_log):
            true, known = (
                ", ".join(map(str, sorted(ids))) for ids in (in_log, gathered.ids)
            )
            raise CalibrationError(
                f"{path}: its true landmarks are {true}, the designs are {known}: none can be measured; "
                "give the designs of the log's landmarks with --designs (designs in Python)"
            )
        recogniser = Recogniser(run.calibration, designs, params)
        session = RecognitionSession(run, recogniser)
        first_ns = run.true_poses.stamps_ns[0]
        last_ns = run.true_poses.stamps_ns[-1]
        for _, result in session.run(
            read_sonar_frames(path, topic, config, salvage=salvage)
        ):
            stamp_ns = result.stamp_ns
            # the truth of a log may begin later and end earlier than its images
            if not result.tracks or not first_ns <= stamp_ns <= last_ns:
                continue
            truth = true_objects(run, stamp_ns)
            for track in result.tracks:
                gathered.add(stamp_ns, log, track, truth)
        if not session.frames:
            raise LogError(no_images(path))
    names = spelt(", ".join(path.name for path, _ in logs))
    kinds = "; ".join(
        dict.fromkeys(run.notes.get("ours", "recorded") for _, run in logs)
    )
    return estimate_confusion(
        gathered.fits(), gathered.ids, {"logs": names, "what they are": kinds}, designs
    )


def estimate_confusion(
    fits: LabelledFits,
    ids: tuple[int, ...],
    provenance: dict[str, str],
    designs: Sequence[LandmarkDesign] = (),
) -> Confusion:
    """Fit the model to labelled frames, all classes weighing the same, for designs with these ids in their order.

    Without the designs themselves, as measured, no recogniser accepts the model. A design with too few frames keeps the
    row of the confusion matrix that it has without calibration (`confusion_for`), and the provenance names it.

    Raises `CalibrationError` when no landmark has enough frames, or other things have too few, naming them.
    """
    counts = np.bincount(fits.label, minlength=len(ids) + 1)
    names = [*(f"landmark {i}" for i in ids), "no landmark"]
    # a design that was not seen enough keeps its assumed row
    is_known = counts >= LEAST_FRAMES
    poor = [
        f"{name}: {count}"
        for name, count in zip(names, counts.tolist(), strict=True)
        if count < LEAST_FRAMES
    ]
    if not is_known[-1] or not is_known[:-1].any() or (poor and not designs):
        needed = f"{LEAST_FRAMES} of a landmark, and of what is none"
        raise CalibrationError(
            f"too few labelled frames ({'; '.join(poor)}; needed {needed}): give longer or more logs"
        )
    shipped = read_confusion(SHIPPED)
    weights, looks = fit_weights(fits, np.array(shipped.weights), shipped.looks)
    odds = np.pad(fits.evidence @ weights, ((0, 0), (0, 1)))
    matrix = confusion_rows(soft_scores(odds, looks), fits.label, trials_of(fits))
    if poor:
        matrix = np.where(is_known[:, None], matrix, confusion_for(designs).array())
    height_bias_m, error = without_height(fits)
    is_moved = fits.moved_m.any(axis=1) & np.isfinite(error).all(axis=1)
    # sightings that something moved err by that, and do not show what the bound is; without others they count
    is_left_out = is_moved & (is_moved.sum() < np.isfinite(error).all(axis=1).sum())
    # these err by what moved them, too
    counted = np.where(is_left_out[:, None], np.nan, error)
    found = accuracy(counted, fits.bound_m, fits.track, shipped.accuracy)
    sigmas_m = np.hypot(found.sigmas_m(fits.bound_m), fits.moved_m)
    range_sigma_m, across_sigma_m = found.usual_sigmas_m.tolist()
    range_bound_m, across_bound_m = found.usual_m.tolist()
    said = dict(provenance)
    if poor:
        said["confusion matrix"] = (
            f"too few frames, so as without calibration: {', '.join(poor)}"
        )
    for kind, numbers in (("frames", counts), ("tracks", tracks_of(fits))):
        for name, number in zip(names, numbers.tolist(), strict=True):
            said[f"{kind} of {name}"] = str(number)
    return Confusion(
        ids=ids,
        designs=tuple(map(mark_of, designs)),
        matrix=tuple(map(tuple, matrix.tolist())),
        weights=tuple(weights.tolist()),
        looks=looks,
        doubt=shipped.doubt,
        range_sigma_m=range_sigma_m,
        across_sigma_m=across_sigma_m,
        range_bound_m=range_bound_m,
        across_bound_m=across_bound_m,
        bound_power=found.power,
        height_bias_m=height_bias_m,
        roughness=roughness_of_tracks(fits, shipped.roughness),
        report_interval_s=report_interval_s(
            error / sigmas_m, fits.track, fits.stamp_ns, shipped.report_interval_s
        ),
        provenance=said,
    )


def tracks_of(fits: LabelledFits) -> Ints:
    """Number of tracks of each class."""
    return np.array(
        [
            len(np.unique(fits.track[fits.label == k]))
            for k in range(fits.evidence.shape[1] + 1)
        ]
    )


def trials_of(fits: LabelledFits) -> Ints:
    """Number of trials of each class for the confusion matrix: its tracks; landmarks share theirs, as the weights."""
    tracks = tracks_of(fits)
    return np.append(np.full(len(tracks) - 1, tracks[:-1].sum()), tracks[-1])


def roughness_of_tracks(
    fits: LabelledFits, before: tuple[float, float] | None = None
) -> tuple[float, float]:
    """`Confusion.roughness`: the range of all but one in twenty tracks; of fewer than forty the given one is in it."""
    beyond = fits.evidence[:, :, EVIDENCE.index("beyond")].mean(axis=1)
    means = [beyond[fits.track == track].mean() for track in np.unique(fits.track)]
    low, high = np.quantile(means, [0.025, 0.975]).tolist()
    if before is None or len(means) >= LEAST_FOR_ENDS:
        return low, high
    return min(low, before[0]), max(high, before[1])


def without_height(fits: LabelledFits) -> tuple[float, Floats]:
    """Height of the faces over the true landmarks, by least squares on the errors of range, and the errors without it.

    A face that is higher by b seems nearer by ``b h / r``, with h the height of the sonar: where sound arrives first.
    Each track counts once.
    """
    error = fits.error_m.copy()
    rise = fits.range_per_height
    known = np.isfinite(error[:, 0]) & (rise > 0)
    if not known.any():
        return 0.0, error
    # frames of a track repeat its error of the height
    once = 1.0 / np.bincount(fits.track)[fits.track]
    bias_m = -float(
        np.sum((once * rise * error[:, 0])[known]) / np.sum((once * rise**2)[known])
    )
    error[:, 0] += bias_m * rise
    return bias_m, error


def accuracy(
    error: Floats,
    bound: Floats,
    track_of: Ints,
    prior: Accuracy | None = None,
    powers: tuple[float, float] = (0.0, 4.0),
) -> Accuracy:
    """Usual bounds along the ray and across, their sigmas there, and the power of the bound, as `Confusion` has them.

    The most probable ones for normal errors, where each track counts once, with a normal prior about the power of the
    given accuracy (`PRIOR_SHARE`) and limits. The usual bound is the geometric mean. Errors of a track repeat, so that
    n tracks are as many samples, less one for the range, lost to the height. The variances of the given accuracy
    count as ``1 / (2 PRIOR_SHARE^2)`` further ones, from which a sigma is known to `PRIOR_SHARE` of itself.
    """
    known = np.isfinite(error).all(axis=1) & np.isfinite(bound).all(axis=1)
    error = error[known]
    bound = bound[known]
    (_, track) = np.unique(track_of[known], return_inverse=True)
    once = 1.0 / np.bincount(track)[track]
    tracks = int(track.max()) + 1
    usual = np.exp(np.average(np.log(bound), axis=0, weights=once))
    # a power law of the bound: sigma = usual sigma (bound / usual)^power
    growth = np.log(bound / usual)
    tiny = np.finfo(float).tiny

    def variances(power: float) -> Floats:
        return np.average(error**2 * np.exp(-2 * power * growth), axis=0, weights=once)

    def loss(power: float) -> float:
        # negative log posterior of the power; the sigmas are profiled out
        off = (power - prior.power) / (PRIOR_SHARE * prior.power) if prior else 0.0
        return float(
            0.5 * off**2
            + 0.5 * tracks * np.log(np.maximum(variances(power), tiny)).sum()
        )

    power = float(minimize_scalar(loss, bounds=powers, method="bounded").x)
    squares = tracks * variances(power)
    # the height was fitted to the ranges: one sample less
    samples = np.array([tracks - 1.0, tracks])
    if prior:
        before = 1 / (2 * PRIOR_SHARE**2)
        squares = squares + before * prior.sigmas_m(usual) ** 2
        samples = samples + before
    return Accuracy(usual, np.sqrt(squares / np.maximum(samples, 1.0)), power)


def report_interval_s(
    error: Floats, track_of: Ints, stamp_ns: Ints, prior_s: float
) -> float:
    """Time in which a track constrains a place as much as one independent frame (`Confusion.report_interval_s`).

    Of errors in sigmas. The mean of a track has the variance c, the mean product of the errors of different frames; 1 /
    c independent frames would have it. A track of T seconds is worth one of them in c T: the mean over tracks and both
    coordinates. The given time counts as some tracks (`PRIOR_SHARE`), and c is at least 0.
    """
    known = np.isfinite(error).all(axis=1)
    seconds = prior_s / PRIOR_SHARE**2
    tracks = 1 / PRIOR_SHARE**2
    for track in np.unique(track_of[known]):
        own = error[known & (track_of == track)]
        stamps = stamp_ns[known & (track_of == track)]
        n = len(own)
        if n > 1:
            # mean product of the errors of different frames of the track
            common = (own.sum(axis=0) ** 2 - (own**2).sum(axis=0)) / (n * (n - 1))
            seconds = seconds + float(common.mean() * np.ptp(stamps) * 1e-9)
            tracks = tracks + 1
    return max(seconds / tracks, 0.0)


def confusion_rows(scores: Floats, label: Ints, trials: Ints) -> Floats:
    """Confusion matrix from the soft scores of frames, for classes with these numbers of trials.

    Its rows are posterior means under Jeffreys' Dirichlet prior, ``C[k, j] = (n_k m_kj + 1/2) / (n_k + features / 2)``
    with the mean scores m of n_k independent trials of class k: a confusion that never happened in n trials keeps about
    1 / 2n. Frames of a track repeat each other, so that tracks are the trials, not frames.
    """
    sums = np.array([scores[label == k].sum(axis=0) for k in range(scores.shape[1])])
    means = sums / np.maximum(np.bincount(label, minlength=len(sums)), 1)[:, None]
    n = trials[:, None]
    return (n * means + JEFFREYS) / (n + JEFFREYS * len(sums))


def fit_weights(
    fits: LabelledFits, prior: Floats, prior_looks: float
) -> tuple[Floats, float]:
    """Weights of the evidence and number of looks with which the posteriors of tracks fit their classes.

    Conditional logit (McFadden 1974) of whole tracks. Landmarks and none of them begin with the prior of a recogniser,
    and count by it, however many tracks there are of each. The weights are the most probable ones under a normal prior
    about those given, with `PRIOR_SHARE`: a few tracks of one scene move them little.
    """
    sums, counted, label, share = track_sums(fits)
    classes = fits.evidence.shape[1] + 1
    # the prior of the recogniser that will use the weights
    log_birth = np.log(IdentityParams().birth(classes - 1))
    scale = PRIOR_SHARE * np.abs(prior)

    def loss(unbounded: Floats) -> float:
        # in units of their prior: the penalty is the squared length
        weights = prior + scale * unbounded[:-1]
        looks = prior_looks * np.exp(PRIOR_SHARE * unbounded[-1])
        # as `bounded_evidence` weighs the end of a track
        odds = np.pad(sums @ weights, ((0, 0), (0, 1))) / (counted + looks)[:, None]
        log_posterior = log_softmax(odds + log_birth, axis=1)
        return float(
            0.5 * unbounded @ unbounded
            - share @ log_posterior[np.arange(len(label)), label]
        )

    best = minimize(loss, np.zeros(len(prior) + 1), method="L-BFGS-B").x
    return prior + scale * best[:-1], float(
        prior_looks * np.exp(PRIOR_SHARE * best[-1])
    )


def track_sums(fits: LabelledFits) -> tuple[Floats, Floats, Ints, Floats]:
    """Sums of evidence and of independent shares over tracks, the class of each, and how much it counts.

    A track that was of several classes is one of each. Landmarks and none of them have the shares of the prior in sum.
    """
    sums = []
    counted = []
    label = []
    for track, k in np.unique(np.stack([fits.track, fits.label]), axis=1).T.tolist():
        rows = np.flatnonzero(
            (fits.track == track) & (fits.label == k) & (fits.independent_share > 0)
        )
        if len(rows):
            sums.append(
                np.einsum(
                    "n,nke->ke", fits.independent_share[rows], fits.evidence[rows]
                )
            )
            counted.append(fits.independent_share[rows].sum())
            label.append(k)
    labels = np.array(label)
    # landmarks and other things count by the prior, not by their number in the logs
    of_none = labels == fits.evidence.shape[1]
    unknown = IdentityParams().unknown_prior
    shares = np.where(
        of_none,
        unknown / max(of_none.sum(), 1),
        (1 - unknown) / max((~of_none).sum(), 1),
    ) * len(labels)
    return np.array(sums), np.array(counted), labels, shares
