"""The sample's vehicles as fusion follows them, without a broker: what sensors send, in order."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

import gis_radar as gr
from gis_radar.lanelets.graph import lane_graph
from gis_radar.live.returns import ReturnFinder, pack_returns, unpack_returns
from gis_radar.live.sources import frames_of_recording
from gis_radar.live.vehicles.clocks import ReturnFrame
from gis_radar.live.vehicles.follower import FollowedSite, VehicleFollower
from gis_radar.live.vehicles.settings import DEFAULTS
from gis_radar.live.vehicles.store import FollowedPose, VehicleStore
from gis_radar.occupancy.views import ViewBook
from gis_radar.sight import SightTiles
from gis_radar.vehicles.map_check import map_of_tiles
from gis_radar.vehicles.visibility import SensorView

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
            finder = ReturnFinder(road)
            road_m = self.book.road_m[pose.sensor, self.views[pose.sensor]]
            for frame in frames_of_recording(recording):
                content = pack_returns([finder.find(frame, pose, road_m=road_m)], pose=1)
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
                sensor=pose.sensor, view=view, hold_s=0.1, content=pose.as_dict()
            )
            self.rows[pose.sensor] = store.add_pose(followed)
            made.add_pose(self.rows[pose.sensor], followed)
        return made

    def feed(self, follower, messages, *, at_once=100, each=id):
        """Hand messages on as the process does, and follow the blocks that are due; yield them."""
        for begin in range(0, len(messages), at_once):
            found = []
            for _, sensor, content in messages[begin : begin + at_once]:
                _, frames = unpack_returns(content)
                found += [ReturnFrame(sensor, self.rows[sensor], one, content) for one in frames]
            each(follower.take(found))
            follower.keep()
            while (span := follower.due()) is not None:
                yield follower.finish(*follower.begin(span))

    def end(self, follower):
        """Follow what is left; yield the blocks."""
        while (span := follower.due(everything=True)) is not None:
            yield follower.finish(*follower.begin(span))


def compare(mine, theirs, tiles, *, every=10):
    """Compare two folders of vehicles, the first by the second."""
    one, other = (gr.read_vehicles(each) for each in (mine, theirs))
    states = [pd.concat(list(each.tracks())) for each in (one, other)]
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
    shares = [coverage(each, tiles) for each in (one, other)]
    known = np.isfinite(shares[0]) & np.isfinite(shares[1])
    passed = [each.passages.groupby("lanelet_id").size() for each in (one, other)]
    return {
        "recall": both / sum(map(len, theirs_by_step.values())),
        "precision": both / sum(map(len, mine_by_step.values())),
        "rms_m": float(np.sqrt(np.mean(np.square(off)))),
        "coverage": float(shares[0][known].mean()),
        "coverage_batch": float(shares[1][known].mean()),
        "coverage_error": float(np.abs(shares[0] - shares[1])[known].mean()),
        "passages": int(passed[0].sum()),
        "passages_batch": int(passed[1].sum()),
        "passages_off": int(passed[0].sub(passed[1], fill_value=0).abs().sum()),
    }


def coverage(vehicles, tiles):
    """Return the coverage of each tile over the whole time, NaN where not visible."""
    sums = np.zeros((2, len(tiles)))
    for block in vehicles.blocks():
        for row, runs in enumerate((block.covered, block.visible)):
            tile = np.searchsorted(tiles["tile_id"], runs["tile_id"])
            np.add.at(sums[row], tile, runs["last_step"] - runs["first_step"] + 1)
    with np.errstate(invalid="ignore"):
        return sums[0] / np.where(sums[1] > 0, sums[1], np.nan)
