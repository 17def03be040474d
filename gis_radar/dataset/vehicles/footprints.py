"""Write the footprints of vehicles as a layer that moves with the time of QGIS."""

from __future__ import annotations

import math
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import shapely

from gis_radar.base import (
    QUIET,
    STEP_S,
    STEP_US,
    TRACK_EVERY_STEPS,
    Floats,
    Integers,
    Reporter,
    UsageError,
    atomic_write,
    copy_saved_styles,
    style_layers,
    write_stream,
)
from gis_radar.dataset.files.source import DatasetFiles, require_vehicles
from gis_radar.dataset.vehicles.states import states_of
from gis_radar.tracking import HEAVY, Footprints, PathBook, footprints_of

FOOTPRINTS = "footprints"
_SCHEMA = pa.schema([
    ("vehicle", pa.int64()),
    ("begin", pa.timestamp("ms", tz="UTC")),
    ("end", pa.timestamp("ms", tz="UTC")),
    ("kind", pa.string()),
    ("state", pa.string()),
    ("speed_kmh", pa.float64()),
    ("heading", pa.float64()),
    ("length_m", pa.float64()),
    ("width_m", pa.float64()),
    ("lanelet_id", pa.int64()),
    ("seen", pa.bool_()),
    ("geometry", pa.binary()),
])  # fmt: skip

# A vehicle has a row at the steps of absolute time that are multiples of this: half a second, in
# which a car at 50 km/h moves 7 m, one and a half of its lengths. All steps would be ten times as
# many rows.
EVERY_STEPS = 10
SHOWN_S = EVERY_STEPS * STEP_S  # how long a row is shown
_STANDING_KMH = 5.0  # a slower vehicle is standing: as traffic engineering counts stops


def write_footprints(dataset: DatasetFiles, path: str | Path, *, reporter: Reporter = QUIET) -> int:
    """Write the footprints of vehicles as a layer, a row for each vehicle and half second.

    Memory holds one hour.

    Parameters
    ----------
    path : str or Path
        The GeoPackage, layer `footprints`; it appears whole or not at all. QGIS loads its style
        by itself, in which its temporal controller moves the vehicles.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    int
        Number of rows written.

    Raises
    ------
    UsageError
        If the name does not end in `.gpkg`.
    InputError
        If vehicles were not looked for.
    OutputError
        If the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".gpkg":
        raise UsageError("{}: footprints are written as GeoPackage", path, hint="end it in .gpkg")
    require_vehicles(dataset)
    rows = _Rows(dataset, reporter)
    with atomic_write(path) as part:
        write_stream(
            rows, _SCHEMA, part, layer=FOOTPRINTS, geometry_name="geometry",
            geometry_type="Polygon", crs=dataset.crs,
        )  # fmt: skip
        styles = {FOOTPRINTS: footprint_style()}
        style_layers(part, styles, name="vehicles", about="vehicles, moved by the time")
        copy_saved_styles(part, earlier=path)
    return rows.count


def footprint_style() -> str:
    """Return the QGIS style of the layer as QML."""
    return (files(__package__) / "footprints.qml").read_text(encoding="utf-8")


class _Rows:
    """Rows of the layer in batches, made while the tracks are read; iterable once."""

    def __init__(self, dataset: DatasetFiles, reporter: Reporter) -> None:
        self._dataset, self._reporter = dataset, reporter
        self.count = 0

    def __iter__(self) -> Iterator[pa.RecordBatch]:
        hours = len(self._dataset.records())
        book = PathBook()
        every = math.gcd(TRACK_EVERY_STEPS, EVERY_STEPS)  # steps of rows and of paths' points
        states_by_hour = states_of(self._dataset, every=every)
        for done, (table, states) in enumerate(states_by_hour, start=1):
            level_m = np.full(len(states), np.nan)  # shapes need no heights
            prints = footprints_of(states, table, level_m, np.zeros(2), book)
            shown = np.flatnonzero(prints.step % EVERY_STEPS == 0)
            row = np.searchsorted(table["vehicle"], states["vehicle"].iloc[shown])
            self.count += len(shown)
            yield self._batch(
                states.iloc[shown], table.iloc[row], shapely.to_wkb(_shapes(prints, shown))
            )
            self._reporter.progress("writing footprints", done, hours)

    def _batch(
        self, states: pd.DataFrame, vehicles: pd.DataFrame, shapes: np.ndarray
    ) -> pa.RecordBatch:
        begin_ms = states["step"].to_numpy(np.int64) * (STEP_US // 1000)
        end_ms = begin_ms + EVERY_STEPS * (STEP_US // 1000)
        speed_kmh = states["speed"].to_numpy(float) * 3.6
        heavy = vehicles["p_heavy"].to_numpy(float) >= HEAVY
        standing = np.abs(speed_kmh) < _STANDING_KMH
        columns = [
            states["vehicle"].to_numpy(np.int64),
            begin_ms,
            end_ms,
            np.where(heavy, "heavy", "light").astype(object),
            np.where(standing, "standing", "moving").astype(object),
            speed_kmh.round(1),
            states["heading"].to_numpy(float),
            vehicles["length_m"].to_numpy(float),
            vehicles["width_m"].to_numpy(float),
            states["lanelet_id"].astype(object).where(states["lanelet_id"].notna(), None).tolist(),
            states["seen"].to_numpy(np.bool_),
            shapes,
        ]
        arrays = [
            pa.array(column, field.type) for column, field in zip(columns, _SCHEMA, strict=True)
        ]
        return pa.RecordBatch.from_arrays(arrays, schema=_SCHEMA)


def _shapes(prints: Footprints, rows: Integers) -> np.ndarray:
    """Return the polygons of some footprints: from the rear's right corner, counter-clockwise."""
    middle, ahead = prints.boxes[rows, :2], prints.boxes[rows, 2:4]
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    along, across = ahead * prints.boxes[rows, 4:5], left * prints.boxes[rows, 5:6]
    corners = [-along - across, along - across, along + across, -along + across]
    shapes = np.asarray(shapely.polygons(middle[:, None] + np.stack(corners, axis=1)))
    for place in np.flatnonzero(prints.path[rows] >= 0):
        shapes[place] = _strip(prints, int(rows[place]))
    return shapes


def _strip(prints: Footprints, row: int) -> Any:
    """Return the strip of a long vehicle along the path that its front took."""
    x, y, ahead_x, ahead_y, half_length, half_width = prints.boxes[row]
    line: list[Floats] = [np.array([x + half_length * ahead_x, y + half_length * ahead_y])]
    backward, left_m, point = (
        np.array([-ahead_x, -ahead_y]),
        2.0 * half_length,
        int(prints.path[row]),
    )
    while left_m > 0.0:
        to_point = prints.points[point] - line[-1]
        whole_m = float(np.hypot(*to_point))
        backward = to_point / whole_m if whole_m > 0.0 else backward
        # before its first point the path is taken as straight
        part_m = left_m if prints.begins[point] else min(whole_m, left_m)
        line.append(line[-1] + part_m * backward)
        if prints.begins[point]:
            break
        left_m, point = left_m - part_m, point - 1
    strip = shapely.LineString(line).buffer(half_width, cap_style="flat", join_style="round")
    return max(shapely.get_parts(strip).tolist(), key=lambda part: part.area)
