"""Draw the plan of a report: the lanes with their numbers, none over another and none left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import geopandas as gpd
import matplotlib as mpl
import numpy as np
import pandas as pd
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from PIL import Image

from gis_radar.base import FONTS, Floats, Integers, figure_text, tr
from gis_radar.hdmap import Lane, lanes_of, quads
from gis_radar.products.heatmap.picture import (
    HALO,
    INK,
    NARROW_IN,
    NOWHERE,
    PAPER,
    SOFT,
    MapPicture,
    add_corner_scale,
    for_a_phone,
    image_of_figure,
    image_of_pixels,
    png,
    rgb,
)
from gis_radar.products.report.content import Figure

_PLAN_IN = 6.0  # width of the figure of lanes: the narrower, the larger its words
_MOST_LABELS = 60  # numbers on the plan: more are illegible
LETTERS_PT = 7.5  # size of the numbers
_GLYPH = (0.68, 1.25)  # width of a bold figure and height of its line, of the size of the letters
# Places to try for the number of a lane: on it, as shares of its length;
_TRIES = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9)
_ASIDE_PT = (14.0, 22.0, 32.0, 46.0, 64.0, 90.0)  # beside it, at the end of a line, points;
_AROUND_PT, _AROUND = (46.0, 64.0, 90.0, 125.0, 175.0), 24  # around its middle, in 24 directions.
_SCALE_IN = (2.2, 0.75)  # size of the corner with the scale bar
# Tints that lanes take in turn; where two look alike, their numbers distinguish them.
_TINTS = ("#cfe3f5", "#f7dfb2", "#d8ead0", "#ead6ea")


class PlacedNumber(NamedTuple):
    """Where the number of a lane stands: its middle, its turn in degrees, and its box.

    A number beside its lane has a line from there, `foot`.
    """

    middle: Floats
    turn: float
    box: shapely.Polygon
    foot: Floats | None = None


def draw_plan(tiles: gpd.GeoDataFrame, picture: MapPicture, table: pd.DataFrame) -> Figure:
    """Draw the lanes with their numbers and where they lead.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    picture : MapPicture
        Grid of pixels and extent of the map.
    table : DataFrame
        From :func:`~gis_radar.products.report.lanes.lane_table`: lanes with a share are named, the
        first where they are too many.
    """
    lanes, (west, east, south, north) = lanes_of(tiles), picture.grid.bounds
    corner, size = np.array([west, south]), np.array([east - west, north - south])
    centres = quads(tiles).mean(axis=1)
    place = (centres - corner) / size
    inside = ((place > 0.0) & (place < 1.0)).all(axis=1)
    shown = [lane for lane in lanes if inside[lane.rows].any()]
    known = set(table.loc[table["share"].notna(), "lane"].tolist()[:_MOST_LABELS])
    middles = {
        lane.number: centres[lane.rows[np.abs(place[lane.rows] - 0.5).max(axis=1) < 0.48]]
        for lane in shown
        if lane.number in known
    }
    ground = _lanes_in_tints(picture, len(tiles), lanes)
    tips = [centres[lane.rows] for lane in shown if inside[lane.rows[-1]]]
    drawn = {
        width_in: _overlay(picture, width_in, [centres[lane.rows] for lane in shown], tips, middles)
        for width_in in (_PLAN_IN, NARROW_IN)
    }
    wide, narrow = (Image.alpha_composite(ground, over).convert("RGB") for over in drawn.values())
    return Figure(
        png=png(wide.quantize(128, dither=Image.Dither.NONE)),
        narrow=png(for_a_phone(narrow).quantize(128, dither=Image.Dither.NONE)),
        width=picture.grid.width,
        height=picture.grid.height,
        caption=tr(
            "The lanes, and the numbers of those in the table; arrows show where they lead."
        ),
        alt=tr(
            "Map of {n} lanes with their numbers. The table has the direction and length of each.",
            n=figure_text(len(lanes)),
        ),
    )


def _overlay(
    picture: MapPicture,
    width_in: float,
    lines: Sequence[Floats],
    tips: Sequence[Floats],
    middles: dict[int, Floats],
) -> Image.Image:
    """Return lines, arrows, numbers and scale as a transparent image of a figure's width."""
    west, east, south, north = picture.grid.bounds
    with mpl.rc_context(FONTS):
        figure, ax = picture.blank(width_in)
        ax.add_collection(LineCollection(list(lines), colors=SOFT, linewidths=0.5))
        for way in tips:
            _add_tip(ax, way)
        point_m = (east - west) / (width_in * 72.0)
        bounds = shapely.box(west, south, east, north)
        for number, placed in place_numbers(middles, point_m, bounds).items():
            _add_number(ax, number, placed)
        add_corner_scale(figure, ax, road=np.concatenate([NOWHERE, *lines]))
        return image_of_figure(figure).convert("RGBA")


