"""How often a landmark looks like which: the measured model that turns what a frame looks like into evidence.

Classes are the designs in their order and last "none of them"; features the same. ``matrix[k, j] = p(z = j | x = k)``
is the mean soft score of feature j over the labelled frames of class k: rows sum to 1. With it go the two numbers that
make scores of correlations, and the accuracy of range and azimuth, all measured on the same frames. The file says
where those came from, and what the landmarks look like for which it was measured. The one that ships,
``default_confusion.json``, was measured on simulated basins with the designs that ship.

From how well designs fit to probabilities of what a frame looks like.

With noise of unknown strength the likelihood of a design whose correlation with a patch of n independent samples is c
is ``(1 - c^2)^(-n/2)``. Samples are not independent and designs do not fit exactly, so that the exponent and the
correlation below which nothing fits are measured (`sonar_graph.sonar.confusion`)::

    s_j     ~  (1 - max(c_j, 0)^2)^(-sharpness visible)
    s_none  ~  (1 - threshold^2)^(-sharpness visible)

where ``visible`` is the share of the template's cells that the image holds.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError, model_validator
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.special import expit

from sonar_graph.calibration import Section
from sonar_graph.devices import LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.measurements import Floats, Ints
from sonar_graph.settings import faults_in
from sonar_graph.sonar.bayes import virtual_evidence

BEST_CORRELATION = 0.999
"""A perfect fit is no reason to divide by zero."""


def soft_scores(correlation: Floats, visible: Floats, sharpness: float, threshold: float) -> Floats:
    """Probabilities of the features: each design, and last "none of the above".

    Parameters
    ----------
    correlation
        Of each design with each patch, shape (n, designs).
    visible
        Share of the template in view, shape (n,).
    sharpness, threshold
        As above.

    Returns
    -------
    Floats
        Shape (n, designs + 1), rows sum to 1.
    """
    known = np.clip(correlation, 0.0, BEST_CORRELATION)
    none = np.full((len(known), 1), threshold)
    logits = -sharpness * visible[:, None] * np.log1p(-(np.hstack([known, none]) ** 2))
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(odds / odds.sum(axis=1, keepdims=True))


LEAST_ENTRY = 1e-3
"""Smallest entry of the matrix: a class that never looked like a feature in some hundred frames still may."""
ASSUMED_RIGHT = 0.9
"""Share of frames in which a landmark that nobody measured looks like itself."""
ONE_STANDARD_ERROR_NATS = 0.5
"""Of the total loss: where a Gaussian likelihood is one sigma from its top."""
LEAST_FRAMES = 20
"""Of every class, for a measured row."""


class DesignMark(Section):
    """By what a design is known again."""

    name: str
    digest: str
    """As `LandmarkDesign.digest` gives it."""


class Confusion(Section):
    """The measured model of a recogniser."""

    ids: tuple[int, ...] = Field(min_length=1)
    """Identities of the designs, in the order of rows and columns."""
    designs: tuple[DesignMark, ...] = ()
    """Of each identity, what it looked like when it was measured; without them no recogniser takes the model."""
    matrix: tuple[tuple[float, ...], ...]
    """p(z = j | x = k), shape (ids + 1, ids + 1); the last row and column are "none of them"."""
    sharpness: float = Field(gt=0)
    """Exponent of the scores; half the number of independent samples in a patch, as it were."""
    threshold: float = Field(gt=0, lt=1)
    """Correlation at which "none of them" is as probable as a design."""
    range_sigma_m: float = Field(gt=0)
    """Of a landmark's range, a frame that shows it wholly."""
    azimuth_sigma_rad: float = Field(gt=0)
    """Of its azimuth."""
    provenance: Mapping[str, str] = Field(default_factory=dict)
    """Where the frames came from, how many there were of each class, what was assumed."""

    @model_validator(mode="after")
    def _is_stochastic(self) -> Confusion:
        matrix = np.array(self.matrix, float, ndmin=2) if len({len(r) for r in self.matrix}) == 1 else np.empty((0, 0))
        classes = len(self.ids) + 1
        if self.designs and len(self.designs) != len(self.ids):
            raise ValueError(f"designs: expected one for each of {len(self.ids)} ids, not {len(self.designs)}")
        if matrix.shape != (classes, classes):
            raise ValueError(f"matrix: expected {classes} rows of {classes} for {len(self.ids)} ids and none of them")
        if (matrix < 0).any() or not np.allclose(matrix.sum(axis=1), 1, atol=1e-6):
            raise ValueError("matrix: each row must be probabilities that sum to 1 (rows are the true classes)")
        return self

    def check_designs(self, designs: Sequence[LandmarkDesign], source: str = "confusion") -> None:
        """Refuse designs other than those that it was measured for.

        Raises
        ------
        CalibrationError
            Naming the source, and the first design that is another.
        """
        ids, remedy = tuple(design.id for design in designs), "measure a model for these with sonar-graph calibrate"
        if self.ids != ids:
            raise CalibrationError(f"{source}: measured for landmarks {self.ids}, the designs are {ids}; {remedy}")
        if not self.designs:
            raise CalibrationError(f"{source}: designs: is missing, so that it may be of other landmarks; {remedy}")
        for mark, design in zip(self.designs, designs, strict=True):
            if mark != mark_of(design):
                raise CalibrationError(
                    f"{source}: measured for another landmark {design.id} ({mark.name}) than the design given "
                    f"({design.name}): name, size, height or picture differ; {remedy}"
                )

    def array(self) -> Floats:
        """The matrix, no entry below 0.001, rows with sum 1."""
        matrix = np.maximum(np.array(self.matrix), LEAST_ENTRY)
        return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))

    def range_azimuth_cov(self, visible: float) -> Floats:
        """Of a landmark of which a share is in view, shape (2, 2).

        Sigmas grow with the inverse square of the share: measured on simulated basins, where half of a landmark's rim
        costs more than half of its area.
        """
        return np.diag(np.square(np.array([self.range_sigma_m, self.azimuth_sigma_rad]) / visible**2))

    def base(self) -> Floats:
        """Share of each feature when all classes are equally frequent, shape (ids + 1,)."""
        return np.asarray(self.array().mean(axis=0))


