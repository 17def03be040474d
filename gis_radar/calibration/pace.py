"""Pace: whether ranges change as the range rates state, and which unit is wrong where not."""

from __future__ import annotations

from gis_radar.base import Text
from gis_radar.calibration.findings import UNKNOWN_CAUSE, Finding, wrong
from gis_radar.calibration.range_scale import RangeScale

# As far off 1 (the clocks and speeds of good radars are right to 2 %), and standard errors.
PACE, PACE_SIGMAS = 0.02, 3.0
LENGTHENED = 0.25  # farther off 1 it is another unit of the range rates, no length that is mistaken
SURE_PACE = 0.05  # the largest standard error (share) of what is no motion at random
LEAST_YARDS = 1.075  # from there on ranges that are longer look like yards, a factor of 1.094


def odd_pace(pace: RangeScale | None) -> Finding | None:
    """Return why ranges do not change as the range rates state; None where they do.

    Parameters
    ----------
    pace : RangeScale or None
        Of what moved; None in too little traffic.
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
    """Return whether a scale of range is known: without, nothing is known of the range rates.

    Parameters
    ----------
    pace : RangeScale or None
        Of what moved.
    """
    return pace is not None and pace.sigma <= SURE_PACE * abs(pace.factor)


def _stated(pace: RangeScale) -> Text:
    return Text(
        "ranges change {:.3f} ± {:.3f} times as fast as the range rates state",
        pace.factor,
        pace.sigma,
    )


def lengthened(pace: RangeScale) -> Finding:
    """Return that ranges are too long or too short by a scale that is measured.

    Parameters
    ----------
    pace : RangeScale
        Of what moved.
    """
    cause: str = Text("ranges are {:.1%} too long, or range rates too low", pace.factor - 1.0)
    if pace.factor < 1.0:
        cause = Text("ranges are {:.1%} too short, or range rates too high", 1.0 - pace.factor)
    # an error may reach from a few percent to yards
    if pace.mistakes and not 1.0 + PACE < pace.factor < LEAST_YARDS:
        return wrong(_stated(pace), pace.likely, pace.advice)
    advice = Text("divide x, y and z by {0:.3f}, or multiply range_rate by it", pace.factor)
    return wrong(_stated(pace), cause, advice)
