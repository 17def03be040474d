"""Datasets that tests write from rows, without recordings."""

from __future__ import annotations

import json

import geopandas as gpd
import numpy as np
from maps import EAST, NORTH, UTM
from shapely import Polygon

from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset import (
    POSES,
    RECORDINGS,
    HourWriter,
    Manifest,
    Origin,
    TileCounts,
    create_dataset,
    hour_of_step,
    measure,
    open_dataset,
    write_single_file,
)
from gis_radar.dataset.files.tables import HIT_TABLES, HOUR_TABLES, SIGHTS
from gis_radar.hdmap import fingerprint
from gis_radar.scans import VIEW_ONLY

HOUR = 472_222  # 2023-11-14, 22 h
BEGIN = HOUR * STEPS_PER_HOUR
CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))


def square_tiles(count):
    """Make tiles of one straight lanelet, 0.5 m along and 3 m wide."""
    rows = [
        {
            "tile_id": i, "lanelet_id": 7, "index": i, "s_m": 0.5 * i, "length_m": 0.5,
            "width_m": 3.0, "height_m": 0.0, "subtype": "road", "lane": 7,
            "geometry": Polygon(
                [(EAST + 0.5 * (i + a), NORTH + 3.0 * b) for a, b in CORNERS]
            ),
        }
        for i in range(count)
    ]  # fmt: skip
    return gpd.GeoDataFrame(rows, crs=UTM)


def write_dataset(
    folder, tables=None, *, tiles=None, hours=None, vehicles=True, method=1, inputs="abc",
    settings=None, timezone="UTC", lanes=None, stop_lines=None, recordings=None, sights=None,
    continued=None, poses=(),
):  # fmt: skip
    """Write a dataset from rows of any hours by table, and open it.

    Rows are put into their hours by their first step; runs must not cross an hour. `hours` are
    written even where they have no rows. `continued` are pairs of numbers by hour. `lanes` without
    `lanelets` are the lanelets of their numbers.
    """
    tiles = square_tiles(20) if tiles is None else tiles
    tables = tables or {}
    manifest = Manifest(
        map="", fingerprint=fingerprint(tiles), crs=f"EPSG:{tiles.crs.to_epsg()}",
        origin=(int(EAST), int(NORTH)), timezone=timezone,
        settings={"vehicles": vehicles, "sight": VIEW_ONLY, "filters": {}}
        | (settings or {}),
    )  # fmt: skip
    if lanes is not None and "lanelets" not in lanes:
        lanes = lanes.assign(lanelets=[[number] for number in lanes["lane"]])
    create_dataset(folder, manifest, tiles, lanes=lanes, stop_lines=stop_lines)
    if recordings is not None:
        write_single_file(RECORDINGS, folder, recordings, manifest.fingerprint)
    if poses:
        write_single_file(POSES, folder, pose_rows(poses), manifest.fingerprint)
    if sights is not None:
        write_single_file(SIGHTS, folder, sights, manifest.fingerprint)
    kinds = {table.name: table for table in (HOUR_TABLES if vehicles else HIT_TABLES)}
    place = {
        name: np.asarray(rows["next"]) // 1_000_000 if name == "continued"
        else hour_of_step(np.asarray(rows[kinds[name].span[0]]))
        for name, rows in tables.items()
    }  # fmt: skip
    found = {int(each) for of in place.values() for each in of} | set(hours or [])
    origin = Origin(fingerprint=manifest.fingerprint, method=method, inputs=inputs)
    for hour in sorted(found):
        with HourWriter(folder=folder, hour=hour, origin=origin) as writer:
            for name, table in kinds.items():
                rows = table.empty()
                if name == "continued" and hour in (continued or {}):
                    rows = dict(zip(table.names, np.array(continued[hour]).T, strict=True))
                if name in tables:
                    mine = place[name] == hour
                    rows = {c: np.asanyarray(v)[mine] for c, v in tables[name].items()}
                writer.write(table, rows)
    for hour in sorted(found):
        TileCounts(folder=folder, fingerprint=manifest.fingerprint).update(hour)
    return open_dataset(folder)


def stored(dataset, name):
    """Read a table as it is stored; `turns` of a dataset are those for people."""
    return dataset.turn_volumes() if name == "turns" else getattr(dataset, name)()


