"""Match moving detections to lanes, with the speed along the lane that their Doppler implies."""

from __future__ import annotations

from dataclasses import dataclass

import geopandas as gpd
import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.poses.files import PoseTrack
from gis_radar.progress import Reporter
from gis_radar.recordings.recording import Detections, Recording
from gis_radar.texts import Text
from gis_radar.tiles.lookup import TileGrid
from gis_radar.tiles.tiles import quads

STAGE = "reading traffic"


@dataclass(frozen=True, kw_only=True)
class ClockSettings:
    """What may be set where clocks are compared; written to the file of clocks.

    Sensitivity, on the sample's two sensors (sigma 10 ms): half or twice any constant of the rough
    search does not change the offset; half or twice a limit of speed or height changes it by under
    10 ms; twice `min_cosine` leaves no traffic.

    Parameters
    ----------
    min_speed_mps, max_speed_mps : float
        Speeds along a lane that count, m/s: over walkers and leaves, under 216 km/h.
    min_cosine : float
        Between lane and line of sight; across it (60 deg) the range rate implies no speed.
    max_over_road_m : float
        Height over the road, metres: the 4 m of a vehicle in the EU, and half a metre of error.
    window_s : (float, float)
        What is read, seconds about the begin of the last recording: an hour of traffic, and twice
        an hour by which a clock may be off.
    max_offset_s : float
        Largest offset looked for, beyond what the begins of the times differ by: over an hour,
        the usual mistake of a time zone.
    bin_s : float
        Width of the bins of time in which agreement is counted: in one a vehicle moves by about a
        cell (4 m).
    rough_score : float
        Least height of the best lag in robust standard deviations over the agreement at other
        lags, of which there are tens of thousands.
    rough_pairs : int
        Least cells that both saw: fewer are chance.
    least_pairs, least_vehicles : int
        Fewer are refused: a sigma from fewer vehicles is not one.
    max_sigma_s : float
        A larger sigma is refused, seconds: five steps.
    least_share : float
        Least share of vehicles that both saw at the answer.
    contradiction_sigmas : float
        Pairs of sensors that differ by more are warned of.
    """

    min_speed_mps: float = 1.5
    max_speed_mps: float = 60.0
    min_cosine: float = 0.5
    max_over_road_m: float = 4.5
    window_s: tuple[float, float] = (-4000.0, 7600.0)
    max_offset_s: float = 4000.0
    bin_s: float = 0.25
    rough_score: float = 8.0
    rough_pairs: int = 20
    least_pairs: int = 50
    least_vehicles: int = 8
    max_sigma_s: float = 0.25
    least_share: float = 0.45
    contradiction_sigmas: float = 4.0


CLOCKS = ClockSettings()


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

    def take(self, keep: Booleans | Integers) -> LaneDetections:
        """Return some of them."""
        return LaneDetections(**{name: values[keep] for name, values in vars(self).items()})

    def scaled(self, time: Floats, *, near_m: float, near_s: float, near_mps: float) -> Floats:
        """Return points of which those of one lanelet are near within 1 in every direction.

        Parameters
        ----------
        time : (n,) array
            Their times, seconds since any moment.
        near_m, near_s, near_mps : float
            The scales of place, time and speed.

        Returns
        -------
        (n, 4) array
        """
        return np.column_stack(
            [self.lanelet * 1e4, self.s_m / near_m, time / near_s, self.speed / near_mps]
        )

    @classmethod
    def joined(cls, parts: list[LaneDetections]) -> LaneDetections:
        """Return parts one after the other."""
        names = cls.__dataclass_fields__
        return cls(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in names})


