"""Measured model of recognition: how much each piece of evidence counts, and how often landmarks look like which.

Classes and features are the designs in their order, last "none". With phi_k the evidence for design k in a frame
(`sonar_graph.sonar.evidence.EVIDENCE`) and w the weights, which all designs share::

    l_k = w . phi_k        l_none = 0        log odds of a track that always looks like this

The log odds of a track are the mean of l over its looks, times ``W / (W + looks)`` with W the number of independent
looks: they are bounded, because what was not foreseen of a landmark repeats from look to look. ``matrix[k, j] =
p(z = j | x = k)`` is the posterior mean of the score of feature j given class k, a score being the posterior of one
look.

The model that ships, ``default_confusion.json``, was measured on simulated basins with the designs that ship.
`sonar_graph.recognition.confusion_fit` measures others.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field, FiniteFloat, ValidationError, model_validator

from sonar_graph.calibration import Section
from sonar_graph.devices import LandmarkDesign
from sonar_graph.errors import CalibrationError
from sonar_graph.files import text_of
from sonar_graph.measurements import Floats
from sonar_graph.settings import faults_in
from sonar_graph.sonar.evidence import EVIDENCE

SHIPPED = Path(__file__).with_name("default_confusion.json")
"""The model of the designs that ship."""
ASSUMED_RIGHT = 0.9
"""Share of frames in which an unmeasured landmark is assumed to show its own feature."""


def soft_scores(log_odds: Floats, looks: float) -> Floats:
    """Soft scores of the features from single looks, shape (n, designs + 1), rows sum to 1.

    From the log odds of each design and none of them, shape (n, designs + 1), of a model with this number of looks.
    """
    share = log_odds / (1.0 + looks)
    odds = np.exp(share - share.max(axis=1, keepdims=True))
    return odds / odds.sum(axis=1, keepdims=True)


class DesignMark(Section):
    """Name and digest of a design, to recognise it by."""

    name: str
    digest: str
    """Of `LandmarkDesign.digest`."""


class Accuracy(NamedTuple):
    """Standard deviations along the ray and across it, as they grow with the bounds of a fit.

    ``sigma = usual sigma (bound / usual bound)^power``: a fit with less contrast, with less of the landmark in view or
    with a larger residual has a larger bound, and errs more than by white noise.
    """

    usual_m: Floats
    """Usual bounds, shape (2,)."""
    usual_sigmas_m: Floats
    """Standard deviations at these, shape (2,)."""
    power: float

    def sigmas_m(self, bound_m: Floats) -> Floats:
        """Standard deviations at bounds, shape (..., 2)."""
        return self.usual_sigmas_m * (bound_m / self.usual_m) ** self.power


class Confusion(Section):
    """The measured model of a recogniser.

    Examples
    --------
    >>> from sonar_graph.sonar import SHIPPED, read_confusion
    >>> model = read_confusion(SHIPPED)
    >>> model.ids, len(model.matrix)
    ((1, 2, 3, 4), 5)
    """

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
    """Share of tracks whose frames hold no evidence: what was never seen in n tracks may still happen in 1 / 2n of them."""
    range_sigma_m: float = Field(gt=0, allow_inf_nan=False)
    """Standard deviation of the range in a frame whose bound of it is `range_bound_m`."""
    across_sigma_m: float = Field(gt=0, allow_inf_nan=False)
    """The same across, range times azimuth, where its bound is `across_bound_m`."""
    range_bound_m: float = Field(gt=0, allow_inf_nan=False)
    """Usual Cramer-Rao bound of the range (`ObjectSighting.bound_m`)."""
    across_bound_m: float = Field(gt=0, allow_inf_nan=False)
    """The same across."""
    bound_power: float = Field(gt=0, le=4)
    """Power of the bound with which standard deviations grow: 1 where a fit errs by nothing but white noise."""
    height_bias_m: float = Field(0.0, gt=-1, lt=1)
    """Height of the faces that sound sees over the heights of the true landmarks."""
    report_interval_s: float = Field(0.0, ge=0, allow_inf_nan=False)
    """Time in which a track constrains a place as much as one independent frame; 0: its frames are independent."""
    provenance: Mapping[str, str] = Field(default_factory=dict)
    """Source of the frames, counts by class, assumptions."""

    @model_validator(mode="after")
    def _is_stochastic(self) -> Confusion:
        matrix = (
            np.array(self.matrix, float, ndmin=2)
            if len({len(r) for r in self.matrix}) == 1
            else np.empty((0, 0))
        )
        classes = len(self.ids) + 1
        if len(set(self.ids)) < len(self.ids):
            raise ValueError(
                f"ids: expected each once, not {', '.join(map(str, self.ids))}"
            )
        if self.designs and len(self.designs) != len(self.ids):
            raise ValueError(
                f"designs: expected one for each of {len(self.ids)} ids, not {len(self.designs)}"
            )
        if matrix.shape != (classes, classes):
            raise ValueError(
                f"matrix: expected {classes} rows of {classes} for {len(self.ids)} ids and none of them"
            )
        if len(self.weights) != len(EVIDENCE):
            raise ValueError(
                f"weights: expected {len(EVIDENCE)}, for {', '.join(EVIDENCE)}"
            )
        if (matrix < 0).any() or not np.allclose(matrix.sum(axis=1), 1, atol=1e-6):
            raise ValueError(
                "matrix: each row must be probabilities that sum to 1 (rows are the true classes)"
            )
        if (matrix == 0).any():
            raise ValueError(
                "matrix: an entry is 0; what was never seen in n tracks may still happen: give about 1 / 2n"
            )
        return self

    def check_designs(
        self, designs: Sequence[LandmarkDesign], source: str = "confusion"
    ) -> None:
        """Refuse designs other than the measured ones.

        Raises
        ------
        CalibrationError
            Naming the source and the first design that differs.
        """
        ids = tuple(design.id for design in designs)
        remedy = "give the designs of the model with --designs, or measure one for these with sonar-graph calibrate"
        if self.ids != ids:
            raise CalibrationError(
                f"{source}: measured for landmarks {_listed(self.ids)}, the designs are {_listed(ids)}; {remedy}"
            )
        if not self.designs:
            raise CalibrationError(
                f"{source}: designs: is missing, so that it may be of other landmarks; {remedy}"
            )
        for mark, design in zip(self.designs, designs, strict=True):
            if mark != mark_of(design):
                raise CalibrationError(
                    f"{source}: measured for another landmark {design.id} ({mark.name}) than the design given "
                    f"({design.name}): name, size, height, relief or picture differ; {remedy}"
                )

    def array(self) -> Floats:
        """The matrix, shape (ids + 1, ids + 1)."""
        return np.array(self.matrix)

    def log_odds(self, evidence: Floats) -> Floats:
        """Log odds of each design against none of them, shape (..., designs), from evidence (..., designs, 11)."""
        return evidence @ np.array(self.weights)

    @property
    def accuracy(self) -> Accuracy:
        """Standard deviations of the place that a fit gives."""
        return Accuracy(
            np.array([self.range_bound_m, self.across_bound_m]),
            np.array([self.range_sigma_m, self.across_sigma_m]),
            self.bound_power,
        )

    def range_azimuth_cov(self, bound_m: Floats, range_m: Floats) -> Floats:
        """Covariances of range and azimuth, shape (n, 2, 2), for `ObjectSighting.bound_m` (n, 2) at ranges (n,).

        What a template lacks is some millimetres of the landmark wherever it lies, so that the law (`Accuracy`) is in
        metres across, not in angles.
        """
        sigmas = self.accuracy.sigmas_m(bound_m)
        sigmas[:, 1] /= range_m
        covariances = np.zeros((len(bound_m), 2, 2))
        covariances[:, [0, 1], [0, 1]] = sigmas**2
        return covariances


def _listed(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids))


def mark_of(design: LandmarkDesign) -> DesignMark:
    """Its name and digest."""
    return DesignMark(name=design.name, digest=design.digest())


def read_confusion(path: Path) -> Confusion:
    """A model that `sonar-graph calibrate` wrote.

    Raises
    ------
    CalibrationError
        When the file is not JSON or not such a model, naming the field.

    Examples
    --------
    >>> from sonar_graph.sonar import SHIPPED, read_confusion
    >>> read_confusion(SHIPPED).looks > 0
    True
    """
    try:
        values = json.loads(text_of(path))
        names = set(values) if isinstance(values, dict) else set()
        if names & {
            "sharpness",
            "error_correlation",
            "azimuth_sigma_rad",
        }:
            raise CalibrationError(
                f"{path}: across_bound_m: missing; it is a model of an earlier version without the bounds of the fit's "
                "accuracy across; measure it again with sonar-graph calibrate"
            )
        if names == {"log", "labels"}:
            raise CalibrationError(
                f"{path}: is a file of labels; `sonar-graph calibrate LOG --labels {path} -o model.json` makes a model "
                "of them"
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
    """The model that ships for the designs that ship; for others an assumed one, marked so in its provenance.

    Examples
    --------
    >>> from sonar_graph.devices import DEFAULT_DESIGNS
    >>> from sonar_graph.sonar import confusion_for
    >>> confusion_for(DEFAULT_DESIGNS[:2]).provenance["origin"][:18]
    'assumed: 90% right'
    """
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
