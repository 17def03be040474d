"""Write the two layers of a heat map, one row a tile, and one row a tile and interval."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyogrio

from gis_radar.geopackage import GPKG_VERSION, add_styles, write_stream
from gis_radar.heatmap import style
from gis_radar.heatmap.counting import Tally
from gis_radar.progress import Reporter
from gis_radar.steps import STEPS_PER_SECOND, step_begin

WIDE = "heatmap"
LONG = "occupancy_by_interval"
BEGIN, END = "begin", "end"
ROWS_AT_ONCE = 65_536

_STEP_MS = 50
_TIME = pa.timestamp("ms", tz="UTC")


def interval_column(begin_step: int, length_steps: int) -> str:
    """Return the name of an interval's column: `occ_` and its begin, UTC.

    Parameters
    ----------
    begin_step : int
        First step of the interval.
    length_steps : int
        Length of the intervals; under a minute the name has seconds, under a second
        milliseconds too.
    """
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
        columns[interval_column(begin, end - begin)] = tally.shares(i).occupied_s
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


def long_batches(tally: Tally) -> Iterator[pa.RecordBatch]:
    """Yield the rows of :func:`long_layer` as Arrow batches, a few at a time."""
    ids = [pa.array(tally.tiles[name].to_numpy()) for name in ("tile_id", "lanelet_id")]
    shapes = pa.array(tally.tiles.geometry.to_wkb().to_numpy(), pa.binary())
    for i in range(len(tally.timeline)):
        times = (int(step[i]) * _STEP_MS for step in (tally.timeline.begin, tally.timeline.end))
        moments = [pa.repeat(pa.scalar(time, _TIME), len(shapes)) for time in times]
        shares = [pa.array(share, from_pandas=True) for share in tally.shares(i)]
        rows = pa.RecordBatch.from_arrays([*ids, *moments, *shares, shapes], schema=LONG_SCHEMA)
        for start in range(0, len(shapes), ROWS_AT_ONCE):
            yield rows.slice(start, ROWS_AT_ONCE)


def write_table(tally: Tally, path: Path, _reporter: Reporter) -> None:
    """Write the layer `heatmap` as GeoParquet 1.1 with a box for each row.

    Parameters
    ----------
    tally : Tally
        What to write.
    path : Path
        The file.
    """
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
    """Write both layers, their styles, and an index on the times.

    Parameters
    ----------
    tally : Tally
        What to write.
    path : Path
        A file that does not exist yet.
    reporter : Reporter
        Where progress goes; the long layer is streamed in batches.
    """
    metadata = {
        name: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for name, value in tally.metadata.items()
    }
    pyogrio.write_dataframe(
        wide_layer(tally), path, layer=WIDE, driver="GPKG", use_arrow=True,
        geometry_type="Polygon", layer_metadata=metadata, VERSION=GPKG_VERSION,
    )  # fmt: skip
    _write_long(tally, path, metadata, reporter)
    with closing(sqlite3.connect(path)) as database, database:
        for field in (BEGIN, END):
            database.execute(f'CREATE INDEX "{LONG}_{field}" ON "{LONG}" ("{field}")')
        _add_styles(database, _length_s(tally))


def _write_long(tally: Tally, path: Path, metadata: dict[str, str], reporter: Reporter) -> None:
    write_stream(
        _reported(tally, reporter), LONG_SCHEMA, path,
        layer=LONG, driver="GPKG", crs=tally.crs.to_wkt(),
        geometry_name="geometry", geometry_type="Polygon", layer_metadata=metadata,
    )  # fmt: skip


def _reported(tally: Tally, reporter: Reporter) -> Iterator[pa.RecordBatch]:
    done, total = 0, len(tally.timeline) * len(tally.tiles)
    for batch in long_batches(tally):
        yield batch
        done += len(batch)
        reporter.progress("writing occupancy by interval", done, total)


def _length_s(tally: Tally) -> float:
    """Return the length of the intervals, which is one for all."""
    return float(tally.timeline.end[0] - tally.timeline.begin[0]) / STEPS_PER_SECOND


def _add_styles(database: sqlite3.Connection, length_s: float) -> None:
    styles = {
        WIDE: (style.vector_qml(), style.sld(WIDE)),
        LONG: (style.vector_qml(interval_s=length_s), style.sld(LONG)),
    }
    about = "fixed classes of occupancy, so that maps compare"
    add_styles(database, styles, name="occupancy", about=about)