def runs_of(steps):
    """Give the runs of a set of steps, or of a range, as (first, last), cut at hours."""
    if isinstance(steps, range):
        hours = range(steps.start // STEPS_PER_HOUR + 1, (steps.stop - 1) // STEPS_PER_HOUR + 1)
        begins = [steps.start, *(hour * STEPS_PER_HOUR for hour in hours)] if steps else []
        return list(zip(begins, [*(at - 1 for at in begins[1:]), steps.stop - 1], strict=False))
    ordered = np.array(sorted(steps), np.int64)
    cut = (np.diff(ordered) > 1) | (np.diff(ordered // STEPS_PER_HOUR) > 0)
    parts = np.split(ordered, np.flatnonzero(cut) + 1) if len(ordered) else []
    return [(part[0], part[-1]) for part in parts]


def run_rows(sets, names):
    """Give the rows of runs of sets of steps, by tile and whatever else is known of them."""
    rows = [(*key, *run) for key, steps in sets.items() for run in runs_of(steps)]
    rows.sort(key=lambda row: (row[0], row[-1]))
    columns = zip(*rows, strict=True) if rows else [[]] * (len(names) + 2)
    kinds = {"seen": bool}
    return {
        name: np.array(values, kinds.get(name, np.int64))
        for name, values in zip([*names, "first_step", "last_step"], columns, strict=True)
    }


def stepwise_dataset(
    folder, tiles, delivered, seen, hit, *, occupied=None, visible=None, **options
):
    """Write a dataset from sets of steps.

    `delivered` are the steps with a frame, `seen` the tiles, of each pair of sensor and pose; `hit`
    holds pairs of step and tile; `occupied` and `visible` are steps by tile and whether seen.
    """
    observed, order = {}, sorted(delivered)
    for key, steps in delivered.items():
        for tile in seen.get(key, ()):
            observed.setdefault((tile,), set()).update(steps)
    frames = sorted(
        (sensor, step * 50_000 + order.index((sensor, pose)), step, f"{sensor}-{pose}")
        for (sensor, pose), steps in delivered.items() for step in steps
    )  # fmt: skip
    columns = [list(each) for each in zip(*frames, strict=True)] or [[], [], [], []]
    step = np.array(columns[2], np.int64)
    count = dict.fromkeys(
        ("detections", "moving", "wild", "tiles_hit", "tiles_seen", "checksum", "shift_us"),
        np.zeros(len(step), np.int64),
    )
    hits = np.array(sorted((tile, at) for at, tile in hit), np.int64).reshape(-1, 2)
    tables = {
        "frames": {
            "sensor": np.array(columns[0], object), "time_us": np.array(columns[1], np.int64),
            "first_step": step, "last_step": step, "pose": np.array(columns[3], object),
            "pose_in_force": np.array(columns[3], object), **count,
        },
        "hits": {"tile_id": hits[:, 0], "step": hits[:, 1]},
        "observed": run_rows(observed, ["tile_id"]),
    }  # fmt: skip
    if visible is not None:
        tables["visible"] = run_rows(visible, ["tile_id", "seen"])
        tables["occupied"] = run_rows(occupied, ["tile_id", "seen"])
    pairs = sorted((f"{s}-{p}", tile) for (s, p), of in seen.items() for tile in of)
    sights = {"pose": [pose for pose, _ in pairs], "tile_id": [tile for _, tile in pairs]}
    sights = {"pose": np.array(sights["pose"], object), "tile_id": np.array(sights["tile_id"], int)}
    recordings = recordings_of({sensor for sensor, _ in delivered})
    return write_dataset(
        folder, tables, tiles=tiles, vehicles=visible is not None, sights=sights,
        recordings=recordings, **options,
    )  # fmt: skip


def pose_rows(poses):
    """Give the rows of poses, each under the name of its sensor."""
    rows = [
        {name: getattr(each, name, None) for name in POSES.names}
        | {"pose": each.sensor, "track": each.sensor, "sight": each.sensor,
           "document": json.dumps(each.as_dict())}
        for each in sorted(poses, key=lambda pose: pose.sensor)
    ]  # fmt: skip
    return {name: [row[name] for row in rows] for name in POSES.names}


def recordings_of(sensors, first_time=0.0, last_time=0.0):
    """Give the rows of recordings that are not there, one a sensor."""
    rows = [
        {
            "path": f"{name}.parquet",
            "digest": name,
            "sensor": name,
            "pose": name,
            "first_time": first_time,
            "last_time": last_time,
            "clock_offset": 0.0,
            "clock_drift_ppm": 0.0,
            "clock_at": 0.0,
            "validity_s": 0.1,
            "rows": 1,
            "has_rates": True,
            "has_elevation": True,
            "hours": [],
            "sights": None,
        }
        for name in sorted(sensors)
    ]
    return {name: [row[name] for row in rows] for name in RECORDINGS.names}


def measured(recordings, poses, tiles, folder, **options):
    """Measure hits alone, or with a map vehicles too; roads and traffic need not fit."""
    map_path = options.pop("map_path", None)
    options = {"check": False, "hits_only": map_path is None} | options
    return measure(recordings, poses, tiles, map_path, folder, **options)
