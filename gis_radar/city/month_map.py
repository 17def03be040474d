"""The map of a city's month: a mark a site, by occupancy and volume, as SVG on the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import shapely

from gis_radar.base import Floats, tr
from gis_radar.city.month_tables import share_with_error, value_with_error
from gis_radar.city.site_month import SiteMonth
from gis_radar.products import NOT_OBSERVED, colour_classes

_WIDTH, _MARGIN = 1000.0, 70.0  # units of the map, some pixels on a wide page
_TALLEST, _FLATTEST = 0.9, 0.35  # height as a share of the width
RADIUS = (9.0, 24.0)  # of the mark without vehicles, and of the site with most
_UNKNOWN_RADIUS = 9.0  # of the mark of a site of unknown volume
_LETTER, _LINE = 8.2, 17.0  # width of a letter of a label, height of its line
RING = 6.0  # from the edge of a mark to the outside of the dashed ring around it
_MOST_LABEL = 26  # letters of a label
_DEEP_FROM = 0.02  # occupancy from which its class has a deep colour
_FINEST = 1.0  # tolerance, in units of the map, by which lanes are simplified
_METRES_PER_DEGREE = 111_195.0  # of latitude, on a sphere of the Earth's mean radius
_BAR_X, _BAR_ROOM = 20.0, 30.0  # of the scale bar from the edge; below the marks, for its text
_BAR_SHARE = 0.25  # longest scale bar, of the width


class SiteMark(NamedTuple):
    """A site on the map.

    Parameters
    ----------
    number : int
        Its number, from 1.
    x, y, radius : float
        Its place and size, units of the map, y downwards.
    colour : str
        Colour of its class of occupancy; empty where none is known.
    is_deep : bool
        Whether its colour is deep, so that the number on it is white.
    label : (x, y, anchor, text) or None
        Its name beside it, where there is room.
    title : str
        What is known of it, in a line.
    link : str
        Its report; empty where there is none.
    has_fault : bool
        Whether one of its sensors does not work.
    """

    number: int
    x: float
    y: float
    radius: float
    colour: str
    is_deep: bool
    label: tuple[float, float, str, str] | None
    title: str
    link: str
    has_fault: bool


class CityMap(NamedTuple):
    """The map of a city: its size, the lanes as a path, its marks, the scale bar and the classes.

    Parameters
    ----------
    width, height : float
        Its size, units.
    lanes : str
        The path of all lanes.
    marks : sequence of SiteMark
        The sites.
    bar : (x, length, text)
        The scale bar at the lower edge, units: in the corner that is farther from a mark.
    classes : sequence of (name, colour, text)
        The legend, lowest class first.
    """

    width: float
    height: float
    lanes: str
    marks: Sequence[SiteMark]
    bar: tuple[float, float, str]
    classes: Sequence[tuple[str, str, str]]


def draw_city(
    sites: Sequence[SiteMonth], faulty: Mapping[str, int], legend: Sequence[tuple[str, str]]
) -> CityMap:
    """Draw the sites of a city.

    Parameters
    ----------
    sites : sequence of SiteMonth
        All sites.
    faulty : mapping
        By site, how many of its sensors do not work; sites without such ones are left out.
    legend : sequence of (colour, text)
        Classes of occupancy.
    """
    middle = np.mean([each.place for each in sites], axis=0)
    metres = np.array([np.cos(np.radians(middle[1])), 1.0]) * _METRES_PER_DEGREE
    places = np.array([(each.place - middle) * metres for each in sites]) * [1.0, -1.0]
    size = np.maximum(np.ptp(places, axis=0), 300.0)
    inner = _WIDTH - 2 * _MARGIN
    scale = min(inner / size[0], (_WIDTH * _TALLEST - 2 * _MARGIN) / size[1])
    height = max(size[1] * scale + 2 * _MARGIN, _WIDTH * _FLATTEST)
    corner = (places.min(axis=0) + places.max(axis=0)) / 2.0 - np.array(
        [_WIDTH, height]
    ) / 2 / scale
    centres, height = (places - corner) * scale, height + _BAR_ROOM
    volumes = np.array([each.volume[0] for each in sites])
    most = np.nanmax(volumes, initial=1.0)
    radius = np.where(
        np.isfinite(volumes),
        RADIUS[0] + (RADIUS[1] - RADIUS[0]) * np.sqrt(np.nan_to_num(volumes) / most),
        _UNKNOWN_RADIUS,
    )
    bar = _bar(scale, centres, height)
    reach = radius + RING * np.array([each.name in faulty for each in sites])
    labels = _labels([each.title for each in sites], centres, reach, height, bar)
    marks = [
        SiteMark(
            number=k + 1, x=round(float(centres[k, 0]), 1), y=round(float(centres[k, 1]), 1),
            radius=round(float(radius[k]), 1), colour=_colour(site),
            is_deep=site.occupancy[0] > _DEEP_FROM, label=labels[k],
            title=_description(site, faulty.get(site.name, 0)), link=site.link,
            has_fault=site.name in faulty,
        )
        for k, site in enumerate(sites)
    ]  # fmt: skip
    lanes = "".join(
        _path(((way - middle) * metres * [1.0, -1.0] - corner) * scale)
        for each in sites for way in each.lines
    )  # fmt: skip
    return CityMap(_WIDTH, round(float(height)), lanes, marks, bar, _legend_classes(legend))


def _colour(site: SiteMonth) -> str:
    share = site.occupancy[0]
    if not np.isfinite(share):
        return ""
    return next(each.colour for each in colour_classes("occupancy") if share <= each.upper)


def _description(site: SiteMonth, faulty: int) -> str:
    if site.lanes is None:
        known = tr("no data in this month")
    else:
        (share, off), (volume, error) = site.occupancy, site.volume
        known = tr("mean occupancy {share}", share=share_with_error(share, off))
        if np.isfinite(volume):
            known += ", " + tr("{n} vehicles an hour", n=value_with_error(volume, error))
    fault = "; " + tr("sensors not well: {n}", n=faulty) if faulty else ""
    return f"{site.title}: {known}{fault}"


def _labels(
    names: Sequence[str],
    centres: Floats,
    radius: Floats,
    height: float,
    bar: tuple[float, float, str],
) -> list[tuple[float, float, str, str] | None]:
    """Return places of names beside their marks, without overlaps; None where there is no room."""
    bounds = shapely.box(0.0, 0.0, _WIDTH, height)
    taken = [shapely.Point(*p).buffer(r) for p, r in zip(centres, radius, strict=True)]
    taken += [_box_of_bar(bar[0], bar[1], height), shapely.box(_WIDTH - 50.0, 0.0, _WIDTH, 80.0)]
    labels: list[tuple[float, float, str, str] | None] = []
    for name, (x, y), r in zip(names, centres, radius, strict=True):
        text = name if len(name) <= _MOST_LABEL else name[: _MOST_LABEL - 1] + "\u2026"
        wide, best = _LETTER * len(text), None
        for dx, dy, anchor in (
            (r + 5, 0, "start"), (-r - 5, 0, "end"), (0, -r - _LINE / 2, "middle"),
            (0, r + _LINE / 2 + 2, "middle"),
        ):  # fmt: skip
            left = x + dx - wide * {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor]
            box = shapely.box(left, y + dy - _LINE / 2, left + wide, y + dy + _LINE / 2)
            if bounds.contains(box) and not any(shapely.intersects(taken, box)):
                best = round(float(x + dx), 1), round(float(y + dy + _LINE * 0.3), 1), anchor, text
                taken.append(box)
                break
        labels.append(best)
    return labels


def _path(points: Floats) -> str:
    """Return a line as a path of whole units, no finer than can be seen."""
    kept = shapely.get_coordinates(shapely.simplify(shapely.LineString(points), _FINEST))
    return "M" + " ".join(f"{x:.0f} {y:.0f}" for x, y in kept)


def _bar(scale: float, centres: Floats, height: float) -> tuple[float, float, str]:
    longest = _WIDTH * _BAR_SHARE / scale
    power = 10.0 ** np.floor(np.log10(longest))
    metres = max(each for each in (power, 2 * power, 5 * power) if each <= longest)
    text = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
    length, marks = round(float(metres * scale), 1), shapely.MultiPoint(centres)
    x = max(
        _BAR_X,
        _WIDTH - _BAR_X - length,
        key=lambda x: _box_of_bar(x, length, height).distance(marks),
    )
    return x, length, text


def _box_of_bar(x: float, length: float, height: float) -> shapely.Polygon:
    return shapely.box(x - 5.0, height - 60.0, x + length + 5.0, height)


def _legend_classes(legend: Sequence[tuple[str, str]]) -> list[tuple[str, str, str]]:
    return [
        ("unseen" if colour == NOT_OBSERVED else f"class-{colour[1:]}", colour, text)
        for colour, text in legend
        if colour.startswith("#")
    ]
