"""Values of options that are more than a number or a name."""

from __future__ import annotations

import math
from typing import Any

import click


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
        kind = Numbers("E,N,H" if str(value).count(",") == 2 else "E,N")
        numbers = kind.convert(value, param, ctx)
        if abs(numbers[0]) <= 180.0 and abs(numbers[1]) <= 90.0:
            self.fail(f"{value!r} looks like degrees: metres of the map are needed", param, ctx)
        return numbers


class Bearing(click.ParamType):  # type: ignore[type-arg]
    """A bearing clockwise from true north: degrees, or a word such as `north-east`."""

    name = "BEARING"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return degrees, or fail as wrong usage."""
        words = ("north", "north-east", "east", "south-east",
                 "south", "south-west", "west", "north-west")  # fmt: skip
        text = str(value).strip().lower()
        if text in words:
            return 45.0 * words.index(text)
        try:
            bearing = float(text)
        except ValueError:
            bearing = math.nan
        if not math.isfinite(bearing):
            self.fail(f"{value!r} is neither degrees nor one of {', '.join(words)}", param, ctx)
        return bearing


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
