"""Measured model of recognition: how much each piece of evidence counts, and how often landmarks look like which.

Classes and features are the designs in their order, last "none". With phi_k what speaks for design k in a frame
(`sonar_graph.sonar.evidence.EVIDENCE`) and w the weights, which all designs share::

    l_k = w . phi_k        l_none = 0        log odds of a track that always looks like this

The log odds of a track are the mean of l over its looks, times ``W / (W + looks)`` with W the number of independent
looks: they are bounded, because what was not foreseen of a landmark repeats from look to look. ``matrix[k, j] =
p(z = j | x = k)`` is the posterior mean of the score of feature j given class k (`posterior_mean_rows`), a score being
the posterior of one look.

The model that ships, ``default_confusion.json``, was measured on simulated basins with the designs that ship.
`sonar_graph.recognition.confusion_fit` measures others.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import Field, FiniteFloat, ValidationError, model_validator

from sonar_graph.calibration import Section
from sonar_graph.devices import LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.files import text_of
from sonar_graph.measurements import Floats, Ints
from sonar_graph.settings import faults_in
from sonar_graph.sonar.evidence import EVIDENCE

SHIPPED = Path(__file__).with_name("default_confusion.json")
"""The model of the designs that ship."""
JEFFREYS = 0.5
"""Prior count of each feature."""
ASSUMED_RIGHT = 0.9
"""Share of frames in which an unmeasured landmark is assumed to show its own feature."""


def soft_scores(log_odds: Floats, looks: float) -> Floats:
    """Soft scores of the features from single looks, shape (n, designs + 1), rows sum to 1.

    From the log odds of each design and none of them, shape (n, designs + 1), of a model with this number of looks.
    """
    share = log_odds / (1.0 + looks)
    odds = np.exp(share - share.max(axis=1, keepdims=True))
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
    weights: tuple[FiniteFloat, ...]
    """How much each column of `EVIDENCE` counts, in nats."""
    looks: float = Field(gt=0, allow_inf_nan=False)
    """Number of independent looks that give a track half of the log odds of endless ones."""
    roughness: tuple[float, float] | None = None
    """2.5 and 97.5 % quantiles, over tracks, of their mean evidence `beyond`; None: not measured."""
    doubt: float = Field(5e-4, ge=0, lt=1)
    """Share of tracks whose looks tell nothing: what was never seen in n tracks may still happen in 1 / 2n of them."""
    range_sigma_m: float = Field(gt=0, allow_inf_nan=False)
    """Standard deviation of the range in a frame that shows the whole landmark."""
    azimuth_sigma_rad: float = Field(gt=0, allow_inf_nan=False)
    """The same of the azimuth."""
    bin_m: float | None = Field(None, gt=0, allow_inf_nan=False)
    """Length of the range bins of the frames in which these were measured; None: they hold for bins of any length."""
    height_bias_m: float = Field(0.0, gt=-1, lt=1)
    """Height of the faces that sound sees over the heights of the true landmarks."""
    error_correlation: float = Field(0.0, ge=0, lt=1)
    """Correlation of the errors of range and azimuth in successive frames of a track."""
    provenance: Mapping[str, str] = Field(default_factory=dict)
    """Source of the frames, counts by class, assumptions."""

    @model_validator(mode="after")
    def _is_stochastic(self) -> Confusion:
        matrix = np.array(self.matrix, float, ndmin=2) if len({len(r) for r in self.matrix}) == 1 else np.empty((0, 0))
        classes = len(self.ids) + 1
        if len(set(self.ids)) < len(self.ids):
            raise ValueError(f"ids: expected each once, not {', '.join(map(str, self.ids))}")
        if self.designs and len(self.designs) != len(self.ids):
            raise ValueError(f"designs: expected one for each of {len(self.ids)} ids, not {len(self.designs)}")
        if matrix.shape != (classes, classes):
            raise ValueError(f"matrix: expected {classes} rows of {classes} for {len(self.ids)} ids and none of them")
        if len(self.weights) != len(EVIDENCE):
            raise ValueError(f"weights: expected {len(EVIDENCE)}, for {', '.join(EVIDENCE)}")
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

    def log_odds(self, evidence: Floats) -> Floats:
        """Log odds of each design against none of them, shape (..., designs), from evidence (..., designs, 9)."""
        return np.asarray(evidence @ np.array(self.weights))

    def range_azimuth_cov(self, visible: Floats, bin_m: float) -> Floats:
        """Covariances of range and azimuth of landmarks with these shares in view, shape (n, 2, 2), in bins so long.

        Sigmas grow with the inverse square of the share, as measured on simulated basins. Variances grow with the bins:
        a bin is one look at the speckle, so that a landmark has half as many where bins are twice as long.
        """
        longer = 1.0 if self.bin_m is None else max(bin_m / self.bin_m, 1.0)
        variances = np.diag([self.range_sigma_m**2, self.azimuth_sigma_rad**2])
        return np.asarray(variances * longer / visible[:, None, None] ** 4)

    def report_interval(self) -> int:
        """Number of frames of a track that tell as much of a place as one independent frame.

        n frames whose errors have the correlation rho from one to the next (a first-order autoregression) tell as much
        as ``1 + (n - 1) (1 - rho) / (1 + rho)`` independent ones: one more in every ``(1 + rho) / (1 - rho)`` frames.
        """
        return math.ceil((1 + self.error_correlation) / (1 - self.error_correlation) - 1e-9)


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
        values = json.loads(text_of(path))
        if isinstance(values, dict) and "sharpness" in values:
            raise CalibrationError(
                f"{path}: weights: missing; it has sharpness and threshold, which belong to an earlier version that "
                "compared by correlation; measure it again with sonar-graph calibrate"
            )
        return Confusion.model_validate(values)
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
    shipped = read_confusion(SHIPPED)
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
            "provenance": {
                "origin": f"assumed: {ASSUMED_RIGHT:.0%} right, weights of the evidence those of the shipped designs; "
                "measure it with sonar-graph calibrate"
            },
        }
    )
