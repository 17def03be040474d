"""Draw the pictures of a report: the map by interval, the lanes' numbers, how poses were found."""

from __future__ import annotations

import math
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure as MplFigure
from matplotlib.patches import Patch
from PIL import Image

from gis_radar.base import FONTS, Clock, Floats, Reporter, figure_text, name_of, percent, tr
from gis_radar.hdmap import quads
from gis_radar.measures import sight_of_tiles
from gis_radar.products.heatmap.heatmap import HeatMap
from gis_radar.products.heatmap.occupancy import mean_occupancy
from gis_radar.products.heatmap.picture import (
    NARROW_IN,
    Extent,
    MapPicture,
    for_a_phone,
    image_of_figure,
    image_of_pixels,
    map_extent,
    map_picture,
    png,
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
