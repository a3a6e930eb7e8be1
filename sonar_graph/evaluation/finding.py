"""One thing that a log's sensors tell, how sure it is, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sonar_graph.navigation.offset_search import Estimate1D

INTERVAL_SIGMAS = 1.96
"""Intervals are printed as plus or minus 95 %."""
NO_NEED = "no need to act"
ALSO = "put right by the line above"


@dataclass(frozen=True)
class Finding:
    """One quantity, how sure it is, and what to do."""

    quantity: str
    estimate: Estimate1D
    unit: str
    advice: str
    """A sentence; says that nothing need be done where nothing need."""
    acts: bool = False
    """Whether something should be done."""

    def text(self) -> str:
        """Value with its 95 % interval, and the advice; or why it cannot be told, or what is wrong before that."""
        if not self.estimate.is_known:
            return self.advice if self.acts else f"cannot be told: {self.estimate.reason}"
        return f"{with_interval(self.estimate, self.unit)}: {self.advice}"

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        known, e = self.estimate.is_known, self.estimate
        numbers = {"value": e.value if known else None, "sigma": e.sigma if known else None, "unit": self.unit}
        return {"quantity": self.quantity, **numbers, "reason": e.reason, "act": bool(self.acts), "advice": self.advice}


def with_interval(estimate: Estimate1D, unit: str) -> str:
    """Digits as far as the interval supports them."""
    half = INTERVAL_SIGMAS * estimate.sigma
    digits = int(np.clip(1 - np.floor(np.log10(half)), 0, 8)) if half > 0 else 3
    if unit.startswith(("rad/s", "m/s")):
        return f"{estimate.value:.2g} ± {half:.1g} {unit}"
    sign = "" if unit == "" else "+"
    return f"{estimate.value:{sign}.{digits}f} ± {half:.{digits}f} {unit}".rstrip()


def in_degrees(angle: Estimate1D) -> Estimate1D:
    """An angle, or a difference of angles, from radians."""
    return replace(angle, value=float(np.degrees(angle.value)), sigma=float(np.degrees(angle.sigma)))


def matters(estimate: Estimate1D, least: float) -> bool:
    """Larger than what is worth the trouble, and its interval leaves zero out."""
    return bool(estimate.is_known and abs(estimate.value) > max(least, INTERVAL_SIGMAS * estimate.sigma))


def said_once(findings: Sequence[Finding]) -> list[Finding]:
    """Findings that one line puts right together: it stands in the first that acts, the others refer to it."""
    acting = [number for number, finding in enumerate(findings) if finding.acts]
    return [replace(f, advice=ALSO) if number in acting[1:] else f for number, f in enumerate(findings)]
