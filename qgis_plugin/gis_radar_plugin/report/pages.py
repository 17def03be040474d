"""The pages of a report: each place over the whole time and in each interval."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osgeo import ogr
from qgis.core import (
    QgsCoordinateReferenceSystem,
    QgsCoordinateTransform,
    QgsCsException,
    QgsFeature,
    QgsFields,
    QgsGeometry,
    QgsProcessingException,
    QgsProcessingFeatureSource,
    QgsProject,
    QgsVectorLayer,
)
from qgis.PyQt.QtCore import QDateTime, QLocale, Qt, QTimeZone

from ..words import speaks_german, tr
from .junctions import junctions_of

NAMES = ("name", "junction", "sensor", "id")
TO_SECOND_MS = 10_000  # longer times are given to the second, here and in the report
Interval = tuple[QDateTime, QDateTime]


@dataclass(frozen=True)
class Place:
    """A junction, a place of the user's, or the whole map.

    Parameters
    ----------
    name : str
        Name on the page.
    frame : QgsGeometry
        What the page shows, in the coordinate system of the heat map.
    marks : bool
        Whether it shows the frames of the other pages.
    """

    name: str
    frame: QgsGeometry
    marks: bool = False


@dataclass(frozen=True)
class Page:
    """One page.

    Parameters
    ----------
    place : Place
        What it shows.
    begin, end : QDateTime
        Of which time, UTC.
    whole : bool
        Whether that is the whole time.
    """

    place: Place
    begin: QDateTime
    end: QDateTime
    whole: bool

    def file_name(self) -> str:
        """Return a name without characters that a file system might refuse."""
        place = _file_form(self.place.name)
        time = "whole" if self.whole else self.begin.toString("yyyyMMdd'T'HHmmss") + "Z"
        return f"{place}_{time}"


def places_of(
    source: QgsProcessingFeatureSource,
    field: str,
    radius_m: float,
    crs: QgsCoordinateReferenceSystem,
) -> list[Place]:
    """Return the places of a layer, each with room around it.

    Raises
    ------
    QgsProcessingException
        If the layer has no coordinate system or no place, or one that is none on earth.
    """
    if not source.sourceCrs().isValid():
        text = tr("The layer '{layer}' has no coordinate system: set it first.")
        raise QgsProcessingException(text.format(layer=source.sourceName()))
    transform = QgsCoordinateTransform(source.sourceCrs(), crs, QgsProject.instance())
    column = field or _name_field(source.fields())
    places = []
    for number, row in enumerate(source.getFeatures(), start=1):
        shape = QgsGeometry(row.geometry())
        if shape.isEmpty():
            continue
        try:
            shape.transform(transform)
        except QgsCsException as error:
            text = tr("The layer '{layer}' has a place that is none on earth: {place}.")
            called = _called(row, column, number)
            raise QgsProcessingException(
                text.format(layer=source.sourceName(), place=called)
            ) from error
        frame = QgsGeometry.fromRect(shape.boundingBox().buffered(radius_m))
        places.append(Place(_called(row, column, number), frame))
    if not places:
        text = tr("The layer '{layer}' holds nothing, or nothing in it is selected.")
        raise QgsProcessingException(text.format(layer=source.sourceName()))
    return with_distinct_names(places)


def junction_places(layer: QgsVectorLayer, radius_m: float) -> list[Place]:
    """Return the junctions of a heat map, numbered from north to south."""
    boxes = junctions_of(layer)
    frames = [QgsGeometry.fromRect(box.buffered(radius_m)) for box in boxes]
    return [Place(f"{tr('Junction')} {n}", frame) for n, frame in enumerate(frames, start=1)]


def _name_field(fields: QgsFields) -> str:
    for name in NAMES:
        place = fields.lookupField(name)
        if place >= 0:
            return str(fields.at(place).name())
    return ""


def _called(row: QgsFeature, column: str, number: int) -> str:
    value = row[column] if column else None
    text = str(value) if value not in (None, "") else ""
    return text if text and text != "NULL" else f"{tr('Place')} {number}"


def _file_form(name: str) -> str:
    return re.sub(r"[^\w-]+", "_", name).strip("_") or "page"


def with_distinct_names(places: Sequence[Place]) -> list[Place]:
    """Give places of one name a number, so that no page takes another's file."""
    seen: dict[str, int] = {}
    named = []
    for place in places:
        key = _file_form(place.name).lower()
        seen[key] = count = seen.get(key, 0) + 1
        named.append(place if count == 1 else Place(f"{place.name} ({count})", place.frame))
    return named


