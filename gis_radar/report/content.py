"""Content of a report, before it becomes a page: text, tables, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of a table.

    Parameters
    ----------
    title : str
        What stands over it.
    unit : str
        Under the title, small.
    is_number : bool
        Numbers stand right.
    width : float
        Its share of the page, beside the others'.
    """

    title: str
    unit: str = ""
    is_number: bool = True
    width: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table as it is read: all cells are text, the first of a row names it.

    Parameters
    ----------
    caption : str
        What it holds.
    columns : sequence of Column
        From left to right.
    rows : sequence of sequence of str
        From top to bottom.
    note : str
        What to know, below it.
    """

    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[str]]
    note: str = ""


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
    """

    png: bytes
    width: int
    height: int
    title: str = ""
    caption: str
    alt: str


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
    lane_figure : Figure
        Where the lanes are.
    lanes : Table
        How busy they are.
    sensors : Table
        Where sensors stand.
    sensor_figures : sequence of Figure
        How their poses were found.
    quality : Table
        What sensors delivered, by hour.
    settings, sources : Table
        How and from what it was made.
    definitions : sequence of (term, meaning)
        What the words mean.
    made_by : str
        The software.
    """

    title: str
    subtitle: str
    zone: str
    until: datetime
    intro: str
    facts: Sequence[tuple[str, str]]
    remarks: Sequence[str]
    map: MapSeries
    lane_figure: Figure
    lanes: Table
    sensors: Table
    sensor_figures: Sequence[Figure]
    quality: Table
    settings: Table
    sources: Table
    definitions: Sequence[tuple[str, str]]
    made_by: str
