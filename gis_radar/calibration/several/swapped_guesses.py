"""Find guesses that were given to the wrong recordings.

With the guess of another sensor, a recording may fit a place there by chance: nothing contradicts
it as long as that sensor has no pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gis_radar.base import NoAnswerError, Text

APART_M = 15.0  # guesses lie within it of the truth; nearer ones are of one place


def swapped_guesses(
    suspects: Collection[str],
    guesses: Mapping[Path, tuple[float, ...]],
    answered: Collection[str],
    localize: Callable[..., Any],
) -> dict[str, Text]:
    """Return the sensors to whose guesses belongs the recording of another one, with the reason.

    Parameters
    ----------
    suspects : collection of str
        Sensors with a pose that no other sensor confirms.
    guesses : mapping of Path to tuple of float
        Guesses of all sensors by their recordings.
    answered : collection of str
        Sensors with an answer.
    localize : callable
        Localizes a recording at a `guess`; raises NoAnswerError.
    """
    found: dict[str, Text] = {}
    for one in (path for path in guesses if path.stem in suspects):
        for other in (path for path in guesses if path.stem not in answered):
            if math.dist(guesses[one][:2], guesses[other][:2]) <= APART_M:
                continue
            with suppress(NoAnswerError):
                localize(other, guess=guesses[one])
                found[one.stem] = Text(
                    "no pose, as the traffic of {} fits its guess: are guesses swapped?", other.stem
                )
    return found


def by_name(reasons: Mapping[str, str]) -> str:
    """Return reasons in one line, each once, with the names of their sensors."""
    named = {
        reason if name in reason.partition(":")[0].split() else f"{name}: {reason}": None
        for name, reason in reasons.items()
    }
    return Text("; ").join(named)
