"""What lies over the map: scale, north, the sensors; and the map of the lanes' numbers."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from typing import Any

import geopandas as gpd
import matplotlib as mpl
import matplotlib.patheffects as effects
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from PIL import Image

from gis_radar.arrays import Floats
from gis_radar.heatmap.picture import INK, SETTINGS, SOFT, round_length
from gis_radar.poses.pose import Pose
from gis_radar.report.canvas import PAPER, Canvas
from gis_radar.report.lanes import Lane
from gis_radar.tiles.tiles import quads

WIDTH_IN, PLAN_WIDTH_IN = 8.0, 6.0  # the fewer, the larger the words
SENSOR = "#00519e"
MOST_LABELS = 60
TRIES = (0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9)  # where on a lane its number may stand
LABEL_ROOM = 0.03  # from one number to the next, of the width
# Four tints that neighbours can take in turn, told apart without colour by their numbers.
TINTS = ("#cfe3f5", "#f7dfb2", "#d8ead0", "#ead6ea")
_HALO = [effects.withStroke(linewidth=2.6, foreground="white")]


def overlay_of(canvas: Canvas, poses: Sequence[Pose], scale: float = 1.0) -> Image.Image:
    """Draw scale bar, north arrow and sensors, on nothing, to lie over a picture of the canvas.

    Parameters
    ----------
    canvas : Canvas
        What it lies over.
    poses : sequence of Pose
        Of the sensors, each with its name.
    scale : float
        Pixels for each pixel of the canvas.
    """
    with mpl.rc_context(SETTINGS):
        figure, ax = _axes(canvas, scale)
        for pose in poses:
            _add_sensor(ax, canvas, pose)
        _add_scale(figure, ax, canvas)
        return _image(figure)


def lane_map(
    canvas: Canvas, tiles: gpd.GeoDataFrame, lanes: Sequence[Lane], order: Sequence[int]
) -> Image.Image:
    """Draw the lanes with their numbers and where they lead.

    Parameters
    ----------
    canvas : Canvas
        The piece of the map.
    tiles : GeoDataFrame
        All tiles.
    lanes : sequence of Lane
        All lanes.
    order : sequence of int
        Numbers of lanes; the first ones keep their label where there are too many.
    """
    centres = quads(tiles).mean(axis=1) - (canvas.west, canvas.north)
    size = np.array([canvas.width, -canvas.height]) * canvas.pixel_m
    inside = ((centres / size > 0.0) & (centres / size < 1.0)).all(axis=1)
    shown = [lane for lane in lanes if inside[lane.rows].any()]
    named = set(order[:MOST_LABELS])
    with mpl.rc_context(SETTINGS):
        figure, ax = _axes(canvas, 1.0, PLAN_WIDTH_IN)
        ways = [centres[lane.rows] for lane in shown]
        ax.add_collection(LineCollection(ways, colors=SOFT, linewidths=0.5))
        taken = [size * (1.0, 0.96)]  # where the scale bar stands
        for lane, way in zip(shown, ways, strict=True):
            if inside[lane.rows[-1]]:
                _add_tip(ax, way)
            if lane.number in named:
                _add_number(ax, way, lane.number, size, taken)
        _add_scale(figure, ax, canvas)
        over = _image(figure).convert("RGBA")
    whole = Image.alpha_composite(_tinted(canvas, len(tiles), lanes), over)
    return whole.convert("RGB").quantize(128, dither=Image.Dither.NONE)


def _tinted(canvas: Canvas, tiles: int, lanes: Sequence[Lane]) -> Image.Image:
    """Return the lanes in tints; where they overlap, the shortest is on top."""
    longest_first = sorted(lanes, key=lambda each: -len(each.rows))
    place = np.zeros(tiles, np.int64)
    for i, lane in enumerate(longest_first):
        place[lane.rows] = i
    tint = np.array([lane.number % len(TINTS) for lane in longest_first])
    picture = canvas.ground.copy()  # paper and outline, as on the map
    picture.ravel()[canvas.pixel] = 2 + tint[canvas.top(place)]
    image = Image.fromarray(picture)
    colours = (PAPER, SOFT, *TINTS)
    image.putpalette([part for each in colours for part in bytes.fromhex(each[1:])])
    return image.convert("RGBA")


def _axes(canvas: Canvas, scale: float, width_in: float = WIDTH_IN) -> tuple[Figure, Axes]:
    """Return axes that fill a figure of the canvas's pixels; metres from its north-west corner."""
    dpi = canvas.width * scale / width_in
    figure = Figure(figsize=(width_in, width_in * canvas.height / canvas.width), dpi=dpi)
    FigureCanvasAgg(figure)
    figure.patch.set_alpha(0.0)
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_xlim(0, canvas.width * canvas.pixel_m)
    ax.set_ylim(-canvas.height * canvas.pixel_m, 0)
    ax.axis("off")
    return figure, ax


def _image(figure: Figure) -> Image.Image:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", facecolor=figure.get_facecolor())
    image = Image.open(buffer)
    image.load()
    return image


