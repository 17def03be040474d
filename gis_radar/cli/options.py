"""Options that several commands share, and values that are more than a number or a name.

The modules that parse them are imported when there is a value: `--help` needs no NumPy.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import click

from gis_radar import base
from gis_radar.base import InputError, Text, UsageError

Verb = TypeVar("Verb", bound=Callable[..., Any])


class _Place(click.Path):
    """A path of a file or a folder: what reads a pipe would wait for ever, of a device not end."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, or refuse it."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        is_there = os.path.exists(path)  # noqa: PTH110 - pathlib raises where a name is too long
        if is_there and not (path.is_file() or path.is_dir()):
            raise InputError("{}: is a pipe or a device, expected a file", path)
        return path


FILE = _Place(path_type=Path)


class Parsed(click.ParamType):  # type: ignore[type-arg]
    """A value that a function reads from a text.

    Parameters
    ----------
    name : str
        Form of the text, as shown in the help: `E,N`.
    parse : callable
        Returns the value; where it raises a ValueError or a UsageError, the usage is wrong.
    """

    def __init__(self, name: str, parse: Callable[[str], Any]) -> None:
        self.name, self._parse = name, parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value, or fail as wrong usage."""
        if not isinstance(value, str):
            return value  # converted already
        try:
            return self._parse(value)
        except UsageError as error:
            self.fail(error.message, param, ctx)
        except ValueError as error:
            self.fail(str(error), param, ctx)


def _numbers(names: str, text: str) -> tuple[float, ...]:
    """Return as many finite numbers as `names` has, from a text with commas."""
    count = names.count(",") + 1
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(Text("{} is not {}: {} numbers with commas", repr(text), names, count))
    return numbers


def _position(text: str) -> tuple[float, ...]:
    numbers = _numbers("E,N,H" if text.count(",") == 2 else "E,N", text)
    if base.looks_like_degrees(*numbers[:2]):
        raise ValueError(Text("{} looks like degrees: metres of the map are needed", repr(text)))
    return numbers


def _bearing(text: str) -> float:
    try:
        return base.bearing_of(text)
    except ValueError:
        expected = Text("neither degrees nor one of {}", ", ".join(base.WINDS))
        raise ValueError(Text("{} is {}", repr(text), expected)) from None


def _words(text: str) -> tuple[str, ...]:
    words = tuple(word.strip() for word in text.split(",") if word.strip())
    if not words:
        raise ValueError(Text("expected one or more words with commas between them"))
    return words


def _pairs(text: str) -> dict[str, str]:
    pairs = [part.partition("=") for part in text.split(",") if part.strip()]
    if not pairs or any(not (name.strip() and value.strip()) for name, _, value in pairs):
        raise ValueError(Text("{} is not {}", repr(text), PAIRS.name))
    return {name.strip(): value.strip() for name, _, value in pairs}


def _duration(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return base.duration_s(text)


def _cycles(text: str) -> dict[str, float]:
    """Return seconds from frame to frame by sensor, from `R3=57ms,R4=150ms`."""
    if text == "auto":
        raise ValueError(Text("'auto' is none: {}", base.CYCLE_HINT))
    cycles: dict[str, float] = {}
    for part in text.split(","):
        sensor, _, time = part.rpartition("=")
        try:
            cycles[sensor.strip()] = base.duration_s(time)
        except UsageError as error:
            raise ValueError(Text("{}: {}", repr(part), error.message)) from error
        if not sensor.strip():
            raise ValueError(Text("{} names no sensor, expected such as R3=57ms", repr(part)))
    return cycles


GIVEN_POSITION = Parsed("E,N[,H]", _position)  # easting and northing, with or without a height, m
BEARING = Parsed("BEARING", _bearing)  # degrees clockwise from true north, or a word for them
WORDS = Parsed("a,b,...", _words)
PAIRS = Parsed("a=A,b=B,...", _pairs)  # values by name
DURATION = Parsed("DURATION", _duration)  # seconds; a bare number is seconds, too
_CYCLES = Parsed("SENSOR=TIME,...", _cycles)  # seconds from frame to frame, by sensor


def numbers(names: str) -> Parsed:
    """Return the type of numbers with commas between them, such as `677885.9,5403673`."""
    return Parsed(names, partial(_numbers, names))


def template(
    make: Callable[[], str], text: str, *, name: str = "--template"
) -> Callable[[Verb], Verb]:
    """Return a decorator that adds `--template`, which prints a file to fill in, and its help."""

    def show(context: click.Context, _option: click.Parameter, wanted: object) -> None:
        if wanted:
            click.echo(make(), nl=False)
            context.exit()

    return click.option(
        name, is_flag=True, is_eager=True, expose_value=False, callback=show, help=text
    )


def language(text: str, default: str | None = "en") -> Callable[[Verb], Verb]:
    """Return a decorator that adds `--language`, with its help."""
    choice = click.Choice(["en", "de"])
    return click.option("--language", type=choice, default=default, show_default=True, help=text)


def in_order(*options: Callable[[Verb], Verb]) -> Callable[[Verb], Verb]:
    """Return a decorator that adds several options, in the order of the help."""

    def add(verb: Verb) -> Verb:
        for option in reversed(options):
            verb = option(verb)
        return verb

    return add


output = click.option("-o", "--output", type=FILE, required=True, help="Where the result goes.")
folder_output = click.option(
    "-o", "--output", metavar="DIR", type=FILE, required=True, help="Folder for the results."
)
origin = click.option(
    "--origin", type=numbers("E,N"), help="Map-frame position of the map's local (0, 0)."
)
scan_crs = click.option("--scan-crs", help="CRS of scans that do not state theirs: EPSG:2154.")
sight_scans = click.option(
    "--scan", "scans", metavar="SCAN.laz", type=FILE, multiple=True,
    help="What stands in it hides tiles (LAS, LAZ, COPC); whole, not masked; repeatable.",
)  # fmt: skip
view = in_order(
    click.option(
        "--max-range", "max_range_m", type=float, help="Range of sensors whose pose has no view, m."
    ),
    click.option("--azimuth", "azimuth_deg", type=float, help="Their full azimuth, deg."),
    click.option("--elevation", "elevation_deg", type=float, help="Their full elevation, deg."),
)
frame_times = in_order(
    click.option(
        "--cycle", "cycles", type=_CYCLES,
        help="Time from frame to frame of sensors slower than 10 Hz: a frame is valid 1.5 times as "
        "long.",
    ),
    click.option(
        "--clocks", type=FILE,
        help="Correct the sensors' clocks by a file from gis-radar clocks.",
    ),
)  # fmt: skip
accept = click.option(
    "--accept", metavar="SENSOR", multiple=True,
    help="Go on though its pose and recordings do not fit; every product says so; repeatable.",
)  # fmt: skip
lanes = click.option(
    "--map", "map_path", metavar="MAP.osm", type=FILE, required=True, help="The lanes."
)
road = click.option("--road", type=FILE, required=True, help="The scanned road (LAZ).")
tile_file = click.option(
    "--tiles", "tiles_path", type=FILE, required=True, help="From gis-radar tiles."
)
recordings = click.argument(
    "recordings", metavar="RECORDING...", type=FILE, nargs=-1, required=True
)
poses = click.option(
    "--pose",
    "poses",
    type=FILE,
    multiple=True,
    required=True,
    help="Pose of each recording, in their order (JSON or pose track).",
)
begin_end = in_order(
    click.option("--begin", help="Only from this time on: '2025-06-12 07:30'."),
    click.option("--end", help="Only before this time."),
)
dataset = click.argument("folder", metavar="DATASET", type=FILE)

csv_locale = click.option(
    "--csv-locale", type=click.Choice(["en", "de"]), default="en", show_default=True,
    help="de: tables with semicolons and decimal commas, as Excel in Germany opens them.",
)  # fmt: skip
