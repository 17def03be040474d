"""Heat maps on pixels: the tiles of each pixel, and the cloud-optimised GeoTIFF.

The centre of a pixel decides in which tiles it is; of overlapping tiles the highest
hit share counts, and those that were not observed do not. The GeoTIFF has pixels of 0.5 m,
aligned to multiples of 0.5 m of the map's coordinates, and a band an interval; it covers the
tiles that were ever observed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.transform import Affine

from gis_radar.base import CELL_M, Floats, Integers, OutputError, Reporter, iso_from_step, ranges
from gis_radar.hdmap import TileGrid, quads
from gis_radar.measures import Runs, union_of_runs
from gis_radar.products.heatmap.counting import Tally

_PIXEL_M = CELL_M  # side of a pixel: the length of a tile, so that none is skipped
_POINTS_AT_ONCE = 1_000_000  # pixels looked up together: 50 MB
_MOST_BLOCK_BYTES = 16_000_000  # most bytes of all bands of a block, which GDAL holds at once
_SMALLEST = 512  # pixels: the smallest overview fits in a few blocks
_CACHE_MB = 256  # cache of GDAL, which else takes a share of the machine's memory
# Overviews are means of the observed pixels: thin lanes stay visible, and values are still shares.
_OVERVIEW = Resampling.average


@dataclass(frozen=True, kw_only=True)
class PixelGrid:
    """Square pixels, north up, numbered along the rows.

    Parameters
    ----------
    west_m, north_m : float
        North-west corner, metres of the map.
    pixel_m : float
        Side of a pixel, metres.
    width, height : int
        Number of pixels along both sides.
    """

    west_m: float
    north_m: float
    pixel_m: float
    width: int
    height: int

    @property
    def transform(self) -> Affine:
        """From (column, row) to (easting, northing) of a pixel's north-west corner."""
        return Affine(self.pixel_m, 0.0, self.west_m, 0.0, -self.pixel_m, self.north_m)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, east, south, north, metres."""
        east_m = self.west_m + self.width * self.pixel_m
        return self.west_m, east_m, self.north_m - self.height * self.pixel_m, self.north_m

    def centres(self, pixel: Integers) -> tuple[Floats, Floats]:
        """Return easting and northing of the centres of pixels."""
        row, column = np.divmod(pixel, self.width)
        return (
            self.west_m + (column + 0.5) * self.pixel_m,
            self.north_m - (row + 0.5) * self.pixel_m,
        )

    def touched(self, corners: Floats) -> Integers:
        """Return the pixels, ascending, that touch the bounding box of any of (n, 4, 2) tiles."""
        west_north = np.array([self.west_m, self.north_m])
        edges = [corners.min(axis=1), corners.max(axis=1)]
        (west, south), (east, north) = (
            np.floor((edge - west_north) / (self.pixel_m, -self.pixel_m)).astype(np.int64).T
            for edge in edges
        )
        west, north = np.maximum(west, 0), np.maximum(north, 0)
        wide = np.minimum(east, self.width - 1) - west + 1
        tall = np.minimum(south, self.height - 1) - north + 1
        tall = np.where(wide > 0, np.maximum(tall, 0), 0)
        # A box is a run of pixels in each of its rows.
        first = ranges(north, tall) * self.width + np.repeat(west, tall)
        rows = union_of_runs([Runs(first=first, last=first + np.repeat(wide, tall) - 1)])
        return ranges(rows.first, rows.last - rows.first + 1)


@dataclass(frozen=True, kw_only=True)
class Cover:
    """The tiles of each pixel of a grid.

    Parameters
    ----------
    pixel : (p,) int64 array
        The pixels in a tile, ascending.
    start : (p,) int64 array
        Index in `tile` of each pixel's first tile.
    tile : (k,) int64 array
        Positions of tiles.
    """

    pixel: Integers
    start: Integers
    tile: Integers

    def highest(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return for each pixel the highest value of its tiles, NaN where all are NaN."""
        return np.asarray(np.fmax.reduceat(values[self.tile], self.start))


def cover(grid: PixelGrid, corners: Floats) -> Cover:
    """Find the tiles that hold each pixel's centre, by the rule of the assignment of points.

    Parameters
    ----------
    grid : PixelGrid
        The pixels.
    corners : (n, 4, 2) array
        Corners of the tiles, metres in the map.
    """
    engine = TileGrid(corners)
    candidates = grid.touched(corners)
    pixels, tiles = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for done in range(0, len(candidates), _POINTS_AT_ONCE):
        some = candidates[done : done + _POINTS_AT_ONCE]
        point, tile = engine.assign(*grid.centres(some))
        pixels.append(some[point])
        tiles.append(tile)
    pixel = np.concatenate(pixels)
    start = np.flatnonzero(np.diff(pixel, prepend=-1)).astype(np.int64)
    return Cover(pixel=pixel[start], start=start, tile=np.concatenate(tiles))


