"""The sample's vehicles as fusion follows them, without a broker: what sensors send, in order."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

import gis_radar as gr
from gis_radar.dataset.tables import OCCUPIED, PASSAGES, TRACKS, VISIBLE
from gis_radar.lanelets.graph import lane_graph
from gis_radar.live.detections import DetectionSelector, pack_detections, unpack_detections
from gis_radar.live.sources import frames_of_recording
from gis_radar.live.vehicles.clocks import SensorFrame
from gis_radar.live.vehicles.follower import FollowedSite, VehicleFollower
from gis_radar.live.vehicles.settings import DEFAULTS
from gis_radar.live.vehicles.store import FollowedPose, VehicleStore
from gis_radar.measures.views import ViewBook
from gis_radar.sight import SightTiles
from gis_radar.tracking.map_check import map_of_tiles
from gis_radar.tracking.visibility import SensorView

SAME_M = 2.0


class Sent:
    """What the sensors of a site send of its recordings, packed and unpacked, by time."""

    def __init__(self, map_path, recordings, poses, folder):
        self.tiles = gr.make_tiles(gr.read_map(map_path))
        road = SightTiles.of(self.tiles)
        self.book, self.poses = ViewBook(road=road), poses
        self.views = {pose.sensor: self.book.see(pose) for pose in poses}
        roads, described = map_of_tiles(map_path, self.tiles)
        self.site = FollowedSite(
            sensors=sorted(self.views), tiles=self.tiles, fingerprint=road.fingerprint,
            graph=lane_graph(roads.lanelets), map=described, sight="view only", folder=folder,
        )  # fmt: skip
        self.messages = []
        for recording, pose in zip(recordings, poses, strict=bool(recordings)):
            finder = DetectionSelector(road)
            road_m = self.book.road_m[pose.sensor, self.views[pose.sensor]]
            for frame in frames_of_recording(recording):
                content = pack_detections([finder.find(frame, pose, road_m=road_m)], pose=1)
                self.messages.append((float(frame.time[0]), pose.sensor, content))
        self.messages.sort(key=lambda each: each[0])

    def at(self, folder):
        """Return the same with files in another folder."""
        made = copy(self)
        folder.mkdir()
        made.site = replace(self.site, folder=folder)
        return made

    def follower(self, settings=DEFAULTS):
        """Return a follower on the files in the site's folder, which knows the poses."""
        store = VehicleStore(self.site.folder / "store", fingerprint=self.site.fingerprint)
        made = VehicleFollower(site=self.site, store=store, settings=settings)
        self.rows = {}
        for pose in self.poses:
            view = self.views[pose.sensor]
            seen = SensorView(
                sensor=pose.sensor, view=view, tile_id=self.book.tiles[view],
                position=pose.position,
            )  # fmt: skip
            road_m = self.book.road_m[pose.sensor, view]
            store.add_view(seen, road_m)
            made.add_view(seen, road_m)
            followed = FollowedPose(
                sensor=pose.sensor, view=view, validity_s=0.1, content=pose.as_dict()
            )
            self.rows[pose.sensor] = store.add_pose(followed)
            made.add_pose(self.rows[pose.sensor], followed)
        return made

    def feed(self, follower, messages, *, at_once=100, each=id):
        """Hand messages on as the process does, and follow the blocks that are due; yield them."""
        for begin in range(0, len(messages), at_once):
            found = []
            for _, sensor, content in messages[begin : begin + at_once]:
                _, frames = unpack_detections(content)
                found += [SensorFrame(sensor, self.rows[sensor], one, content) for one in frames]
            each(follower.take(found))
            follower.keep()
            while (span := follower.due()) is not None:
                yield follower.finish(*follower.begin(span))

    def end(self, follower):
        """Follow what is left; yield the blocks."""
        while (span := follower.due(everything=True)) is not None:
            yield follower.finish(*follower.begin(span))


def compare(mine, theirs, tiles, *, every=20):
    """Compare a folder of vehicles of an hour by a dataset."""
    states = [pd.read_parquet(mine / "tracks.parquet"), states_of(theirs)]
    both, off = 0, []
    mine_by_step, theirs_by_step = (
        dict(list(each[each["step"] % every == 0].groupby("step"))) for each in states
    )
    for step, rows in theirs_by_step.items():
        if step not in mine_by_step:
            continue
        places = [each[["easting", "northing"]].to_numpy() for each in (rows, mine_by_step[step])]
        apart = np.hypot(*np.moveaxis(places[0][:, None] - places[1], -1, 0))
        row, column = linear_sum_assignment(np.minimum(apart, SAME_M))
        near = apart[row, column][apart[row, column] < SAME_M]
        both += len(near)
        off += near.tolist()
    runs = [
        [pd.read_parquet(mine / f"{name}.parquet") for name in ("occupied", "visible")],
        [table_of(theirs, kind) for kind in (OCCUPIED, VISIBLE)],
    ]
    shares = [occupancy(*each, tiles) for each in runs]
    known = np.isfinite(shares[0]) & np.isfinite(shares[1])
    passages = [pd.read_parquet(mine / "passages.parquet"), table_of(theirs, PASSAGES)]
    passed = [each.groupby("lanelet_id").size() for each in passages]
    return {
        "recall": both / sum(map(len, theirs_by_step.values())),
        "precision": both / sum(map(len, mine_by_step.values())),
        "rms_m": float(np.sqrt(np.mean(np.square(off)))),
        "occupancy": float(shares[0][known].mean()),
        "occupancy_batch": float(shares[1][known].mean()),
        "occupancy_error": float(np.abs(shares[0] - shares[1])[known].mean()),
        "passages": int(passed[0].sum()),
        "passages_batch": int(passed[1].sum()),
        "passages_off": int(passed[0].sub(passed[1], fill_value=0).abs().sum()),
    }


def frames_in(folder):
    """Return the runs of frames of a folder of vehicles."""
    return pd.read_parquet(folder / "frames.parquet")


def table_of(dataset, kind):
    """Return a table of a dataset as its files hold it."""
    return pd.concat([part.to_pandas() for part in dataset.batches(kind)], ignore_index=True)


def states_of(dataset):
    """Return the states of a dataset's vehicles, metres."""
    rows = table_of(dataset, TRACKS)
    east, north = dataset.manifest.origin
    return rows.assign(easting=0.01 * rows["x_cm"] + east, northing=0.01 * rows["y_cm"] + north)


def occupancy(occupied, visible, tiles):
    """Return the occupancy of each tile over the whole time, NaN where not visible."""
    sums = np.zeros((2, len(tiles)))
    for row, runs in enumerate((occupied, visible)):
        tile = np.searchsorted(tiles["tile_id"], runs["tile_id"])
        np.add.at(sums[row], tile, runs["last_step"] - runs["first_step"] + 1)
    with np.errstate(invalid="ignore"):
        return sums[0] / np.where(sums[1] > 0, sums[1], np.nan)
