"""Settings of the smoother that exclude each other, or do nothing beside another: all reasons, in one place."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from sonar_graph.slam.isam2 import Isam2Params

_OF_MIXTURES = ("wrong_id_probability", "view_range_m", "view_azimuth_rad")
_OF_UNKNOWN = ("unknown_gate_probability", "unknown_density_m2", "unknown_sightings", "unknown_wait_s")


class Conflict(NamedTuple):
    """A setting that cannot stand beside the others."""

    setting: str
    reason: str
    """With what it collides, and what to do: one line that names the setting."""


def conflicts(params: Isam2Params) -> list[Conflict]:
    """What excludes each other, then what was set on purpose and does nothing."""
    return [*_excluding(params), *_idle(params)]


def _excluding(params: Isam2Params) -> list[Conflict]:
    """A mixture is of landmarks that have names, in a history that is kept."""
    if params.mixture() is None:
        return []
    policy, found = f'identity_policy = "{params.identity_policy}"', []
    if params.history == "bounded":
        reason = (
            f"{policy} chooses anew in the whole history; give it"
            ' history = "whole", or history = "bounded" with identity_policy = "robust"'
        )
        found.append(Conflict("history", reason))
    if params.unknown_landmarks == "associate":
        reason = (
            f"{policy} pairs detections by place itself, and begins no landmark"
            ' without a name; give it unknown_landmarks = "ignore", or "associate" with identity_policy = "robust"'
        )
        found.append(Conflict("unknown_landmarks", reason))
    return found


def _idle(params: Isam2Params) -> list[Conflict]:
    """Settings that were given and that nothing asks for; what says the same as the others is let through."""
    given = params.model_fields_set
    idle = {name: why for name, why in _without_effect(params).items() if name in given}
    return [Conflict(name, f"{name} is of no effect with {why}") for name, why in idle.items()]


def _without_effect(params: Isam2Params) -> dict[str, str]:
    """Beside which setting each of them does nothing, and what to set for it to do something."""
    policy, idle = f'"{params.identity_policy}"', {}
    if params.identity_policy != "gate" and params.gate_probability < 1:
        idle["gate_probability"] = f'{policy}: set identity_policy = "gate"'
    if params.mixture() is None:
        idle |= dict.fromkeys(_OF_MIXTURES, f'{policy}: set identity_policy = "max-mixture" or "gnc"')
        if not params.deferred_identity:
            idle["longest_wait_s"] = "deferred_identity = false: leave one of them out"
    else:
        idle["identity_probability"] = f"{policy}, which weighs every posterior: leave it out"
        if not params.deferred_identity:
            idle["deferred_identity"] = f"{policy}, which always decides on whole tracks: leave it out"
    if params.unknown_landmarks == "ignore":
        idle |= dict.fromkeys(_OF_UNKNOWN, 'unknown_landmarks = "ignore": set unknown_landmarks = "associate"')
    if params.kernel == "none":
        idle["kernel_width"] = 'kernel = "none": set kernel = "cauchy" or "huber"'
    if params.history == "whole" and params.remembered_s is not None:
        idle["remembered_s"] = 'history = "whole": set history = "bounded"'
    return idle
