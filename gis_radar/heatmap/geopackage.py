"""A heat map as GeoPackage: both layers, with styles that QGIS loads by itself."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pyarrow as pa
import pyogrio

from gis_radar.clock import STEPS_PER_SECOND
from gis_radar.heatmap import style
from gis_radar.heatmap.layers import BEGIN, END, LONG, LONG_SCHEMA, WIDE, long_batches, wide_layer
from gis_radar.heatmap.tally import Tally
from gis_radar.layer_styles import add_styles
from gis_radar.progress import Reporter
from gis_radar.streams import write_stream

VERSION = "1.2"  # the GDAL of QGIS 3.40 warns of later ones


def write_geopackage(tally: Tally, path: Path, reporter: Reporter) -> None:
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
        geometry_type="Polygon", layer_metadata=metadata, VERSION=VERSION,
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
        LONG: (style.vector_qml(begin=BEGIN, end=END, length_s=length_s), style.sld(LONG)),
    }
    about = "fixed classes of occupancy, so that maps compare"
    add_styles(database, styles, name="occupancy", about=about)
