"""What the tags of a lanelet mean, after Lanelet2's tagging rules."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

VEHICLE, BICYCLE, PEDESTRIAN = "vehicle", "bicycle", "pedestrian"

# Lanelet2, "Tagging Lanelets and Areas", table "Subtype and Location".
USERS: dict[str, tuple[str, ...]] = {
    "": (VEHICLE,),
    "road": (BICYCLE, VEHICLE),
    "highway": (VEHICLE,),
    "play_street": (BICYCLE, PEDESTRIAN, VEHICLE),
    "exit": (BICYCLE, PEDESTRIAN, VEHICLE),
    "emergency_lane": ("vehicle:emergency",),
    "bus_lane": ("vehicle:bus", "vehicle:emergency", "vehicle:taxi"),
    "bicycle_lane": (BICYCLE,),
    "walkway": (PEDESTRIAN,),
    "shared_walkway": (BICYCLE, PEDESTRIAN),
    "crosswalk": (PEDESTRIAN,),
    "stairs": (PEDESTRIAN,),
}
_YES, _NO = {"yes", "true", "1"}, {"no", "false", "0"}
ON_FOOT_OR_BICYCLE = ("bicycle_lane", "crosswalk", "shared_walkway", "stairs", "walkway")
_KMH_PER_UNIT = {
    "": 1.0,
    "km/h": 1.0,
    "kmh": 1.0,
    "kph": 1.0,
    "kmph": 1.0,
    "m/s": 3.6,
    "mps": 3.6,
    "ms": 3.6,
    "mph": 1.609344,
}
_SPEED = re.compile(r"\s*(\d+(?:[.,]\d+)?)\s*([a-z/]*)\s*", re.IGNORECASE)
_SIGN = re.compile(r"(?:^|[^0-9])274(?:\.1)?[-_](\d{2,3})$")


def participants_of(tags: dict[str, str]) -> tuple[str, ...]:
    """Return who may use a lanelet, sorted: `vehicle`, `bicycle`, `pedestrian`, `vehicle:bus`, ...

    One `participant:*` tag sets aside all that the subtype implies. A subtype that Lanelet2 does
    not know has no users.
    """
    override = {key: value for key, value in tags.items() if key.startswith("participant:")}
    if override:
        users = (key.removeprefix("participant:") for key in override if truth(override[key]))
        return tuple(sorted(users))
    return USERS.get(tags.get("subtype", ""), ())


def subtype_of(tags: dict[str, str]) -> str:
    """Return the subtype; where old maps give none, the one that fits the participants."""
    if subtype := tags.get("subtype", ""):
        return subtype
    users = participants_of(tags)
    if any(user.startswith(VEHICLE) for user in users):
        return "road"
    fitting = {
        (BICYCLE,): "bicycle_lane",
        (PEDESTRIAN,): "walkway",
        (BICYCLE, PEDESTRIAN): "shared_walkway",
    }
    return fitting.get(users, "unknown")


def one_way_of(tags: dict[str, str]) -> bool:
    """Return whether a lanelet is used in one direction only.

    Without a `one_way` tag it is, unless pedestrians alone use it; a tag for single participants
    (`one_way:bicycle=no`) leaves the rest in one direction.
    """
    given = truth(tags.get("one_way", ""))
    if given is not None:
        return given
    return participants_of(tags) != (PEDESTRIAN,)


def truth(text: str) -> bool | None:
    """Return the truth of yes, no, true, false, 1 or 0, or None for anything else."""
    word = text.strip().lower()
    return True if word in _YES else False if word in _NO else None


def kmh(text: str) -> float:
    """Return a speed in km/h from text such as `50`, `13.9 m/s` or `30 mph`; NaN if it is none."""
    match = _SPEED.fullmatch(text)
    if match is None:
        return math.nan
    factor = _KMH_PER_UNIT.get(match[2].lower(), math.nan)
    return float(match[1].replace(",", ".")) * factor


def kmh_of_signs(signs: Iterable[str]) -> float:
    """Return the lowest speed in km/h that signs state: `50 km/h`, or German ones, `de274-50`."""
    speeds = [kmh(sign) for sign in signs]
    speeds += [float(match[1]) for sign in signs if (match := _SIGN.search(sign))]
    return min((speed for speed in speeds if not math.isnan(speed)), default=math.nan)
