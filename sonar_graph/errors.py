"""Errors that this package raises on purpose, under one root.

Each message says what was asked, what was found, and what to do. The command line prints it on one line and exits
with 2; only an unforeseen error ends in a traceback.
"""

MISFIT = "misfit"
"""Type of a validation error whose message alone says all."""


class SonarGraphError(Exception):
    """Root of every error that this package raises on purpose."""


class MeasurementError(SonarGraphError):
    """A block of measurements breaks its own rules (shape, order, finiteness)."""


class CalibrationError(SonarGraphError):
    """A calibration is missing or impossible."""


class SimulationError(SonarGraphError):
    """A simulated run is asked for that cannot be made."""


class LogError(SonarGraphError):
    """A file cannot be read as what it should be."""


class MissingTopicError(LogError):
    """A needed topic is not in the log."""


class DatasetError(LogError):
    """A data set's folder or file is not what its converter expects."""


class AlignmentError(SonarGraphError):
    """Attitude and gyro bias cannot be told from a stretch of a run."""


class EstimatorError(SonarGraphError):
    """An estimator cannot be set up or cannot go on."""


class UnknownEstimatorError(EstimatorError):
    """No installed estimator has the name that was asked for."""


class EvaluationError(SonarGraphError):
    """A comparison or report cannot be made."""


class BatchError(SonarGraphError):
    """A suite of runs has a mistake, or the batch cannot go on."""
