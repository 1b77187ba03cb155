"""Scales on which parameters of subjects are normal: as they are, logarithms or logits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special

from rankone.support.arrays import Array
from rankone.support.errors import OptionError
from rankone.support.wording import did_you_mean, listing, quote, shown


@dataclass(frozen=True)
class Scale:
    """A parameter x as a function of its coordinate z on which it is normal, and back.

    ``slope`` is dx/dz as a function of x. Parameters are between ``least`` and ``most``.
    """

    name: str
    coordinate: Callable[[Array], Array]
    value: Callable[[Array], Array]
    slope: Callable[[Array], Array]
    least: float = -np.inf
    most: float = np.inf


NORMAL = Scale("normal", np.asarray, np.asarray, np.ones_like)
LOG_NORMAL = Scale("log-normal", np.log, np.exp, np.asarray, 0.0)
LOGIT_NORMAL = Scale(
    "logit-normal", special.logit, special.expit, lambda x: x * (1.0 - x), 0.0, 1.0
)
SCALES = {scale.name: scale for scale in (NORMAL, LOG_NORMAL, LOGIT_NORMAL)}
"""The scales by the names that ``random=`` takes."""
_OTHER_NAMES = {"lognormal": "log-normal", "logit": "logit-normal", "logitnormal": "logit-normal"}


def scale_of(given: object, parameter: str, box: tuple[float, float]) -> Scale:
    """The scale of a random parameter by its name; an OptionError if the box does not fit it."""
    name = _OTHER_NAMES.get(given, given) if isinstance(given, str) else None
    if name not in SCALES:
        raise OptionError(
            f"random: the distribution of {quote(parameter)} is {shown(given)}"
            f"{did_you_mean(str(given), SCALES)}",
            term=given,
            remedy=f"choose from {listing(SCALES)}",
        )
    scale = SCALES[name]
    if box[0] <= scale.least or box[1] >= scale.most:
        end = box[0] if box[0] <= scale.least else box[1]
        bounds = "positive" if scale.most == np.inf else "between 0 and 1"
        raise OptionError(
            f"{quote(parameter)} is {scale.name}, and so {bounds}, but the box of the solution "
            f"reaches to {end:g}",
            term=parameter,
            remedy='solve on a box inside of that, or choose "normal"',
        )
    return scale


def search_scale(box: tuple[float, float]) -> Scale:
    """The scale on which a parameter without random effect is searched: its logarithm if it can."""
    return LOG_NORMAL if box[0] > 0.0 else NORMAL
