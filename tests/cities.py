"""Cities that tests write: sites with a few hours in two months, drawn from driven ones."""

from __future__ import annotations

import json
import shutil
from functools import cache

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from datasets import pose_rows, recordings_of
from driven import drive, driven, straight_tiles
from shapely import LineString
from sites import pose

from gis_radar.base import STEPS_PER_HOUR
from gis_radar.dataset import (
    POSES,
    RECORDINGS,
    HourWriter,
    LaneTraffic,
    TileCounts,
    listed_hours,
    open_dataset,
    part_path,
    read_hour,
    write_single_file,
)
from gis_radar.dataset.files.tables import HOUR_TABLES, SIGHTS

HOUR = 472_222  # 2023-11-14, 22 h
LANES = gpd.GeoDataFrame(
    {
        "lane": [7], "lanelets": [[7]], "subtype": ["road"], "street": ["<Ring>"],
        "street_part": [None], "turn": ["left"], "stop_line_m": [50.0], "speed_limit_kmh": [50.0],
        "length_m": [60.0],
    },
    geometry=[LineString([(677_000, 5_403_000), (677_060, 5_403_000)])], crs="EPSG:25832",
)  # fmt: skip


def driven_hour(folder, *, every_s, speed=10.0, east_m=0.0):
    """Let cars drive over a straight lane for an hour, so many seconds apart; give the dataset."""
    lanes = LANES.assign(geometry=LANES.translate(east_m, east_m / 3))
    begin = HOUR * STEPS_PER_HOUR
    starts = np.arange(0, STEPS_PER_HOUR - 400, round(every_s * 20))
    fronts = np.arange(0.0, 59.0, speed / 20.0)
    cars = [drive(HOUR * 1_000_000 + n, begin + at, fronts, speed=speed)
            for n, at in enumerate(starts)]  # fmt: skip
    ends = [drive(HOUR * 1_000_000 + 900_000 + k, begin + at, [0.0])
            for k, at in enumerate((0, STEPS_PER_HOUR - 1))]  # fmt: skip
    return driven(folder, straight_tiles(20, length=3.0), pd.concat([*cars, *ends]), lanes=lanes)


def draw_hour(source, target, hour):
    """Write an hour of a dataset's copy as another hour, all its times and numbers shifted."""
    later = hour - HOUR
    record = read_hour(source, HOUR)
    shift = {
        "vehicle": later * 1_000_000, "step": later * STEPS_PER_HOUR,
        "first_step": later * STEPS_PER_HOUR, "last_step": later * STEPS_PER_HOUR,
        "time_us": later * 3_600_000_000, "next": later * 1_000_000,
    }  # fmt: skip
    with HourWriter(folder=target, hour=hour, origin=record.origin) as writer:
        for table in HOUR_TABLES:
            if table.name in record.parts:
                rows = pq.read_table(part_path(source, table, HOUR), partitioning=None)
                for name in set(shift) & set(rows.column_names):
                    values = rows[name].to_numpy() + shift[name]
                    rows = rows.set_column(
                        rows.column_names.index(name), rows.schema.field(name), [values]
                    )
                writer.write(table, rows)


@cache
def drawn_hours(source, fingerprint, hours):
    """Draw the hours of a site once for all that have the same; return their folder."""
    folder = source.with_name(f"{source.name}-{hours[0]}-{len(hours)}")
    shutil.copytree(source, folder)
    for part in ("hours", *(table.name for table in HOUR_TABLES), "tile_counts", "lane_measures",
                 "turns"):  # fmt: skip
        shutil.rmtree(folder / part, ignore_errors=True)
    for hour in hours:
        draw_hour(source, folder, hour)
    for hour in {each // 24 * 24: each for each in listed_hours(folder)}.values():
        TileCounts(folder=folder, fingerprint=fingerprint).update(hour)
        LaneTraffic(folder=folder, fingerprint=fingerprint).update(hour)
    return folder


def write_site(root, name, source, hours, *, sensors=None, clock_offset=0.0):
    """Write a site of a city with drawn hours; `sensors` are spans of hours that each recorded."""
    folder, fingerprint = root / f"site={name}", source.manifest.fingerprint
    shutil.copytree(drawn_hours(source.folder, fingerprint, tuple(hours)), folder)
    sensors = sensors or {"R1": [(each, each + 1) for each in hours]}
    rows = [
        {key: of[0] for key, of in recordings_of({sensor}).items()}
        | {"first_time": first * 3600.0, "last_time": after * 3600.0 - 0.05,
           "digest": f"{sensor}-{first}", "clock_offset": clock_offset}
        for sensor, spans in sorted(sensors.items()) for first, after in spans
    ]  # fmt: skip
    write_single_file(
        RECORDINGS, folder, {n: [r[n] for r in rows] for n in RECORDINGS.names}, fingerprint
    )
    poses = [pose(sensor=sensor) for sensor in sorted(sensors)]
    write_single_file(POSES, folder, pose_rows(poses), fingerprint)
    tiles = source.tiles()["tile_id"].to_numpy()
    parts = np.array_split(tiles, len(sensors))  # each sees tiles of its own
    sights = {"pose": np.repeat(sorted(sensors), [len(each) for each in parts]), "tile_id": tiles}
    write_single_file(SIGHTS, folder, sights, fingerprint)
    return open_dataset(folder)


def write_run(root, name, **site):
    """Write what a run of a site notes, and a report to be linked."""
    folder = root / "results" / name
    folder.mkdir(parents=True)
    document = {"site": {"title": name, "sensor": []} | site, "stages": []}
    (folder / "run.json").write_text(json.dumps(document), encoding="utf-8")
    (folder / "report.html").write_text("<title>a report</title>", encoding="utf-8")
