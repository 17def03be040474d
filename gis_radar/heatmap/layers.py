"""The two layers of a heat map: one row a tile, and one row a tile and interval."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyogrio
from pyogrio.errors import DataLayerError, DataSourceError

from gis_radar.arrays import Integers
from gis_radar.errors import InputError
from gis_radar.geopackage import GPKG_VERSION, add_styles, write_stream
from gis_radar.heatmap import style
from gis_radar.heatmap.counting import Counts, Tally
from gis_radar.heatmap.intervals import Timeline
from gis_radar.progress import QUIET, Reporter
from gis_radar.steps import STEPS_PER_SECOND, seconds_from_iso, step_begin, step_of
from gis_radar.tiles.tiles import COLUMNS, fingerprint

FILE = "heatmap.gpkg"
WIDE = "heatmap"
LONG = "occupancy_by_interval"
BEGIN, END = "begin", "end"
ROWS_AT_ONCE = 65_536

_STEP_MS = 50
_TIME = pa.timestamp("ms", tz="UTC")


def _interval_column(begin_step: int, length_steps: int) -> str:
    """Return `occ_` and an interval's begin in UTC, as fine as intervals of that length need."""
    begin = step_begin(begin_step)
    name = f"occ_{begin:%Y%m%dT%H%M}"
    if length_steps < 60 * STEPS_PER_SECOND:
        name += f"{begin:%S}"
    if length_steps < STEPS_PER_SECOND:
        name += f"{begin.microsecond // 1000:03d}"
    return name


def wide_layer(tally: Tally) -> gpd.GeoDataFrame:
    """Return one row a tile: the whole time, and a column an interval.

    Returns
    -------
    GeoDataFrame
        The tiles' columns, then `occupied_s`, `observed_s`, `occupancy` over the whole time, and
        `occ_...`, the occupied seconds of each interval, NaN where not observed in it.
    """
    timeline = tally.timeline
    columns = tally.shares()._asdict()
    for i in tally.columns:
        begin, end = int(timeline.begin[i]), int(timeline.end[i])
        columns[_interval_column(begin, end - begin)] = tally.shares(i).occupied_s
    shares = pd.DataFrame(columns, index=tally.tiles.index)
    attributes = tally.tiles.drop(columns="geometry")
    return gpd.GeoDataFrame(
        pd.concat([attributes, shares], axis=1), geometry=tally.tiles.geometry, crs=tally.crs
    )


def long_layer(tally: Tally) -> gpd.GeoDataFrame:
    """Return one row a tile and interval, also where nothing was hit or observed.

    Returns
    -------
    GeoDataFrame
        `tile_id`, `lanelet_id`, `begin` and `end` (UTC; the end is exclusive), `occupied_s`,
        `observed_s`, `occupancy`, geometry, ordered by interval, then by tile. Where a
        tile was not observed, `observed_s` is 0 and the other two are NaN.
    """
    rows = pa.Table.from_batches(long_batches(tally), schema=LONG_SCHEMA).drop(["geometry"])
    geometry = np.tile(tally.tiles.geometry.to_numpy(), len(tally.timeline))
    return gpd.GeoDataFrame(rows.to_pandas(), geometry=geometry, crs=tally.crs)


LONG_SCHEMA = pa.schema(
    [
        ("tile_id", pa.int64()),
        ("lanelet_id", pa.int64()),
        (BEGIN, _TIME),
        (END, _TIME),
        ("occupied_s", pa.float64()),
        ("observed_s", pa.float64()),
        ("occupancy", pa.float64()),
        pa.field("geometry", pa.binary(), metadata={"ARROW:extension:name": "geoarrow.wkb"}),
    ]
)


def long_batches(tally: Tally, reporter: Reporter = QUIET) -> Iterator[pa.RecordBatch]:
    """Yield the rows of :func:`long_layer` as Arrow batches, a few at a time."""
    done, total = 0, len(tally.timeline) * len(tally.tiles)
    ids = [pa.array(tally.tiles[name].to_numpy()) for name in ("tile_id", "lanelet_id")]
    shapes = pa.array(tally.tiles.geometry.to_wkb().to_numpy(), pa.binary())
    for i in range(len(tally.timeline)):
        times = (int(step[i]) * _STEP_MS for step in (tally.timeline.begin, tally.timeline.end))
        moments = [pa.repeat(pa.scalar(time, _TIME), len(shapes)) for time in times]
        shares = [pa.array(share, from_pandas=True) for share in tally.shares(i)]
        rows = pa.RecordBatch.from_arrays([*ids, *moments, *shares, shapes], schema=LONG_SCHEMA)
        for start in range(0, len(shapes), ROWS_AT_ONCE):
            batch = rows.slice(start, ROWS_AT_ONCE)
            yield batch
            done += len(batch)
            reporter.progress("writing occupancy by interval", done, total)


def write_table(tally: Tally, path: Path, _reporter: Reporter) -> None:
    """Write the layer `heatmap` as GeoParquet 1.1 with a box for each row."""
    frame = wide_layer(tally)
    frame.attrs = tally.metadata
    frame.to_parquet(
        path,
        index=False,
        compression="zstd",
        schema_version="1.1.0",
        write_covering_bbox=True,
        write_page_checksum=True,  # a flipped bit is found on reading
    )


def write_package(tally: Tally, path: Path, reporter: Reporter) -> None:
    """Write both layers, the long one in batches, their styles, and an index on the times."""
    metadata = {
        name: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for name, value in tally.metadata.items()
    }
    pyogrio.write_dataframe(
        wide_layer(tally), path, layer=WIDE, driver="GPKG", use_arrow=True,
        geometry_type="Polygon", layer_metadata=metadata, VERSION=GPKG_VERSION,
    )  # fmt: skip
    write_stream(
        long_batches(tally, reporter), LONG_SCHEMA, path,
        layer=LONG, driver="GPKG", crs=tally.crs.to_wkt(),
        geometry_name="geometry", geometry_type="Polygon", layer_metadata=metadata,
    )  # fmt: skip
    length_s = float(tally.timeline.end[0] - tally.timeline.begin[0]) / STEPS_PER_SECOND
    styles = {
        WIDE: (style.vector_qml(), style.sld(WIDE)),
        LONG: (style.vector_qml(interval_s=length_s), style.sld(LONG)),
    }
    about = "fixed classes of occupancy, so that maps compare"
    with closing(sqlite3.connect(path)) as database, database:
        for field in (BEGIN, END):
            database.execute(f'CREATE INDEX "{LONG}_{field}" ON "{LONG}" ("{field}")')
        add_styles(database, styles, name="occupancy", about=about)


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


def read_package(path: Path) -> dict[str, Any]:
    """Read both layers back as the fields of a tally, the one by interval in batches.

    Parameters
    ----------
    path : Path
        The GeoPackage, or its folder.

    Raises
    ------
    InputError
        If there is none, it is damaged, or its tiles were changed since.
    """
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
    return {
        "tiles": tiles[[*COLUMNS, "geometry"]],
        "fingerprint": notes["fingerprint"],
        "sensors": tuple(json.loads(notes["sensors"])),
        "whole": whole,
        "timeline": whole if timeline.spans() == whole.spans() else timeline,
        "seen": seen,
        "group": group,
        "occupied": occupied[:, seen],
        "observed": observed[:, seen[first]].astype(np.int64),
    }


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
