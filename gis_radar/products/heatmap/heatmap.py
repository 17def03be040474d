"""Make a heat map from a dataset, with its figures, plots and files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import (
    QUIET,
    InputError,
    Reporter,
    Text,
    UsageError,
    card,
    iso_from_step,
    small_picture,
    step_at,
    zone_of,
)
from gis_radar.dataset import Dataset, measured_span, open_dataset
from gis_radar.measures import Runs
from gis_radar.products.heatmap.by_lane import table_by_lane
from gis_radar.products.heatmap.counting import Tally
from gis_radar.products.heatmap.figure import SMALL_PIXELS, draw, write_figure
from gis_radar.products.heatmap.intervals import MapLabels, Timeline, intervals_of, whole_of
from gis_radar.products.heatmap.layers import (
    long_layer,
    read_package,
    wide_layer,
    write_one_layer,
    write_package,
    write_table,
)
from gis_radar.products.heatmap.raster import write_raster
from gis_radar.products.heatmap.style import sidecar_qml
from gis_radar.products.report_files import REPORT_FILES
from gis_radar.products.results_folder import write_results

NO_OCCUPANCY = Text("occupancy is missing: no vehicles were measured; the map shows the hit share")
_MOST_DRAWN = 60_000  # tiles in the small picture of a notebook
# Begins of the names of its files, and of those of a report, which is removed with the heat map.
OWNED_BY_HEATMAP = ("heatmap.", "hits.", *REPORT_FILES)


class HeatMap(Tally):
    """Heat map: occupancy and hit share of each tile, over a time and its intervals.

    It is made by :func:`make_heatmap`; its fields are described at :class:`Tally`.
    """

    wide = wide_layer
    long = long_layer
    plot = draw
    by_lane = table_by_lane

    def _repr_html_(self) -> str:
        def small(ax: Any) -> None:
            self.plot(ax, legend=False, most_pixels=SMALL_PIXELS).set_axis_off()

        few = len(self.seen) <= _MOST_DRAWN
        picture = small_picture(small) if few else b""
        return card("Heat map", self.figures() | self.local_span, picture=picture)

    def write(self, folder: str | Path, reporter: Reporter = QUIET) -> list[Path]:
        """Write `heatmap.gpkg`, `heatmap.tif`, `hits.tif`, `heatmap.parquet`, `heatmap.png`.

        Beside them `heatmap.qml` lets QGIS show the GeoTIFF and the table in the same colours.
        Where vehicles were not looked for, all show the hit share, and `heatmap.tif` is missing.

        Parameters
        ----------
        folder : path
            The folder; an earlier heat map there is replaced as a whole.
        reporter : Reporter
            Receives progress.

        Returns
        -------
        list of Path
            The files.

        Raises
        ------
        OutputError
            If the folder cannot be written or holds other files.
        """
        raster = partial(write_raster, self, reporter=reporter)
        writers: dict[str, Callable[[Path], object]] = {
            "heatmap.gpkg": lambda path: write_package(self, path, reporter),
            "heatmap.parquet": partial(write_table, self),
            "heatmap.png": lambda path: write_figure(self, path, reporter),
            "heatmap.qml": partial(_write_style, self),
            "hits.tif": partial(raster, measure="hit_share"),
        }
        if self.occupancy is not None:
            writers["heatmap.tif"] = raster
        else:
            writers["hits.qml"] = writers["heatmap.qml"]
        return write_results(
            folder, writers, name="heatmap", owned=OWNED_BY_HEATMAP, reporter=reporter
        )


def make_heatmap(
    dataset: Dataset | str | Path,
    *,
    interval: str | None = None,
    at: Any = None,
    begin: Any = None,
    end: Any = None,
    month: str | None = None,
    timezone: str | None = None,
    labels: MapLabels | None = None,
    reporter: Reporter = QUIET,
) -> HeatMap:
    """Make the heat map of all tiles (the paper's section "Global Occupancy Heat Map").

    A tile's occupancy is the share of the steps in which it was visible that a vehicle was on it,
    its hit share that of the steps in which it was observed that it was hit.

    Parameters
    ----------
    dataset : Dataset, str or Path
        From :func:`gis_radar.open_dataset`, or its folder.
    interval : str, optional
        Length of intervals such as `15min`; they begin at multiples of it since the UNIX epoch.
    at : str or datetime, optional
        The map of the one step that contains this time, given as `begin`, in place of the whole.
    begin, end : str or datetime, optional
        Begin and end of the whole time, such as `2025-06-12 07:30`; without an offset they are by
        the clocks of `timezone`. Intervals are cut at both.
    month : str, optional
        A month by the clocks of the site, such as `2026-10`, in place of times and intervals. It is
        made from the roll-up of the month, exact tables or not.
    timezone : str, optional
        Time zone of the intervals' hours and days, such as Europe/Berlin, and of pictures where
        `labels` are not given; tables and layers stay in UTC. By default the dataset's.
    labels : MapLabels, optional
        Title, time zone and sources for pictures and reports.
    reporter : Reporter
        Receives progress and remarks.

    Returns
    -------
    HeatMap

    Raises
    ------
    UsageError
        If `interval` is no duration, stands beside `at`, or is too short for this much data;
        if there is no such time zone.
    InputError
        If there is no frame, no tile in sight, or a part of the dataset is damaged.

    Examples
    --------
    >>> import gis_radar as gr
    >>> sample = gr.sample_folder()
    >>> tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    >>> pose = gr.read_pose(sample / "R1.json")
    >>> ds = gr.measure([sample / "R1.parquet"], [pose], tiles, sample / "junction.osm", "site")
    >>> heat = gr.make_heatmap(ds, interval="20s").wide()
    >>> seen = heat[heat["visible_s"] > 0]
    >>> bool(seen["occupancy"].between(0, 1).all())
    True
    """
    if at is not None and (interval, begin, end) != (None, None, None):
        raise UsageError("at and interval, begin, end do not go together", hint="give one of them")
    if month is not None and (at, interval, begin, end) != (None,) * 4:
        raise UsageError("month and times or intervals do not go together", hint="give one of them")
    dataset = open_dataset(dataset, reporter=reporter)
    labels = labels or MapLabels(timezone=timezone or dataset.timezone)
    zone = None if timezone is None else zone_of(timezone)
    clocks = zone_of(labels.timezone)
    span = [
        None if time is None else step_at(time, clocks, what=what)
        for time, what in ((begin, "begin"), (end, "end"))
    ]
    if month is not None:
        first, last = measured_span(dataset, month)
        whole = timeline = Timeline(begin=np.array([first]), end=np.array([last + 1]))
    else:
        whole = timeline = whole_of(_within(dataset.frame_steps(), *span), at, clocks)
    if interval is not None:
        frames = _within(dataset.frame_steps(valid=False), *span)
        timeline = intervals_of(frames, interval, zone, len(dataset.tiles()), reporter).cut(*span)
        # Steps after the last interval, in which a frame is still valid, do not count.
        whole = whole.cut(None, int(timeline.end[-1]))
    if not dataset.has_vehicles:
        reporter.log(NO_OCCUPANCY)
    for doubt in dataset.doubts:
        reporter.warn("{}", doubt)
    return HeatMap.count(
        dataset, whole, timeline, labels=labels, month=month, reporter=reporter
    )  # fmt: skip


def write_joint_layer(maps: Mapping[str, HeatMap], folder: Path, crs: Any = None) -> Path:
    """Write heat maps of several sites as one layer, `heatmap.gpkg`; see :func:`joint_layer`.

    Parameters
    ----------
    maps : mapping
        Heat map of each site, by its name.
    folder : Path
        The folder; an earlier heat map there is replaced as a whole.
    crs : optional
        Coordinate system of the layer; by default that of the first.

    Raises
    ------
    OutputError
        If the folder cannot be written or holds other files.
    """
    least_s = min(each.least_visible_s() for each in maps.values())
    writer = partial(write_one_layer, joint_layer(maps, crs), least_s=least_s)
    (path,) = write_results(
        folder, {"heatmap.gpkg": writer}, name="heatmap", owned=OWNED_BY_HEATMAP
    )
    return path


def joint_layer(maps: Mapping[str, HeatMap], crs: Any = None) -> gpd.GeoDataFrame:
    """Return the tiles of heat maps of several sites, with a column `site`."""
    tables = []
    for name, each in maps.items():
        table = each.wide() if crs is None else each.wide().to_crs(crs)
        table.insert(0, "site", name)
        tables.append(table)
    return gpd.GeoDataFrame(pd.concat(tables, ignore_index=True))


def _write_style(tally: Tally, path: Path) -> None:
    """Write the QGIS style (QML) of the raster and the table with that name."""
    style = sidecar_qml(tally.measure, least_s=tally.least_visible_s())
    path.write_text(style, encoding="utf-8")


def _within(runs: Runs, first: int | None, after: int | None) -> Runs:
    """Return the steps of a set that lie in a span; refuse one without any."""
    known = int(runs.first[0]), int(runs.last[-1]) + 1
    low, high = known[0] if first is None else first, known[1] if after is None else after
    begin, end, *frames = (iso_from_step(step) for step in (low, high, *known))
    if low < high and len(inside := runs.within(low, high - 1)) > 0:
        return inside
    if first is not None and after is not None and not low < high:
        raise UsageError("begin and end are {} and {}, expected ascending times", begin, end)
    raise InputError(
        "no sensor delivered a frame from {} to {}",
        Text("its begin") if first is None else begin,
        Text("its end") if after is None else end,
        hint=Text("there are frames from {} to {}", *frames),
    )


def read_heatmap(path: str | Path) -> HeatMap:
    """Read a heat map back, with all its counts.

    The layer by interval is read in batches: memory holds the result.

    Parameters
    ----------
    path : str or Path
        The heat map's folder, or the GeoPackage in it.

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
