"""The two layers of a heat map: a row for each tile, and a row for each tile and interval."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
from numpy.typing import NDArray

from gis_radar.base import (
    STEPS_PER_SECOND,
    GisRadarError,
    InputError,
    Integers,
    LayerNotes,
    Reporter,
    Text,
    add_layer,
    add_styles,
    describe_layers,
    opened_package,
    read_only,
    seconds_from_iso,
    step_of,
)
from gis_radar.hdmap import LANE_COLUMN, TILE_COLUMNS, TILE_FIELDS, fingerprint, own_columns
from gis_radar.products.heatmap import style
from gis_radar.products.heatmap.counting import Tally
from gis_radar.products.heatmap.intervals import MapLabels, Timeline
from gis_radar.products.heatmap.occupancy import Occupancy
from gis_radar.products.heatmap.package_tables import (
    BEGIN,
    END,
    ERROR,
    LONG,
    STEPS,
    TILES_TABLE,
    WIDE,
    interval_columns,
    list_tiles_last,
    measure_columns,
    read_times,
    step_columns,
    write_steps,
    write_wide,
)

HEATMAP_FILE = "heatmap.gpkg"
Counted = dict[str, NDArray[Any]]

_STEP_MS = 50


def wide_layer(tally: Tally) -> gpd.GeoDataFrame:
    """Return a row for each tile: the whole time, and a column for each interval.

    Returns
    -------
    GeoDataFrame
        The tiles' columns, then `hit_s`, `observed_s`, `hit_share` over the whole time, and
        `hit_...`, the hit seconds of each interval, NaN where not observed in it. Where
        vehicles are known also `visible_s`, `occupied_s`, `occupancy`, `occupancy_se`, and
        `occ_...`, the occupied seconds of each interval, NaN where not visible in it.
    """
    columns, stamps = measure_columns(tally), interval_columns(tally)
    for i, stamp in zip(tally.columns, stamps, strict=True):
        columns[f"hit_{stamp}"] = tally.shares(i).hit_s
    for i, stamp in zip(tally.columns, stamps, strict=True):
        if (part := tally.occupancy_shares(i)) is not None:
            columns[f"occ_{stamp}"] = part.occupied_s
    shares = pd.DataFrame(columns, index=tally.tiles.index)
    attributes = tally.tiles.drop(columns="geometry")
    return gpd.GeoDataFrame(
        pd.concat([attributes, shares], axis=1), geometry=tally.tiles.geometry, crs=tally.crs
    )


def long_layer(tally: Tally) -> gpd.GeoDataFrame:
    """Return a row for each tile and interval, also where nothing was hit or observed.

    Returns
    -------
    GeoDataFrame
        `tile_id`, `lanelet_id`, `begin` and `end` (UTC; the end is exclusive), `hit_s`,
        `observed_s`, `hit_share`, where vehicles are known also `visible_s`, `occupied_s`,
        `occupancy`, `occupancy_se`, and geometry, ordered by interval, then by tile. Where a tile
        was not observed, `observed_s` is 0 and the other two are NaN.
    """
    parts = []
    tiles = tally.tiles[["tile_id", "lanelet_id"]]
    for i in range(len(tally.timeline)):
        times = (int(step[i]) * _STEP_MS for step in (tally.timeline.begin, tally.timeline.end))
        begin, end = (pd.Timestamp(time, unit="ms", tz="UTC").as_unit("ms") for time in times)
        parts.append(tiles.assign(**{BEGIN: begin, END: end}, **measure_columns(tally, i)))
    geometry = np.tile(tally.tiles.geometry.to_numpy(), len(tally.timeline))
    rows = pd.concat(parts, ignore_index=True)
    return gpd.GeoDataFrame(rows, geometry=geometry, crs=tally.crs)


def write_table(tally: Tally, path: Path) -> None:
    """Write the layer `heatmap` as GeoParquet 1.1 with a box for each row."""
    frame = wide_layer(tally)
    frame.attrs = tally.metadata
    frame.to_parquet(
        path,
        index=False,
        compression="zstd",
        schema_version="1.1.0",
        write_covering_bbox=True,
        write_page_checksum=True,  # so that a flipped bit is found on reading
    )


def write_package(tally: Tally, path: Path, reporter: Reporter) -> None:
    """Write the layer of tiles, the tables of counts, their views, and styles."""
    metadata = {
        name: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for name, value in tally.metadata.items()
    }
    options = {"geometry_type": "Polygon", "layer_metadata": metadata}
    add_layer(tally.tiles, path, TILES_TABLE, use_arrow=True, **options)
    about = f"fixed classes of {tally.measure}, so that maps compare"
    with closing(sqlite3.connect(path)) as database, database:
        write_wide(database, tally)
        write_steps(database, tally, reporter)
        list_tiles_last(database)
        describe_layers(database, _notes_of(tally))
        add_styles(database, styles_of(tally), name=tally.measure, about=about)


def write_one_layer(table: gpd.GeoDataFrame, path: Path, least_s: float) -> None:
    """Write tiles of several heat maps over their whole time as one layer with their style.

    Parameters
    ----------
    table : GeoDataFrame
        Rows of :func:`wide_layer` without intervals.
    path : Path
        The GeoPackage.
    least_s : float
        Visible time below which the occupancy of a tile is uncertain, seconds.
    """
    measure = "occupancy" if "occupancy" in table else "hit_share"
    styles = own_styles(measure, 0.0, {WIDE: least_s, LONG: least_s})
    add_layer(table, path, WIDE, use_arrow=True, geometry_type="Polygon")
    about = f"fixed classes of {measure}, so that maps compare"
    with closing(sqlite3.connect(path)) as database, database:
        add_styles(database, {WIDE: styles[WIDE]}, name=measure, about=about)


def styles_of(tally: Tally) -> dict[str, str]:
    """Return the QGIS styles of both layers of a heat map.

    Styles in its file are not used: anybody's may hold code in forms, actions and expressions.
    """
    length_s = float(tally.timeline.end[0] - tally.timeline.begin[0]) / STEPS_PER_SECOND
    least_s = {layer: tally.least_visible_s(part) for layer, part in ((WIDE, None), (LONG, 0))}
    return own_styles(tally.measure, length_s, least_s, _interval_titles(tally))


def own_styles(
    measure: str, length_s: float, least_s: Mapping[str, float],
    of_intervals: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, str]:  # fmt: skip
    """Return the QGIS styles of both layers; tiles visible for under `least_s` are uncertain.

    `of_intervals` are titles of the columns of intervals, of the layer of the whole time.
    """
    measured = {
        name: title for name, title in _TITLES.items()
        if measure == "occupancy" or name in _OF_HITS
    }  # fmt: skip
    titles = {name: title for name, (title, _) in TILE_FIELDS.items()}
    return {
        layer: style.vector_qml(
            interval_s=shown_s, measure=measure, least_s=least_s[layer],
            titles=titles | {**more} | measured,
        )
        for layer, shown_s, more in ((WIDE, None, of_intervals), (LONG, length_s, _TIMES))
    }  # fmt: skip


def _interval_titles(tally: Tally) -> dict[str, str]:
    """Return titles of the columns of intervals, such as `Occupied (s) 2025-06-12T07:30Z`."""
    titles = {}
    for prefix, measured in _OF_INTERVALS.items():
        for stamp in interval_columns(tally) if measured in measure_columns(tally) else ():
            time = f"{stamp[:4]}-{stamp[4:6]}-{stamp[6:11]}:{stamp[11:13]}"
            time += f":{stamp[13:15]}" * bool(stamp[13:]) + f".{stamp[15:]}" * bool(stamp[15:])
            titles[f"{prefix}_{stamp}"] = f"{_TITLES[measured]} {time}Z"
    return titles


_TIMES = {BEGIN: "Begin (UTC)", END: "End (UTC)"}
_OF_HITS = ("hit_s", "observed_s", "hit_share")
_OF_INTERVALS = {"hit": "hit_s", "occ": "occupied_s"}
_TITLES = {
    "hit_s": "Hit (s)",
    "observed_s": "Observed (s)",
    "hit_share": "Hit share",
    "visible_s": "Visible (s)",
    "occupied_s": "Occupied (s)",
    "occupancy": "Occupancy",
    "occupancy_se": "Occupancy, standard error",
}


def _notes_of(tally: Tally) -> dict[str, LayerNotes]:
    """Return titles and meanings of both layers and their fields."""
    measured = {name: (_TITLES[name], text) for name, text in tally.definitions.items()}
    times = {BEGIN: (_TIMES[BEGIN], "of the interval"), END: (_TIMES[END], "exclusive")}
    begin, end = tally.whole_iso
    about = f"{tally.definitions[tally.measure]}. Sensors {', '.join(tally.sensors)}"
    title = tally.labels.title or "Heat map"
    return {
        TILES_TABLE: LayerNotes(
            "Tiles", "slices of lanes that the heat map counts on", TILE_FIELDS
        ),
        WIDE: LayerNotes(
            f"{title}: {tally.measure}", f"{about}, {begin} to {end}", TILE_FIELDS | measured
        ),
        LONG: LayerNotes(
            f"{title}: {tally.measure} by interval", f"{about}, {begin} to {end}",
            TILE_FIELDS | times | measured,
        ),
    }  # fmt: skip


_HINT = Text("make one with: gis-radar heatmap")


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
    inside = path / "heatmap"
    hint = Text("did you mean {}?", inside) if (inside / HEATMAP_FILE).is_file() else _HINT
    path = path / HEATMAP_FILE if path.is_dir() else path
    with opened_package(path, what="a heat map", hint=hint) as place:
        return _fields(place, path)


def _fields(place: Path, path: Path) -> dict[str, Any]:
    """Return the fields of a tally from the GeoPackage `place`, named `path` in messages."""
    tiles = pyogrio.read_dataframe(
        place, layer=WIDE, columns=[*TILE_COLUMNS, LANE_COLUMN], use_arrow=True
    )
    metadata = pyogrio.read_info(place, layer=WIDE)["layer_metadata"] or {}
    whole = _checked_whole(tiles, metadata, path)
    with read_only(place) as database:
        times = read_times(database)
        names = step_columns(database)
    timeline = Timeline(
        begin=_steps_of([begin for begin, _ in times], path),
        end=_steps_of([end for _, end in times], path),
    )
    counts = _read_counts(path, tiles["tile_id"].to_numpy(np.int64), len(timeline), names)
    errors = pyogrio.read_dataframe(
        place, layer=WIDE, columns=["occupancy_se"], read_geometry=False, use_arrow=True
    )
    hit, observed = counts["hit"], counts["observed"]
    seen = np.flatnonzero(observed.any(axis=0))
    return {
        "tiles": tiles[[*own_columns(tiles), "geometry"]],
        "fingerprint": metadata["fingerprint"],
        "sensors": tuple(json.loads(metadata["sensors"])),
        "whole": whole,
        "timeline": whole if timeline.spans() == whole.spans() else timeline,
        "seen": seen,
        "hit": hit[:, seen].astype(np.uint32),
        "observed": observed[:, seen].astype(np.uint32),
        "occupancy": _occupancy_of(counts, seen, errors),
        "labels": _labels_of(metadata.get("labels", "{}"), path),
    }


def _labels_of(text: str, path: Path) -> MapLabels:
    """Return labels from their stored text; refuse a text that holds none."""
    try:
        return MapLabels(**json.loads(text))
    except (TypeError, ValueError, GisRadarError) as error:
        raise InputError("{}: its labels cannot be read: {}", path, error, hint=_HINT) from error


def _occupancy_of(counts: Counted, seen: Integers, errors: pd.DataFrame) -> Occupancy | None:
    """Return visible and occupied steps and errors of the seen tiles; None without vehicles."""
    if "visible" not in counts:
        return None
    return Occupancy(
        visible=counts["visible"][:, seen].astype(np.uint32),
        occupied=counts["occupied"][:, seen].astype(np.uint32),
        error=counts["occupancy_se"][:, seen].astype(np.float32),
        error_whole=errors["occupancy_se"].to_numpy(np.float32)[seen],
    )


def _checked_whole(tiles: gpd.GeoDataFrame, notes: dict[str, Any], path: Path) -> Timeline:
    """Return the whole time; refuse a table of tiles that was changed."""
    missing = [name for name in TILE_COLUMNS if name not in tiles]
    missing += [name for name in ("fingerprint", "sensors", "begin", "end") if name not in notes]
    if missing or not isinstance(tiles, gpd.GeoDataFrame):
        lacking = ", ".join(missing) or "geometry"
        raise InputError("{}: lacks {}", path, lacking, hint="make it again")
    if fingerprint(tiles) != notes["fingerprint"]:
        raise InputError("{}: its tiles were changed since it was made", path, hint="make it again")
    begin, end = (_steps_of([notes[name]], path) for name in ("begin", "end"))
    return Timeline(begin=begin, end=end)


def _steps_of(times: list[str], path: Path) -> Integers:
    return step_of(
        np.array([seconds_from_iso(each, what=Text("{}: time", path)) for each in times])
    )


def _read_counts(path: Path, tile_ids: Integers, intervals: int, names: list[str]) -> Counted:
    """Read the table of steps: for each column an (intervals, tiles) array."""
    rows = intervals * len(tile_ids)
    counts = {name: np.zeros(rows, np.float32 if name == ERROR else np.uint32) for name in names}
    done = 0
    with pyogrio.open_arrow(
        path, layer=STEPS, use_pyarrow=True, read_geometry=False, columns=["tile_id", *names]
    ) as (_, reader):
        for batch in reader:
            place = np.arange(done, done + len(batch))
            done += len(batch)
            expected = tile_ids[place % len(tile_ids)] if done <= rows else tile_ids[:0]
            if not np.array_equal(batch["tile_id"].to_numpy(), expected):
                done = -1
                break
            for name, values in counts.items():
                read = batch[name].to_numpy(zero_copy_only=False)
                values[place] = read if name == ERROR else np.nan_to_num(read)
    if done != rows or not rows:
        raise InputError(
            "{}: {} is damaged: not one row a tile and interval", path, STEPS, hint=_HINT
        )
    return {name: values.reshape(intervals, len(tile_ids)) for name, values in counts.items()}