def pages_of(
    places: Sequence[Place],
    intervals: Sequence[Interval],
    *,
    whole: bool,
    each: bool,
    recorded: Interval | None = None,
) -> Iterator[Page]:
    """Yield the pages, place by place: the whole time that was recorded, then the intervals."""
    for place in places:
        if whole:
            yield Page(place, *(recorded or (intervals[0][0], intervals[-1][1])), whole=True)
        if each and not (whole and len(intervals) == 1):  # they would be the same page
            for begin, end in intervals:
                yield Page(place, begin, end, whole=False)


def labels_of(package: Path) -> dict[str, Any]:
    """Return title, time zone and sources that a heat map was made with, where it holds them."""
    try:
        found = json.loads(_told_in(package, "labels") or "{}")
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def zone_name(package: Path) -> str:
    """Return the site's time zone of a heat map or of traffic; nothing where it holds none."""
    return str(labels_of(package).get("timezone", ""))


def recorded_in(package: Path) -> Interval | None:
    """Return begin and end of what was recorded: the last interval may end later.

    They are to the second, as in the report; to the millisecond where it is under 10 s.
    """
    begin, end = (
        QDateTime.fromString(_told_in(package, name), Qt.DateFormat.ISODateWithMs)
        for name in ("begin", "end")
    )
    if not (begin.isValid() and end.isValid()):
        return None
    if begin.msecsTo(end) < TO_SECOND_MS:
        return begin.toUTC(), end.toUTC()
    return _to_second(begin), _to_second(end)


def _to_second(moment: QDateTime) -> QDateTime:
    seconds = (moment.toMSecsSinceEpoch() + 500) // 1000
    return QDateTime.fromSecsSinceEpoch(seconds).toUTC()


def _told_in(package: Path, item: str) -> str:
    """Return the metadata of a heat map's file, or of one with layers of traffic."""
    data = ogr.Open(str(package)) if package.is_file() else None
    layer = (data.GetLayerByName("heatmap") or data.GetLayer(0)) if data is not None else None
    return (layer.GetMetadataItem(item) if layer is not None else None) or ""


def timezone(name: str) -> QTimeZone:
    """Return the time zone of a name such as `Europe/Berlin`; without one the machine's.

    Raises
    ------
    QgsProcessingException
        If there is no such zone.
    """
    zone = QTimeZone(name.encode()) if name else QTimeZone.systemTimeZone()
    if not zone.isValid():
        raise QgsProcessingException(
            tr("'{name}' is no time zone: give one such as Europe/Berlin.").format(name=name)
        )
    return zone


def local_time(begin: QDateTime, end: QDateTime, zone: QTimeZone) -> str:
    """Return a span of time in local form, to the second but for short ones; with the zone."""
    if begin.msecsTo(end) >= TO_SECOND_MS:
        begin, end = _to_second(begin), _to_second(end)
    first, last = begin.toTimeZone(zone), end.toTimeZone(zone)
    locale = QLocale("de" if speaks_german() else "en")
    clock = "HH:mm:ss" if first.time().second() or last.time().second() else "HH:mm"
    if first.time().msec() or last.time().msec():
        clock = "HH:mm:ss.zzz"
    day = "ddd dd.MM.yyyy " if speaks_german() else "ddd yyyy-MM-dd "
    same_day = first.date() == last.date()
    text = f"{locale.toString(first, day + clock)} \u2013 "
    text += locale.toString(last, clock if same_day else day + clock)
    return f"{text} ({_zone_text(zone, first, last)})"


def _zone_text(zone: QTimeZone, first: QDateTime, last: QDateTime) -> str:
    """Return a zone by name and offset, both offsets where clocks change in between."""
    name = bytes(zone.id()).decode()
    if name == "UTC":
        return name
    offsets = []
    for moment in (first, last):
        hours, minutes = divmod(abs(moment.offsetFromUtc()) // 60, 60)
        offsets.append(f"UTC{'-' if moment.offsetFromUtc() < 0 else '+'}{hours:02d}:{minutes:02d}")
    return f"{name}, {tr(' then ').join(dict.fromkeys(offsets))}"
