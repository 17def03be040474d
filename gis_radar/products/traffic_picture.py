"""The turning diagram of a site: turns as wide as their volumes, with numbers at each stop line."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from gis_radar.base import Clock, picture_file, tr, with_error, zone_of
from gis_radar.products.heatmap.picture import INK, SOFT

_WIDTH_IN, _DPI = 10.0, 160  # width of the picture, and dots an inch
_AROUND_M = 45.0  # length of road shown around the turns, for the numbers
_VEH_H_PER_POINT = 40.0  # a line of 10 points is 400 veh/h
HEAD = (4.0, 1.2)  # size of an arrow's head: points, and a multiple of its line's width
_BEFORE_M = 2.0  # distance of the numbers before the turn, and more where others stand there
_LETTERS, _TRIES = 8.0, 30  # size of the numbers, points; how often they are moved by as much
_ROAD, _FLOW = "#d5d8db", "#ba1c4d"  # distinct in grey and for colour-blind eyes
_ARROWS = {"left": "\u21b0", "straight": "\u2191", "right": "\u21b1", "back": "\u21b6"}


def write_turning_diagram(
    lanes: gpd.GeoDataFrame, turns: gpd.GeoDataFrame, path: Path
) -> None:  # fmt: skip
    """Draw the turning diagram, in the current language, with title and explanation.

    Parameters
    ----------
    lanes, turns : GeoDataFrame
        From :meth:`gis_radar.Dataset.traffic` and :meth:`gis_radar.Dataset.turns`, the latter over
        the whole time; one at least with a volume.
    path : Path
        The picture (PNG).
    """
    turns = turns[turns["volume"].notna()]
    begin, end = turns["begin"].min(), turns["end"].max()
    hours = (end - begin).total_seconds() / 3600.0
    if an_hour := turns["volume_veh_h"].sum():  # without the time between recordings
        hours = turns["volume"].sum() / an_hour
    with picture_file(path, (_WIDTH_IN, _WIDTH_IN), _DPI, tight=True) as figure:
        draw_turning_diagram(figure, lanes, turns.assign(error_veh_h=turns["volume_se"] / hours))
        left = {"x": 0.0, "ha": "left"}  # beyond the numbers, which may reach over the axes
        figure.suptitle(_title(begin, end), color=INK, fontsize=13, fontweight="bold", **left)
        figure.supxlabel(f"{tr(_BELOW)}\n{tr(_UNSEEN)}", color=SOFT, fontsize=9, **left)


def draw_turning_diagram(
    figure: Any, lanes: gpd.GeoDataFrame, turns: gpd.GeoDataFrame, *, labels: bool = True
) -> Any:
    """Draw turns as wide as their volumes on a figure, with their figures; return its axes.

    Parameters
    ----------
    figure : matplotlib Figure
        Square; the smaller, the thinner are lines. Letters keep their size.
    lanes : GeoDataFrame
        As for :func:`write_turning_diagram`.
    turns : GeoDataFrame
        The known turns of the whole time, with `error_veh_h`, the error of `volume_veh_h`.
    labels : bool
        Whether their figures are written along the approaches.
    """
    axes, scale = figure.subplots(), figure.get_figwidth() / _WIDTH_IN
    for line in lanes.geometry.drop_duplicates():
        axes.plot(*line.xy, color=_ROAD, linewidth=7.0 * scale, solid_capstyle="butt", zorder=1)
    for row in turns.itertuples():
        _draw_turn(axes, row.geometry, float(row.volume_veh_h) * scale)
    low_x, low_y, high_x, high_y = turns.total_bounds
    half = max(high_x - low_x, high_y - low_y) / 2.0 + _AROUND_M
    x, y = (low_x + high_x) / 2.0, (low_y + high_y) / 2.0
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")
    axes.set_axis_off()
    box = axes.get_window_extent()
    point_m = 2.0 * half / min(box.width, box.height) * figure.dpi / 72.0
    taken: list[shapely.Polygon] = []
    for lane, rows in turns.groupby("from_lane") if labels else ():
        others = turns.geometry[turns["from_lane"] != lane].union_all()
        taken += _label(axes, rows, point_m, taken, others)
    return axes


_BELOW = (
    "Vehicles an hour over the whole time, with their standard errors. "
    "A line is as wide as its volume; north is up."
)
_UNSEEN = "Turns without a line were not seen; figures without room stand in the table."


def _title(begin: pd.Timestamp, end: pd.Timestamp) -> str:
    clock = Clock(zone=zone_of(str(begin.tz)), first=begin, last=end, to_seconds=False)
    return f"{tr('Turning volumes')}, {clock.long_span_in_zone(begin, end)}"


def _draw_turn(axes: Any, line: shapely.LineString, volume: float) -> None:
    points = shapely.get_coordinates(line)
    width = max(volume / _VEH_H_PER_POINT, 0.4)
    axes.plot(*points.T, color=_FLOW, linewidth=width, alpha=0.55, zorder=3, solid_capstyle="butt")
    ahead = points[-1] - points[-2]
    turned = math.degrees(math.atan2(ahead[1], ahead[0])) - 90.0  # a marker points north
    axes.plot(
        *points[-1], marker=(3, 0, turned), markersize=HEAD[0] + HEAD[1] * width, color=_FLOW,
        markeredgewidth=0.0, zorder=4,
    )  # fmt: skip


def _label(
    axes: Any, rows: pd.DataFrame, point_m: float, taken: list[shapely.Polygon], others: Any
) -> list[shapely.Polygon]:
    """Write the volumes of an approach along its lane, and return the area of the text.

    It begins before the stop line, or so far from it that it lies on no other text. It is left out
    where it would then lie on turns of other approaches, as if it were theirs.
    """
    from matplotlib.textpath import TextPath  # noqa: PLC0415 - reading fonts takes time

    order = {name: k for k, name in enumerate(_ARROWS)}
    rows = rows.sort_values(["turn", "to_lane"], key=lambda v: v.map(order).fillna(0))
    values = zip(rows["turn"], rows["volume_veh_h"], rows["error_veh_h"], strict=True)
    texts = [f"{_ARROWS[str(turn)]} {with_error(volume, error)}" for turn, volume, error in values]
    start, after = shapely.get_coordinates(rows.geometry.iloc[0])[:2]
    turned = math.degrees(math.atan2(*(after - start)[::-1]))
    upside_down = not -90.0 < turned <= 90.0
    ahead = (after - start) / max(float(np.hypot(*(after - start))), 1e-9)
    text = "   ".join(texts)
    length_m = TextPath((0, 0), text, size=_LETTERS).get_extents().width * point_m
    for number in range(_TRIES):
        place = start - (_BEFORE_M + number * _LETTERS * point_m) * ahead
        line = shapely.LineString([place, place - length_m * ahead])
        area = line.buffer(0.4 * _LETTERS * point_m, cap_style="flat")
        if number and area.intersects(others):
            return []
        if not any(area.intersects(other) for other in taken):
            break
    axes.text(
        *map(float, place), text, color=INK, fontsize=_LETTERS, zorder=5, va="center",
        ha="left" if upside_down else "right",
        rotation=turned - 180.0 if upside_down else turned, rotation_mode="anchor",
    )  # fmt: skip
    return [area]
