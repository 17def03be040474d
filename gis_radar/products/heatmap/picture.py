"""Draw the map: tiles as pixels in the colours of all heat maps, scale bar, north arrow, sensors.

The figure of a heat map, plots in notebooks, and the report's pages all show these pictures.
The tiles of each pixel are found once, for all pictures of an extent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation
from matplotlib.transforms import BboxBase
from numpy.typing import NDArray
from PIL import Image

from gis_radar.base import Booleans, Floats, class_label, current_language
from gis_radar.poses import Pose
from gis_radar.products.heatmap import style
from gis_radar.products.heatmap.raster import Cover, PixelGrid, cover

INK, SOFT, _SENSOR = "#1d2126", "#59616a", "#00519e"
PAPER, STRIPE = "#ffffff", "#5c6268"
HALO = [withStroke(linewidth=2.6, foreground="white")]  # white outline of letters on the map

_LEAST_MARGIN_M = 12.0  # around what was observed: sensors stand beside the road
_MARGIN = 0.05  # margin as a share of the longer side, where that is more
_FINEST_M = 0.04  # finest pixel: finer ones show no more of tiles of 0.5 m
# Pixels between stripes in a picture of 1000 pixels: of tiles not observed (visible as stripes on a
# phone, too), and of uncertain ones.
_STRIPES, _HATCHED = 12, 7
OVERLAY_IN = 5.2  # width of the figure over a picture: the narrower, the larger its letters
NOWHERE = np.empty((0, 2))
NARROW_IN, _NARROW_PIXELS = 3.1, 800  # on a phone: a page as wide as this, of so many pixels
_SENSOR_IN = 0.2  # around a sensor's place: its triangle
_BAR_IN, _BAR_SHARE = 1.4, 0.27  # the longest scale bar; in the corner of a map, of its width

# Places in the palette; the classes of hit share follow.
_NO_TILE, _OUTLINE, _UNSEEN, _STRIPED, _HATCH_DARK, _HATCH_LIGHT, _CLASSES = range(7)

_HATCHES = style.hatches()

Pixels = NDArray[np.uint8]
Extent = tuple[Floats, Floats]  # south-west and north-east, metres


@dataclass(frozen=True, kw_only=True, eq=False)
class MapPicture:
    """A north-up picture of tiles, to be painted with any of their values.

    Parameters
    ----------
    grid : PixelGrid
        The pixels.
    cover : Cover
        The tiles of each pixel.
    ground : (height, width) uint8 array
        The picture without tiles, as indices in the palette: paper, and the road's outline.
    """

    grid: PixelGrid
    cover: Cover
    ground: Pixels

    def paint(self, share: Floats, uncertain: Booleans) -> Pixels:
        """Return the picture as indices in the palette; of overlapping tiles the busiest shows.

        Parameters
        ----------
        share : (n,) array
            Share of all tiles; NaN, where not observed, is striped, unlike a 0.
        uncertain : (n,) bool array
            Whether each tile is hatched over its colour.
        """
        breaks = [each.upper for each in style.colour_classes()]
        place = np.where(np.isnan(share), _UNSEEN, _CLASSES + np.searchsorted(breaks, share))
        top = self.cover.highest((2 * place + uncertain).astype(np.uint8))
        top, vague = np.divmod(top, 2)
        row, column = np.divmod(self.cover.pixel, self.grid.width)
        apart, close = (max(4, round(n * self.grid.width / 1000)) for n in (_STRIPES, _HATCHED))
        striped = (top == _UNSEEN) & ((row + column) % apart < max(1, apart // 3))
        hatched = (vague > 0) & ((row - column) % close < max(1, close // 4))
        colours = [_HATCH_DARK if each == style.HATCH_DARK else _HATCH_LIGHT for each in _HATCHES]
        lines = np.array([0] * _CLASSES + colours, np.uint8)[top]
        picture = self.ground.copy()
        picture[row, column] = np.where(striped, _STRIPED, np.where(hatched, lines, top))
        return picture

    def show(
        self, ax: Axes, share: Floats, uncertain: Booleans, *, dots: tuple[int, int] | None = None
    ) -> None:
        """Draw the picture on axes in metres of the map, and set their limits.

        With `dots`, width and height of the axes in pixels, it is resampled to them here:
        matplotlib, which works with floating numbers and masks, takes several times as long.
        """
        colours = np.array(palette(), np.uint8).reshape(-1, 3)[self.paint(share, uncertain)]
        west, east, south, north = self.grid.bounds
        if dots is not None:
            smooth = Image.fromarray(colours).resize(dots, Image.Resampling.HAMMING)
            colours = np.asarray(smooth)
        ax.imshow(
            colours, extent=(west, east, south, north),
            interpolation="auto" if dots is None else "nearest",
        )  # fmt: skip

    def blank(self, width_in: float = OVERLAY_IN) -> tuple[Figure, Axes]:
        """Return a transparent figure of the same pixels, and axes in metres that fill it."""
        width, height = self.grid.width, self.grid.height
        figure = Figure(figsize=(width_in, width_in * height / width), dpi=width / width_in)
        FigureCanvasAgg(figure)
        figure.patch.set_alpha(0.0)
        ax = figure.add_axes((0, 0, 1, 1))
        west, east, south, north = self.grid.bounds
        ax.set(xlim=(west, east), ylim=(south, north))
        ax.axis("off")
        return figure, ax

    def overlay(self, poses: Sequence[Pose], width_in: float = OVERLAY_IN) -> Image.Image:
        """Draw scale bar, north arrow and sensors on a transparent image, for a painted picture.

        Parameters
        ----------
        poses : sequence of Pose
            Poses of the sensors, with their names.
        width_in : float
            Width of the figure, inches: the narrower, the larger its letters.
        """
        figure, ax = self.blank(width_in)
        row, column = np.divmod(self.cover.pixel, self.grid.width)
        north_west = np.array([self.grid.west_m, self.grid.north_m])
        road = north_west + self.grid.pixel_m * np.column_stack([column, -row])
        scale = add_corner_scale(figure, ax, poses, road)
        for pose in poses:
            add_sensor(ax, pose, scale)
        return image_of_figure(figure)


def map_extent(corners: Floats, shown: Booleans, aspect: tuple[float, float]) -> Extent:
    """Return the extent of a map of the tiles to show, with a margin.

    Parameters
    ----------
    corners : (n, 4, 2) array
        Corners of all tiles, metres.
    shown : (n,) bool array
        Tiles that must be in the picture; where there is none, all are.
    aspect : (lowest, highest)
        Limits of height over width.
    """
    inside = corners[shown] if shown.any() else corners
    low, high = inside.min(axis=(0, 1)), inside.max(axis=(0, 1))
    width, height = high - low + 2 * max(_LEAST_MARGIN_M, _MARGIN * float((high - low).max()))
    size = np.array([max(width, height / aspect[1]), max(height, width * aspect[0])])
    return (low + high - size) / 2, (low + high + size) / 2


def map_picture(corners: Floats, extent: Extent, most_pixels: int) -> MapPicture:
    """Make the picture of tiles in an extent.

    Parameters
    ----------
    corners : (n, 4, 2) array
        Corners of all tiles, metres.
    extent : (south-west, north-east)
        Extent of the picture, metres.
    most_pixels : int
        Largest number of pixels.
    """
    low, high = extent
    wide, tall = high - low
    pixel_m = max(math.sqrt(wide * tall / most_pixels), _FINEST_M)
    width, height = max(1, int(wide / pixel_m)), max(1, int(tall / pixel_m))
    west, north = (low + high) / 2 + np.array([-width, height]) * pixel_m / 2
    grid = PixelGrid(
        west_m=float(west), north_m=float(north), pixel_m=pixel_m, width=width, height=height
    )
    tiles_of_pixels = cover(grid, corners)
    road = np.zeros((height, width), np.bool_)
    road.ravel()[tiles_of_pixels.pixel] = True
    around = scipy.ndimage.binary_dilation(road, iterations=max(1, round(width / 700)))
    ground = np.where(around & ~road, _OUTLINE, _NO_TILE).astype(np.uint8)
    return MapPicture(grid=grid, cover=tiles_of_pixels, ground=ground)


def legend_in_words(measure: str) -> list[tuple[str, str]]:
    """Return colours with their labels in the current language, as the legend lists them."""
    language = current_language()
    return [(colour, class_label(label, language)) for colour, label in style.legend(measure)]


def palette() -> list[int]:
    """Return red, green, blue of each index in the palette, one after the other."""
    classes = [each.colour for each in style.colour_classes()]
    hatches = style.HATCH_DARK, style.HATCH_LIGHT
    return rgb(PAPER, SOFT, style.NOT_OBSERVED, STRIPE, *hatches, *classes)


def rgb(*colours: str) -> list[int]:
    """Return red, green, blue of colours such as `#1d2126`, one after the other."""
    return [part for colour in colours for part in bytes.fromhex(colour.removeprefix("#"))]


def image_of_pixels(pixels: Pixels, colours: Sequence[int] | None = None) -> Image.Image:
    """Return an image of indices in the palette, or in another one."""
    image = Image.fromarray(pixels)
    image.putpalette(palette() if colours is None else colours)
    return image


def image_of_figure(figure: Figure) -> Image.Image:
    """Return a figure as an image."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba()))


