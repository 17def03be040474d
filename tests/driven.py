"""Vehicles that tests let drive, and datasets of their tracks."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
from datasets import recordings_of, run_rows, write_dataset
from maps import EAST, NORTH
from sites import pose

from gis_radar.base import STEPS_PER_HOUR, TRACK_EVERY_STEPS
from gis_radar.dataset import FRAMES
from gis_radar.hdmap import polygons

FIRST = 34_000_000_000


def straight_tiles(count=40, *, length=0.5, width=3.0, lanelet_id=7, height=np.nan):
    """Lay the tiles of a lanelet that goes east from (0, 0)."""
    x = np.arange(count) * length
    ahead = np.array([length, 0.0])
    right, left = (np.column_stack([x, np.full(count, side)]) for side in (-width / 2, width / 2))
    return gpd.GeoDataFrame(
        {
            "tile_id": np.arange(count),
            "lanelet_id": lanelet_id,
            "index": np.arange(count),
            "s_m": x,
            "length_m": length,
            "width_m": width,
            "height_m": height,
            "subtype": "road",
        },
        geometry=polygons(np.stack([right, right + ahead, left + ahead, left], axis=1)),
        crs="EPSG:25832",
    )


def drive(vehicle, first_step, fronts, *, speed=10.0, lanelet_id=7, length=4.5, seen=True):
    """Give the states of a vehicle that goes east, its front at x = fronts."""
    fronts = np.asarray(fronts, float)
    return pd.DataFrame(
        {
            "vehicle": vehicle,
            "step": first_step + np.arange(len(fronts)),
            "easting": fronts - length / 2,
            "northing": 0.0,
            "heading": 0.0,
            "speed": speed,
            "lanelet_id": pd.array(np.full(len(fronts), lanelet_id), dtype="Int64"),
            "s_m": fronts,
            "d_m": 0.0,
            "seen": seen,
        }
    )


def driven(
    folder, tiles, tracks, *, length=4.5, width=1.8, p_heavy=0.0, continued=None, seen_from=None,
    unseen=(), until=None, hidden=None, **options,
):  # fmt: skip
    """Write a dataset of tracks, states of which are every step; give it.

    It is seen from a pose, the usual one where none is given; what else `write_dataset` takes it
    may be given, too.
    Tiles that are `unseen` are in nobody's sight; those of `until` are observed before a step only,
    those `hidden` visible before one.
    Vehicles that drive on in another hour have another number in it, as `continued` says.
    """
    tracks = tracks.sort_values(["vehicle", "step"], ignore_index=True)
    ends = tracks.groupby("vehicle")["step"].agg(["min", "max"])
    step = tracks["step"]
    known = ends.loc[tracks["vehicle"]]
    at_end = (step == known["min"].to_numpy()) | (step == known["max"].to_numpy())
    kept = tracks[(step % TRACK_EVERY_STEPS == 0) | at_end]
    steps = np.arange(step.min(), step.max() + 1)
    ids = tiles.loc[~tiles["tile_id"].isin(unseen), "tile_id"].to_numpy()
    first, end = int(steps[0]), int(steps[-1]) + 1
    last = until or {}
    whole = {(n, True): range(first, max(first, min(last.get(n, end), end))) for n in ids}
    shown = {k: range(of.start, min((hidden or {}).get(k[0], end), of.stop))
             for k, of in whole.items()}  # fmt: skip
    frames = {"sensor": np.full(len(steps), "R1"), "time_us": steps * 50_000, "first_step": steps,
              "last_step": steps, "pose": np.full(len(steps), "R1")}  # fmt: skip
    zeros = [name for name in FRAMES.names if name not in frames]
    dataset = write_dataset(
        folder,
        {
            "frames": frames | dict.fromkeys(zeros, np.zeros(len(steps), np.int64)),
            "observed": run_rows({(tile,): of for (tile, _), of in whole.items()}, ["tile_id"]),
            "visible": run_rows(shown, ["tile_id", "seen"]),
            "tracks": _rows(kept),
            "vehicles": _vehicles(tracks, ends, length, width, p_heavy),
        },
        tiles=tiles, recordings=recordings_of({"R1"}, first / 20, (end - 1) / 20),
        poses=[seen_from or pose()], continued=continued,
        sights={"pose": np.full(len(ids), "R1"), "tile_id": ids}, **options,
    )  # fmt: skip
    assert hours_of(tracks) == len(dataset.records())
    return dataset


def hours_of(tracks):
    """Count the hours from the first to the last state."""
    first, last = (int(each) // STEPS_PER_HOUR for each in tracks["step"].agg(["min", "max"]))
    return last - first + 1


def _rows(states):
    """Give states as the table of tracks holds them."""

    def whole(values):
        return np.ma.masked_invalid(np.rint(np.asarray(values, float) * 100.0)).astype(np.int64)

    lanelet = states["lanelet_id"]
    return {
        "vehicle": states["vehicle"].to_numpy(),
        "step": states["step"].to_numpy(),
        "x_cm": whole(states["easting"] - int(EAST)),
        "y_cm": whole(states["northing"] - int(NORTH)),
        "heading_cdeg": whole(states["heading"]),
        "speed_cms": whole(states["speed"]),
        "lanelet_id": np.ma.array(lanelet.fillna(0).to_numpy(np.int64), mask=lanelet.isna()),
        "s_cm": whole(states["s_m"]),
        "d_cm": whole(states["d_m"]),
        "seen": states["seen"].to_numpy(bool),
    }


def _vehicles(tracks, ends, length, width, p_heavy):
    count = len(ends)
    lanelets = np.empty(count, object)
    for i, mine in enumerate(tracks.groupby("vehicle")["lanelet_id"].unique()):
        lanelets[i] = mine.dropna().tolist()
    return {
        "vehicle": ends.index.to_numpy(), "first_step": ends["min"].to_numpy(),
        "last_step": ends["max"].to_numpy(), "length_m": np.full(count, length),
        "width_m": np.full(count, width), "length_sigma_m": np.full(count, 0.3),
        "p_exists": np.ones(count), "p_heavy": np.full(count, p_heavy), "lanelets": lanelets,
    }  # fmt: skip
