"""Content of a report before it becomes a page: tables, pictures, numbers and times in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple

import pandas as pd

from gis_radar.base import figure_text, listed, percent, plus_minus, tr

QUEUES = "queues"  # the chapter whose figures may show ways of single vehicles
HOW_FOUND = {"lane": "found from traffic on the lanes", "icp": "found by ICP"}
LOOKS = {
    "confirms": "the airborne scan confirms it",
    "doubts": "the airborne scan speaks against it",
    "undecided": "two places fit the airborne scan alike",
    "nothing to compare": "the airborne scan shows nothing to compare",
}


class ReportWords(NamedTuple):
    """How a report calls what its map shows: in English, for :func:`gis_radar.base.words.tr`.

    Parameters
    ----------
    kind : str
        Over the title.
    title : str
        After the name of the site.
    share, base, tile : str
        Heading of a share, what it is a share of, and that of one tile.
    seen : str
        Heading of what a share is known of.
    intro : str
        How to read the map.
    nothing, none : str
        Where no tile has a share; where no share is over 0.
    touched : str
        How many tiles have a share over 0.
    unseen_one, unseen_many : str
        How many lanes have no share.
    """

    kind: str
    title: str
    share: str
    base: str
    tile: str
    seen: str
    intro: str
    nothing: str
    none: str
    touched: str
    unseen_one: str
    unseen_many: str


WORDS = {
    "hit_share": ReportWords(
        "Radar hit report", "radar hits", "Hit share", "of observed time", "hit_share",
        "Observed",
        "The map shows in which share of the observed time radar hit each half metre of lane. "
        "Compare one place over time, not places with each other; the figures count neither "
        "vehicles nor queues",
        "Nothing was observed.", "No tile was hit; {n} tiles observed.",
        "Radar hit {share} of {n} observed tiles at some time.",
        "{n} lane of the map was not observed.", "{n} lanes of the map were not observed.",
    ),
    "occupancy": ReportWords(
        "Traffic occupancy report", "traffic occupancy", "Mean occupancy", "of visible time",
        "occupancy", "Visible",
        "The map shows occupancy: for each half metre of lane the estimated share of time in which "
        "a vehicle was on it, moving or waiting. 20 % means 12 seconds of every minute. It is an "
        "estimate: radar follows the vehicles, also for moments while others hide them; "
        "± is its standard error. Hatched in colour is uncertain; hatched in grey is road that no "
        "radar saw, which is not 0 %",
        "Nothing was visible.", "No tile was occupied; {n} tiles visible.",
        "A vehicle was on {share} of {n} visible tiles at some time.",
        "{n} lane of the map was not visible.", "{n} lanes of the map were not visible.",
    ),
}  # fmt: skip


class Column(NamedTuple):
    """A column of a table.

    Parameters
    ----------
    title, unit : str
        What stands over it, the unit small.
    text : callable
        Returns its cell of what a row is made of.
    is_number : bool
        Numbers stand right.
    """

    title: str
    unit: str
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
    files : sequence of (name, text)
        The files beside the report that hold all of it, and what they hold.
    """

    name: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    note: str = ""
    files: Sequence[tuple[str, str]] = ()


def text_columns(*titles: str) -> list[Column]:
    """Return columns of texts."""
    return [Column(title, "", str, False) for title in titles]


def text_rows(items: Iterable[Any], columns: Sequence[Column]) -> list[list[str]]:
    """Return a row of cells for each item."""
    return [[column.text(item) for column in columns] for item in items]


