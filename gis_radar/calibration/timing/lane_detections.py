"""Match moving detections to lanes, with the speed along the lane by their Doppler."""

from __future__ import annotations

from dataclasses import dataclass

import geopandas as gpd
import numpy as np
import shapely

from gis_radar.base import Booleans, Floats, Integers, Reporter, Text
from gis_radar.calibration.registration.lanes import LANE_STEP_M, Lanes, sample_lanes
from gis_radar.calibration.registration.matches import match_along
from gis_radar.hdmap import quads
from gis_radar.poses import Pose, PoseTrack
from gis_radar.recordings import Detections, Recording

_STAGE = "reading traffic"
_LEAST_MPS = 1.5  # least speed along a lane: above walkers and leaves
# Least cosine between lane and line of sight (60 deg): across the sight the range rate gives no
# speed. Twice the value leaves no traffic.
_LEAST_SPEED_COSINE = 0.5
# Begin and end of the time that is read, seconds from the begin of the last recording: an hour of
# traffic, and an hour to either side for clock offsets.
_WINDOW_S = (-4000.0, 7600.0)
_PLACE_M = 10.0  # length of a place, within which the error of a pose is constant
_REACH_M = 300.0  # reach of the lanes around a sensor: the longest range of the sensors


@dataclass(frozen=True, kw_only=True)
class LaneDetections:
    """Detections of one sensor that move along lanes.

    Parameters
    ----------
    time : (n,) array
        UNIX seconds of the sensor's clock, ascending.
    lanelet : (n,) int64 array
        Number of the lanelet, the same for all sensors.
    s_m : (n,) array
        Distance along the lanelet, metres.
    speed : (n,) array
        Speed along the lanelet, m/s.
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

    @property
    def places(self) -> Integers:
        """Number of each detection's place: a section of `_PLACE_M` of its lanelet."""
        return self.lanelet * 100_000 + (self.s_m // _PLACE_M).astype(np.int64)

    def take(self, keep: Booleans | Integers) -> LaneDetections:
        """Return the detections selected by a mask or by indices."""
        return LaneDetections(**{name: values[keep] for name, values in vars(self).items()})

    def scaled(self, time: Floats, *, near_m: float, near_s: float, near_mps: float) -> Floats:
        """Return coordinates of detections in units in which near ones differ by 1 at most.

        Parameters
        ----------
        time : (n,) array
            Times of the detections, seconds from any origin.
        near_m, near_s, near_mps : float
            Units of distance along the lanelet, time and speed.

        Returns
        -------
        (n, 4) array
        """
        return np.column_stack(
            [self.lanelet * 1e4, self.s_m / near_m, time / near_s, self.speed / near_mps]
        )

    @classmethod
    def joined(cls, parts: list[LaneDetections]) -> LaneDetections:
        """Concatenate detections; none give an empty result."""
        none = {name: np.empty(0) for name in cls.__dataclass_fields__}
        none["lanelet"] = np.empty(0, np.int64)
        return cls(
            **{n: np.concatenate([first, *(getattr(part, n) for part in parts)])
               for n, first in none.items()}
        )  # fmt: skip


def lane_detections(
    lanes: Lanes, time: Floats, points: Floats, rate: Floats, sensor: Floats
) -> LaneDetections:
    """Match detections to lanes; return those on a lane with a speed of at least `_LEAST_MPS`.

    Parameters
    ----------
    lanes : Lanes
        The map.
    time : (n,) array
        UNIX seconds.
    points : (n, 3) array
        Local map coordinates, metres; the height is NaN without elevation.
    rate : (n,) array
        Range rates, m/s.
    sensor : (3,) array
        Position of the sensor, local map coordinates, metres.
    """
    offset = np.nan_to_num(points - sensor)
    reach = np.linalg.norm(offset, axis=1)
    sight = offset[:, :2] / np.maximum(reach, 1.0)[:, None]
    matches = match_along(lanes, points, sight, rate, reach, least_cosine=_LEAST_SPEED_COSINE)
    rows = np.flatnonzero(matches.found)
    sample = matches.lane[rows]
    ahead_m, left_m, _ = lanes.beside(sample, points[rows])
    cosine = np.sum(lanes.along[sample] * sight[rows], axis=1)
    speed = rate[rows] / cosine
    along_lane = (np.abs(left_m) <= lanes.width_m[sample] / 2.0) & (np.abs(ahead_m) <= LANE_STEP_M)
    along_lane &= speed >= _LEAST_MPS
    return LaneDetections(
        time=time[rows[along_lane]],
        lanelet=lanes.lane[sample[along_lane]],
        s_m=(lanes.s_m[sample] + ahead_m)[along_lane],
        speed=speed[along_lane],
        side=np.sign(cosine[along_lane]),
    )


def lanelets_of(tiles: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Return the lanelets of tiles, with the columns that :func:`sample_lanes` needs.

    Parameters
    ----------
    tiles : GeoDataFrame
        As from :func:`gis_radar.hdmap.tiles.read_tiles`.
    """
    corners = quads(tiles)
    ends = [(corners[:, i] + corners[:, j]) / 2.0 for i, j in ((0, 3), (1, 2))]
    height = tiles["height_m"].to_numpy(np.float64)
    ids, number = np.unique(tiles["lanelet_id"].to_numpy(), return_inverse=True)
    points = np.vstack([np.column_stack([end, height]) for end in ends])
    numbers, place = np.tile(number, 2), np.repeat([0.0, 0.5], len(tiles))
    place += np.tile(tiles["index"].to_numpy(), 2)
    is_last = np.bincount(number)[number] == tiles["index"].to_numpy() + 1
    order = np.flatnonzero(np.append(np.ones(len(tiles), dtype=bool), is_last))
    order = order[np.lexsort((place[order], numbers[order]))]
    centre = shapely.linestrings(points[order], indices=numbers[order])
    width = np.bincount(number, tiles["width_m"].to_numpy()) / np.bincount(number)
    return gpd.GeoDataFrame(
        {
            "centre": gpd.GeoSeries(centre, crs=tiles.crs),
            "participants": [("vehicle",)] * len(ids),
            "speed_limit_kmh": np.nan,
            "one_way": True,
        },
        geometry=shapely.buffer(centre, width / 2.0, cap_style="flat"),
        crs=tiles.crs,
    )


def read_lane_detections(
    recording: Recording,
    track: PoseTrack,
    lanelets: gpd.GeoDataFrame,
    latest_s: float,
    reporter: Reporter,
) -> LaneDetections:
    """Read a recording's detections that move along lanes, within `_WINDOW_S` of a time.

    Parameters
    ----------
    recording, track : Recording, PoseTrack
        The recording, and the pose track of its sensor.
    lanelets : GeoDataFrame
        As from :func:`lanelets_of`.
    latest_s : float
        UNIX seconds at which the last of all recordings begins. Of a recording without detections
        in the window around it, its first hours are read.
    reporter : Reporter
        Receives the progress.
    """
    middle, no_road = track.poses[0].position[:2], np.empty((0, 3))
    lanes = sample_lanes(lanelets, no_road, place=middle, reach_m=_REACH_M)
    parts: list[LaneDetections] = []
    around: list[LaneDetections] = []
    before_s, after_s = _WINDOW_S
    done, begin_s = 0, np.nan
    for batch in recording.read():
        begin_s = float(batch.time[0]) if done == 0 else begin_s
        done += len(batch)
        reporter.progress(Text("{}: {}", _STAGE, recording.path.name), done, recording.rows)
        if batch.time[0] > max(latest_s, begin_s) + after_s:
            break
        keep = np.abs(batch.time - latest_s - (before_s + after_s) / 2) <= (after_s - before_s) / 2
        if keep.any():
            around += _along_lanes(batch.take(keep), track, lanes)
        elif not around and batch.time[0] <= begin_s + after_s - before_s:
            parts += _along_lanes(batch, track, lanes)
    return LaneDetections.joined(around or parts)


def _along_lanes(rows: Detections, track: PoseTrack, lanes: Lanes) -> list[LaneDetections]:
    """Return the detections that move along a lane, for each pose of the track."""
    rows = rows.take(rows.present & (np.abs(rows.range_rate) >= _LEAST_MPS * _LEAST_SPEED_COSINE))
    pose_index = track.at(rows.time)
    by_pose = []
    for index in np.unique(pose_index).tolist():
        pose, rows_of_pose = track.poses[index], pose_index == index
        by_pose.append(
            placed_on_lanes(
                lanes,
                rows.time[rows_of_pose],
                rows.points[rows_of_pose],
                rows.range_rate[rows_of_pose],
                pose,
            )
        )
    return by_pose


def placed_on_lanes(
    lanes: Lanes, time: Floats, points: Floats, range_rate: Floats, pose: Pose
) -> LaneDetections:
    """Place detections of the sensor frame by a pose; return those that move along a lane."""
    origin = np.array([*lanes.origin, 0.0])
    placed = pose.to_map(points) - origin
    placed[np.isnan(points[:, 2]), 2] = np.nan
    return lane_detections(lanes, time, placed, range_rate, pose.position - origin)
