"""From occupancy to heat map: the table of tiles, and the files that other programs open."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import geopandas as gpd
import numpy as np
from pyogrio.errors import DataSourceError
from rasterio.errors import RasterioError

from gis_radar.clock import interval_steps, iso_from_step, seconds_from_iso, step_of, zone_of
from gis_radar.crs import metric_crs
from gis_radar.errors import InputError, OutputError, UsageError
from gis_radar.heatmap.calendar import follows_utc, local_intervals
from gis_radar.heatmap.geopackage import write_geopackage
from gis_radar.heatmap.layers import long_layer, wide_layer
from gis_radar.heatmap.measure import count_hits, frame_runs, observe
from gis_radar.heatmap.picture import draw, write_picture
from gis_radar.heatmap.raster import write_raster
from gis_radar.heatmap.style import sidecar_qml
from gis_radar.heatmap.table import write_table
from gis_radar.heatmap.tally import MOST_COLUMNS, Tally
from gis_radar.heatmap.timeline import (
    Timeline,
    aligned,
    aligned_with,
    intervals_with,
    those_with,
)
from gis_radar.occupancy import Occupancy
from gis_radar.occupancy.runs import Runs
from gis_radar.outputs import whole_folder
from gis_radar.progress import QUIET, Reporter
from gis_radar.tiles import COLUMNS, fingerprint

MOST_ROWS = 100_000_000  # of the long layer: about 35 GB of GeoPackage


class HeatMap(Tally):
    """How long each tile was occupied, of the time it was observed.

    Made by :func:`make_heatmap`; what it holds is described at :class:`Tally`.
    """

    def wide(self) -> gpd.GeoDataFrame:
        """Return one row a tile; see :func:`wide_layer`."""
        return wide_layer(self)

    def long(self) -> gpd.GeoDataFrame:
        """Return one row a tile and interval; see :func:`long_layer`."""
        return long_layer(self)

    def plot(self, ax: Any = None) -> Any:
        """Draw the occupancy over the whole time.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to draw; without it, on a new figure.

        Returns
        -------
        matplotlib Axes
        """
        return draw(self, ax)

    def write(self, folder: str | Path, reporter: Reporter = QUIET) -> list[Path]:
        """Write `heatmap.gpkg`, `heatmap.tif`, `heatmap.parquet`, `heatmap.png`.

        Beside them `heatmap.qml` lets QGIS show the GeoTIFF and the table in the same colours.

        Parameters
        ----------
        folder : path
            Where; an earlier heat map there is replaced as a whole.
        reporter : Reporter
            Where progress goes.

        Returns
        -------
        list of Path
            The files.

        Raises
        ------
        OutputError
            If the folder cannot be written or holds other files.
        """
        folder = Path(folder)
        writers = {
            "heatmap.gpkg": write_geopackage,
            "heatmap.tif": write_raster,
            "heatmap.parquet": write_table,
            "heatmap.png": write_picture,
            "heatmap.qml": _write_style,
        }
        with whole_folder(folder, owned=("heatmap",)) as fresh:
            for name, write in writers.items():
                try:
                    write(self, fresh / name, reporter)
                except (OSError, sqlite3.Error, DataSourceError, RasterioError) as error:
                    raise OutputError(f"{folder / name}: cannot be written: {error}") from error
        return [folder / name for name in writers]


def make_heatmap(
    occupancy: Occupancy,
    tiles: gpd.GeoDataFrame,
    *,
    interval: str | None = None,
    at: str | None = None,
    timezone: str | None = None,
    reporter: Reporter = QUIET,
) -> HeatMap:
    """Make the heat map of all tiles (the paper's section "Global Occupancy Heat Map").

    A tile's occupancy is the share of the steps in which it was observed that it was also
    occupied in. Only hits in steps in which the tile was observed count.

    Parameters
    ----------
    occupancy : Occupancy
        Hits, frames and views of any number of sensors.
    tiles : GeoDataFrame
        The tiles of the same map.
    interval : str, optional
        Length of intervals such as `15min`; they begin at multiples of it since the UNIX epoch.
    timezone : str, optional
        Whose hours and days intervals follow, such as Europe/Berlin; all output stays in UTC.
    at : str, optional
        ISO 8601 time: the map of the one step that contains it, instead of the whole time.
    reporter : Reporter
        Where progress and remarks go.

    Returns
    -------
    HeatMap

    Raises
    ------
    UsageError
        If `interval` is no duration, stands beside `at`, or is too short for this much data;
        if there is no such time zone, or it stands without `interval`.
    CrsError
        If the tiles' coordinate system is not a projected one in metres.
    InputError
        If there is no frame, no tile in view, or the tiles are not those of the occupancy.
    """
    if at is not None and interval is not None:
        raise UsageError("at and interval do not go together", hint="give one of them")
    if timezone is not None and interval is None:
        raise UsageError("a timezone needs an interval", hint="such as 1h or 1d")
    zone = None if timezone is None else zone_of(timezone)
    tiles = _checked(tiles, occupancy.fingerprint)
    tile_ids = tiles["tile_id"].to_numpy(np.int64)
    runs = frame_runs(occupancy)
    whole = _whole(runs, at)
    observation = observe(occupancy, tile_ids)
    timeline = whole
    if interval is not None:
        timeline = _intervals(runs, interval, zone, len(tiles), reporter)
    occupied = count_hits(occupancy, observation, timeline, tile_ids, reporter)
    return HeatMap(
        tiles=tiles,
        fingerprint=occupancy.fingerprint,
        sensors=tuple(sorted(map(str, occupancy.frames["sensor"].unique()))),
        whole=whole,
        timeline=timeline,
        seen=observation.seen,
        group=observation.group,
        occupied=occupied,
        observed=np.stack([timeline.counts(each) for each in observation.runs], axis=1),
    )


def _write_style(_tally: Tally, path: Path, _reporter: Reporter) -> None:
    path.write_text(sidecar_qml(), encoding="utf-8")


def _checked(tiles: gpd.GeoDataFrame, wanted: str) -> gpd.GeoDataFrame:
    missing = [name for name in COLUMNS if name not in tiles]
    if missing:
        raise InputError(f"the tiles lack the column(s) {', '.join(missing)}")
    metric_crs(tiles.crs, what="tiles")
    got = fingerprint(tiles)
    if got != wanted:
        raise InputError(
            f"the tiles have the fingerprint {got}, the occupancy was made with {wanted}",
            hint="use the tiles that the occupancy was made with",
        )
    attributes = tiles[list(COLUMNS)].reset_index(drop=True)
    shapes = tiles.geometry.reset_index(drop=True)
    return gpd.GeoDataFrame(attributes, geometry=shapes, crs=tiles.crs)


def _whole(runs: Runs, at: str | None) -> Timeline:
    """Return the whole time, or the step that contains `at`, as one interval."""
    first, last = int(runs.first[0]), int(runs.last[-1])
    if at is not None:
        moment = _moment(at)
        first = last = int(step_of(np.array([moment]))[0])
        nearest = runs.nearest(first)
        if nearest != first:
            raise InputError(
                f"no sensor delivered a frame at {at}, in the step from {iso_from_step(first)}",
                hint=f"the nearest step with a frame begins at {iso_from_step(nearest)}",
            )
    return Timeline(begin=np.array([first]), end=np.array([last + 1]))


def _moment(at: str) -> float:
    try:
        return seconds_from_iso(at, what="at")
    except InputError as error:
        raise UsageError(error.message, hint=error.hint) from error


def _intervals(
    runs: Runs, interval: str, zone: ZoneInfo | None, tiles: int, reporter: Reporter
) -> Timeline:
    """Return the intervals; where there are very many, only those with a frame."""
    steps = interval_steps(interval)
    first, last = int(runs.first[0]), int(runs.last[-1])
    local = None
    if zone is not None and not follows_utc(steps):
        local = local_intervals(first, last, steps, zone)
    count = last // steps - first // steps + 1 if local is None else len(local)
    if count <= MOST_COLUMNS:
        return aligned(first, last, steps) if local is None else local
    kept = None if local is None else those_with(local, runs)
    filled = intervals_with(runs, steps) if kept is None else len(kept)
    if filled * tiles > MOST_ROWS:
        raise UsageError(
            f"{filled} intervals of {interval} for {tiles} tiles are more than a heat map can hold",
            hint="use a longer interval",
        )
    said = f"only the {filled} intervals in which a sensor delivered a frame are kept"
    if filled > MOST_COLUMNS:
        said += (
            f"; more than {MOST_COLUMNS}, so they are rows of occupancy_by_interval, "
            "not columns and bands"
        )
    reporter.log(said)
    return aligned_with(runs, steps) if kept is None else kept
