"""Check whether ranges change as the range rates state, and which unit is wrong if not."""

from __future__ import annotations

from gis_radar.base import Text
from gis_radar.calibration.findings import UNKNOWN_CAUSE, Finding, wrong
from gis_radar.calibration.range_scale import RangeScale

# Least error of a wrong scale (good radars are right to 2 %), and least of its standard errors.
PACE, PACE_SIGMAS = 0.02, 3.0
LENGTHENED = 0.25  # farther off 1, the unit of the range rates is wrong, not a length
SURE_PACE = 0.05  # largest standard error, as a share of the scale, of a known scale
LEAST_YARDS = 1.075  # scales from here on look like yards, a factor of 1.094


def odd_pace(pace: RangeScale | None) -> Finding | None:
    """Return why ranges do not change as the range rates state; None where they do.

    Parameters
    ----------
    pace : RangeScale or None
        The measured scale of range; None in too little traffic.
    """
    if pace is None or not is_sure(pace):
        return None
    if pace.absolute:
        return wrong(_stated(pace), pace.likely, pace.advice)
    if abs(pace.factor - 1.0) <= max(PACE, PACE_SIGMAS * pace.sigma):
        return None
    lengths = [each for each in pace.mistakes if each.of_positions]
    if pace.mistakes and not lengths:
        return wrong(_stated(pace), pace.likely, pace.advice)
    if lengths or abs(pace.factor - 1.0) <= LENGTHENED:
        return lengthened(pace)
    return wrong(_stated(pace), UNKNOWN_CAUSE, Text("look at the units of the recording"))


def is_sure(pace: RangeScale | None) -> bool:
    """Return whether a scale of range is known; if not, range rates cannot be checked.

    Parameters
    ----------
    pace : RangeScale or None
        Of what moved.
    """
    return pace is not None and pace.sigma <= SURE_PACE * abs(pace.factor)


def _stated(pace: RangeScale) -> Text:
    return Text(
        "recorded ranges change {:.3f} ± {:.3f} times as fast as the recorded range rates state",
        pace.factor,
        pace.sigma,
    )


def lengthened(pace: RangeScale) -> Finding:
    """Return the finding that ranges are too long or too short by a measured scale.

    Parameters
    ----------
    pace : RangeScale
        Of what moved.
    """
    cause: str = Text("ranges are {:.1%} too long, or range rates too low", pace.factor - 1.0)
    if pace.factor < 1.0:
        cause = Text("ranges are {:.1%} too short, or range rates too high", 1.0 - pace.factor)
    # from a few percent up to yards, a scale is no certain sign of one unit
    if pace.mistakes and not 1.0 + PACE < pace.factor < LEAST_YARDS:
        return wrong(_stated(pace), pace.likely, pace.advice)
    advice = Text(
        "divide x, y and z of all detections by {0:.3f}, or multiply range_rate by it", pace.factor
    )
    return wrong(_stated(pace), cause, advice)