class Fact(NamedTuple):
    """A figure at the top.

    Parameters
    ----------
    name, value : str
        What it is, and how much.
    rests : str
        What it rests on.
    """

    name: str
    value: str
    rests: str = ""


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
    narrow : bytes
        PNG for a phone, with larger words; empty where it is the same.
    """

    png: bytes
    width: int
    height: int
    title: str = ""
    caption: str
    alt: str
    narrow: bytes = b""


class Strip(NamedTuple):
    """One lane over the time, as the page draws it.

    Parameters
    ----------
    name : str
        Of the lane, in one line or two.
    line, band : str
        Paths, 1000 units wide and 100 high, y downwards: the share, and its standard error.
    unseen : sequence of (begin, length)
        Where nothing was seen, as shares of the width.
    """

    name: str
    line: str
    band: str
    unseen: Sequence[tuple[float, float]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Chart:
    """Strips over time, which the page draws as wide as it is.

    Parameters
    ----------
    caption : str
        Below it.
    alt : str
        What it shows, for who cannot see it.
    heading, below : str
        What the strips show, and in which zone times are.
    top : str
        The highest value of the scale.
    strips : sequence of Strip
        From top to bottom.
    times : sequence of (place, label)
        Below the last: as shares of the width.
    """

    caption: str
    alt: str
    heading: str
    below: str
    top: str
    strips: Sequence[Strip]
    times: Sequence[tuple[float, str]]


@dataclass(frozen=True, kw_only=True, eq=False)
class MapSeries:
    """The map, over the whole time and by interval.

    Parameters
    ----------
    whole : Figure
        The whole time.
    frames : sequence of Figure
        The intervals, as large as `whole`; none where the heat map has but one.
    overlay, narrow : bytes
        PNG with scale, north and sensors, to go over each of them; with larger words for a phone.
    caption : str
        Below the map.
    note : str
        That not all intervals are shown singly, where it is so.
    """

    whole: Figure
    frames: Sequence[Figure]
    overlay: bytes
    narrow: bytes
    caption: str
    note: str


class Chapter(NamedTuple):
    """A chapter before or after the map.

    Parameters
    ----------
    name, title : str
        One word for links, and the heading.
    parts : sequence of Table, Figure, Chart or Terms
        From top to bottom.
    """

    name: str
    title: str
    parts: Sequence[Table | Figure | Chart | Terms]


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
    facts : sequence of Fact
        The figures worth a look.
    remarks : sequence of str
        What to know before reading on, in sentences.
    basis : Table
        What the figures rest on.
    questions : sequence of Chapter
        What comes before the map: traffic, a question each.
    map : MapSeries
        The map.
    chapters : sequence of Chapter
        What follows.
    made_by : str
        The software.
    measure : str
        What the map shows: `occupancy` or `hit_share`.
    shows_ways : bool
        Whether a picture shows the ways of single vehicles.
    """

    title: str
    subtitle: str
    zone: str
    until: datetime
    intro: str
    facts: Sequence[Fact]
    remarks: Sequence[str]
    basis: Table
    map: MapSeries
    chapters: Sequence[Chapter]
    made_by: str
    questions: Sequence[Chapter] = ()
    shows_ways: bool = False

    measure: str = "hit_share"


def tie_words(tie: Any) -> str:
    """Return how many vehicles tie a pose to others, and how certain it is without them."""
    try:
        before = [float(tie["gained"][name]["before"]) for name in ("easting", "northing")]
        others, shared = listed([str(each) for each in tie["sensors"]]), int(tie["pairs"])
    except (KeyError, TypeError, ValueError):
        return ""
    return tr(
        "{n} vehicles that {others} saw, too, make it more certain (without them {error})",
        n=figure_text(shared), others=others, error=plus_minus(math.hypot(*before), 2, " m"),
    )  # fmt: skip


def how_found(evidence: Mapping[str, Any]) -> str:
    """Return how a pose was found, and on what evidence, in words."""
    known = HOW_FOUND.get(str(evidence.get("method")), "given, not found by gis_radar")
    words = [tr(known)]
    fitness = evidence.get("fitness")
    if isinstance(fitness, int | float) and not isinstance(fitness, bool):
        share = percent(float(fitness), 0)
        words.append(tr("{share} of the vehicle paths lie on the lanes", share=share))
    if evidence.get("observable") is False:
        words.append(tr("the scene leaves part of it open"))
    if isinstance(look := evidence.get("scan_check"), dict) and look.get("verdict"):
        words.append(tr(LOOKS.get(str(look["verdict"]), str(look["verdict"]))))
    if tie := tie_words(evidence.get("together")):
        words.append(tie)
    return "; ".join(words)


def utc(moment: datetime) -> str:
    """Return a time as ISO 8601 with Z."""
    text = pd.Timestamp(moment).tz_convert("UTC").isoformat(timespec="milliseconds")
    return text.removesuffix("+00:00").removesuffix(".000") + "Z"
