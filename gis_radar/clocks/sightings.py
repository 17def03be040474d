"""Sightings: moving detections on the lanes, with the speed along the lane that they imply."""

from __future__ import annotations

from dataclasses import dataclass

import geopandas as gpd
import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.poses.files import PoseTrack
from gis_radar.progress import Reporter
from gis_radar.recordings.recording import Detections, Recording
from gis_radar.tiles.lookup import TileGrid
from gis_radar.tiles.tiles import quads

MIN_SPEED_MPS = 1.5
MAX_SPEED_MPS = 60.0
MIN_COSINE = 0.5  # between lane and line of sight: a range rate across it tells no speed
MOST_HEIGHT_M = 4.5
STAGE = "reading traffic"
HOURS_S = (-4000.0, 7600.0)  # an hour of traffic, and an hour that a clock may be off, twice


@dataclass(frozen=True, kw_only=True)
class Sightings:
    """What one sensor saw move along the lanes.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds of the sensor's clock, ascending.
    lanelet : (n,) int64 array
        Number of the lanelet, the same for all sensors.
    s_m : (n,) array
        Place along the lanelet, metres.
    speed : (n,) array
        Along the lanelet, m/s.
    side : (n,) array
        1 where the vehicle recedes and shows its rear, -1 where it shows its front.
    """

    time: Floats
    lanelet: Integers
    s_m: Floats
    speed: Floats
    side: Floats

    def __len__(self) -> int:
        return len(self.time)

    def take(self, keep: Booleans | Integers) -> Sightings:
        """Return some of them."""
        return Sightings(**{name: values[keep] for name, values in vars(self).items()})

    @classmethod
    def joined(cls, parts: list[Sightings]) -> Sightings:
        """Put parts one after the other."""
        return cls(
            **{
                name: np.concatenate([getattr(part, name) for part in parts])
                for name in cls.__dataclass_fields__
            }
        )


class Lanes:
    """The lanes as tiles: finds where on a lane a detection lies.

    Parameters
    ----------
    tiles : GeoDataFrame
        As from :func:`gis_radar.tiles.tiles.read_tiles`.
    """

    def __init__(self, tiles: gpd.GeoDataFrame) -> None:
        corners = quads(tiles)
        self._engine = TileGrid(corners)
        self._begin = (corners[:, 0] + corners[:, 3]) / 2
        along = (corners[:, 1] + corners[:, 2]) / 2 - self._begin
        self._ahead = along / np.linalg.norm(along, axis=1, keepdims=True)
        self._s_m = tiles["s_m"].to_numpy(np.float64)
        self._height_m = tiles["height_m"].to_numpy(np.float64)
        self._lanelet = np.unique(tiles["lanelet_id"].to_numpy(), return_inverse=True)[1]

    def sightings(self, rows: Detections, track: PoseTrack) -> Sightings:
        """Return what moves along a lane; a detection on two lanelets counts on both."""
        rows = rows.take(rows.present & (np.abs(rows.range_rate) >= MIN_SPEED_MPS * MIN_COSINE))
        held = track.at(rows.time)
        parts = [self._of(rows, held == i, track, i) for i in np.unique(held)]
        nothing = np.empty(0)
        empty = Sightings(
            time=nothing, lanelet=np.empty(0, np.int64), s_m=nothing, speed=nothing, side=nothing
        )
        return Sightings.joined([empty, *parts])

    def _of(self, rows: Detections, now: Booleans, track: PoseTrack, index: int) -> Sightings:
        pose = track.poses[index]
        place = pose.to_map(rows.points[now])
        point, tile = self._engine.assign(place[:, 0], place[:, 1])
        sight = place[point] - pose.position
        cosine = np.einsum("ij,ij->i", sight[:, :2], self._ahead[tile])
        cosine /= np.linalg.norm(sight, axis=1)
        speed = rows.range_rate[now][point] / np.where(cosine == 0.0, np.nan, cosine)
        over_road = np.nan_to_num(np.abs(place[point, 2] - self._height_m[tile]))
        keep = (np.abs(cosine) >= MIN_COSINE) & (over_road <= MOST_HEIGHT_M)
        keep &= (speed >= MIN_SPEED_MPS) & (speed <= MAX_SPEED_MPS)
        point, tile = point[keep], tile[keep]
        offset = np.einsum("ij,ij->i", place[point, :2] - self._begin[tile], self._ahead[tile])
        return Sightings(
            time=rows.time[now][point],
            lanelet=self._lanelet[tile].astype(np.int64),
            s_m=self._s_m[tile] + offset,
            speed=speed[keep],
            side=np.sign(cosine[keep]),
        )


def read_sightings(
    recording: Recording, track: PoseTrack, lanes: Lanes, latest_s: float, reporter: Reporter
) -> Sightings:
    """Read what a sensor saw move in a few hours, by its own clock.

    Parameters
    ----------
    recording, track : Recording, PoseTrack
        What is read, and where its sensor stood.
    lanes : Lanes
        The lanes.
    latest_s : float
        When the last of all recordings begins: the hours around it are read, so that long ones
        meet. Where this one is over by then, its own first hours.
    reporter : Reporter
        Hears how far the work is.
    """
    parts: list[Sightings] = []
    around: list[Sightings] = []
    done, begin_s = 0, np.nan
    for piece in recording.read():
        begin_s = float(piece.time[0]) if done == 0 else begin_s
        done += len(piece)
        reporter.progress(f"{STAGE}: {recording.path.name}", done, recording.rows)
        if piece.time[0] > max(latest_s, begin_s) + HOURS_S[1]:
            break
        keep = np.abs(piece.time - latest_s - sum(HOURS_S) / 2) <= (HOURS_S[1] - HOURS_S[0]) / 2
        if keep.any():
            around.append(lanes.sightings(piece.take(keep), track))
        elif not around and piece.time[0] <= begin_s + HOURS_S[1] - HOURS_S[0]:
            parts.append(lanes.sightings(piece, track))
    return Sightings.joined(around or parts)
