"""Findings of the check of poses and recordings, their texts, and the error that refuses them."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from gis_radar.base import NoAnswerError, Reporter, Text


class Cause(NamedTuple):
    """What is probably wrong, and what to do about it."""

    text: str
    advice: str


FITS, _FITS_BUT, WRONG = Text("fits"), Text("fits, but"), Text("does not fit")
UNKNOWN = Text("too little traffic to tell")
UNKNOWN_CAUSE = Text("cause unknown")
RECORD_MORE = Text("record more traffic")
NOT_ONE_PLACE = Cause(
    UNKNOWN_CAUSE,
    Text(
        "check that map, pose and recording are of one place and the recording is of one sensor, "
        "and find the pose with gis-radar localize"
    ),
)
CLOCKS_APART = "its clock and that of {} are apart"
HEADS = (Text("sensor"), Text("verdict"), Text("evidence"), Text("what to do"))
_RECORD = ("verdict", "evidence", "cause", "advice")  # fields that every stored finding has
_SPAN = ("since", "until")  # fields that a stored finding may have
_SIDES = (  # counter-clockwise from east, each of 45 degrees
    Text("east"), Text("north-east"), Text("north"), Text("north-west"), Text("west"),
    Text("south-west"), Text("south"), Text("south-east"),
)  # fmt: skip
_CLOCKWISE, _ANTICLOCKWISE = Text("clockwise"), Text("anticlockwise")


class HealthState:
    """States of a sensor in a city's month and in the live system's alerts, worst first."""

    NO_DATA = Text("no data")
    SILENT = Text("silent")
    MOVED = Text("moved")
    DOUBTFUL = Text("pose doubtful")
    CLOCK_OFF = Text("clock off")
    GAPS = Text("gaps")
    NOT_CONFIRMED = Text("pose not confirmed")
    WORKS = Text("works")


SENSOR_STATES = tuple(each for each in vars(HealthState).values() if isinstance(each, Text))


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Finding of the check about one sensor.

    Parameters
    ----------
    sensor : str
        Its name.
    verdict : str
        `FITS`, `WRONG` or `UNKNOWN`.
    evidence : str
        The numbers behind the verdict.
    cause, advice : str
        What is probably wrong and what to do; empty where nothing is.
    since, until : str
        First and last frame of the recordings on which it rests, ISO 8601; empty where not stated.
    moment : str
        From when on the cause acts, by the sensor's clock, ISO 8601; empty where it acts from the
        begin, or all the time.
    """

    sensor: str
    verdict: str
    evidence: str
    cause: str = ""
    advice: str = ""
    since: str = ""
    until: str = ""
    moment: str = ""

    @property
    def record(self) -> dict[str, str]:
        """All fields but the sensor's name, as a dataset stores them."""
        span = {name: value for name in _SPAN if (value := getattr(self, name))}
        return {name: getattr(self, name) for name in _RECORD} | span

    def joined(self, other: Finding) -> Finding:
        """Merge the findings on one sensor's recordings of two times, in either order.

        The one of higher severity is returned. Of two with equal severity it is the later one,
        with `since` of the earlier.
        """
        worse = max(self, other, key=lambda each: (each.severity, each.until, each.evidence))
        equal = self.severity == other.severity
        return replace(worse, since=min(self.since, other.since)) if equal else worse

    @property
    def severity(self) -> int:
        """Rank of the finding: 0 fits, 1 too little traffic, 2 fits but may be off, 3 refused."""
        if self.verdict == FITS:
            return 2 if self.cause else 0
        return 3 if self.refused else 1

    @property
    def row(self) -> list[str]:
        """The finding as a row of a table under `HEADS`."""
        return [self.sensor, self.shown_verdict, self.reason, self.advice]

    @property
    def shown_verdict(self) -> Text:
        """The verdict as a table shows it: `_FITS_BUT` for a sensor that fits with a cause."""
        return _FITS_BUT if self.verdict == FITS and self.cause else Text(self.verdict)

    @property
    def refused(self) -> bool:
        """Whether the sensor is refused unless the user accepts it."""
        return self.verdict == WRONG

    @property
    def is_of_clocks(self) -> bool:
        """Whether the cause is a clock that contradicts another sensor's."""
        return concerns_clocks(self.cause)

    @property
    def doubt(self) -> str:
        """The warning that results carry if the run goes on; empty where all fits."""
        if self.refused:
            return Text("{}; it is accepted anyway", self.line)
        return self.line if self.verdict != FITS or self.cause else ""

    @property
    def refusal(self) -> ImplausibleError:
        """The finding as an error, with what to do."""
        go_on = Text("{} {}", "--accept", self.sensor)
        hint = Text("{}; or go on anyway: {}", self.advice, go_on)
        return ImplausibleError("{}", self.line, hint=hint, findings=(self,))

    @property
    def reason(self) -> str:
        """The cause with its evidence, or the evidence alone."""
        return Text("{} ({})", self.cause, self.evidence) if self.cause else self.evidence

    @property
    def text(self) -> Text:
        """The finding, without the sensor's name."""
        between = "{} {}" if self.shown_verdict == _FITS_BUT else "{}: {}"
        return Text(between, self.shown_verdict, self.reason)

    @property
    def text_with_advice(self) -> Text:
        """The finding with what to do, without the sensor's name."""
        return Text("{} ({})", self.text, self.advice) if self.advice else self.text

    @property
    def line(self) -> Text:
        """The finding in a line."""
        return Text("{}: {}", self.sensor, self.text)


