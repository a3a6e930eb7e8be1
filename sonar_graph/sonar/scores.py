"""From how well designs fit to probabilities of what a frame looks like.

With noise of unknown strength the likelihood of a design whose correlation with a patch of n independent samples is c
is ``(1 - c^2)^(-n/2)``. Samples are not independent and designs do not fit exactly, so that the exponent and the
correlation below which nothing fits are measured (`sonar_graph.sonar.confusion`)::

    s_j     ~  (1 - max(c_j, 0)^2)^(-sharpness visible)
    s_none  ~  (1 - threshold^2)^(-sharpness visible)

where ``visible`` is the share of the template's cells that the image holds.
"""

from __future__ import annotations

import numpy as np

from sonar_graph.measurements import Floats

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