def mark_of(design: LandmarkDesign) -> DesignMark:
    """Its name and digest."""
    return DesignMark(name=design.name, digest=design.digest())


@dataclass(frozen=True, eq=False)
class LabelledFits:
    """What was seen of objects whose class is known."""

    correlation: Floats
    """Of each design with the patch, shape (n, ids)."""
    visible: Floats
    """Share of the template in view, shape (n,)."""
    label: Ints
    """Index of the true class; the number of ids for "none of them", shape (n,)."""
    track: Ints
    """Number of the track that it is of; frames of one track are not independent. Shape (n,)."""
    range_azimuth_error: Floats
    """Measured minus true (m, rad), shape (n, 2); NaN where there is no landmark."""


def estimate_confusion(
    fits: LabelledFits, ids: tuple[int, ...], provenance: dict[str, str], designs: Sequence[LandmarkDesign] = ()
) -> Confusion:
    """The model with which one frame says as much as the labelled ones bear out, all classes counting the same.

    Parameters
    ----------
    fits
        What was seen.
    ids
        Of the designs, in their order.
    provenance
        Where it comes from.
    designs
        What the identities look like; left out, no recogniser takes the model.

    Raises
    ------
    CalibrationError
        When a class has too few frames, naming it.
    """
    counts = np.bincount(fits.label, minlength=len(ids) + 1)
    names = [*(f"landmark {i}" for i in ids), "no landmark"]
    poor = [f"{name}: {count}" for name, count in zip(names, counts.tolist(), strict=True) if count < LEAST_FRAMES]
    if poor:
        raise CalibrationError(
            f"too few labelled frames ({'; '.join(poor)}; needed {LEAST_FRAMES} of each): give longer or more logs"
        )
    tracks = np.array([len(np.unique(fits.track[fits.label == k])) for k in range(len(counts))])
    targets = _targets(tracks)[fits.label] / (counts[fits.label] * len(counts))[:, None]
    sharpness, threshold = _fit_scores(fits, targets, int(tracks.sum()))
    matrix = _mean_scores(soft_scores(fits.correlation, fits.visible, sharpness, threshold), fits.label)
    sigmas = np.sqrt(np.nanmean((fits.range_azimuth_error * fits.visible[:, None] ** 2) ** 2, axis=0))
    return Confusion(
        ids=ids,
        designs=tuple(map(mark_of, designs)),
        matrix=tuple(map(tuple, matrix.tolist())),
        sharpness=sharpness,
        threshold=threshold,
        range_sigma_m=float(sigmas[0]),
        azimuth_sigma_rad=float(sigmas[1]),
        provenance=provenance
        | {f"frames of {n}": str(c) for n, c in zip(names, counts.tolist(), strict=True)}
        | {f"tracks of {n}": str(c) for n, c in zip(names, tracks.tolist(), strict=True)},
    )


