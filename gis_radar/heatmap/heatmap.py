"""From occupancy to heat map: the table of tiles, and the files that other programs open."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyogrio
from pyogrio.errors import DataLayerError, DataSourceError
from rasterio.errors import RasterioError

from gis_radar.arrays import Integers
from gis_radar.errors import InputError, OutputError, UsageError
from gis_radar.files import whole_folder
from gis_radar.heatmap.counting import Counts, Tally, checked, count_hits, frame_runs, observe
from gis_radar.heatmap.figure import SMALL_PIXELS, draw, explore, write_figure
from gis_radar.heatmap.intervals import Timeline, intervals_of, whole_of
from gis_radar.heatmap.layers import (
    BEGIN,
    END,
    LONG,
    WIDE,
    long_layer,
    wide_layer,
    write_package,
    write_table,
)
from gis_radar.heatmap.raster import write_raster
from gis_radar.heatmap.series import MOST_MIB, dataset
from gis_radar.heatmap.style import sidecar_qml
from gis_radar.notebooks import card, small_picture
from gis_radar.occupancy import Occupancy
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import STEPS_PER_SECOND, seconds_from_iso, step_of, zone_of
from gis_radar.tiles.tiles import COLUMNS, fingerprint

PAGE, PAPER = "report.html", "report.pdf"
LANES, LANES_BY_INTERVAL = "lanes.csv", "lanes_by_interval.csv"
SENSORS, QUALITY = "sensors.csv", "quality.csv"
REPORT_FILES = (PAGE, PAPER, LANES, LANES_BY_INTERVAL, SENSORS, QUALITY)


MOST_DRAWN = 60_000  # tiles in the small picture of a notebook
# A report of it may stand there; it goes when the heat map does.
OWNED = ("heatmap.", *REPORT_FILES)


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

    def plot(self, ax: Any = None, *, interval: int | None = None, legend: bool = True) -> Any:
        """Draw the occupancy of the tiles in the classes and colours of all heat maps.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to draw; without it, on a new figure.
        interval : int, optional
            Which interval, from 0, negative from the end; without it, the whole time.
        legend : bool
            Whether the classes stand beside it.

        Returns
        -------
        matplotlib Axes

        Raises
        ------
        UsageError
            If there is no such interval.
        """
        if interval is not None:
            interval = self._known(interval)
        return draw(self, ax, interval=interval, legend=legend)

    def explore(self, *, interval: int | None = None, **options: Any) -> Any:
        """Show the observed tiles on a map to move about in (folium, extra `notebooks`).

        Parameters
        ----------
        interval : int, optional
            Which interval, as for :meth:`plot`; without it, the whole time.
        **options
            For :meth:`geopandas.GeoDataFrame.explore`; with `tiles=None` nothing is loaded from
            a map server.

        Returns
        -------
        folium.Map

        Raises
        ------
        UsageError
            If there is no such interval.
        InputError
            If folium is not installed.
        """
        return explore(self, None if interval is None else self._known(interval), options)

    def to_xarray(self, *, most_mib: float = MOST_MIB) -> Any:
        """Return the occupancy over (tile, time) as an xarray Dataset; see :func:`dataset`.

        Raises
        ------
        UsageError
            If it would take more than `most_mib` of memory; :func:`gis_radar.to_xarray` cuts out
            times and tiles before it counts.
        InputError
            If xarray is not installed.
        """
        return dataset(self, most_mib=most_mib)

    def _known(self, interval: int) -> int:
        count = len(self.timeline)
        if not -count <= interval < count:
            raise UsageError(f"interval {interval} of {count}", hint=f"from 0 to {count - 1}")
        return interval % count

    def _repr_html_(self) -> str:
        def small(ax: Any) -> None:
            draw(self, ax, legend=False, most_pixels=SMALL_PIXELS).set_axis_off()

        few = len(self.seen) <= MOST_DRAWN
        return card("Heat map", self.figures(), picture=small_picture(small) if few else b"")

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
            "heatmap.gpkg": write_package,
            "heatmap.tif": write_raster,
            "heatmap.parquet": write_table,
            "heatmap.png": write_figure,
            "heatmap.qml": _write_style,
        }
        with whole_folder(folder, owned=OWNED) as fresh:
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

    Examples
    --------
    >>> import gis_radar as gr
    >>> sample = gr.sample_folder()
    >>> tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    >>> pose = gr.read_pose(sample / "R1.json")
    >>> occupancy = gr.measure_occupancy([sample / "R1.parquet"], [pose], tiles, "occupancy")
    >>> heat = gr.make_heatmap(occupancy, tiles, interval="20s").wide()
    >>> seen = heat[heat["observed_s"] > 0]
    >>> bool(seen["occupancy"].between(0, 1).all())
    True
    """
    if at is not None and interval is not None:
        raise UsageError("at and interval do not go together", hint="give one of them")
    if timezone is not None and interval is None:
        raise UsageError("a timezone needs an interval", hint="such as 1h or 1d")
    zone = None if timezone is None else zone_of(timezone)
    tiles = checked(tiles, occupancy.fingerprint)
    tile_ids = tiles["tile_id"].to_numpy(np.int64)
    runs = frame_runs(occupancy)
    whole = whole_of(runs, at)
    observation = observe(occupancy, tile_ids)
    timeline = whole
    if interval is not None:
        timeline = intervals_of(runs, interval, zone, len(tiles), reporter)
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


