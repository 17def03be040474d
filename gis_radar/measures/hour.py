"""The window of an hour: its steps, and the steps around it that its tables depend on, too."""

from __future__ import annotations

from dataclasses import dataclass

from gis_radar.base import STEP_US, STEPS_PER_HOUR, STEPS_PER_SECOND

HOUR_MARGIN_STEPS = 120 * STEPS_PER_SECOND
"""Steps on either side of an hour that its vehicles are found from (the contract: two minutes)."""
LONGEST_VALID_STEPS = 64
"""Upper bound of validity in steps: 1.5 x the slowest cycle are 3 s, 60 steps."""


@dataclass(frozen=True, kw_only=True)
class HourWindow:
    """An hour with its margins, in steps.

    Parameters
    ----------
    hour : int
        Hours since 1970, UTC.
    margin : int
        Steps before and after the hour that are read, too.
    """

    hour: int
    margin: int = HOUR_MARGIN_STEPS

    @property
    def begin(self) -> int:
        """First step of the hour."""
        return self.hour * STEPS_PER_HOUR

    @property
    def end(self) -> int:
        """Step after the last one of the hour."""
        return self.begin + STEPS_PER_HOUR

    @property
    def span(self) -> tuple[int, int]:
        """First step of the window, and the step after its last."""
        return self.begin - self.margin, self.end + self.margin

    @property
    def span_us(self) -> tuple[int, int]:
        """The span in microseconds since 1970."""
        first, after = self.span
        return first * STEP_US, after * STEP_US
