"""Find guesses that were given to the wrong recordings.

With the guess of another sensor, a recording may fit a place there by chance: nothing contradicts
it as long as that sensor has no pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from gis_radar.base import GisRadarError, Text
from gis_radar.calibration.scan.scan_check_result import CONFIRMS
from gis_radar.poses import Pose

_APART_M = 15.0  # guesses lie within it of the truth; nearer ones are of one place


def swapped_guesses(
    poses: Mapping[str, Pose],
    pairs: Collection[tuple[str, str]],
    starts: Mapping[str, tuple[Path, Sequence[float]]],
    answered: Collection[str],
    localize: Callable[..., Any],
) -> dict[str, Text]:
    """Return the sensors to whose guesses belongs the recording of another one, with the reason.

    Looked at are sensors with a pose that neither a scan nor shared vehicles confirm. Their
    recordings must fit the guess of another one, too: where a wrong guess is of a sensor that
    stands beside a right one, its recording also fits at that one's guess.

    Parameters
    ----------
    poses : mapping of str to Pose
        By sensor; with their scan checks if there are scans.
    pairs : collection of (str, str)
        Sensors that share vehicles.
    starts : mapping of str to (Path, guess)
        Recording and guess of all sensors.
    answered : collection of str
        Sensors with an answer of their own, even if it is refused by now.
    localize : callable
        Localizes a recording at a `guess` in the map's CRS; raises NoAnswerError.
    """

    def fits(sensor: str, at: str) -> bool:
        with suppress(GisRadarError):
            localize(starts[sensor][0], guess=tuple(starts[at][1]))
            return True
        return False

    found: dict[str, Text] = {}
    for one in (name for name in _unconfirmed(poses, pairs) if name in starts):
        here = starts[one][1]
        apart = [at for at in starts if math.dist(here[:2], starts[at][1][:2]) > _APART_M]
        for other in (name for name in apart if name not in answered):
            if fits(other, one) and any(fits(one, at) for at in apart):
                found[one] = Text(
                    "no pose, as the traffic of {} fits its guess: are guesses swapped?", other
                )
                break
    return found


def _unconfirmed(poses: Mapping[str, Pose], pairs: Collection[tuple[str, str]]) -> list[str]:
    """Return the sensors whose pose neither a scan nor vehicles shared with another one confirm."""
    shared = {name for pair in pairs for name in pair}
    checks = {name: pose.evidence.get("scan_check") or {} for name, pose in poses.items()}
    confirmed = {name for name, each in checks.items() if each.get("verdict") == CONFIRMS}
    return [name for name in poses if name not in shared | confirmed]


def by_name(reasons: Mapping[str, str]) -> str:
    """Return reasons in one line, each once, with the names of their sensors."""
    named = {
        reason if Text(reason).names(name) else Text("{}: {}", name, reason): None
        for name, reason in reasons.items()
    }
    return Text("; ").join(named)
