"""Recordings of the sample with an hour's edge where a test wants it, and datasets of them."""

from __future__ import annotations

from functools import cache

import pandas as pd

import gis_radar as gr

SAMPLE = gr.sample_folder()
MAP = SAMPLE / "junction.osm"
BEGIN_S = 1_749_713_400.0  # of the sample's recordings
EDGE_S = 1_749_715_200.0  # the begin of an hour


@cache
def tiles():
    """Tiles of the sample junction."""
    return gr.make_tiles(gr.read_map(MAP))


@cache
def sample_pose(sensor):
    """Where a sensor of the sample stands."""
    return gr.read_pose(SAMPLE / f"{sensor}.json")


@cache
def rows(sensor):
    """The rows of a recording of the sample."""
    return pd.read_parquet(SAMPLE / f"{sensor}.parquet")


def cut(path, sensor, begin_s, end_s, *, edge_s, change=None):
    """Write some seconds of the sample so that an hour begins `edge_s` after the sample's begin."""
    table = rows(sensor)
    since = table["time"] - BEGIN_S
    table = table[(since >= begin_s) & (since < end_s)]
    # by whole steps, so that frames stay in theirs
    table = table.assign(time=table["time"] + (EDGE_S - BEGIN_S - edge_s))
    path.parent.mkdir(parents=True, exist_ok=True)
    (table if change is None else change(table)).to_parquet(path, index=False)
    return path


def measured(folder, *recordings, **options):
    """Measure recordings, each a pair of sensor and path; that poses fit is tested elsewhere."""
    options = {"check": False} | options
    poses = [sample_pose(sensor) for sensor, _ in recordings]
    return gr.measure([path for _, path in recordings], poses, tiles(), MAP, folder, **options)


def contents(folder):
    """Return the bytes of all files of a dataset."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "tiles.gpkg"  # not of equal bytes, and never rewritten
    }