def place_numbers(
    middles: dict[int, Floats], point_m: float, bounds: shapely.Polygon
) -> dict[int, PlacedNumber]:
    """Return where the numbers of lanes stand, so that none covers another and none is missing.

    A number stands along its lane, or beside it at the end of a line. Short lanes come first: long
    ones have more room.

    Parameters
    ----------
    middles : dict
        By number, the middles of the tiles of a lane within the map, (n, 2), metres.
    point_m : float
        Metres of the map to a point of the letters' size.
    bounds : Polygon
        The map.
    """
    _, south, east, _ = bounds.bounds
    wide, high = (each * 72.0 * point_m for each in _SCALE_IN)
    taken = [shapely.box(east - wide, south, east, south + high)]
    placed: dict[int, PlacedNumber] = {}
    for number in sorted(middles, key=lambda each: (len(middles[each]), each)):
        if not len(middles[number]):
            continue
        best_place, least_covered = None, np.inf
        for each in _candidates(middles[number], str(number), point_m):
            covered = float(shapely.area(shapely.intersection(taken, each.box)).sum())
            covered += each.box.area - float(shapely.intersection(each.box, bounds).area)
            if covered < least_covered:
                best_place, least_covered = each, covered
            if not least_covered:
                break
        if best_place is not None:
            placed[number] = best_place
            taken.append(best_place.box)
    return placed


def _candidates(middles: Floats, text: str, point_m: float) -> Iterator[PlacedNumber]:
    """Yield where a number may stand: along its lane, beside it, then all around its middle."""
    half = np.array([_GLYPH[0] * len(text), _GLYPH[1]]) * LETTERS_PT * point_m / 2.0
    at = np.unique((np.array(_TRIES) * (len(middles) - 1)).astype(int), return_index=True)
    spots: Integers = at[0][np.argsort(at[1])]
    for k in spots:
        direction = _direction_at(middles, int(k))
        turn = (np.degrees(np.arctan2(direction[1], direction[0])) + 90.0) % 180.0 - 90.0
        yield PlacedNumber(middles[k], float(turn), _box(middles[k], half, turn))
    for aside in _ASIDE_PT:
        for k in spots[:5]:
            direction = _direction_at(middles, int(k))
            length = float(np.hypot(*direction))
            if not length:
                continue
            left = np.array([-direction[1], direction[0]]) / length
            for side in (left, -left):
                middle = middles[k] + side * aside * point_m
                yield PlacedNumber(middle, 0.0, _box(middle, half, 0.0), middles[k])
    foot = middles[len(middles) // 2]
    for aside in _AROUND_PT:
        for angle in np.arange(_AROUND) * (2.0 * np.pi / _AROUND):
            middle = foot + aside * point_m * np.array([np.cos(angle), np.sin(angle)])
            yield PlacedNumber(middle, 0.0, _box(middle, half, 0.0), foot)


def _direction_at(middles: Floats, k: int) -> Floats:
    return np.asarray(middles[min(k + 2, len(middles) - 1)] - middles[max(k - 2, 0)])


def _box(middle: Floats, half: Floats, turn: float) -> shapely.Polygon:
    """Return the box of a number around its middle."""
    angle = np.radians(turn)
    along, across = (
        np.array([np.cos(angle), np.sin(angle)]),
        np.array([-np.sin(angle), np.cos(angle)]),
    )
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return shapely.Polygon([middle + x * half[0] * along + y * half[1] * across for x, y in signs])


def _add_number(ax: Axes, number: int, placed: PlacedNumber) -> None:
    """Write a number at its place."""
    if placed.foot is not None:
        line = np.array([placed.foot, placed.middle])
        ax.plot(line[:, 0], line[:, 1], color=INK, linewidth=0.6, zorder=3)
    ax.text(
        placed.middle[0], placed.middle[1], str(number),
        fontsize=LETTERS_PT, fontweight="bold", color=INK,
        ha="center", va="center", rotation=placed.turn, path_effects=HALO, zorder=4,
    )  # fmt: skip


def _lanes_in_tints(picture: MapPicture, tiles: int, lanes: Sequence[Lane]) -> Image.Image:
    """Return the lanes in tints; where they overlap, the shortest is on top."""
    longest_first = sorted(lanes, key=lambda each: -len(each.rows))
    place = np.zeros(tiles, np.int64)
    for i, lane in enumerate(longest_first):
        place[lane.rows] = i
    tint = np.array([lane.number % len(_TINTS) for lane in longest_first])
    pixels = picture.ground.copy()  # paper and outline, as on the map
    pixels.ravel()[picture.cover.pixel] = 2 + tint[picture.cover.highest(place)]
    return image_of_pixels(pixels, rgb(PAPER, SOFT, *_TINTS)).convert("RGBA")


def _add_tip(ax: Axes, middles: Floats) -> None:
    """Draw an arrow at a lane's end."""
    if len(middles) < 4:
        return
    look = {"arrowstyle": "-|>", "color": INK, "lw": 0.7, "mutation_scale": 7}
    ax.annotate("", tuple(middles[-1]), tuple(middles[-4]), arrowprops=look)
