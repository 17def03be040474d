"""A heat map as cloud-optimised GeoTIFF: occupancy on 0.5 m pixels, a band an interval.

The centre of a pixel decides in which tiles it lies; of overlapping tiles the highest
occupancy counts, and those that were not observed do not. Pixels are aligned to multiples of
0.5 m of the map's coordinates, and the raster covers the tiles that were ever observed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.windows import Window

from gis_radar.arrays import Floats, Integers
from gis_radar.errors import OutputError
from gis_radar.heatmap.counting import DEFINITIONS, Tally
from gis_radar.progress import Reporter
from gis_radar.steps import iso_from_step
from gis_radar.tiles.lookup import TileGrid
from gis_radar.tiles.tiles import quads

PIXEL_M = 0.5
AT_ONCE = 1_000_000
TILES_AT_ONCE = 50_000
MOST_BLOCK_BYTES = 16_000_000
SMALLEST = 512
CACHE_MB = 256  # GDAL would take a share of the machine's memory
# The mean of the observed pixels: a thin lane stays in sight, and 0 to 1 keeps its meaning.
OVERVIEW = Resampling.average


@dataclass(frozen=True, kw_only=True)
class PixelGrid:
    """Square pixels in blocks, the north-west corner at a multiple of the pixel size.

    Parameters
    ----------
    west, north : int
        The corner, in pixels from the origin of the coordinate system.
    width, height : int
        Pixels.
    block : int
        Side of a block, pixels.
    """

    west: int
    north: int
    width: int
    height: int
    block: int

    @property
    def transform(self) -> Affine:
        """From (column, row) to (easting, northing) of a pixel's north-west corner."""
        west_m, north_m = self.west * PIXEL_M, self.north * PIXEL_M
        return Affine(PIXEL_M, 0.0, west_m, 0.0, -PIXEL_M, north_m)

    @property
    def overviews(self) -> list[int]:
        """Factors by which overviews are smaller, until one fits in a few blocks."""
        side = max(self.width, self.height)
        return [2**i for i in range(1, 32) if side > SMALLEST * 2 ** (i - 1)]

    def centres(self, pixel: Integers) -> tuple[Floats, Floats]:
        """Return easting and northing of the centres of pixels, numbered along the rows."""
        row, column = np.divmod(pixel, self.width)
        return (self.west + column + 0.5) * PIXEL_M, (self.north - row - 0.5) * PIXEL_M

    def block_of(self, pixel: Integers) -> Integers:
        """Return the block of each pixel, numbered along the rows of blocks."""
        row, column = np.divmod(pixel, self.width)
        across = -(-self.width // self.block)
        return np.asarray(row // self.block * across + column // self.block)

    def window(self, block: int) -> Window:
        """Return the pixels of a block."""
        row, column = divmod(block, -(-self.width // self.block))
        top, left = row * self.block, column * self.block
        return Window(
            left, top, min(self.block, self.width - left), min(self.block, self.height - top)
        )


@dataclass(frozen=True, kw_only=True)
class Cover:
    """Which observed tiles each pixel lies in.

    Parameters
    ----------
    pixel : (p,) int64 array
        The pixels that lie in a tile, block by block.
    start : (p,) int64 array
        Where each pixel's tiles begin in `tile`.
    tile : (k,) int64 array
        Positions in the `seen` of the tally.
    """

    pixel: Integers
    start: Integers
    tile: Integers

    def highest(self, values: Floats) -> NDArray[np.float32]:
        """Return for each pixel the highest value of its tiles, NaN where all are NaN."""
        return np.asarray(np.fmax.reduceat(values[self.tile].astype(np.float32), self.start))


def pixel_grid(corners: Floats, bands: int) -> PixelGrid:
    """Return the grid that covers the corners of all tiles.

    Parameters
    ----------
    corners : (n, 4, 2) array
        Metres in the map.
    bands : int
        How many there will be; blocks hold all bands, so more bands make smaller blocks.
    """
    low = np.floor(corners.min(axis=(0, 1)) / PIXEL_M).astype(int)
    high = np.ceil(corners.max(axis=(0, 1)) / PIXEL_M).astype(int)
    width, height = (int(side) for side in np.maximum(high - low, 1))
    sides = (side for side in (512, 256) if side * side * bands * 4 <= MOST_BLOCK_BYTES)
    block = next(sides, 128)
    return PixelGrid(
        west=int(low[0]), north=int(low[1]) + height, width=width, height=height, block=block
    )


def cover(grid: PixelGrid, corners: Floats) -> Cover:
    """Find the tiles that each pixel's centre lies in, by the rule of the assignment of points."""
    engine = TileGrid(corners)
    candidates = _candidates(grid, corners)
    candidates = candidates[np.lexsort((candidates, grid.block_of(candidates)))]
    pixels, tiles = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for done in range(0, len(candidates), AT_ONCE):
        some = candidates[done : done + AT_ONCE]
        point, tile = engine.assign(*grid.centres(some))
        pixels.append(some[point])
        tiles.append(tile)
    pixel = np.concatenate(pixels)
    start = np.flatnonzero(np.diff(pixel, prepend=-1)).astype(np.int64)
    return Cover(pixel=pixel[start], start=start, tile=np.concatenate(tiles))


def _candidates(grid: PixelGrid, corners: Floats) -> Integers:
    """Return the pixels, ascending, that touch the bounding box of any tile."""
    low = np.floor(corners.min(axis=1) / PIXEL_M).astype(np.int64)
    high = np.floor(corners.max(axis=1) / PIXEL_M).astype(np.int64)
    column, row = low[:, 0] - grid.west, grid.north - 1 - high[:, 1]
    wide, tall = (high - low + 1).T
    some = [np.empty(0, np.int64)]
    for tiles in np.array_split(np.arange(len(corners)), -(-len(corners) // TILES_AT_ONCE)):
        size = (wide * tall)[tiles]
        tile = np.repeat(tiles, size)
        place = np.arange(len(tile)) - np.repeat(np.cumsum(size) - size, size)
        down, along = np.divmod(place, wide[tile])
        x, y = column[tile] + along, row[tile] + down
        inside = (x < grid.width) & (y >= 0)
        some.append(np.unique(y[inside] * grid.width + x[inside]))
    return np.unique(np.concatenate(some))


def write_raster(tally: Tally, path: Path, reporter: Reporter) -> None:
    """Write the cloud-optimised GeoTIFF: float32 occupancy, NaN where not observed.

    Parameters
    ----------
    tally : Tally
        What to write.
    path : Path
        The file; a plain GeoTIFF stands beside it while it is built, band by band.
    reporter : Reporter
        Where progress goes.
    """
    corners = quads(tally.tiles)[tally.seen]
    intervals = [None, *tally.columns]
    grid = pixel_grid(corners, len(intervals))
    plain = path.with_suffix(".plain.tif")
    with rasterio.Env(GDAL_CACHEMAX=CACHE_MB, SPARSE_OK_OVERVIEW=True):
        with rasterio.open(plain, "w", **_profile(tally, grid, len(intervals))) as raster:
            _write_bands(raster, tally, grid, corners, intervals, reporter)
        with rasterio.open(plain, "r+") as raster:
            raster.build_overviews(grid.overviews, OVERVIEW)
        rasterio.shutil.copy(plain, path, driver="COG", **_cog_options(grid))
    plain.unlink()
    _check_crs(path)


def _check_crs(path: Path) -> None:
    """Refuse a file whose coordinate system was lost: GDAL only warns where PROJ fails it."""
    with rasterio.open(path) as raster:
        if raster.crs is None or not raster.crs.is_projected:
            raise OutputError(
                f"{path.name}: its coordinate system cannot be written, because the environment "
                "points to a PROJ database of another version",
                hint="unset PROJ_DATA and PROJ_LIB",
            )


def _write_bands(
    raster: Any,
    tally: Tally,
    grid: PixelGrid,
    corners: Floats,
    intervals: list[int | None],
    reporter: Reporter,
) -> None:
    covered = cover(grid, corners)
    for band, interval in enumerate(intervals, start=1):
        values = covered.highest(tally.shares(interval).occupancy[tally.seen])
        _write_band(raster, band, grid, covered.pixel, values)
        raster.set_band_description(band, _description(tally, interval))
        reporter.progress("writing bands", band, len(intervals))
    raster.update_tags(fingerprint=tally.fingerprint, definitions=json.dumps(DEFINITIONS))


def _profile(tally: Tally, grid: PixelGrid, bands: int) -> dict[str, Any]:
    return {
        "driver": "GTiff", "dtype": "float32", "nodata": np.nan, "count": bands,
        "crs": tally.crs.to_wkt(), "transform": grid.transform,
        "width": grid.width, "height": grid.height,
        "tiled": True, "blockxsize": grid.block, "blockysize": grid.block,
        "interleave": "band", "sparse_ok": True, "bigtiff": "if_safer", "compress": "zstd",
    }  # fmt: skip


def _cog_options(grid: PixelGrid) -> dict[str, str]:
    return {
        "COMPRESS": "DEFLATE",
        "PREDICTOR": "YES",
        "BLOCKSIZE": str(grid.block),
        "BIGTIFF": "IF_SAFER",
        "SPARSE_OK": "TRUE",
        "NUM_THREADS": "ALL_CPUS",
    }


def _write_band(
    raster: Any, band: int, grid: PixelGrid, pixel: Integers, values: NDArray[np.float32]
) -> None:
    """Write a band block by block; blocks without a tile stay empty in the file."""
    block = grid.block_of(pixel)
    starts = np.flatnonzero(np.diff(block, prepend=-1))
    for start, stop in zip(starts, [*starts[1:], len(block)], strict=True):
        window = grid.window(int(block[start]))
        row, column = np.divmod(pixel[start:stop], grid.width)
        part = np.full((window.height, window.width), np.nan, np.float32)
        part[row - window.row_off, column - window.col_off] = values[start:stop]
        raster.write(part, band, window=window)


def _description(tally: Tally, interval: int | None) -> str:
    if interval is not None:
        return iso_from_step(int(tally.timeline.begin[interval]))
    return "whole time, {} to {}".format(*tally.times)
