"""Content of a report before it becomes a page: tables, pictures, numbers and times in words."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from numbers import Number
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

HOW_FOUND = {"lane": "found from traffic on the lanes", "icp": "found by ICP"}


class ReportWords(NamedTuple):
    """How a report calls what its map shows: time it is a share of, of a lane, of a tile."""

    base: str
    part: str
    touched: str
    share: str
    intro: str


WORDS = {
    "occupancy": ReportWords(
        "observed", "occupied", "hit", "Occupancy",
        "The map shows in which share of the observed time radar hit each half metre of lane. "
        "Compare one place over time; the figures count neither vehicles nor queues",
    ),
    "coverage": ReportWords(
        "visible", "covered", "covered", "Coverage",
        "The map shows coverage: for each half metre of lane the estimated share of time in which "
        "a vehicle was on it, moving or waiting. 20 % means 12 seconds of every minute. It is an "
        "estimate: radar follows the vehicles, also for moments while others hide them; "
        "± is its standard error. Hatched in colour is uncertain; hatched in grey is road that no "
        "radar saw, which is not 0 %",
    ),
}  # fmt: skip


class Column(NamedTuple):
    """A column of a table.

    Parameters
    ----------
    title, unit : str
        What stands over it, the unit small.
    width : float
        Its share of the page, beside the others'.
    text : callable
        Returns its cell of what a row is made of.
    is_number : bool
        Numbers stand right.
    """

    title: str
    unit: str
    width: float
    text: Callable[[Any], str]
    is_number: bool = True


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table as it is read: all cells are text, the first of a row names it.

    Parameters
    ----------
    name : str
        One word, for its layout.
    caption : str
        What it holds.
    columns : sequence of Column
        From left to right.
    rows : sequence of sequence of str
        From top to bottom.
    note : str
        What to know, below it.
    """

    name: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    note: str = ""


def text_rows(items: Iterable[Any], columns: Sequence[Column]) -> list[list[str]]:
    """Return a row of cells for each item."""
    return [[column.text(item) for column in columns] for item in items]


