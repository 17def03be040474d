"""The map of a report as pixels: which tiles each lies in is found once, for all its pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.heatmap import style
from gis_radar.tiles.lookup import TileGrid

LEAST_MARGIN_M = 12.0
MARGIN = 0.05  # of the longer side
FINEST_M = 0.08  # what is finer shows no more
ASPECT = (0.55, 1.25)  # height by width: lowest, which the scale needs, and highest
PAPER, CASING, HATCH = "#ffffff", "#6b737b", "#84898e"
NO_TILE, OUTLINE, UNSEEN, STRIPE, LEVELS = 0, 1, 2, 3, 4
ROWS_AT_ONCE = 256
STRIPES = 7  # pixels from one to the next, at 1000 pixels

Picture = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class Canvas:
    """A north-up map of square pixels.

    Parameters
    ----------
    west, north : float
        Its north-west corner, metres of the map.
    pixel_m : float
        Side of a pixel.
    width, height : int
        Pixels.
    pixel, start : (p,) int64 arrays
        The pixels that lie in a tile, along the rows, and where their tiles begin in `tile`.
    tile : (k,) int64 array
        Positions of tiles.
    ground : (height, width) uint8 array
        The map without any tile: paper, and the road's outline.
    """

    west: float
    north: float
    pixel_m: float
    width: int
    height: int
    pixel: Integers
    start: Integers
    tile: Integers
    ground: Picture

    def paint(self, share: Floats) -> Picture:
        """Return a picture as places in the palette: of overlapping tiles the busiest shows.

        Parameters
        ----------
        share : (n,) array
            Occupancy of all tiles, NaN where not observed: hatched, unlike a 0.
        """
        breaks = [level.upper for level in style.colour_classes()]
        place = np.where(np.isnan(share), UNSEEN, LEVELS + np.searchsorted(breaks, share))
        top = self.top(place.astype(np.uint8))
        row, column = np.divmod(self.pixel, self.width)
        apart = max(4, round(STRIPES * self.width / 1000))
        striped = (top == UNSEEN) & ((row + column) % apart < max(1, apart // 3))
        picture = self.ground.copy()
        picture[row, column] = np.where(striped, STRIPE, top)
        return picture

    def top(self, place: NDArray[Any]) -> NDArray[Any]:
        """Return the highest place, an integer a tile, of the tiles in each of `pixel`."""
        return np.maximum.reduceat(place[self.tile], self.start)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north, metres."""
        east = self.west + self.width * self.pixel_m
        return self.west, east, self.north - self.height * self.pixel_m, self.north


def canvas_of(corners: Floats, shown: Booleans, most_pixels: int) -> Canvas:
    """Lay a canvas over tiles.

    Parameters
    ----------
    corners : (n, 4, 2) array
        Of all tiles, metres.
    shown : (n,) bool array
        The tiles that decide what is in the picture.
    most_pixels : int
        As many it may have.
    """
    inside = corners[shown] if shown.any() else corners
    low, high = inside.min(axis=(0, 1)), inside.max(axis=(0, 1))
    margin = max(LEAST_MARGIN_M, MARGIN * float((high - low).max()))
    size = high - low + 2 * margin
    wide = max(size[0], size[1] / ASPECT[1])
    tall = max(size[1], size[0] * ASPECT[0])
    pixel_m = max(math.sqrt(wide * tall / most_pixels), FINEST_M)
    width, height = int(wide / pixel_m), int(tall / pixel_m)
    middle = (low + high) / 2
    west, north = middle[0] - width * pixel_m / 2, middle[1] + height * pixel_m / 2
    engine = TileGrid(corners)
    x = west + (np.arange(width) + 0.5) * pixel_m
    pixels, tiles = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for rows in np.array_split(np.arange(height), -(-height // ROWS_AT_ONCE)):
        y = north - (rows + 0.5) * pixel_m
        point, tile = engine.assign(np.tile(x, len(rows)), np.repeat(y, width))
        pixels.append(rows[0] * width + point)
        tiles.append(tile)
    every = np.concatenate(pixels)
    start = np.flatnonzero(np.diff(every, prepend=-1)).astype(np.int64)
    pixel = every[start]
    return Canvas(
        west=float(west), north=float(north), pixel_m=pixel_m, width=width, height=height,
        pixel=pixel, start=start, tile=np.concatenate(tiles),
        ground=_ground(pixel, width, height),
    )  # fmt: skip


def _ground(pixel: Integers, width: int, height: int) -> Picture:
    road = np.zeros((height, width), np.bool_)
    road.ravel()[pixel] = True
    around = ndimage.binary_dilation(road, iterations=max(1, round(width / 700)))
    return np.where(around & ~road, OUTLINE, NO_TILE).astype(np.uint8)


def palette() -> list[int]:
    """Return red, green, blue of each place in the palette, one after the other."""
    colours = [
        PAPER,
        CASING,
        style.NOT_OBSERVED,
        HATCH,
        *(each.colour for each in style.colour_classes()),
    ]
    return [part for colour in colours for part in bytes.fromhex(colour.removeprefix("#"))]


def image_of(picture: Picture) -> Image.Image:
    """Return a picture of places in the palette as an image."""
    image = Image.fromarray(picture)
    image.putpalette(palette())
    return image


def png(image: Image.Image) -> bytes:
    """Return an image as PNG."""
    buffer = BytesIO()
    # The highest level takes six times as long and saves a tenth.
    image.save(buffer, "PNG", compress_level=6)
    return buffer.getvalue()
