"""Measured model of recognition: soft scores of the features, and how often each landmark shows each feature.

Classes and features are the designs in their order, last "none". ``matrix[k, j] = p(z = j | x = k)`` is the posterior
mean of the score of feature j given class k (`posterior_mean_rows`). With c_j the corrected correlation of design j
with the patch and ``visible`` the share of its cells in the image (docs/theory/recognition.md)::

    s_j     ~  (1 - max(c_j, 0)^2)^(-sharpness visible)
    s_none  ~  (1 - threshold^2)^(-sharpness visible)

The model that ships, ``default_confusion.json``, was measured on simulated basins with the designs that ship.
`sonar_graph.recognition.confusion_fit` measures others.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError, model_validator

from sonar_graph.calibration import Section
from sonar_graph.devices import LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.files import text_of
from sonar_graph.measurements import Floats, Ints
from sonar_graph.settings import faults_in

BEST_CORRELATION = 0.999
"""Upper limit of correlations, which keeps the scores finite."""
JEFFREYS = 0.5
"""Prior count of each feature."""
STANDARD_ATTENUATION = 0.896
"""Correlation of the shipped designs with their own patches that speckle leaves, in the window that ships: their mean.
Correlations are corrected to it (`sonar_graph.sonar.appearance`)."""
TRACK_SPREAD = 0.0135
"""Standard deviation of the median corrected correlation of a landmark's track: 8 tracks of the shipped designs."""
UNMEASURED_THRESHOLD = STANDARD_ATTENUATION - 3 * TRACK_SPREAD
"""For designs that were never measured: fits worse than those of a landmark's tracks are of something else."""
ASSUMED_RIGHT = 0.9
"""Share of frames in which an unmeasured landmark is assumed to show its own feature."""


def soft_scores(correlation: Floats, visible: Floats, sharpness: float, threshold: float) -> Floats:
    """Soft scores of the features: each design, last "none of the above", shape (n, designs + 1), rows sum to 1.

    From the correlation of each design with n patches, shape (n, designs), and the visible shares, shape (n,).
    """
    known = np.clip(correlation, 0.0, BEST_CORRELATION)
    none = np.full((len(known), 1), threshold)
    logits = -sharpness * visible[:, None] * np.log1p(-(np.hstack([known, none]) ** 2))
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    return np.asarray(odds / odds.sum(axis=1, keepdims=True))


class DesignMark(Section):
    """Name and digest of a design, to recognise it by."""

    name: str
    digest: str
    """Of `LandmarkDesign.digest`."""


class Confusion(Section):
    """The measured model of a recogniser."""

    ids: tuple[int, ...] = Field(min_length=1)
    """Identities of the designs, in the order of rows and columns."""
    designs: tuple[DesignMark, ...] = ()
    """The designs as measured; without them no recogniser accepts the model."""
    matrix: tuple[tuple[float, ...], ...]
    """p(z = j | x = k), shape (ids + 1, ids + 1); the last row and column are "none of them"."""
    sharpness: float = Field(gt=0)
    """Exponent of the scores; half the effective number of independent samples in a patch."""
    threshold: float = Field(gt=0, lt=1)
    """Corrected correlation at which "none of them" is as probable as a design."""
    range_sigma_m: float = Field(gt=0)
    """Standard deviation of the range in a frame that shows the whole landmark."""
    azimuth_sigma_rad: float = Field(gt=0)
    """The same of the azimuth."""
    error_correlation: float = Field(0.0, ge=0, lt=1)
    """Correlation of the errors of range and azimuth in successive frames of a track."""
    provenance: Mapping[str, str] = Field(default_factory=dict)
    """Source of the frames, counts by class, assumptions."""

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
        if (matrix == 0).any():
            raise ValueError(
                "matrix: an entry is 0; what was never seen in n tracks may still happen: give about 1 / 2n"
            )
        return self

    def check_designs(self, designs: Sequence[LandmarkDesign], source: str = "confusion") -> None:
        """Refuse designs other than the measured ones.

        Raises
        ------
        CalibrationError
            Naming the source and the first design that differs.
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
        """The matrix, shape (ids + 1, ids + 1)."""
        return np.array(self.matrix)

    def range_azimuth_cov(self, visible: float) -> Floats:
        """Covariance of range and azimuth of a landmark with this share in view, shape (2, 2).

        Sigmas grow with the inverse square of the share, as measured on simulated basins.
        """
        return np.diag(np.square(np.array([self.range_sigma_m, self.azimuth_sigma_rad]) / visible**2))

    def report_interval(self) -> int:
        """Number of frames of a track that tell as much of a place as one independent frame.

        n frames whose errors have the correlation rho from one to the next (a first-order autoregression) tell as much
        as ``1 + (n - 1) (1 - rho) / (1 + rho)`` independent ones: one more in every ``(1 + rho) / (1 - rho)`` frames.
        """
        return math.ceil((1 + self.error_correlation) / (1 - self.error_correlation) - 1e-9)

    def base(self) -> Floats:
        """Share of each feature for equally frequent classes, shape (ids + 1,)."""
        return np.asarray(self.array().mean(axis=0))


def posterior_mean_rows(mean_scores: Floats, trials: Ints) -> Floats:
    """Posterior mean of each row of a confusion matrix, shape (classes, features), under Jeffreys' Dirichlet prior.

    ``C[k, j] = (n_k m_kj + 1/2) / (n_k + features / 2)`` with the mean scores m of n_k independent trials of class k: a
    confusion that never happened in n trials keeps about 1 / 2n.
    """
    n = trials[:, None]
    return np.asarray((n * mean_scores + JEFFREYS) / (n + JEFFREYS * mean_scores.shape[1]))


def mark_of(design: LandmarkDesign) -> DesignMark:
    """Its name and digest."""
    return DesignMark(name=design.name, digest=design.digest())


def read_confusion(path: Path) -> Confusion:
    """A model that `sonar-graph calibrate` wrote.

    Raises
    ------
    CalibrationError
        When the file is not JSON or not such a model, naming the field.
    """
    try:
        return Confusion.model_validate(json.loads(text_of(path)))
    except OSError as error:
        raise CalibrationError(f"{path} cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise CalibrationError(
            f"{path}: {faults_in(error, Confusion)}; write one with sonar-graph calibrate"
        ) from error
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} is not JSON: {error}") from error


def confusion_for(designs: Sequence[LandmarkDesign]) -> Confusion:
    """The model that ships for the designs that ship; for others an assumed one, which says so in its provenance."""
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
            "threshold": UNMEASURED_THRESHOLD,
            "provenance": {
                "origin": f"assumed: {ASSUMED_RIGHT:.0%} right, threshold derived from the contrast of the designs; "
                "measure it with sonar-graph calibrate"
            },
        }
    )
