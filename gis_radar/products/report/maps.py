"""Draw the pictures of a report: the map by interval, the lanes' numbers, what sensors see."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import geopandas as gpd
import matplotlib as mpl
import numpy as np
import pandas as pd
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as MplFigure
from matplotlib.patches import Patch
from PIL import Image

from gis_radar.base import (
    FONTS,
    Clock,
    Floats,
    Integers,
    Reporter,
    figure_text,
    name_of,
    percent,
    tr,
)
from gis_radar.hdmap import Lane, lanes_of, quads
from gis_radar.measures import sight_of_tiles
from gis_radar.products.heatmap.heatmap import HeatMap
from gis_radar.products.heatmap.occupancy import mean_occupancy
from gis_radar.products.heatmap.picture import (
    HALO,
    INK,
    NARROW_IN,
    NOWHERE,
    PAPER,
    SOFT,
    Extent,
    MapPicture,
    add_corner_scale,
    for_a_phone,
    image_of_figure,
    image_of_pixels,
    map_extent,
    map_picture,
    png,
    rgb,
)
from gis_radar.products.report.content import REPORT_WORDS, Figure, MapSeries
from gis_radar.products.report.lanes import part_and_base
from gis_radar.products.report.results import Results
from gis_radar.scans import (
    HIDDEN,
    IN_SIGHT,
    SIGHT_COLOURS,
    SIGHT_NAMES,
    VIEW_ONLY,
    Sight,
    SightTiles,
    draw_sight,
)

_ASPECT = (0.55, 1.25)  # height over width: least, which the scale bar needs, and greatest
_SCALE_SHARE = (0.4, 0.13)  # width and height of the scale bar's corner, of the map's width
_MOST_FRAMES = 96  # pictures in time: a day of quarter hours
_MOST_PIXELS = 2_200_000  # of a picture
_ALL_PIXELS = 70_000_000  # of all together: a browser holds four bytes of each
_STAGE = "drawing the maps"

SIGHT_IN = 3.4  # width of a sensor's picture: alone on a phone's page its words can be read
_MOST_SIGHTS = 6  # sensors whose sight is drawn


def lay_out(heat: HeatMap) -> MapPicture:
    """Return the pixels that all maps of a report share: the more maps, the coarser."""
    maps = len(_groups(heat)) + 1
    corners = quads(heat.tiles)
    extent = map_extent(corners, heat.shares().observed_s > 0, _ASPECT)
    extent = with_room_for_scale(extent, corners)
    return map_picture(corners, extent, min(_MOST_PIXELS, _ALL_PIXELS // maps))


def with_room_for_scale(extent: Extent, corners: Floats) -> Extent:
    """Return an extent with a strip below for the scale bar, if both lower corners hold road."""
    low, high = extent
    wide, tall = np.array(_SCALE_SHARE) * (high - low)[0]
    east, north = (corners.reshape(-1, 2) - low).T
    below = (north > 0.0) & (north < tall)
    sides = (east, (high - low)[0] - east)
    taken = all((below & (side > 0.0) & (side < wide)).any() for side in sides)
    return (low - np.array([0.0, tall]) if taken else low), high


def draw_maps(results: Results, picture: MapPicture, clock: Clock, reporter: Reporter) -> MapSeries:
    """Draw the map over the whole time and by interval.

    Parameters
    ----------
    results : Results
        The heat map, the poses of its sensors, and the sources of the data.
    picture : MapPicture
        Pixels of the maps.
    clock : Clock
        Clock for the labels.
    reporter : Reporter
        Receives progress.
    """
    heat, poses, sources = results.heat, results.poses, results.credits
    groups, frames = _groups(heat), []
    for done, group in enumerate(groups, start=1):
        begin, end = heat.timeline.span(group.start)[0], heat.timeline.span(group.stop - 1)[1]
        if len(heat.timeline) > 1:
            label = clock.span(begin, end)
            frames.append(_map(picture, heat, label, group))
        reporter.progress(_STAGE, done, len(groups))
    size, note = groups[0].stop, ""
    if size > 1:
        text = "The heat map has {n} intervals; each picture shows {size} of them together."
        note = tr(text, n=figure_text(len(heat.timeline)), size=size)
    caption = [
        tr("North is up on the grid of {crs}.", crs=f"{heat.crs.name} ({name_of(heat.crs)[:24]})")
    ]
    if poses:
        caption.append(tr("Triangles: sensors; dashed: their range and opening angle."))
    caption.append(tr("Where tiles overlap, the highest value is on top."))
    if sources:
        caption.append(tr("Sources: {sources}.", sources="; ".join(sources)))
    with mpl.rc_context(FONTS):
        overlay = png(picture.overlay(poses))
        narrow = png(for_a_phone(picture.overlay(poses, NARROW_IN)))
    return MapSeries(
        whole=_map(picture, heat, tr("Whole time")),
        frames=frames,
        overlay=overlay,
        narrow=narrow,
        caption=" ".join(caption),
        note=note,
    )


def _groups(heat: HeatMap) -> list[slice]:
    """Return the intervals as pictures show them: singly, or several at a time where many."""
    total = len(heat.timeline)
    size = -(-total // _MOST_FRAMES)
    return [slice(first, min(first + size, total)) for first in range(0, total, size)]


def _map(picture: MapPicture, heat: HeatMap, label: str, group: slice | None = None) -> Figure:
    sentence = _sentence(heat, group)
    alt = "Map of occupancy, {time}. {text}"
    if heat.measure == "hit_share":
        alt = "Map of radar hits, {time}. {text}"
    return Figure(
        png=png(image_of_pixels(picture.paint(heat.shown(group), heat.uncertain(group)))),
        width=picture.grid.width,
        height=picture.grid.height,
        title=label,
        caption=sentence,
        alt=tr(alt, time=label, text=sentence),
    )


def _sentence(heat: HeatMap, group: slice | None) -> str:
    """Describe a map: the mean of what was seen, and how much was seen and hit or occupied."""
    words = REPORT_WORDS[heat.measure]
    part_s, base_s = part_and_base(heat, group)
    seen, hit = int((base_s > 0).sum()), int((part_s > 0).sum())
    if not seen:
        return tr(words.nothing)
    if not hit:
        return tr(words.none, n=figure_text(seen))
    text = tr(words.touched, share=percent(hit / seen, 0), n=figure_text(seen))
    known = heat.occupancy_shares(group)
    if known is None:
        return text
    mean, error = mean_occupancy(heat.tiles, known)
    return f"{tr('Mean occupancy {share}.', share=percent(mean, error=error))} {text}"


def draw_sights(results: Results) -> list[Figure]:
    """Draw what each sensor sees, side by side."""
    dataset, tiles = results.dataset, SightTiles.of(results.heat.tiles)
    poses = results.poses[:_MOST_SIGHTS]
    sights = [sight_of_tiles(dataset.sight_of(pose.sensor), pose, tiles) for pose in poses]
    picture = _sight_picture(sights, tiles, columns=min(len(sights), 3))
    narrow = _sight_picture(sights, tiles, columns=1)
    how = tr(
        "what stands in the airborne scan hides the tiles behind it"
        if dataset.manifest.settings["sight"] != VIEW_ONLY
        else "without an airborne scan, houses hide nothing here"
    )
    shares = "; ".join(
        tr("{sensor} {n} tiles in sight, {hidden} hidden", sensor=sight.pose.sensor,
           n=figure_text(int((sight.state == IN_SIGHT).sum())),
           hidden=figure_text(int((sight.state == HIDDEN).sum())))
        for sight in sights
    )  # fmt: skip
    return [
        Figure(
            png=png(picture),
            narrow=png(narrow),
            width=picture.width,
            height=picture.height,
            caption=tr("What each sensor sees of the lanes; {how}.", how=how) + f" {shares}.",
            alt=tr("Maps of the tiles in sight of each sensor: {shares}.", shares=shares),
        )
    ]


def _sight_picture(sights: Sequence[Sight], tiles: SightTiles, *, columns: int) -> Image.Image:
    """Return the pictures of what sensors see, in a number of columns."""
    rows = math.ceil(len(sights) / columns)
    with mpl.rc_context(FONTS):
        size_in = (SIGHT_IN * columns, SIGHT_IN * rows)
        figure = MplFigure(figsize=size_in, dpi=150, layout="constrained")
        for number, sight in enumerate(sights, start=1):
            ax = figure.add_subplot(rows, columns, number)
            draw_sight(ax, sight, tiles)
            ax.set_title(sight.pose.sensor, fontsize=9)
            ax.axis("off")
        handles = [
            Patch(color=SIGHT_COLOURS[state], label=tr(SIGHT_NAMES[state])) for state in SIGHT_NAMES
        ]
        figure.legend(
            handles=handles, loc="outside lower center", ncols=min(columns + 1, 3), frameon=False
        )
        return image_of_figure(figure).convert("RGB").quantize(64, dither=Image.Dither.NONE)


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
