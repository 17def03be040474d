"""Refuse recordings whose numbers cannot be metres and radians; name the unit they look like."""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats, InputError, Text

FARTHEST_RADAR_M = 1514.0  # the farthest an ARS548 can be set to; others end at 300 m
LEAST_JUDGED = 100  # detections, of which the median is no ghost's
LEAST_MEDIAN_M = 10.0  # of roadside radars it is 20 to 60 m: under it, the next smaller unit
MAP_M = 1e5  # no median range in millimetres is over 100 m
LEAST_EXTENT_M = 0.02  # even one still target wanders by more; 0.02 degrees are 2 km
TURN_RAD = 2.0 * np.pi


def refuse_positions_in_other_units(points: Floats, what: str) -> None:
    """Refuse positions that look like millimetres, centimetres, degrees or places in a map.

    Parameters
    ----------
    points : (n, 3) array
        Of detections, finite x and y; fewer than 100 are not judged.
    what : str
        What they are, for the message.

    Raises
    ------
    InputError
        If their median is beyond any radar, or all are in one spot.
    """
    if len(points) < LEAST_JUDGED:
        return
    range_m = np.hypot(points[:, 0], points[:, 1])
    median = float(np.median(range_m))
    if median > FARTHEST_RADAR_M:
        raise InputError(
            "{}: half of the detections are over {:,.0f} m away, beyond any radar: {}",
            what,
            median,
            _likely(median),
            hint="x, y and z are metres from the sensor, x forward and y to the left",
        )
    extent = np.ptp(points[:, :2], axis=0)
    if (extent < LEAST_EXTENT_M).all() and len(np.unique(points[:, :2], axis=0)) >= LEAST_JUDGED:
        middle = np.median(points[:, :2], axis=0)
        raise InputError(
            "{}: all detections are within {:.1g} of x {:g}, y {:g}: it looks like degrees",
            what,
            extent.max(),
            middle[0],
            middle[1],
            hint="x, y and z are metres from the sensor, x forward and y to the left",
        )


def _likely(median: float) -> str:
    if median > MAP_M:
        return "it looks like places in a map, not positions from the sensor"
    unit = "millimetres" if median / 1000.0 >= LEAST_MEDIAN_M else "centimetres"
    return Text("it looks like {}", Text(unit))


def refuse_degrees(angles: Floats, field: str, name: str) -> None:
    """Refuse angles in radians that look like degrees.

    Parameters
    ----------
    angles : (n,) array
        Of one frame or more.
    field, name : str
        The file's field, and what it is read as: `azimuth` or `elevation`.

    Raises
    ------
    InputError
        If half of them are over a turn, or as elevations over a right angle.
    """
    limit = TURN_RAD if name == "azimuth" else TURN_RAD / 4.0
    known = np.abs(angles[np.isfinite(angles)])
    median = float(np.median(known)) if len(known) >= 5 else 0.0
    if median > limit:
        raise InputError(
            "{}: half of the values are over {:.3g}, expected radians: it looks like degrees",
            field,
            median,
            hint=Text("state it: {} {}_deg={}", "--columns", name, field),
        )


MOVING_MPS = 3.0  # over walkers and leaves
LAPSE_S = 0.5  # in which a vehicle moves by more than its reflections wander
NEAR_RAD, NEAR_MPS = 0.17, 0.5  # of one vehicle before and after
MOST_FRAMES, EVERY = 3000, 3  # looked at, of these one in so many
LEAST_PAIRS = 200
WINDOW, LEAD = 0.2, 3.0  # share of a ratio within which pairs count; over those that fit metres
# How much faster ranges change than the range rates state, if a unit or a sign is mistaken.
RATIOS = {
    3.28084: "positions look like feet",
    1.0 / 3.6: "range rates look like km/h",
    -1.0: "range rates look positive where targets approach",
}


def compare_speeds(time: Floats, points: Floats, range_rate: Floats) -> str:
    """Return what is odd where ranges do not change as the range rates state; empty if nothing is.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds, ascending; detections of one frame share one.
    points, range_rate : arrays
        Positions (n, 3), metres, and range rates (n,), m/s.
    """
    moving = np.abs(range_rate) >= MOVING_MPS
    time, points, rate = time[moving], points[moving], range_rate[moving]
    range_m, azimuth = np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])
    frames, begins = np.unique(time, return_index=True)
    ends = np.append(begins[1:], len(time))
    found = []
    looked_at = np.arange(0, min(len(frames), MOST_FRAMES), EVERY)
    later = np.searchsorted(frames, frames[looked_at] + LAPSE_S)
    for one, other in zip(looked_at.tolist(), later.tolist(), strict=True):
        if other == len(frames) or frames[other] - frames[one] > 1.5 * LAPSE_S:
            continue
        a, b = (slice(begins[i], ends[i]) for i in (one, other))
        alike = np.abs(rate[a, None] - rate[b]) <= NEAR_MPS
        alike &= np.abs(azimuth[a, None] - azimuth[b]) <= NEAR_RAD
        stated = (rate[a, None] + rate[b]) / 2 * (frames[other] - frames[one])
        found.append(((range_m[b] - range_m[a, None])[alike], stated[alike]))
    if sum(len(moved) for moved, _ in found) < LEAST_PAIRS:
        return ""
    moved, stated = (np.concatenate(part) for part in zip(*found, strict=True))
    fits = {r: int((np.abs(moved / stated / r - 1.0) <= WINDOW).sum()) for r in (1.0, *RATIOS)}
    # pairs of targets that have nothing in common fall into a window by its width
    density = {ratio: count / abs(ratio) for ratio, count in fits.items()}
    best = max(RATIOS, key=lambda ratio: density[ratio])
    if fits[best] < LEAST_PAIRS / 4 or density[best] < LEAD * density[1.0]:
        return ""
    return Text(
        "ranges change {:.2f} times as fast as the range rates state: {}", best, RATIOS[best]
    )
