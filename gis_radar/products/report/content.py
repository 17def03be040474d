"""Content of a report before it becomes a page: tables, pictures, numbers and times in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, NamedTuple

import pandas as pd

from gis_radar.base import figure_text, listed, percent, plus_minus, tr

LANES_CHAPTER = "lanes"  # the chapter with the plan
NOT_SEEN, TOO_LITTLE = "not seen", "too little seen"  # in place of a volume
QUEUES = "queues"  # the chapter whose figures may show trajectories of single vehicles
_HOW_FOUND = {"lane": "found from traffic on the lanes", "icp": "found by ICP"}
_LOOKS = {
    "confirms": "the airborne scan confirms it",
    "doubts": "the airborne scan speaks against it",
    "undecided": "other places may fit the airborne scan alike",
    "nothing to compare": "the airborne scan shows nothing to compare",
}


class ReportWords(NamedTuple):
    """Words of a report for the measure of its map: English, for :func:`gis_radar.base.words.tr`.

    Parameters
    ----------
    kind : str
        Kind of the report, above its title.
    title : str
        Subject of the report, after the name of the site.
    share, base, tile : str
        Name of a share, of what it is a share, and the name of the share of one tile.
    seen : str
        Name of the part of a lane that has a share.
    intro : str
        Explanation of the map.
    nothing, none : str
        Texts if no tile has a share, and if no share is over 0.
    touched : str
        Text on the tiles with a share over 0.
    unseen_one, unseen_many : str
        Texts on one lane, and on several lanes, without a share.
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


REPORT_WORDS = {
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
        Heading, and the unit in small letters below it.
    text : callable
        Returns the text of a cell, given the item of its row.
    is_number : bool
        Whether its cells are numbers, which are aligned right.
    chapter : str
        Name of the chapter that its unit leads to, or empty.
    """

    title: str
    unit: str
    text: Callable[[Any], str]
    is_number: bool = True
    chapter: str = ""


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of a page: all cells are text, and the first cell of a row names the row.

    Parameters
    ----------
    name : str
        One word, by which the page styles it.
    caption : str
        Caption.
    columns : sequence of Column
        Columns from left to right.
    rows : sequence of sequence of str
        Cells of the rows, from top to bottom.
    note : str
        Remarks below the table.
    files : sequence of (name, text)
        Files beside the report with all rows, and what each holds.
    printed : int, optional
        Number of rows on paper and in the PDF; all by default.
    """

    name: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    note: str = ""
    files: Sequence[tuple[str, str]] = ()
    printed: int | None = None


def text_columns(*titles: str) -> list[Column]:
    """Return columns of texts."""
    return [Column(title, "", str, False) for title in titles]


def number_column(text: Callable[[Any], str]) -> Column:
    """Return the column of the numbers of lanes, which leads to the plan that shows them."""
    return Column(tr("No."), tr("on the plan"), text, chapter=LANES_CHAPTER)


def text_rows(items: Iterable[Any], columns: Sequence[Column]) -> list[list[str]]:
    """Return a row of cells for each item."""
    return [[column.text(item) for column in columns] for item in items]


class Fact(NamedTuple):
    """A key figure at the top of a page.

    Parameters
    ----------
    name, value : str
        Its name and its value, with the unit.
    rests : str
        What the value rests on.
    """

    name: str
    value: str
    rests: str = ""


class Terms(NamedTuple):
    """Pairs of a word and its definition, in the order of the page."""

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
        Time of a map; else empty.
    caption : str
        Caption.
    alt : str
        Description of the picture, for screen readers.
    narrow : bytes
        PNG for a phone, with larger letters; empty where it is the same.
    """

    png: bytes
    width: int
    height: int
    title: str = ""
    caption: str
    alt: str
    narrow: bytes = b""


class Strip(NamedTuple):
    """One lane over time, as paths of SVG.

    Parameters
    ----------
    name : str
        Name of the lane, in one line or two.
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
    """Strips over time, which the page draws over its whole width.

    Parameters
    ----------
    caption : str
        Caption.
    alt : str
        Description of the chart, for screen readers.
    heading, below : str
        What the strips show, and the time zone of the times.
    top : str
        The highest value of the scale.
    strips : sequence of Strip
        Strips from top to bottom.
    times : sequence of (place, label)
        Times below the last strip; places are shares of the width.
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
        Map of the whole time.
    frames : sequence of Figure
        Maps of the intervals, as large as `whole`; none if the heat map has a single one.
    overlay, narrow : bytes
        PNG with scale, north and sensors, laid over each map; with larger letters for a phone.
    caption : str
        Caption.
    note : str
        Remark that each map shows several intervals together; else empty.
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
        Its parts from top to bottom.
    """

    name: str
    title: str
    parts: Sequence[Table | Figure | Chart | Terms]


@dataclass(frozen=True, kw_only=True, eq=False)
class Content:
    """Content of a report.

    Parameters
    ----------
    title, subtitle : str
        Name of the site, and the time.
    zone : str
        Time zone of all times.
    until : datetime
        End of the data.
    intro : str
        Explanation of the map.
    facts : sequence of Fact
        Key figures.
    remarks : sequence of str
        Sentences to read first.
    basis : Table
        What the figures rest on.
    questions : sequence of Chapter
        Chapters on traffic, before the map; each answers a question.
    map : MapSeries
        The map.
    chapters : sequence of Chapter
        Chapters after the map.
    made_by : str
        The software.
    measure : str
        Measure of the map: `occupancy` or `hit_share`.
    shows_paths : bool
        Whether a picture shows the trajectories of single vehicles.
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
    shows_paths: bool = False

    measure: str = "hit_share"


def joint_words(joint: Any) -> str:
    """Return how many vehicles were shared with other sensors, and the pose's error without them.

    Parameters
    ----------
    joint : mapping
        Entry `together` of a pose, from a joint calibration; anything else gives an empty text.
    """
    try:
        before = [float(joint["gained"][name]["before"]) for name in ("easting", "northing")]
        others, shared = listed([str(each) for each in joint["sensors"]]), int(joint["pairs"])
    except (KeyError, TypeError, ValueError):
        return ""
    return tr(
        "{n} vehicles that {others} saw, too, make it more certain (without them {error})",
        n=figure_text(shared), others=others, error=plus_minus(math.hypot(*before), 2, " m"),
    )  # fmt: skip


def how_found(evidence: Mapping[str, Any]) -> str:
    """Return how a pose was found, and on what evidence, in words."""
    origin = _HOW_FOUND.get(str(evidence.get("method")), "given, not found by gis_radar")
    words = [tr(origin)]
    fitness = evidence.get("fitness")
    if isinstance(fitness, int | float) and not isinstance(fitness, bool):
        share = percent(float(fitness), 0)
        words.append(tr("{share} of the vehicle paths lie on the lanes", share=share))
    if evidence.get("observable") is False:
        words.append(tr("the scene leaves part of it open"))
    if isinstance(check := evidence.get("scan_check"), dict) and check.get("verdict"):
        words.append(tr(_LOOKS.get(str(check["verdict"]), str(check["verdict"]))))
    if joint := joint_words(evidence.get("together")):
        words.append(joint)
    return "; ".join(words)


def utc(moment: datetime) -> str:
    """Return a time as ISO 8601 with Z."""
    text = pd.Timestamp(moment).tz_convert("UTC").isoformat(timespec="milliseconds")
    return text.removesuffix("+00:00").removesuffix(".000") + "Z"