def _targets(tracks: Ints) -> Floats:
    """How certain a frame of each class may be after so many tracks of each, shape (classes, classes).

    ``(n + 1) / (n + 2)`` for itself, the rest for the others: for classes that were never confused the most likely
    numbers would make it certain, which n tracks do not show (Platt, "Probabilistic outputs for support vector
    machines", 1999, section 2.2). All landmarks share what is fitted, so that n counts the tracks of all of them.
    """
    n = np.append(np.full(len(tracks) - 1, tracks[:-1].sum()), tracks[-1])
    targets = np.tile(1.0 / ((n + 2.0) * (len(n) - 1))[:, None], (1, len(n)))
    np.fill_diagonal(targets, (n + 1.0) / (n + 2.0))
    return targets


def _mean_scores(scores: Floats, label: Ints) -> Floats:
    """The confusion matrix, no entry below the least, rows with sum 1."""
    matrix = np.array([scores[label == k].mean(axis=0) for k in range(scores.shape[1])])
    matrix = np.maximum(matrix, LEAST_ENTRY)
    return np.asarray(matrix / matrix.sum(axis=1, keepdims=True))


def _fit_scores(fits: LabelledFits, targets: Floats, tracks: int) -> tuple[float, float]:
    """Sharpness and threshold with which one frame's posterior comes near to weighted targets, shape (n, classes).

    It is the posterior that counts, after the confusion matrix and from equal priors: doubt that were in the scores
    already would count twice. Where nothing was ever confused, any large sharpness is as good as any other; so not the
    best one is taken but the least whose loss is within one standard error of it, each track counting as one
    observation (the rule of Breiman, Friedman, Olshen and Stone, "Classification and Regression Trees", 1984, section
    3.4.3; with a loss in nats, half a nat over all tracks).
    """
    classes = targets.shape[1]
    equal, news = np.full((len(targets), classes), 1.0 / classes), np.ones(len(targets))

    def loss(log_sharpness: float, logit: float) -> float:
        scores = soft_scores(fits.correlation, fits.visible, float(np.exp(log_sharpness)), float(expit(logit)))
        matrix = _mean_scores(scores, fits.label)
        posterior = virtual_evidence(equal, scores, matrix, matrix.mean(axis=0), news)
        return float(-np.sum(targets * np.log(np.maximum(posterior, 1e-12))))

    def both(unbounded: Floats) -> float:
        return loss(float(unbounded[0]), float(unbounded[1]))

    best = minimize(both, np.array([np.log(10.0), 1.0]), method="Nelder-Mead")
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


def read_confusion(path: Path) -> Confusion:
    """A model that `sonar-graph calibrate` wrote.

    Raises
    ------
    CalibrationError
        When the file is not JSON or not such a model, naming the field.
    """
    try:
        return Confusion.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read: {error.strerror}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path} is not JSON: {error}") from error
    except ValidationError as error:
        raise CalibrationError(
            f"{path}: {faults_in(error, Confusion)}; write one with sonar-graph calibrate"
        ) from error


def confusion_for(designs: Sequence[LandmarkDesign]) -> Confusion:
    """The model that ships, for the designs that ship; for others an assumed one, which says so."""
    ids = tuple(design.id for design in designs)
    shipped = read_confusion(Path(__file__).with_name("default_confusion.json"))
    marks = tuple(map(mark_of, designs))
    if (ids, marks) == (shipped.ids, shipped.designs):
        return shipped
    classes = len(ids) + 1
    matrix = np.full((classes, classes), (1 - ASSUMED_RIGHT) / (classes - 1))
    np.fill_diagonal(matrix, ASSUMED_RIGHT)
    return shipped.model_copy(
        update={
            "ids": ids,
            "designs": marks,
            "matrix": tuple(map(tuple, matrix.tolist())),
            "provenance": {"origin": f"assumed: {ASSUMED_RIGHT:.0%} right; measure it with sonar-graph calibrate"},
        }
    )
