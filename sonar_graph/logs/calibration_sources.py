"""What the calibration of a run comes from, field by field.

What a user's file says goes before what the log's own record says, that before the mountings of ``/tf_static``, and
those before defaults.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from sonar_graph.calibration import Calibration, Mounting
from sonar_graph.errors import CalibrationError
from sonar_graph.logs.mountings import with_mountings
from sonar_graph.validation import faults_in

Values = Mapping[str, Any]
MOUNTING_FIELDS = {"imu": "mounting", "dvl": "mounting", "depth": "port_m", "sonar": "mounting"}
"""Where each sensor's place is in its section."""


@dataclass(frozen=True)
class PartialCalibration:
    """What a user says; all else is left to the log. ``false`` takes away what may be absent, such as ``floor``."""

    values: Values
    source: str
    """Names the file in errors and notes."""

    @classmethod
    def parse(cls, values: Values, source: str) -> PartialCalibration:
        """Check plain values as TOML and JSON give them; what is not said may be needed, but not yet.

        Raises
        ------
        CalibrationError
            Naming the source, each wrong field, what was expected, and the fields that exist.
        """
        try:
            Calibration.model_validate(_over(Calibration().model_dump(), values))
        except ValidationError as error:
            if any(not _is_missing_field(fault["type"], fault["loc"]) for fault in error.errors()):
                raise CalibrationError(f"{source}: {faults_in(error, Calibration)}") from error
        return cls(values, source)

    def fields(self) -> list[str]:
        """Paths of all that is said, such as ``dvl.mounting.translation_m``."""
        return list(_paths(self.values))


def gathered(
    given: PartialCalibration | None, recorded: Calibration | None, mountings: Mapping[str, Mounting]
) -> Calibration:
    """The calibration from what there is, by precedence.

    Parameters
    ----------
    given
        What the user says.
    recorded
        What the log's record says; fields that it leaves out count as not said.
    mountings
        Those of ``/tf_static``, by sensor.

    Raises
    ------
    CalibrationError
        When all together is none; naming the user's source.
    """
    values = with_mountings(Calibration(), dict(mountings)).model_dump()
    if recorded is not None:
        values = _over(values, recorded.model_dump(exclude_unset=True))
    if given is None:
        return Calibration.model_validate(values)
    return Calibration.parse(_over(values, given.values), given.source)


def mounted_by(values: Values) -> set[str]:
    """Sensors whose place is said."""
    return {
        sensor
        for sensor, field in MOUNTING_FIELDS.items()
        if isinstance(values.get(sensor), Mapping) and field in values[sensor]
    }


def _over(values: Values, changes: Values) -> dict[str, Any]:
    merged = dict(values)
    for name, change in changes.items():
        old = merged.get(name)
        if isinstance(old, Mapping) and isinstance(change, Mapping):
            merged[name] = _over(old, change)
        elif change is False and name in merged and not isinstance(old, bool):
            merged[name] = None
        else:
            merged[name] = change
    return merged


def _paths(values: Values, prefix: str = "") -> Iterator[str]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _paths(value, f"{prefix}{name}.")
        else:
            yield prefix + name


def _is_missing_field(kind: str, place: tuple[int | str, ...]) -> bool:
    """Whether a field is missing, and not an element of a list."""
    return kind == "missing" and isinstance(place[-1], str)