def png(image: Image.Image) -> bytes:
    """Return an image as PNG."""
    buffer = BytesIO()
    # The highest level takes six times as long and saves a tenth.
    image.save(buffer, "PNG", compress_level=6)
    return buffer.getvalue()


def for_a_phone(image: Image.Image) -> Image.Image:
    """Return a picture no wider than a phone's screen."""
    narrow = image.copy()
    narrow.thumbnail((_NARROW_PIXELS, 4 * _NARROW_PIXELS), Image.Resampling.LANCZOS)
    return narrow


def round_length(longest_m: float) -> float:
    """Return the longest length of 1, 2 or 5 times a power of ten that is not over `longest_m`."""
    power = 10.0 ** math.floor(math.log10(longest_m))
    return max(factor * power for factor in (1, 2, 5) if factor * power <= longest_m * (1 + 1e-9))


def add_scale_bar(
    figure: Figure, corner_in: tuple[float, float], metre_in: float, longest_in: float = _BAR_IN
) -> None:
    """Draw a scale bar and a north arrow.

    Parameters
    ----------
    figure : Figure
        Figure to draw on.
    corner_in : (right, base)
        Right end and lower edge of both, inches.
    metre_in : float
        Inches on paper of a metre of the map.
    longest_in : float
        Longest length of the bar, inches.
    """
    tip, base = corner_in[0] - 0.1, corner_in[1]
    right = corner_in[0] - 0.5
    bar_m = round_length(longest_in / metre_in)
    bar_in = bar_m * metre_in
    left = right - bar_in
    inches = figure.dpi_scale_trans
    look: dict[str, Any] = {
        "transform": inches, "edgecolor": INK, "linewidth": 0.6, "zorder": 7,
    }  # fmt: skip
    for start, face in ((left, INK), (left + bar_in / 2, "white")):
        figure.add_artist(Rectangle((start, base), bar_in / 2, 0.06, facecolor=face, **look))
    for side, face in ((-1, INK), (1, "white")):
        corners = [(tip, base + 0.24), (tip + side * 0.07, base), (tip, base + 0.05)]
        figure.add_artist(Polygon(corners, facecolor=face, **look))
    text: dict[str, Any] = {
        "transform": inches, "color": INK, "va": "bottom", "ha": "center", "zorder": 8,
    }  # fmt: skip
    figure.text(left, base + 0.11, "0", fontsize=8, **text)
    figure.text(right, base + 0.11, f"{bar_m:g} m", fontsize=8, **text)
    figure.text(tip, base + 0.27, "N", fontsize=7, fontweight="bold", **text)