def concerns_clocks(text: object) -> bool:
    """Return whether words of a finding name a clock that contradicts another sensor's."""
    return isinstance(text, Text) and (
        text.template == CLOCKS_APART or any(map(concerns_clocks, text.values))
    )


def is_record(value: object) -> bool:
    """Return whether a value is a finding as a dataset stores it: a :attr:`Finding.record`."""
    return (
        isinstance(value, dict)
        and {*_RECORD} <= value.keys() <= {*_RECORD, *_SPAN}
        and all(isinstance(each, str) for each in value.values())
    )


def judged(verdict: str, evidence: str, *causes: Cause) -> Finding:
    """Return the finding of equally likely causes; the caller adds the sensor's name.

    Parameters
    ----------
    verdict : str
        `FITS`, `WRONG` or `UNKNOWN`.
    evidence : str
        The numbers behind it.
    *causes : Cause
        What is probably wrong, likeliest first; several are joined: "a or b", "a: do; b: do".
    """
    cause = Text(" or ").join(each.text for each in causes)
    advices = [each.advice if len(causes) == 1 else Text("{}: {}", *each) for each in causes]
    return Finding(
        sensor="", verdict=verdict, evidence=evidence, cause=cause,
        advice=Text("; ").join(advices),
    )  # fmt: skip


def wrong(evidence: str, *causes: Cause) -> Finding:
    """Return the finding that a sensor does not fit, for one of some causes."""
    return judged(WRONG, evidence, *causes)


def side(east: float, north: float) -> Text:
    """Return the compass direction of an offset in the plane, the nearest of eight.

    Parameters
    ----------
    east, north : float
        The offset, in any unit.

    Examples
    --------
    >>> side(-2.0, 1.9)
    'north-west'
    """
    return _SIDES[round(math.degrees(math.atan2(north, east)) / 45.0) % 8]


def sense(turn: float) -> Text:
    """Return the direction of a rotation: of yaw seen from above, of roll seen from the front.

    Parameters
    ----------
    turn : float
        Angle of the rotation; positive is anticlockwise.
    """
    return _CLOCKWISE if turn < 0.0 else _ANTICLOCKWISE


class ImplausibleError(NoAnswerError):
    """Error of sensors whose poses and recordings do not fit each other or the map.

    Parameters
    ----------
    template, *values, hint
        As for every error.
    findings : tuple of Finding
        The findings about these sensors.
    """

    def __init__(  # callable with the message alone: that is how errors are unpickled
        self, template: str, /, *values: Any, hint: str = "", findings: tuple[Finding, ...] = ()
    ) -> None:
        parts = [each.refusal for each in findings] if len(findings) > 1 else []
        super().__init__(template, *values, hint=hint, parts=parts)
        self.findings = findings


def refuse_implausible(
    findings: Sequence[Finding], accepted: Collection[str], reporter: Reporter
) -> None:
    """Refuse sensors that do not fit; warn of those that are accepted, or have too little traffic.

    Parameters
    ----------
    findings : sequence of Finding
        As from :func:`check_plausibility`.
    accepted : collection of str
        Names of sensors that are used although they do not fit.
    reporter : Reporter
        Receives the warnings.

    Raises
    ------
    ImplausibleError
        Naming all sensors that do not fit.
    """
    refused = tuple(each for each in findings if each.refused and each.sensor not in accepted)
    if len(refused) == 1:
        raise refused[0].refusal
    if refused:
        accept = Text(", ").join(Text("{} {}", "--accept", each.sensor) for each in refused)
        advice = Text("; ").join(Text("{}: {}", each.sensor, each.advice) for each in refused)
        raise ImplausibleError(
            "{}",
            Text("; ").join(each.line for each in refused),
            hint=Text("{}; or go on anyway: {}", advice, accept),
            findings=refused,
        )
    for each in findings:
        if each.doubt:
            reporter.warn("{}", each.doubt)
