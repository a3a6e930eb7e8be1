"""Errors that this package raises on purpose, under one root.

Each message has what was requested, what was found, and what to do. The command line prints it on one line and exits
with 2; only an unforeseen error ends in a traceback.
"""

import re

MISFIT = "misfit"
"""Type of a validation error whose message needs no words around it."""


class SonarGraphError(Exception):
    """Root of every error that this package raises on purpose."""


class ArgumentError(SonarGraphError, TypeError):
    """A function of this package is called with a value of another kind."""


class MeasurementError(SonarGraphError):
    """A block of measurements breaks its own rules (shape, order, finiteness)."""


class CalibrationError(SonarGraphError):
    """A calibration is missing or impossible."""


class SettingError(SonarGraphError, ValueError):
    """A section of settings is made with a value that does not fit, or changed."""


class SimulationError(SonarGraphError):
    """A simulated run cannot be made as requested."""


class LogError(SonarGraphError):
    """A file cannot be read as what it should be."""


class MissingTopicError(LogError):
    """A needed topic is not in the log."""


class DatasetError(LogError):
    """A data set's folder or file is not what its converter expects."""


class AlignmentError(SonarGraphError):
    """Attitude and gyro bias cannot be determined from a stretch of a run.

    ``misfit``: root mean square of differences over their sigmas, where sensors contradict each other.
    """

    def __init__(self, message: str, misfit: float = 0.0) -> None:
        super().__init__(message)
        self.misfit = misfit


class EstimatorError(SonarGraphError):
    """An estimator cannot be set up or cannot go on."""


class UnknownEstimatorError(EstimatorError):
    """No installed estimator has the requested name."""


class EvaluationError(SonarGraphError):
    """A comparison or report cannot be made."""


class BatchError(SonarGraphError):
    """A suite of runs has a mistake, or the batch cannot go on."""


EXPECTED = {
    "model_type": "a section", "dict_type": "a section", "tuple_type": "a list", "list_type": "a list",
    "bool_type": "true or false", "bool_parsing": "true or false", "string_type": "a text",
    "float_type": "a number", "float_parsing": "a number", "int_type": "an integer", "int_parsing": "an integer",
    "int_from_float": "an integer",
}  # fmt: skip
"""Words for what a field holds, by the type of a validation error."""


def expectation(kind: str, message: str) -> str:
    """Text of a validation error of this type, without the words of the library that found it."""
    if kind in EXPECTED:
        return f"expected {EXPECTED[kind]}"
    # pydantic puts it before the messages of validators
    message = message.removeprefix("Value error, ")
    return re.sub(
        "^Input should be (?=(greater|less))", "expected a number ", message
    ).replace("Input should be", "expected", 1)
