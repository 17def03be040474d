"""Views: which tiles a sensor sees from where it stands.

A pose track corrects a pose by centimetres, and each correction adds or removes a tile at the rim
of the view. So a pose shares the view of an earlier one of its track that is near enough, unless a
pose `moved` stands between them. Views follow from the track alone, not from what was recorded;
detections are moved to the map by the poses as they are.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from gis_radar.arrays import Floats, Integers
from gis_radar.occupancy.settings import DEFAULTS, OccupancySettings
from gis_radar.poses.files import PoseTrack
from gis_radar.poses.pose import Pose, View


def seen_tiles(pose: Pose, view: View, tile_id: Integers, centres: Floats) -> Integers:
    """Return the ids of the tiles whose centre, at road height, lies in a sensor's view.

    Parameters
    ----------
    pose : Pose
        Where the sensor stands and looks.
    view : View
        What it sees.
    tile_id : (n,) int64 array
        Ids of the tiles.
    centres : (n, 3) array
        Their centres in the map, metres. Where the road's height is NaN, any elevation is in
        view.
    """
    unknown = np.isnan(centres[:, 2])
    level = np.where(unknown, pose.height, centres[:, 2])
    points = pose.to_sensor(np.column_stack([centres[:, :2], level]))
    points[unknown, 2] = np.nan
    return tile_id[view.sees(points)]


def name_of_view(tiles: Integers) -> str:
    """Return the name of a view: equal for equal sets of tiles, whatever pose sees them."""
    return hashlib.blake2b(np.sort(tiles).tobytes(), digest_size=8).hexdigest()


@dataclass(kw_only=True)
class ViewBook:
    """The views met so far, each by its name.

    Parameters
    ----------
    tile_id : (n,) int64 array
    centres : (n, 3) array
        Ids and centres of all tiles, as for :func:`seen_tiles`.
    settings : OccupancySettings
        Which poses share a view.
    tiles : dict
        By view, the ids of its tiles.
    road_m : dict
        By view, the height of the road near the sensor, metres; NaN where it is not known.
    """

    tile_id: Integers
    centres: Floats
    settings: OccupancySettings = DEFAULTS
    tiles: dict[str, Integers] = field(default_factory=dict)
    road_m: dict[str, float] = field(default_factory=dict)

    def enter(self, track: PoseTrack) -> tuple[str, ...]:
        """Return the name of what each pose of a track sees, and remember the tiles."""
        standing = standing_for(track.poses, self.settings)
        names = {index: self._name(track.poses[index]) for index in np.unique(standing).tolist()}
        return tuple(names[index] for index in standing.tolist())

    def _name(self, pose: Pose) -> str:
        seen = seen_tiles(pose, pose.view or View(), self.tile_id, self.centres)
        name = name_of_view(seen)
        self.tiles[name] = seen
        self.road_m[name] = self._road_m(pose, seen)
        return name

    def _road_m(self, pose: Pose, seen: Integers) -> float:
        centres = self.centres[np.isin(self.tile_id, seen) & np.isfinite(self.centres[:, 2])]
        if len(centres) == 0:
            return float("nan")
        near = np.argsort(np.hypot(*(centres[:, :2] - pose.position[:2]).T), kind="stable")
        return float(np.median(centres[near[: self.settings.road_tiles], 2]))


def standing_for(poses: Sequence[Pose], settings: OccupancySettings = DEFAULTS) -> Integers:
    """Return for each pose of a track the one whose view it shares: an earlier one, or itself.

    Parameters
    ----------
    poses : sequence of Pose
        In order of time.
    settings : OccupancySettings
        Which of them share a view.

    Returns
    -------
    (n,) int64 array
        Indices into `poses`.
    """
    position = np.array([pose.position for pose in poses])
    turn = Rotation.from_quat([pose.quaternion for pose in poses])
    found = np.zeros(len(poses), np.int64)
    heads: list[int] = []  # poses with a view of their own, the one in force last
    for index, pose in enumerate(poses):
        if pose.evidence.get("event") == "moved":
            heads = []
        apart_m = np.linalg.norm(position[heads] - position[index], axis=1)
        apart_deg = np.degrees((turn[index].inv() * turn[heads]).magnitude()) if heads else apart_m
        near_m, near_deg = apart_m <= settings.view_shared_m, apart_deg <= settings.view_shared_deg
        near = np.flatnonzero(near_m & near_deg)
        alike = [heads[each] for each in near if poses[heads[each]].view == pose.view]
        head = alike[-1] if alike else index
        heads = [*(each for each in heads if each != head), head][-settings.views_compared :]
        found[index] = head
    return found
