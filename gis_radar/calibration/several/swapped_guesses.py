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
from gis_radar.calibration.scan.scan_check_result import CONFIRMS
from gis_radar.calibration.single.result import Localization

_APART_M = 15.0  # guesses lie within it of the truth; nearer ones are of one place


def swapped_guesses(
    suspects: Collection[str],
    guesses: Mapping[Path, tuple[float, ...]],
    answered: Collection[str],
    localize: Callable[..., Any],
) -> dict[str, Text]:
    """Return the sensors to whose guesses belongs the recording of another one, with the reason.

    Theirs must fit the guess of another one, too: where a wrong guess is of a sensor that stands
    beside a right one, its recording also fits at that one's guess.

    Parameters
    ----------
    suspects : collection of str
        Sensors with a pose that nothing confirms, as from :func:`unconfirmed`.
    guesses : mapping of Path to tuple of float
        Guesses of all sensors by their recordings.
    answered : collection of str
        Sensors with an answer.
    localize : callable
        Localizes a recording at a `guess`; raises NoAnswerError.
    """

    def fits(recording: Path, guess: tuple[float, ...]) -> bool:
        with suppress(NoAnswerError):
            localize(recording, guess=guess)
            return True
        return False

    found: dict[str, Text] = {}
    for one in (path for path in guesses if path.stem in suspects):
        here = guesses[one]
        apart = [path for path in guesses if math.dist(here[:2], guesses[path][:2]) > _APART_M]
        for other in (path for path in apart if path.stem not in answered):
            if fits(other, here) and any(fits(one, guesses[path]) for path in apart):
                found[one.stem] = Text(
                    "no pose, as the traffic of {} fits its guess: are guesses swapped?", other.stem
                )
                break
    return found


def unconfirmed(
    placed: Mapping[str, Localization], pairs: Collection[tuple[str, str]]
) -> list[str]:
    """Return the sensors whose pose neither a scan nor vehicles shared with another one confirm.

    Parameters
    ----------
    placed : mapping of str to Localization
        Localizations by sensor, with their scan checks if there are scans.
    pairs : collection of (str, str)
        Sensors that share vehicles.
    """
    shared = {name for pair in pairs for name in pair}
    checks = {name: each.pose.evidence.get("scan_check") or {} for name, each in placed.items()}
    confirmed = {name for name, each in checks.items() if each.get("verdict") == CONFIRMS}
    return [name for name in placed if name not in shared | confirmed]


def by_name(reasons: Mapping[str, str]) -> str:
    """Return reasons in one line, each once, with the names of their sensors."""
    named = {
        reason if name in reason.partition(":")[0].split() else f"{name}: {reason}": None
        for name, reason in reasons.items()
    }
    return Text("; ").join(named)