def add_corner_scale(
    figure: Figure, ax: Axes, poses: Sequence[Pose] = (), road: Floats = NOWHERE
) -> BboxBase:
    """Draw scale bar and north arrow on white in a lower corner; return their box, px.

    It is the corner without a sensor, else the one with fewer points of the road (n, 2), m, else
    the right one.
    """
    width_in = float(figure.get_size_inches()[0])
    west, east = ax.get_xlim()
    metre_in = width_in / (east - west)
    longest_in = min(_BAR_IN, _BAR_SHARE * width_in)
    room_in = round_length(longest_in / metre_in) * metre_in + 0.76
    low = np.array([west, ax.get_ylim()[0]])
    stand = np.array([each.position[:2] for each in poses]).reshape(-1, 2)

    def within(left: float, places: Floats, around: float) -> int:
        along, up = ((places - low) * metre_in).T
        beside = (along > left - around) & (along < left + room_in + around)
        return int(np.count_nonzero(beside & (up < 0.66 + around)))

    def taken(left: float) -> tuple[bool, int]:
        return within(left, stand, _SENSOR_IN) > 0, within(left, road, 0.0)

    left = min(width_in - 0.1 - room_in, 0.1, key=taken)
    add_scale_bar(figure, (left + room_in - 0.06, 0.2), metre_in, longest_in)
    ground = Rectangle(
        (left, 0.1), room_in, 0.56, transform=figure.dpi_scale_trans, facecolor="white", alpha=0.9,
        zorder=6,
    )  # fmt: skip
    figure.add_artist(ground)
    return ground.get_window_extent()


