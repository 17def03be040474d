"""Mistakes of units or signs of a recording, found by its scale of range, and their correction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gis_radar.base import NoAnswerError, Text
from gis_radar.calibration.findings import UNKNOWN_CAUSE, Cause, Finding, wrong

# A scale is refused if it differs from 1 by more than SIGMAS standard errors and by _LEAST_OFF: a
# pose fitted to wrong ranges is wrong itself, by 1 m at 100 m, without another sign of it.
SIGMAS, _LEAST_OFF = 3.0, 0.01
# As _LEAST_OFF where a pose is given, which lanes check as well: good radars are right to 2 %.
LEAST_WRONG = 0.02
_LENGTH_OFF = 0.25  # scales closer to 1 are wrong lengths, others wrong units of range rates
_KNOWN_SHARE = 0.05  # largest standard error, as a share of the scale, to check range rates by it
_LEAST_YARDS = 1.075  # least scale that is taken for yards, a factor of 1.094
NOT_FITTED = Text("not fitted")  # entry of a pose's evidence for a scale with too little traffic
_FOOT_M, _YARD_M, _MILE_KM, _NAUTICAL_MILE_KM, _KMH = 0.3048, 0.9144, 1.609344, 1.852, 3.6
_TIMES_XYZ = "multiply x, y and z of all detections by {:g}"
_TIMES_RATE = "multiply range_rate by {:g}"
_TIMES_RATE_OR_TIME = "multiply range_rate by {:g}, or time if the clock is off"

FEET = Cause(Text("positions look like feet"), Text(_TIMES_XYZ, _FOOT_M))
YARDS = Cause(Text("positions look like yards"), Text(_TIMES_XYZ, _YARD_M))
SIGN = Cause(
    Text("range rates look positive where targets approach"), Text("change the sign of range_rate")
)
ABSOLUTE = Cause(
    Text("range rates look like absolute values"), Text("range_rate is positive when receding")
)
# Usual mistakes, and the exact change of range over the integral of range rate that each makes.
USUAL_MISTAKES = {
    FEET: 1.0 / _FOOT_M,
    YARDS: 1.0 / _YARD_M,
    Cause(Text("range rates look like km/h"), Text("divide range_rate by {:g}", _KMH)): 1.0 / _KMH,
    Cause(Text("range rates look like mph"), Text(_TIMES_RATE, _MILE_KM / _KMH)): _MILE_KM / _KMH,
    Cause(
        Text("range rates look like knots"), Text(_TIMES_RATE, round(_NAUTICAL_MILE_KM / _KMH, 6))
    ): _NAUTICAL_MILE_KM / _KMH,
    SIGN: -1.0,
    Cause(
        Text("range rates look halved, or times run half as fast"), Text(_TIMES_RATE_OR_TIME, 2.0)
    ): 2.0,
    Cause(
        Text("range rates look doubled, or times run twice as fast"), Text(_TIMES_RATE_OR_TIME, 0.5)
    ): 0.5,
}


@dataclass(frozen=True, kw_only=True)
class RangeScale:
    """Scale of range: change of range over the integral of range rate.

    Parameters
    ----------
    factor : float
        The scale: 1 where units and times are right, negative where range rates have the wrong
        sign.
    sigma : float
        Standard error of the factor.
    vehicles : int
        Number of vehicles from which it is measured.
    absolute : bool
        Whether range rates are absolute values.
    one_sign : bool
        Whether all range rates have one sign.
    """

    factor: float
    sigma: float
    vehicles: int
    absolute: bool = False
    one_sign: bool = False

    @property
    def off(self) -> bool:
        """Whether the factor differs from 1 by more than three standard errors and 1 %."""
        return self.differs(_LEAST_OFF)

    def differs(self, least: float) -> bool:
        """Return whether the factor differs from 1 by three standard errors and by `least`."""
        return self.absolute or abs(self.factor - 1.0) > max(SIGMAS * self.sigma, least)

    @property
    def known(self) -> bool:
        """Whether the factor is known well enough to check range rates."""
        return self.sigma <= _KNOWN_SHARE * abs(self.factor)

    @property
    def causes(self) -> tuple[Cause, ...]:
        """The usual mistakes whose factors agree with it, or what else would explain it."""
        if self.absolute:
            return (ABSOLUTE,)
        within = max(SIGMAS * self.sigma, _LEAST_OFF * abs(self.factor))
        agreeing = [each for each, by in USUAL_MISTAKES.items() if abs(self.factor - by) < within]
        if SIGN in agreeing and self.one_sign:  # if all approach, values without signs are the same
            agreeing.append(ABSOLUTE)
        # a scale between 2 % too long and yards may have other causes than yards
        if agreeing and not 1.0 + LEAST_WRONG < self.factor < _LEAST_YARDS:
            return tuple(agreeing)
        if abs(self.factor - 1.0) > _LENGTH_OFF:
            units = "x, y, z are metres, range_rate is m/s, positive when receding, time is seconds"
            return (Cause(UNKNOWN_CAUSE, Text(units)),)
        looks = Text("ranges are {:.1%} too long, or range rates too low", self.factor - 1.0)
        if self.factor < 1.0:
            looks = Text("ranges are {:.1%} too short, or range rates too high", 1.0 - self.factor)
        advice = "divide x, y and z of all detections by {0:.3f}, or multiply range_rate by it"
        return (Cause(looks, Text(advice, self.factor)),)

    @property
    def stated(self) -> Text:
        """The factor as evidence of a finding."""
        return Text(
            "ranges change {:.3f} \u00b1 {:.3f} times as fast as the range rates state",
            self.factor, self.sigma,
        )  # fmt: skip

    def require_one(self, name: str) -> None:
        """Refuse a scale that contradicts 1.

        Parameters
        ----------
        name : str
            Name of the recording.

        Raises
        ------
        NoAnswerError
            If :attr:`off`; with the factor, its standard error, and advice.
        """
        if self.off:
            found = wrong(self.stated, *self.causes)
            raise NoAnswerError(
                "{}: {} ({} vehicles): {}", name, self.stated, self.vehicles, found.cause,
                hint=found.advice,
            )  # fmt: skip

    def evidence(self) -> Mapping[str, float]:
        """Return the entry of the scale in a pose's evidence."""
        return {"factor": self.factor, "sigma": self.sigma, "vehicles": self.vehicles}

    def __repr__(self) -> str:
        lost = ", signs lost" if self.absolute else ""
        return f"RangeScale({self.factor:.3f} ± {self.sigma:.3f}, {self.vehicles} vehicles{lost})"


def odd_scale(scale: RangeScale | None) -> Finding | None:
    """Return the finding on a scale of range that is not 1; None where it is, or is not known.

    Parameters
    ----------
    scale : RangeScale or None
        The measured scale of range; None in too little traffic.
    """
    if scale is None or not scale.known or not scale.differs(LEAST_WRONG):
        return None
    return wrong(scale.stated, *scale.causes)
