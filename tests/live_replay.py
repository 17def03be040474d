"""A live map of the sample's hit share, played step by step, for tests of what shows it."""

from __future__ import annotations

from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
from live_programs import rows_of

import gis_radar as gr
from gis_radar.base import step_begin
from gis_radar.dataset.files.tables import HITS, OBSERVED
from gis_radar.live import Place, QuarterMeasures, Snapshot
from gis_radar.live.now.now_filter import VehiclesNow
from gis_radar.live.served.snapshot import ShownSensor


class Replay:
    """The map at any step of a dataset; `at` sets which, `silent` takes sensors off."""

    def __init__(self, measure_once):
        self.alarms = {}  # by sensor, as ShownSensor has them
        sample = gr.sample_folder()
        roads = gr.read_map(sample / "junction.osm")
        tiles = gr.make_tiles(roads)
        names = ["R1", "R2"]
        self.poses = {name: gr.read_pose(sample / f"{name}.json") for name in names}
        recordings = [sample / f"{name}.parquet" for name in names]
        made = measure_once(
            recordings, list(self.poses.values()), tiles, sample / "junction.osm", hits_only=True
        )
        batch = gr.open_dataset(made)
        tile, step = rows_of(batch, HITS, ("tile_id", "step"))
        self.first, self.last = int(step.min()), int(step.max())
        self.step, self.tile = step, np.searchsorted(tiles["tile_id"], tile)
        self.seen = np.isin(tiles["tile_id"], rows_of(batch, OBSERVED, ("tile_id",))[0])
        self.place = Place(
            title="Sample junction",
            zone=ZoneInfo("Europe/Berlin"),
            tiles=tiles,
            lanes=roads.lanes(),
        )
        self.at, self.silent = self.first + 600, set()

    def snapshot(self):
        past = self.step <= self.at
        now = self.tile[self.step == self.at]
        return Snapshot(
            step=self.at,
            now=now,
            observed_now=self.seen,
            hit=np.bincount(self.tile[past], minlength=len(self.seen)),
            observed=np.where(self.seen, self.at - self.first + 1, 0),
            sensors=[
                ShownSensor(
                    name=name, online=name not in self.silent, pose=pose, lag_s=0.04,
                    frames_per_s=20.0, alarms=self.alarms.get(name, {}),
                )
                for name, pose in self.poses.items()
            ],
            vehicles=self.vehicles(now),
            quarter=self.quarter(past),
        )  # fmt: skip

    def vehicles(self, now):
        """Return a vehicle on some of the tiles that are hit."""
        middles = self.place.tiles.geometry.iloc[now[::5]].centroid
        rows = [(k, each.x, each.y, 0.3 * k, 9.0, 4.6 + 6.0 * (k == 1))
                for k, each in enumerate(middles)]  # fmt: skip
        return VehiclesNow.of(self.at / 20.0, np.array(rows).reshape(-1, 6))

    def quarter(self, past):
        """Return the hits as if they were occupied."""
        hits = np.bincount(self.tile[past], minlength=len(self.seen))
        visible = np.where(self.seen, self.at - self.first + 1, 0)
        each = np.arange(len(self.place.lane_numbers))
        lanes = pd.DataFrame(
            {"lane": self.place.lane_numbers, "occupancy": 0.1, "visible_share": 1.0,
             "counted": each, "volume": np.where(each > 2, each, np.nan), "volume_se": 0.5,
             "speed_kmh": np.where(each, 36.0, np.nan),
             "queue_max_m": np.where(each % 2, 23.4, np.nan)}
        )  # fmt: skip
        return QuarterMeasures(until_step=self.at, visible=visible, occupied=hits, lanes=lanes)

    def lane_intervals(self):
        begin = step_begin(self.first)
        return pd.DataFrame(
            {
                "lane": self.place.lane_numbers,
                "begin": pd.Timestamp(begin),
                "end": pd.Timestamp(begin) + pd.Timedelta("15min"),
                "hit_s": 1.0,
                "observed_s": 60.0,
            }
        )

    def metrics(self):
        return "# TYPE gis_radar_frames_total counter\ngis_radar_frames_total 1\n"
