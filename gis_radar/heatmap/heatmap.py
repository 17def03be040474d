"""From occupancy to heat map: its figures, plots and files, and a labelled cube for xarray."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import ArrayLike

from gis_radar.arrays import Integers
from gis_radar.crs import metric_crs, name_of
from gis_radar.errors import NOTEBOOKS, InputError, UsageError
from gis_radar.files import output_errors, whole_folder, writing_errors
from gis_radar.geopackage import keep_styles
from gis_radar.heatmap.by_lane import table_by_lane
from gis_radar.heatmap.counting import Shares, Tally, positions
from gis_radar.heatmap.covering import CoverageShares, require_same_origin
from gis_radar.heatmap.figure import SMALL_PIXELS, draw, show_in_browser, write_figure
from gis_radar.heatmap.intervals import (
    MapLabels,
    intervals_of,
    whole_of,
)
from gis_radar.heatmap.layers import (
    long_layer,
    read_package,
    wide_layer,
    write_package,
    write_table,
)
from gis_radar.heatmap.raster import write_raster
from gis_radar.heatmap.style import sidecar_qml
from gis_radar.notebooks import card, small_picture
from gis_radar.occupancy import Occupancy
from gis_radar.occupancy.frame_steps import Runs, common_steps, steps_in
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import STEP_US, iso_from_step, step_at, zone_of
from gis_radar.tiles.tiles import COLUMNS, fingerprint, own_columns
from gis_radar.vehicles import Vehicles

if TYPE_CHECKING:
    import xarray

MOST_MIB = 1024.0  # of a cube
LANELET, START = "lanelet of the tile", "start of the tile along its lanelet"
CELL_BYTES = 3 * 4 + 4  # of a tile and interval: three numbers, and the count they come from
MOST_DRAWN = 60_000  # tiles in the small picture of a notebook
# A report of it may stand there; it goes when the heat map does.
OWNED = (
    "heatmap.",
    "occupancy.tif",
    "report.",
    "lanes.csv",
    "lanes_by_interval.csv",
    "sensors.csv",
    "quality.csv",
)


class HeatMap(Tally):
    """How long each tile was occupied, of the time it was observed.

    Made by :func:`make_heatmap`; what it holds is described at :class:`Tally`.
    """

    wide = wide_layer
    long = long_layer
    plot = draw
    explore = show_in_browser
    by_lane = table_by_lane

    def to_xarray(self, *, most_mib: float = MOST_MIB) -> xarray.Dataset:
        """Return the heat map as an xarray Dataset over (tile, time).

        `occupied_s`, `observed_s` and `occupancy` are float32; where a tile was not observed,
        `observed_s` is 0 and the others are NaN. So are `visible_s`, `covered_s`, `coverage` and
        `coverage_se`, where vehicles are known. Coordinates of a tile: `tile_id` (an index, so
        that `sel(tile_id=7)` works), `lanelet_id`, `s_m`, `easting`, `northing` (of its centre, m);
        of a time: `time` and `begin`, `end` (exclusive), datetime64 in UTC; the attribute
        `timezone` names the site's.

        Parameters
        ----------
        most_mib : float
            The memory that it may take, MiB.

        Raises
        ------
        UsageError
            If it would take more; :func:`gis_radar.make_heatmap` counts a part of the time or of
            the tiles alone.
        InputError
            If xarray is not installed.
        """
        xr = _require_xarray()
        require_room(len(self.tiles), len(self.timeline), most_mib)
        shape = (len(self.tiles), len(self.timeline))
        names = (*Shares._fields, *(() if self.coverage is None else CoverageShares._fields))
        arrays = {name: np.full(shape, np.nan, np.float32) for name in names}
        for column in range(shape[1]):
            known = self.coverage_shares(column)
            shares = self.shares(column)._asdict() | ({} if known is None else known._asdict())
            for name, value in shares.items():
                arrays[name][:, column] = value
        units = {name: "s" if name.endswith("_s") else "1" for name in names}
        values = {
            name: (("tile", "time"), array, {"long_name": about, "units": units[name]})
            for (name, array), about in zip(arrays.items(), self.definitions.values(), strict=True)
        }
        attributes = {
            "title": f"{' and '.join(dict.fromkeys((self.measure, 'occupancy')))} of lane tiles",
            "crs": name_of(self.crs),
            "fingerprint": self.fingerprint,
            "sensors": ", ".join(self.sensors),
            "timezone": str(self.zone),
        }
        cube: xarray.Dataset = xr.Dataset(values, coords=_coordinates(self), attrs=attributes)
        return cube.set_xindex("tile_id")

    def _repr_html_(self) -> str:
        def small(ax: Any) -> None:
            self.plot(ax, legend=False, most_pixels=SMALL_PIXELS).set_axis_off()

        few = len(self.seen) <= MOST_DRAWN
        picture = small_picture(small) if few else b""
        return card("Heat map", self.figures() | self.local_span, picture=picture)

    def write(self, folder: str | Path, reporter: Reporter = QUIET) -> list[Path]:
        """Write `heatmap.gpkg`, `heatmap.tif`, `heatmap.parquet`, `heatmap.png`.

        Beside them `heatmap.qml` lets QGIS show the GeoTIFF and the table in the same colours.
        Where vehicles are known, these show coverage, and `occupancy.tif` stands beside.

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
        UsageError
            If it was made with `tile_ids`.
        """
        folder = Path(folder)
        if fingerprint(self.tiles) != self.fingerprint:
            raise UsageError(
                f"{folder}: a heat map of some tiles is not written",
                hint="make it without tile_ids; wide() and long() give its tables",
            )
        style = sidecar_qml(self.measure, least_s=self.least_visible_s())
        writers: dict[str, Callable[[Tally, Path, Reporter], object]] = {
            "heatmap.gpkg": write_package,
            "heatmap.tif": write_raster,
            "heatmap.parquet": write_table,
            "heatmap.png": write_figure,
            "heatmap.qml": lambda _, path, __: path.write_text(style, encoding="utf-8"),
        }
        if self.coverage is not None:
            writers["occupancy.tif"] = partial(write_raster, measure="occupancy")
        with whole_folder(folder, owned=OWNED, reporter=reporter) as fresh:
            for name, write in writers.items():
                with output_errors(folder / name), writing_errors(folder / name):
                    write(self, fresh / name, reporter)
            keep_styles(fresh / "heatmap.gpkg", earlier=folder / "heatmap.gpkg")
        return [folder / name for name in writers]


def make_heatmap(
    occupancy: Occupancy,
    tiles: gpd.GeoDataFrame,
    *,
    interval: str | None = None,
    at: str | None = None,
    begin: Any = None,
    end: Any = None,
    tile_ids: ArrayLike | None = None,
    timezone: str | None = None,
    vehicles: Vehicles | None = None,
    labels: MapLabels | None = None,
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
        Whose hours and days intervals follow, such as Europe/Berlin, and whose clocks pictures
        show where `labels` are not given; tables and layers stay in UTC.
    at : str, optional
        ISO 8601 time: the map of the one step that contains it, instead of the whole time.
    begin, end : str or datetime, optional
        Only what is between these times, such as `2025-06-12 07:30`; without an offset they are by
        the clocks of `timezone`. Intervals are cut at both.
    tile_ids : array of int, optional
        Only these tiles.
    vehicles : Vehicles, optional
        Of the same tiles, sensors, poses and sight, as from :func:`gis_radar.read_vehicles`: adds
        coverage, which maps then show. The whole time is what both hold.
    labels : MapLabels, optional
        Title, time zone and sources for pictures and reports.
    reporter : Reporter
        Where progress and remarks go.

    Returns
    -------
    HeatMap

    Raises
    ------
    UsageError
        If `interval` is no duration, stands beside `at`, or is too short for this much data;
        if there is no such time zone.
    CrsError
        If the tiles' coordinate system is not a projected one in metres.
    InputError
        If there is no frame, no tile in view, the tiles are not those of the occupancy, or the
        vehicles were made from other tiles, sensors, poses or sight, or at another time.

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
    if at is not None and (interval, begin, end) != (None, None, None):
        raise UsageError("at and interval, begin, end do not go together", hint="give one of them")
    labels = labels or MapLabels(timezone=timezone or "UTC")
    zone = None if timezone is None else zone_of(timezone)
    tiles, runs = checked(occupancy, tiles, vehicles)
    span = [
        None if time is None else step_at(time, zone_of(labels.timezone), what=what)
        for time, what in ((begin, "begin"), (end, "end"))
    ]
    runs = _within(runs, *span)
    chosen = None if tile_ids is None else _chosen(tiles["tile_id"].to_numpy(np.int64), tile_ids)
    whole = timeline = whole_of(runs, at)
    if interval is not None:
        counted = len(tiles if chosen is None else chosen)
        timeline = intervals_of(runs, interval, zone, counted, reporter).cut(*span)
    return HeatMap.count(
        occupancy, tiles, whole, timeline, chosen=chosen, vehicles=vehicles, reporter=reporter,
        labels=labels,
    )  # fmt: skip


def _within(runs: Runs, first: int | None, after: int | None) -> Runs:
    """Return the steps of a set that lie in a span; refuse one without any."""
    low = int(runs.first[0]) if first is None else first
    high = int(runs.last[-1]) + 1 if after is None else after
    if not low < high:
        begin, end = (iso_from_step(step) for step in (low, high))
        raise UsageError(f"begin and end are {begin} and {end}, expected ascending times")
    inside = runs.within(low, high - 1)
    if len(inside) == 0:
        begin, end = (iso_from_step(step) for step in (low, high))
        raise InputError(f"no sensor delivered a frame from {begin} to {end}")
    return inside


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
    return HeatMap(**read_package(Path(path)))


def _require_xarray() -> Any:
    """Return the module xarray, or refuse where it is not installed."""
    try:
        import xarray  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise InputError("a Dataset needs xarray, which is missing", hint=NOTEBOOKS) from error
    return xarray


def require_room(tiles: int, intervals: int, most_mib: float) -> None:
    """Refuse a cube that would take more memory than it may, before it is made.

    Raises
    ------
    UsageError
        If it would.
    """
    mib = tiles * intervals * CELL_BYTES / 2**20
    if mib > most_mib:
        raise UsageError(
            f"{tiles} tiles in {intervals} intervals take {mib:.0f} MiB, over {most_mib:g} MiB",
            hint="take a longer interval, fewer tiles (tile_ids), a part of the time (begin, end), "
            "or raise most_mib",
        )


def _coordinates(tally: Tally) -> dict[str, Any]:
    tiles = tally.tiles
    middle = shapely.get_coordinates(shapely.centroid(tiles.geometry.array))
    metres = {"units": "m"}
    begin, end = (
        (steps * (STEP_US // 1000)).astype("datetime64[ms]").astype("datetime64[ns]")
        for steps in (tally.timeline.begin, tally.timeline.end)
    )
    begins = ("time", begin, {"long_name": "begin of the interval, UTC"})
    return {
        "tile_id": ("tile", tiles["tile_id"].to_numpy(np.int64)),
        "lanelet_id": ("tile", tiles["lanelet_id"].to_numpy(), {"long_name": LANELET}),
        "s_m": ("tile", tiles["s_m"].to_numpy(), {"long_name": START} | metres),
        "easting": ("tile", middle[:, 0], {"long_name": "easting"} | metres),
        "northing": ("tile", middle[:, 1], {"long_name": "northing"} | metres),
        "time": begins,
        "begin": begins,
        "end": ("time", end, {"long_name": "end of the interval, exclusive, UTC"}),
    }


def _chosen(all_ids: Integers, tile_ids: ArrayLike | None) -> Integers:
    """Return the positions of the chosen tiles, ascending."""
    if tile_ids is None:
        return np.arange(len(all_ids))
    wanted = np.unique(np.asarray(tile_ids, dtype=np.int64))
    if len(wanted) == 0:
        raise UsageError("tile_ids names no tile")
    if unknown := np.setdiff1d(wanted, all_ids).tolist():
        raise InputError(f"tile_ids names tile {unknown[0]}, which the tiles lack")
    return positions(all_ids, wanted)


def checked(
    occupancy: Occupancy, tiles: gpd.GeoDataFrame, vehicles: Vehicles | None = None
) -> tuple[gpd.GeoDataFrame, Runs]:
    """Return the tiles with their own columns only, and the steps that any sensor's frames cover.

    With vehicles, these are the steps that both hold.

    Raises
    ------
    InputError
        If there is no frame, the tiles are not those of the occupancy, or the vehicles are of
        other sensors, poses or sight, or of no common time.
    """
    if occupancy.frames.empty:
        raise InputError("the occupancy holds no frame", hint="was the recording empty?")
    missing = [name for name in COLUMNS if name not in tiles]
    if missing:
        raise InputError(f"the tiles lack the column(s) {', '.join(missing)}")
    metric_crs(tiles.crs, what="tiles")
    got = fingerprint(tiles)
    if got != occupancy.fingerprint:
        raise InputError(
            f"the tiles have the fingerprint {got}, the occupancy was made with "
            f"{occupancy.fingerprint}",
            hint="use the tiles that the occupancy was made with",
        )
    attributes = tiles[own_columns(tiles)].reset_index(drop=True)
    shapes = tiles.geometry.reset_index(drop=True)
    own = gpd.GeoDataFrame(attributes, geometry=shapes, crs=tiles.crs)
    steps = steps_in(occupancy.covered_frames())
    if vehicles is None:
        return own, steps
    require_same_origin(occupancy, vehicles)
    steps = common_steps(steps, vehicles.covered_frames())
    if len(steps) == 0:
        raise InputError(f"{occupancy.place} and {vehicles.place} have no time in common")
    return own, steps
