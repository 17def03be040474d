"""Mistakes of units or signs of a recording, told by its scale of range, and their correction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gis_radar.base import NoAnswerError, Text
from gis_radar.calibration.findings import UNKNOWN_CAUSE, Finding, join_mistakes, wrong

# A scale is refused if it differs from 1 by more than SIGMAS standard errors and by LEAST_OFF: a
# pose fitted to wrong ranges is wrong itself, by 1 m at 100 m, without another sign of it.
SIGMAS, LEAST_OFF = 3.0, 0.01
# As LEAST_OFF where a pose is given, which lanes check as well: good radars are right to 2 %.
LEAST_WRONG = 0.02
LENGTH_OFF = 0.25  # scales closer to 1 are wrong lengths, others wrong units of range rates
KNOWN_SHARE = 0.05  # largest standard error, as a share of the scale, to check range rates by it
LEAST_YARDS = 1.075  # least scale that is taken for yards, a factor of 1.094
NOT_FITTED = Text("not fitted")  # entry of a pose's evidence for a scale with too little traffic
FOOT_M, YARD_M, MILE_KM, NAUTICAL_MILE_KM, KMH = 0.3048, 0.9144, 1.609344, 1.852, 3.6


@dataclass(frozen=True, kw_only=True)
class UnitMistake:
    """Usual mistake of units or signs, with its exact factor.

    Parameters
    ----------
    looks : str
        Description of a recording with this mistake.
    advice : str
        How to correct it.
    factor : float
        Change of range over the integral of range rate, as this mistake makes it.
    of_positions : bool
        Whether x, y and z are wrong; else the range rates or the times are.
    """

    looks: str
    advice: str
    factor: float
    of_positions: bool = False


FEET = UnitMistake(
    looks=Text("positions look like feet"), of_positions=True, factor=1.0 / FOOT_M,
    advice=Text("multiply x, y and z of all detections by {:g}", FOOT_M),
)  # fmt: skip
YARDS = UnitMistake(
    looks=Text("positions look like yards"), of_positions=True, factor=1.0 / YARD_M,
    advice=Text("multiply x, y and z of all detections by {:g}", YARD_M),
)  # fmt: skip
ABSOLUTE = UnitMistake(
    looks=Text("range rates look like absolute values"), factor=1.0,
    advice=Text("range_rate is positive when receding"),
)  # fmt: skip
SIGN = UnitMistake(
    looks=Text("range rates look positive where targets approach"), factor=-1.0,
    advice=Text("change the sign of range_rate"),
)  # fmt: skip
USUAL_MISTAKES = (
    FEET,
    YARDS,
    UnitMistake(
        looks=Text("range rates look like km/h"), factor=1.0 / KMH,
        advice=Text("divide range_rate by {:g}", KMH),
    ),
    UnitMistake(
        looks=Text("range rates look like mph"), factor=MILE_KM / KMH,
        advice=Text("multiply range_rate by {:g}", MILE_KM / KMH),
    ),
    UnitMistake(
        looks=Text("range rates look like knots"), factor=NAUTICAL_MILE_KM / KMH,
        advice=Text("multiply range_rate by {:g}", round(NAUTICAL_MILE_KM / KMH, 6)),
    ),
    SIGN,
    UnitMistake(
        looks=Text("range rates look halved, or times run half as fast"), factor=2.0,
        advice=Text("multiply range_rate by {:g}, or time if the clock is off", 2.0),
    ),
    UnitMistake(
        looks=Text("range rates look doubled, or times run twice as fast"), factor=0.5,
        advice=Text("multiply range_rate by {:g}, or time if the clock is off", 0.5),
    ),
)  # fmt: skip


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
    """

    factor: float
    sigma: float
    vehicles: int
    absolute: bool = False

    @property
    def off(self) -> bool:
        """Whether the factor differs from 1 by more than three standard errors and 1 %."""
        return self.absolute or abs(self.factor - 1.0) > max(SIGMAS * self.sigma, LEAST_OFF)

    @property
    def known(self) -> bool:
        """Whether the factor is known well enough to check range rates."""
        return self.sigma <= KNOWN_SHARE * abs(self.factor)

    @property
    def mistakes(self) -> tuple[UnitMistake, ...]:
        """The usual mistakes whose factors agree with it."""
        if self.absolute:
            return (ABSOLUTE,)
        within = max(SIGMAS * self.sigma, LEAST_OFF * abs(self.factor))
        return tuple(each for each in USUAL_MISTAKES if abs(self.factor - each.factor) < within)

    @property
    def likely(self) -> str:
        """Description of the mistakes that agree with it; empty where none does."""
        return Text(" or ").join(each.looks for each in self.mistakes)

    @property
    def advice(self) -> str:
        """How to correct each of the mistakes that agree with it; empty where none does."""
        return join_mistakes((each.looks, each.advice) for each in self.mistakes)[1]

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
        if not self.off:
            return
        stated = Text(
            "{}: ranges change {:.3f} \u00b1 {:.3f} times as fast as the range rates state "
            "({} vehicles)",
            name, self.factor, self.sigma, self.vehicles,
        )  # fmt: skip
        raise NoAnswerError(
            "{}",
            Text(": ").join([stated, self.likely] if self.likely else [stated]),
            hint=self.advice
            or "x, y, z are metres, range_rate is m/s, positive when receding, time is seconds",
        )

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
    if scale is None or not scale.known:
        return None
    if scale.absolute:
        return wrong(_scale_evidence(scale), scale.likely, scale.advice)
    if abs(scale.factor - 1.0) <= max(LEAST_WRONG, SIGMAS * scale.sigma):
        return None
    lengths = [each for each in scale.mistakes if each.of_positions]
    if scale.mistakes and not lengths:
        return wrong(_scale_evidence(scale), scale.likely, scale.advice)
    if lengths or abs(scale.factor - 1.0) <= LENGTH_OFF:
        return wrong_lengths(scale)
    return wrong(_scale_evidence(scale), UNKNOWN_CAUSE, Text("look at the units of the recording"))


def _scale_evidence(scale: RangeScale) -> Text:
    return Text(
        "recorded ranges change {:.3f} ± {:.3f} times as fast as the recorded range rates state",
        scale.factor,
        scale.sigma,
    )


def wrong_lengths(scale: RangeScale) -> Finding:
    """Return the finding that ranges are too long or too short by a scale.

    Parameters
    ----------
    scale : RangeScale
        The scale of range, measured or fitted.
    """
    cause: str = Text("ranges are {:.1%} too long, or range rates too low", scale.factor - 1.0)
    if scale.factor < 1.0:
        cause = Text("ranges are {:.1%} too short, or range rates too high", 1.0 - scale.factor)
    # a scale between 2 % too long and yards may have other causes than yards
    if scale.mistakes and not 1.0 + LEAST_WRONG < scale.factor < LEAST_YARDS:
        return wrong(_scale_evidence(scale), scale.likely, scale.advice)
    advice = Text(
        "divide x, y and z of all detections by {0:.3f}, or multiply range_rate by it", scale.factor
    )
    return wrong(_scale_evidence(scale), cause, advice)
