"""Refuse recordings whose numbers cannot be metres and radians; name the unit they look like."""

from __future__ import annotations

import numpy as np

from gis_radar.base import Floats, InputError, Text

FARTHEST_RADAR_M = 1514.0  # the farthest an ARS548 can be set to; others end at 300 m
_LEAST_CHECKED = 100  # detections: the median of fewer may be that of a ghost target
# Median range; of roadside radars 20 to 60 m. Less: a smaller unit was meant
_LEAST_MEDIAN_M = 10.0
_MAP_M = 1e5  # numbers beyond are no millimetres: the median range of a radar is under 100 m
_LEAST_EXTENT_M = 0.02  # positions of even one still target vary by more; 0.02 degrees are 2 km
_TURN_RAD = 2.0 * np.pi
# Most detections of one frame: radars have some 500; more of each time are several frames. Fewer
# than those of _LEAST_FRAMES are not checked.
_MOST_ROWS, _LEAST_FRAMES = 1000, 10
_ODD_ANGLES, _MOST_ODD = 0.1, 2  # share and number of angles beyond a turn that damage may explain


def refuse_positions_in_other_units(points: Floats, what: str) -> None:
    """Refuse positions that look like millimetres, centimetres, degrees or places in a map.

    Parameters
    ----------
    points : (n, 3) array
        Positions of detections, x and y finite; fewer than `_LEAST_CHECKED` are not checked.
    what : str
        Their file, for the message.

    Raises
    ------
    InputError
        If their median is beyond any radar, or all are in one spot.
    """
    if len(points) < _LEAST_CHECKED:
        return
    plane, (x, y, _) = points[:, :2], points.T
    # a median takes long: only where half of the detections may be beyond
    may_be_far = x * x + y * y > 0.99 * FARTHEST_RADAR_M**2
    is_far = 2 * np.count_nonzero(may_be_far) >= len(points)
    if is_far and (median := float(np.median(np.hypot(x, y)))) > FARTHEST_RADAR_M:
        raise InputError(
            "{}: half of the detections are over {:,.0f} m away, beyond any radar: {}",
            what,
            median,
            _likely(median),
            hint="x, y and z are metres from the sensor, x forward and y to the left",
        )
    if (np.ptp(plane[:_LEAST_CHECKED], axis=0) >= _LEAST_EXTENT_M).any():
        return
    extent = np.ptp(plane, axis=0)
    if (extent < _LEAST_EXTENT_M).all() and len(np.unique(plane, axis=0)) >= _LEAST_CHECKED:
        middle = np.median(plane, axis=0)
        raise InputError(
            "{}: all detections are within {:.1g} of x {:g}, y {:g}: it looks like degrees",
            what,
            extent.max(),
            middle[0],
            middle[1],
            hint="x, y and z are metres from the sensor, x forward and y to the left",
        )


def _likely(median: float) -> str:
    if median > _MAP_M:
        return "it looks like places in a map, not positions from the sensor"
    unit = "millimetres" if median / 1000.0 >= _LEAST_MEDIAN_M else "centimetres"
    return Text("it looks like {}", Text(unit))


def refuse_whole_seconds(time: Floats, what: str) -> None:
    """Refuse times that have lost their fractions of a second.

    Rounded times, and those stored as float32, join the frames of a second, or of two minutes.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds, ascending.
    what : str
        Their file, for the message.

    Raises
    ------
    InputError
        If all are whole seconds, each of more detections than a frame has.
    """
    frames = max(int(np.count_nonzero(np.diff(time, prepend=-1.0))), _LEAST_FRAMES)
    if len(time) > _MOST_ROWS * frames and not np.any(time % 1.0):
        raise InputError(
            "{}: all times are whole seconds: the fractions are lost",
            what,
            hint="write UNIX seconds as float64 (text: six decimals), not float32",
        )


def refuse_degrees(angles: Floats, field: str, name: str) -> None:
    """Refuse angles in radians that look like degrees, and azimuths in degrees like radians.

    Parameters
    ----------
    angles : (n,) array
        Angles of one frame or more, in the unit of `name`.
    field, name : str
        The file's field, and what it is read as: `azimuth` or `elevation` in radians, or
        `azimuth_deg`.

    Raises
    ------
    InputError
        If a tenth of them, and more than `_MOST_ODD`, are over a full turn, or over a right angle
        for elevations; if no azimuth in degrees is over a right angle in radians, 1.57.
    """
    known = np.abs(angles[np.isfinite(angles)])
    if name == "azimuth_deg":
        # radars look ahead
        if len(known) >= _LEAST_CHECKED and 0.0 < known.max() <= _TURN_RAD / 4.0:
            raise InputError(
                "{}: no value is over {:.3g}, expected degrees: it looks like radians",
                field,
                known.max(),
                hint=Text("state it: {} azimuth={}", "--columns", field),
            )
        return
    limit = _TURN_RAD if name == "azimuth" else _TURN_RAD / 4.0
    beyond = np.count_nonzero(known > limit)
    if beyond > max(_ODD_ANGLES * len(known), _MOST_ODD):
        raise InputError(
            "{}: {:.0%} of the values are over {:.3g}, expected radians: it looks like degrees",
            field,
            beyond / len(known),
            limit,
            hint=Text("state it: {} {}_deg={}", "--columns", name, field),
        )