def _add_sensor(ax: Axes, canvas: Canvas, pose: Pose) -> None:
    origin = np.array([canvas.west, canvas.north])
    outline = np.asarray(pose.outline().exterior.coords) - origin
    ax.add_patch(
        Polygon(
            outline,
            facecolor="none",
            edgecolor=SENSOR,
            linewidth=0.8,
            linestyle=(0, (4, 3)),
            alpha=0.5,
        )
    )
    place = pose.position[:2] - origin
    ahead = pose.R_map_sensor[:2, 0]
    size = 0.017 * canvas.width * canvas.pixel_m
    side = np.array([-ahead[1], ahead[0]])
    tip = [
        place + size * ahead,
        place - size * (0.5 * ahead - 0.6 * side),
        place - size * (0.5 * ahead + 0.6 * side),
    ]
    ax.add_patch(Polygon(tip, facecolor=SENSOR, edgecolor="white", linewidth=1.2, zorder=5))
    ax.annotate(
        pose.sensor, place, xytext=(0, -11), textcoords="offset points", ha="center", va="top",
        fontsize=9, fontweight="bold", color=SENSOR, path_effects=_HALO, zorder=6,
        annotation_clip=True, parse_math=False,
    )  # fmt: skip


def _add_tip(ax: Axes, centres: Floats) -> None:
    """Draw an arrow at a lane's end."""
    if len(centres) < 4:
        return
    look = {"arrowstyle": "-|>", "color": INK, "lw": 0.7, "mutation_scale": 7}
    ax.annotate("", centres[-1], centres[-4], arrowprops=look)


def _add_number(ax: Axes, centres: Floats, number: int, size: Floats, taken: list[Floats]) -> None:
    """Write a lane's number along it, in sight and as far from the others as need be."""
    inside = ((centres / size > 0.02) & (centres / size < 0.98)).all(axis=1)
    places = np.flatnonzero(inside)
    if not len(places):
        return
    tries = places[(np.array(TRIES) * (len(places) - 1)).astype(int)]
    room = np.array([min(np.hypot(*(centres[at] - each)) for each in taken) for at in tries])
    enough = room > LABEL_ROOM * size[0]
    middle = int(tries[int(enough.argmax()) if enough.any() else int(room.argmax())])
    taken.append(centres[middle])
    ahead = centres[min(middle + 2, len(centres) - 1)] - centres[max(middle - 2, 0)]
    turn = (np.degrees(np.arctan2(ahead[1], ahead[0])) + 90.0) % 180.0 - 90.0
    ax.text(
        centres[middle, 0], centres[middle, 1], str(number),
        fontsize=7.5, fontweight="bold", color=INK,
        ha="center", va="center", rotation=turn, path_effects=_HALO, zorder=4,
    )  # fmt: skip


def _add_scale(figure: Figure, ax: Axes, canvas: Canvas) -> None:
    """Draw scale bar and north arrow on a white ground in the lower right corner."""
    width_in = float(figure.get_size_inches()[0])
    inch_m = canvas.width * canvas.pixel_m / width_in
    bar_m = round_length(1.5 * inch_m)
    bar, right, base = bar_m / inch_m, width_in - 0.62, 0.2
    left = right - bar
    inches = figure.dpi_scale_trans
    shape: dict[str, Any] = {"transform": inches, "zorder": 7}
    edge: dict[str, Any] = {"edgecolor": INK, "linewidth": 0.6}
    ax.add_patch(
        Rectangle(
            (left - 0.2, 0.1),
            width_in - 0.1 - left + 0.2,
            0.58,
            facecolor="white",
            alpha=0.9,
            **shape,
        )
    )
    for start, face in ((left, INK), (left + bar / 2, "white")):
        ax.add_patch(Rectangle((start, base), bar / 2, 0.07, facecolor=face, **edge, **shape))
    text: dict[str, Any] = {
        "transform": inches,
        "color": INK,
        "va": "bottom",
        "ha": "center",
        "zorder": 8,
    }
    ax.text(left, base + 0.1, "0", fontsize=8.5, **text)
    ax.text(right, base + 0.1, f"{bar_m:g} m", fontsize=8.5, **text)
    tip = width_in - 0.26
    for side, face in ((-1, INK), (1, "white")):
        corners = [(tip, base + 0.26), (tip + side * 0.08, base), (tip, base + 0.06)]
        ax.add_patch(Polygon(corners, facecolor=face, **edge, **shape))
    ax.text(tip, base + 0.27, "N", fontsize=8, fontweight="bold", **text)


def thumbnail(path: Any, width: int) -> Image.Image | None:
    """Return a picture file, no wider than that, on white; None where it is none."""
    try:
        with Image.open(path) as image:
            image.load()
            whole = image.convert("RGBA")
    except (OSError, ValueError):
        return None
    white = Image.new("RGBA", whole.size, "white")
    flat = Image.alpha_composite(white, whole).convert("RGB")
    flat.thumbnail((width, width * 4))
    return flat