FILE = "heatmap.gpkg"
_HINT = "make one with: gis-radar heatmap"
# From one begin to the next by their index: a scan of all rows would take seconds.
_TIMES = f"""
    WITH RECURSIVE times(moment) AS (
        SELECT min("{BEGIN}") FROM "{LONG}"
        UNION ALL
        SELECT (SELECT min("{BEGIN}") FROM "{LONG}" WHERE "{BEGIN}" > moment)
        FROM times WHERE moment IS NOT NULL
    )
    SELECT moment, (SELECT "{END}" FROM "{LONG}" WHERE "{BEGIN}" = moment LIMIT 1)
    FROM times WHERE moment IS NOT NULL
"""  # noqa: S608 - our own names


def read_heatmap(path: str | Path) -> HeatMap:
    """Read a heat map back, with all that it counted.

    The layer by interval is read in batches: memory is that of the result.

    Parameters
    ----------
    path : str or Path
        Its folder, or the GeoPackage in it.

    Returns
    -------
    HeatMap
        Equal in all figures to the one that was written.

    Raises
    ------
    InputError
        If there is none, it is damaged, or its tiles were changed since.
    """
    path = Path(path)
    path = path / FILE if path.is_dir() else path
    if not path.is_file():
        raise InputError(f"{path}: there is no heat map", hint=_HINT)
    try:
        tiles = pyogrio.read_dataframe(path, layer=WIDE, columns=list(COLUMNS), use_arrow=True)
        notes = pyogrio.read_info(path, layer=WIDE)["layer_metadata"] or {}
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            times = database.execute(_TIMES).fetchall()
        whole = _checked_whole(tiles, notes, path)
        timeline = Timeline(
            begin=_steps_of([begin for begin, _ in times], path),
            end=_steps_of([end for _, end in times], path),
        )
        occupied, observed = _read_counts(path, tiles["tile_id"].to_numpy(np.int64), len(timeline))
    except (DataSourceError, DataLayerError, sqlite3.Error, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: not a heat map: {reason}", hint=_HINT) from error
    seen = np.flatnonzero(observed.any(axis=0))
    first, group = _alike(observed[:, seen])
    return HeatMap(
        tiles=tiles[[*COLUMNS, "geometry"]],
        fingerprint=notes["fingerprint"],
        sensors=tuple(json.loads(notes["sensors"])),
        whole=whole,
        timeline=whole if timeline.spans() == whole.spans() else timeline,
        seen=seen,
        group=group,
        occupied=occupied[:, seen],
        observed=observed[:, seen[first]].astype(np.int64),
    )


def _checked_whole(tiles: gpd.GeoDataFrame, notes: dict[str, Any], path: Path) -> Timeline:
    """Return the whole time; refuse a table that is not what was written."""
    missing = [name for name in COLUMNS if name not in tiles]
    missing += [name for name in ("fingerprint", "sensors", "begin", "end") if name not in notes]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}", hint="make it again")
    if fingerprint(tiles) != notes["fingerprint"]:
        raise InputError(f"{path}: its tiles were changed since it was made", hint="make it again")
    begin, end = (_steps_of([notes[name]], path) for name in ("begin", "end"))
    return Timeline(begin=begin, end=end)


def _steps_of(times: list[str], path: Path) -> Integers:
    return step_of(np.array([seconds_from_iso(each, what=f"{path}: time") for each in times]))


def _read_counts(path: Path, tile_ids: Integers, intervals: int) -> tuple[Counts, Counts]:
    """Read the steps in which tiles were occupied and observed, (intervals, tiles) each."""
    rows = intervals * len(tile_ids)
    names = ("occupied_s", "observed_s")
    counts = np.zeros((len(names), rows), np.uint32)
    done = 0
    with pyogrio.open_arrow(
        path, layer=LONG, use_pyarrow=True, read_geometry=False, columns=["tile_id", *names]
    ) as (_, reader):
        for batch in reader:
            place = np.arange(done, done + len(batch))
            done += len(batch)
            expected = tile_ids[place % len(tile_ids)] if done <= rows else tile_ids[:0]
            if not np.array_equal(batch["tile_id"].to_numpy(), expected):
                done = -1
                break
            for steps, name in zip(counts, names, strict=True):
                seconds = np.nan_to_num(batch[name].to_numpy(zero_copy_only=False))
                steps[place] = np.rint(seconds * STEPS_PER_SECOND)
    if done != rows or not rows:
        raise InputError(f"{path}: {LONG} is damaged: not one row a tile and interval", hint=_HINT)
    occupied, observed = counts.reshape(len(names), intervals, len(tile_ids))
    return occupied, observed


def _alike(observed: Counts) -> tuple[Integers, Integers]:
    """Group tiles observed alike in all intervals: the first tile of each group, and the groups."""
    rows = np.ascontiguousarray(observed.T)
    whole = rows.view(np.dtype((np.void, rows.strides[0]))).ravel()
    _, first, group = np.unique(whole, return_index=True, return_inverse=True)
    return first, group