class LaneMatcher:
    """Finds the lane of a detection by the tiles of the lanes.

    Parameters
    ----------
    tiles : GeoDataFrame
        As from :func:`gis_radar.tiles.tiles.read_tiles`.
    settings : ClockSettings
        Which detections count.
    """

    def __init__(self, tiles: gpd.GeoDataFrame, settings: ClockSettings = CLOCKS) -> None:
        self.settings = settings
        corners = quads(tiles)
        self._engine = TileGrid(corners)
        self._begin = (corners[:, 0] + corners[:, 3]) / 2
        along = (corners[:, 1] + corners[:, 2]) / 2 - self._begin
        self._ahead = along / np.linalg.norm(along, axis=1, keepdims=True)
        self._s_m = tiles["s_m"].to_numpy(np.float64)
        self._height_m = tiles["height_m"].to_numpy(np.float64)
        self._lanelet = np.unique(tiles["lanelet_id"].to_numpy(), return_inverse=True)[1]

    def match(self, rows: Detections, track: PoseTrack) -> LaneDetections:
        """Return detections that move along a lane; one on two lanelets counts on both."""
        least_mps = self.settings.min_speed_mps * self.settings.min_cosine
        rows = rows.take(rows.present & (np.abs(rows.range_rate) >= least_mps))
        held = track.at(rows.time)
        met = np.unique(held).tolist() or [0]
        return LaneDetections.joined([self._of(rows, held == i, track, i) for i in met])

    def _of(self, rows: Detections, now: Booleans, track: PoseTrack, index: int) -> LaneDetections:
        pose, limits = track.poses[index], self.settings
        place = pose.to_map(rows.points[now])
        point, tile = self._engine.assign(place[:, 0], place[:, 1])
        sight = place[point] - pose.position
        cosine = np.einsum("ij,ij->i", sight[:, :2], self._ahead[tile])
        cosine /= np.linalg.norm(sight, axis=1)
        speed = rows.range_rate[now][point] / np.where(cosine == 0.0, np.nan, cosine)
        over_road = np.abs(place[point, 2] - self._height_m[tile])
        over_road[np.isnan(rows.points[now][point, 2]) | np.isnan(over_road)] = 0.0
        keep = (np.abs(cosine) >= limits.min_cosine) & (over_road <= limits.max_over_road_m)
        keep &= (speed >= limits.min_speed_mps) & (speed <= limits.max_speed_mps)
        point, tile = point[keep], tile[keep]
        offset = np.einsum("ij,ij->i", place[point, :2] - self._begin[tile], self._ahead[tile])
        return LaneDetections(
            time=rows.time[now][point],
            lanelet=self._lanelet[tile].astype(np.int64),
            s_m=self._s_m[tile] + offset,
            speed=speed[keep],
            side=np.sign(cosine[keep]),
        )


def read_lane_detections(
    recording: Recording, track: PoseTrack, lanes: LaneMatcher, latest_s: float, reporter: Reporter
) -> LaneDetections:
    """Read what moved along lanes in a few hours, by the sensor's own clock.

    Parameters
    ----------
    recording, track : Recording, PoseTrack
        What is read, and where its sensor stood.
    lanes : LaneMatcher
        The lanes.
    latest_s : float
        When the last of all recordings begins: the hours around it are read, so that long ones
        meet. Where this one is over by then, its own first hours.
    reporter : Reporter
        Receives the progress.
    """
    parts: list[LaneDetections] = []
    around: list[LaneDetections] = []
    before_s, after_s = lanes.settings.window_s
    done, begin_s = 0, np.nan
    for batch in recording.read():
        begin_s = float(batch.time[0]) if done == 0 else begin_s
        done += len(batch)
        reporter.progress(Text("{}: {}", STAGE, recording.path.name), done, recording.rows)
        if batch.time[0] > max(latest_s, begin_s) + after_s:
            break
        keep = np.abs(batch.time - latest_s - (before_s + after_s) / 2) <= (after_s - before_s) / 2
        if keep.any():
            around.append(lanes.match(batch.take(keep), track))
        elif not around and batch.time[0] <= begin_s + after_s - before_s:
            parts.append(lanes.match(batch, track))
    return LaneDetections.joined(around or parts)
