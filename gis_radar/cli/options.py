"""Options that several commands share, and values that are more than a number or a name.

The modules that parse them are imported when there is a value: `--help` needs no NumPy.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import click

from gis_radar.errors import UsageError

FILE = click.Path(path_type=Path)

output = click.option("-o", "--output", type=FILE, required=True, help="Where the result goes.")


class Numbers(click.ParamType):  # type: ignore[type-arg]
    """Two or three numbers with commas between them, such as `677885.9,5403673`.

    Parameters
    ----------
    names : str
        What they are, as shown in the help: `E,N`.
    """

    def __init__(self, names: str) -> None:
        self.name = names
        self._count = names.count(",") + 1

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Return the numbers, or fail as wrong usage."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count or not all(map(math.isfinite, numbers)):
            self.fail(
                f"{value!r} is not {self.name}: {self._count} numbers with commas", param, ctx
            )
        return numbers


class Position(Numbers):
    """Easting and northing, and a height if one likes, of a projected system."""

    def __init__(self) -> None:
        super().__init__("E,N[,H]")

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Return two or three numbers, or fail as wrong usage; degrees are refused."""
        from gis_radar.crs import looks_like_degrees  # noqa: PLC0415 - NumPy

        kind = Numbers("E,N,H" if str(value).count(",") == 2 else "E,N")
        numbers = kind.convert(value, param, ctx)
        if looks_like_degrees(*numbers[:2]):
            self.fail(f"{value!r} looks like degrees: metres of the map are needed", param, ctx)
        return numbers


class Bearing(click.ParamType):  # type: ignore[type-arg]
    """A bearing clockwise from true north: degrees, or a word such as `north-east`."""

    name = "BEARING"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return degrees, or fail as wrong usage."""
        from gis_radar.crs import WINDS, bearing_of  # noqa: PLC0415 - NumPy

        try:
            return bearing_of(value)
        except ValueError:
            self.fail(f"{value!r} is neither degrees nor one of {', '.join(WINDS)}", param, ctx)


class Words(click.ParamType):  # type: ignore[type-arg]
    """Words with commas between them, such as `road,highway`."""

    name = "a,b,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """Return the words, or fail as wrong usage."""
        if isinstance(value, tuple):
            return value
        words = tuple(word.strip() for word in str(value).split(",") if word.strip())
        if not words:
            self.fail("expected one or more words with commas between them", param, ctx)
        return words


class Pairs(click.ParamType):  # type: ignore[type-arg]
    """Names and what they stand for, such as `x=X,range_rate=-doppler`."""

    name = "a=A,b=B,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> dict[str, str]:
        """Return the pairs, or fail as wrong usage."""
        if isinstance(value, dict):
            return value
        pairs = [part.partition("=") for part in str(value).split(",") if part.strip()]
        if not pairs or any(not (name.strip() and stands.strip()) for name, _, stands in pairs):
            self.fail(f"{value!r} is not {self.name}", param, ctx)
        return {name.strip(): stands.strip() for name, _, stands in pairs}


class Duration(click.ParamType):  # type: ignore[type-arg]
    """A time span such as `30s` or `10min`; a bare number is seconds."""

    name = "DURATION"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return seconds, or fail as wrong usage."""
        from gis_radar.steps import duration_s  # noqa: PLC0415 - NumPy

        try:
            return float(value)
        except ValueError:
            pass
        try:
            return duration_s(str(value))
        except UsageError as error:
            self.fail(error.message, param, ctx)


class Cycles(click.ParamType):  # type: ignore[type-arg]
    """Times from frame to frame by sensor, such as `R3=57ms,R4=100ms`, or `auto`."""

    name = "auto|SENSOR=TIME,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Literal["auto"] | dict[str, float]:
        """Return seconds by sensor or `auto`, or fail as wrong usage."""
        from gis_radar.steps import duration_s  # noqa: PLC0415 - NumPy

        if value == "auto":
            return "auto"
        if isinstance(value, dict):
            return dict(value)
        cycles: dict[str, float] = {}
        for part in str(value).split(","):
            sensor, _, time = part.rpartition("=")
            try:
                cycles[sensor.strip()] = duration_s(time)
            except UsageError as error:
                self.fail(f"{part!r}: {error.message}", param, ctx)
            if not sensor.strip():
                self.fail(f"{part!r} names no sensor, expected such as R3=57ms", param, ctx)
        return cycles