class Terms(NamedTuple):
    """Words and what they mean, as pairs in the order in which they are read."""

    terms: Sequence[tuple[str, str]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Figure:
    """A picture.

    Parameters
    ----------
    png : bytes
        The picture.
    width, height : int
        Pixels.
    title : str
        For a map, its time.
    caption : str
        Below it.
    alt : str
        What it shows, for who cannot see it.
    tallest_mm : float
        How high it may be on paper.
    """

    png: bytes
    width: int
    height: int
    title: str = ""
    caption: str
    alt: str
    tallest_mm: float = 165.0


@dataclass(frozen=True, kw_only=True, eq=False)
class MapSeries:
    """The map, over the whole time and by interval.

    Parameters
    ----------
    whole : Figure
        The whole time.
    frames : sequence of Figure
        The intervals, as large as `whole`; none where the heat map has but one.
    overlay : bytes
        PNG with scale, north and sensors, to go over each of them.
    caption : str
        Below the map.
    note : str
        That not all intervals are shown singly, where it is so.
    """

    whole: Figure
    frames: Sequence[Figure]
    overlay: bytes
    caption: str
    note: str


class Chapter(NamedTuple):
    """A chapter after the map.

    Parameters
    ----------
    name, title : str
        One word for links, and the heading.
    parts : sequence of Table, Figure or Terms
        From top to bottom.
    least_mm : float
        What must be left of a page of paper for it to begin there.
    """

    name: str
    title: str
    parts: Sequence[Table | Figure | Terms]
    least_mm: float = 45.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Content:
    """All of a report.

    Parameters
    ----------
    title, subtitle : str
        What it is about, and when.
    zone : str
        In which time zone all times are.
    until : datetime
        End of the data.
    intro : str
        How to read the map.
    facts : sequence of (name, value)
        The figures worth a look.
    remarks : sequence of str
        What to know before reading on, in sentences.
    map : MapSeries
        The map.
    chapters : sequence of Chapter
        What follows.
    made_by : str
        The software.
    measure : str
        What the map shows: `coverage` or `occupancy`.
    """

    title: str
    subtitle: str
    zone: str
    until: datetime
    intro: str
    facts: Sequence[tuple[str, str]]
    remarks: Sequence[str]
    map: MapSeries
    chapters: Sequence[Chapter]
    made_by: str
    measure: str = "occupancy"


NOTHING, MINUS = "\u2013", "\u2212"  # a dash; a minus as wide as a plus
THIN = "\u202f"  # narrow, and no line ends there
_WINDS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


def figure_text(value: float, digits: int = 0) -> str:
    """Return a number with thousands set apart; a dash where there is none."""
    if not math.isfinite(value):
        return NOTHING
    text = f"{value:,.{digits}f}".replace(",", THIN)
    return text.replace("-", MINUS) if float(f"{value:.{digits}f}") else text.replace("-", "")


def percent(share: float, digits: int = 1, *, off: float = math.nan) -> str:
    """Return a share as percent, with its standard error where there is one.

    What is more than nothing never reads as nothing.
    """
    if math.isfinite(share) and math.isfinite(off):
        value, error = (figure_text(100 * each, digits) for each in (share, off))
        return f"{value}{THIN}±{THIN}{error}{THIN}%"
    if math.isfinite(share) and 0.0 < share * 100 < 0.5 * 10.0**-digits:
        return f"under {10.0**-digits:g}{THIN}%"
    return f"{figure_text(share * 100, digits)}{THIN}%" if math.isfinite(share) else NOTHING


def plus_minus(value: float, digits: int, unit: str = "") -> str:
    """Return one standard deviation; a dash where it is not known."""
    return f"± {figure_text(value, digits)}{unit}" if math.isfinite(value) else NOTHING


def tie_words(tie: Any) -> str:
    """Return to which sensors a pose is tied, and how certain it was before, from its evidence."""
    try:
        before = [float(tie["gained"][name]["before"]) for name in ("easting", "northing")]
        others, shared = listed([str(each) for each in tie["sensors"]]), int(tie["pairs"])
    except (KeyError, TypeError, ValueError):
        return ""
    alone = plus_minus(math.hypot(*before), 2, " m")
    return f"tied by {count(shared, 'vehicle')} to {others}, alone {alone}"


def how_found(evidence: Mapping[str, Any]) -> str:
    """Return how a pose was found, and on what evidence, in words."""
    words = [HOW_FOUND.get(str(evidence.get("method")), "given, not found by gis_radar")]
    fitness = evidence.get("fitness")
    if isinstance(fitness, int | float) and not isinstance(fitness, bool):
        words.append(f"{percent(float(fitness), 0)} of the traces fit")
    if evidence.get("observable") is False:
        words.append("the scene does not fix all of it")
    if isinstance(look := evidence.get("second_look"), dict) and look.get("verdict"):
        words.append(f"second look {look['verdict']}")
    if tie := tie_words(evidence.get("together")):
        words.append(tie)
    return "; ".join(words)


def count(amount: int, noun: str) -> str:
    """Return an amount with its noun."""
    return f"{figure_text(amount)} {noun}{'' if amount == 1 else 's'}"


def direction(east_m: float, north_m: float) -> str:
    """Return to which of eight winds of the map's grid a way leads."""
    if math.hypot(east_m, north_m) < 1e-6:
        return NOTHING
    return _WINDS[round(math.atan2(north_m, east_m) / (math.pi / 4)) % 8]


def listed(words: list[str]) -> str:
    """Return words as a list in a sentence."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


# What makes a spreadsheet take a cell for a formula (OWASP), in ASCII and in full width.
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")


def safe(cell: Any) -> Any:
    """Return a cell as it is written: numbers stay, text never begins a formula."""
    if cell is None or cell is pd.NaT:
        return ""
    if isinstance(cell, Number):
        return "" if isinstance(cell, float) and math.isnan(cell) else cell
    text = str(cell)
    return f"'{text}" if text.lstrip(" ").startswith(FORMULA) else text


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table as CSV in UTF-8, with commas and points."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\r\n")
        writer.writerow([safe(name) for name in header])
        writer.writerows([safe(cell) for cell in row] for row in rows)


def utc(moment: datetime) -> str:
    """Return a time as ISO 8601 with Z."""
    text = pd.Timestamp(moment).tz_convert("UTC").isoformat(timespec="milliseconds")
    return text.removesuffix("+00:00").removesuffix(".000") + "Z"