def add_sensor(ax: Axes, pose: Pose, taken: BboxBase) -> None:
    """Draw the outline of a sensor's view, a triangle that points ahead, and its name.

    Parameters
    ----------
    ax : Axes
        A map in metres, with its limits set.
    pose : Pose
        The sensor's, in the map's coordinate system.
    taken : BboxBase
        Box, in pixels of the figure, that the name must not cover.
    """
    rim = np.asarray(pose.outline().exterior.coords)
    dashed: dict[str, Any] = {"linewidth": 0.8, "linestyle": (0, (4, 3)), "alpha": 0.5}
    ax.add_patch(Polygon(rim, facecolor="none", edgecolor=_SENSOR, **dashed))
    place, ahead = pose.position[:2], pose.R_map_sensor[:2, 0]
    west, east = ax.get_xlim()
    size_m, side = 0.017 * (east - west), np.array([-ahead[1], ahead[0]])
    triangle = place + size_m * np.array(
        [ahead, -0.5 * ahead + 0.6 * side, -0.5 * ahead - 0.6 * side]
    )
    ax.add_patch(Polygon(triangle, facecolor=_SENSOR, edgecolor="white", linewidth=1.2, zorder=5))
    name = ax.annotate(
        pose.sensor, (place[0], place[1]), xytext=(0, -11), textcoords="offset points",
        ha="center", va="top", fontsize=9, fontweight="bold", color=_SENSOR, zorder=9,
        path_effects=HALO, annotation_clip=True, parse_math=False,
    )  # fmt: skip
    _keep_inside(ax, name, taken)


def _keep_inside(ax: Axes, name: Annotation, taken: BboxBase) -> None:
    """Move a name that the map's edge would cut; if there is no room, above its sensor."""
    box, frame, dot = name.get_window_extent(), ax.get_window_extent(), ax.figure.dpi / 72.0
    x, y = name.xyann
    x += max(frame.x0 - box.x0, 0.0) / dot - max(box.x1 - frame.x1, 0.0) / dot
    if box.y0 < frame.y0 or box.overlaps(taken):
        y = 11.0
        name.set_verticalalignment("bottom")
    name.xyann = (x, y)