def aligned_grid(corners: Floats) -> PixelGrid:
    """Return the grid of the GeoTIFF, which covers the corners of all tiles."""
    low = np.floor(corners.min(axis=(0, 1)) / _PIXEL_M).astype(int)
    high = np.ceil(corners.max(axis=(0, 1)) / _PIXEL_M).astype(int)
    width, height = (int(side) for side in np.maximum(high - low, 1))
    return PixelGrid(
        west_m=int(low[0]) * _PIXEL_M, north_m=(int(low[1]) + height) * _PIXEL_M, pixel_m=_PIXEL_M,
        width=width, height=height,
    )  # fmt: skip


def write_raster(
    tally: Tally, path: Path, reporter: Reporter, *, measure: str | None = None
) -> None:
    """Write the cloud-optimised GeoTIFF: float32 shares, NaN where not observed or visible.

    A plain GeoTIFF stands beside it while it is built, band by band.

    Parameters
    ----------
    tally : Tally
        The counts of the heat map.
    path : Path
        The file.
    reporter : Reporter
        Receives progress.
    measure : str, optional
        As for :meth:`Tally.shown`; by default the tally's measure.
    """
    corners = quads(tally.tiles)[tally.seen]
    intervals = [None, *tally.columns]
    grid = aligned_grid(corners)
    # A block holds all bands, so more bands make smaller blocks.
    fitting = (side for side in (512, 256) if side**2 * len(intervals) * 4 <= _MOST_BLOCK_BYTES)
    side = next(fitting, 128)
    plain_profile = {
        "driver": "GTiff", "dtype": "float32", "nodata": np.nan, "count": len(intervals),
        "crs": tally.crs.to_wkt(), "transform": grid.transform,
        "width": grid.width, "height": grid.height,
        "tiled": True, "blockxsize": side, "blockysize": side,
        "interleave": "band", "sparse_ok": True, "bigtiff": "if_safer", "compress": "zstd",
    }  # fmt: skip
    longer = max(grid.width, grid.height)
    overviews = [2**i for i in range(1, 32) if longer > _SMALLEST * 2 ** (i - 1)]
    plain = path.with_suffix(".plain.tif")
    with rasterio.Env(GDAL_CACHEMAX=_CACHE_MB, SPARSE_OK_OVERVIEW=True):
        with rasterio.open(plain, "w", **plain_profile) as raster:
            _write_bands(raster, tally, cover(grid, corners), measure, reporter)
        with rasterio.open(plain, "r+") as raster:
            raster.build_overviews(overviews, _OVERVIEW)
        rasterio.shutil.copy(
            plain, path, driver="COG", COMPRESS="DEFLATE", PREDICTOR="YES", BLOCKSIZE=str(side),
            BIGTIFF="IF_SAFER", SPARSE_OK="TRUE", NUM_THREADS="ALL_CPUS",
            OVERVIEWS="FORCE_USE_EXISTING",  # GDAL's own are cubic, and take 20 s for 280 bands
        )  # fmt: skip
    plain.unlink()
    _check_crs(path)


def _check_crs(path: Path) -> None:
    """Refuse a file whose coordinate system was lost, as GDAL only warns if PROJ fails."""
    with rasterio.open(path) as raster:
        if raster.crs is None or not raster.crs.is_projected:
            raise OutputError(
                "{}: its coordinate system cannot be written, because the environment "
                "points to a PROJ database of another version",
                path.name,
                hint="unset PROJ_DATA and PROJ_LIB",
            )


def _write_bands(
    raster: Any, tally: Tally, occupied: Cover, measure: str | None, reporter: Reporter
) -> None:
    """Write the whole time and each interval, block by block; empty blocks stay out of the file."""
    row, column = np.divmod(occupied.pixel, raster.width)
    down, across = row // raster.profile["blockysize"], column // raster.profile["blockxsize"]
    order = np.lexsort((across, down))
    row, column, down, across = (each[order] for each in (row, column, down, across))
    starts = np.flatnonzero(np.diff(down, prepend=-1) | np.diff(across, prepend=-1))
    intervals = [None, *tally.columns]
    for band, interval in enumerate(intervals, start=1):
        share = tally.shown(interval, measure)[tally.seen].astype(np.float32)
        values = occupied.highest(share)[order]
        for start, stop in pairwise([*starts.tolist(), len(order)]):
            window = raster.block_window(band, down[start], across[start])
            part = np.full((window.height, window.width), np.nan, np.float32)
            place = row[start:stop] - window.row_off, column[start:stop] - window.col_off
            part[place] = values[start:stop]
            raster.write(part, band, window=window)
        if interval is None:
            about = "whole time, {} to {}".format(*tally.whole_iso)
        else:
            about = iso_from_step(int(tally.timeline.begin[interval]))
        raster.set_band_description(band, about)
        reporter.progress("writing bands", band, len(intervals))
    raster.update_tags(fingerprint=tally.fingerprint, definitions=json.dumps(tally.definitions))
