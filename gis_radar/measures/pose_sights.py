"""Sights of sensors from the poses of their tracks, and recordings with these sights.

A pose track corrects a pose by centimetres, and each correction would add or remove tiles at the
rim of the view. So a pose shares the sight of an earlier, near one of its track, unless a pose
with the event `moved` comes between them. Sights depend on the track alone, not on what was
recorded; detections are moved to the map by the exact poses.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import scipy

from gis_radar.base import Floats, Integers, NoAnswerError, Reporter, Text, require_same
from gis_radar.calibration import SensorClock
from gis_radar.poses import Pose, PoseTrack
from gis_radar.recordings import Recording, as_recording
from gis_radar.scans import (
    HIDDEN,
    IN_SIGHT,
    OUT_OF_VIEW,
    WINDOWS_KEPT,
    Sight,
    SightScan,
    SightTiles,
    find_sight,
    report_uncovered,
)

# Farthest earlier pose of a track whose sight a pose shares: half a tile, and about the sigma of a
# tracked angle. Smaller values give more sights; hits do not depend on them.
_VIEW_SHARED_M, _VIEW_SHARED_DEG = 0.25, 0.2
_VIEWS_COMPARED = 64  # latest sights of a track that a pose is compared with: limits the work
# Number of nearest tiles whose median height is the road's for detections without elevation: 100 m
# of lane near the sensor, where it matters: 5 m shift a place by 0.6 m at 20 m, 0.1 m at 120 m.
ROAD_TILES = 200


def name_of_track(track: PoseTrack) -> str:
    """Return the name of a pose track: equal for equal poses that hold at equal times."""
    documents = [json.dumps(pose.as_dict(), sort_keys=True) for pose in track.poses]
    text = json.dumps([documents, track.since.tolist()])
    return f"{track.sensor}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def pose_names(track: str, count: int) -> list[str]:
    """Return the names of the poses of a track."""
    return [track] if count == 1 else [f"{track}/{k:06d}" for k in range(count)]


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseSight:
    """A pose with the tiles in its sight; later poses of its track may share it.

    Parameters
    ----------
    name : str
        Name of the pose.
    pose : Pose
        The pose.
    tile_id : (n,) int64 array
        Tiles in sight, ascending.
    road_m : float
        Height of the road near the sensor, metres; NaN where it is not known.
    """

    name: str
    pose: Pose
    tile_id: Integers
    road_m: float

    @classmethod
    def of(cls, sight: Sight, road: SightTiles, *, name: str) -> Self:
        """Return what the counting of frames needs of a sight."""
        return cls(
            name=name, pose=sight.pose, tile_id=np.sort(sight.seen),
            road_m=road_near(sight, road),
        )  # fmt: skip


def digest_of_sights(sights: Iterable[PoseSight]) -> str:
    """Return the digest of what the poses of a track see; poses may share a sight."""
    digest = hashlib.blake2b(digest_size=16)
    for name, sight in sorted({each.name: each for each in sights}.items()):
        digest.update(f"{name} {sight.road_m!r} {len(sight.tile_id)} ".encode())
        digest.update(np.ascontiguousarray(sight.tile_id, "<i8").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True, kw_only=True)
class PlacedRecording:
    """A recording with track, sights and clock of its sensor.

    Parameters
    ----------
    recording, track : Recording, PoseTrack
        The recording, and the poses of its sensor.
    track_name : str
        Name of the track.
    sights : sequence of PoseSight
        The sight of each pose of the track.
    clock : SensorClock, optional
        Offset of the sensor's clock.
    """

    recording: Recording
    track: PoseTrack
    track_name: str
    sights: Sequence[PoseSight]
    clock: SensorClock | None

    @property
    def pose_names(self) -> list[str]:
        """Names of the poses of the track."""
        return pose_names(self.track_name, len(self.track.poses))

    @property
    def right_clock(self) -> SensorClock:
        """The sensor's clock; one without offset where it is unknown."""
        return self.clock or SensorClock(offset_s=0.0)


@dataclass(frozen=True, kw_only=True)
class SightBook:
    """Collection of the sights of poses, found by tiles and scan.

    Parameters
    ----------
    road : SightTiles
        All tiles.
    scan : SightScan, optional
        Source of sight; without it, all tiles in a view are in sight.
    sights : dict
        Sights found so far, by the name of the pose.
    """

    road: SightTiles
    scan: SightScan | None = None
    sights: dict[str, Sight] = field(default_factory=dict)

    def place(
        self,
        recordings: Sequence[str | Path | Recording],
        tracks: Sequence[PoseTrack],
        clocks: Mapping[str, SensorClock] | None,
        reporter: Reporter,
    ) -> list[PlacedRecording]:
        """Return recordings with the sights of their tracks; warn of sensors that see no tile.

        Raises
        ------
        InputError
            If a recording cannot be opened, or a pose is not in the tiles' coordinate system.
        NoAnswerError
            If no sensor sees any tile.
        """
        for track in tracks:
            what = Text("the pose of {}", track.sensor)
            require_same(track.poses[0].crs, self.road.crs, what=what, other_what="the tiles")
        seen = self._sights_of_tracks({name_of_track(track): track for track in tracks})
        self._report_blind(seen, reporter)
        return [
            PlacedRecording(
                recording=as_recording(recording), track=track, track_name=name_of_track(track),
                sights=seen[name_of_track(track)], clock=(clocks or {}).get(track.sensor),
            )
            for recording, track in zip(recordings, tracks, strict=True)
        ]  # fmt: skip

    def _sights_of_tracks(
        self, tracks: Mapping[str, PoseTrack]
    ) -> dict[str, tuple[PoseSight, ...]]:
        """Find the sights of the poses of each track; return them by the track's name."""
        owner_of = {name: sight_owners(each.poses) for name, each in tracks.items()}
        own_poses = {
            name: {k: track.poses[k] for k in np.unique(owner_of[name]).tolist()}
            for name, track in tracks.items()
        }
        all_own = [pose for poses in own_poses.values() for pose in poses.values()]
        if self.scan is not None and len(all_own) <= WINDOWS_KEPT:
            self.scan.read(all_own)  # in one pass
        sights = {}
        for name, track in tracks.items():
            if self.scan is not None:
                self.scan.read([*own_poses[name].values()])
            names = pose_names(name, len(track.poses))
            own_sights = {
                k: self._find_sight(names[k], pose) for k, pose in own_poses[name].items()
            }
            sights[name] = tuple(own_sights[k] for k in owner_of[name].tolist())
        return sights

    def _find_sight(self, name: str, pose: Pose) -> PoseSight:
        self.sights[name] = find_sight(pose, self.road, self.scan)
        return PoseSight.of(self.sights[name], self.road, name=name)

    def _report_blind(self, seen: Mapping[str, Sequence[PoseSight]], reporter: Reporter) -> None:
        blind = [
            sights[0].pose.sensor
            for sights in seen.values()
            if not any(len(each.tile_id) for each in sights)
        ]
        if len(blind) == len(seen):
            pose = next(iter(seen.values()))[0].pose
            raise NoAnswerError(
                "no tile lies in the view of {}", ", ".join(blind), hint=self._why_blind(pose)
            )
        for sensor in blind:
            reporter.warn("no tile lies in the view of {}", sensor)

    def _why_blind(self, pose: Pose) -> Text:
        """Return what to check of a pose that has no tile in sight."""
        offset = self.road.centres - pose.position
        distance = np.hypot(offset[:, 0], offset[:, 1])
        text = Text("{} stands {:,.0f} m from the nearest tile", pose.sensor, distance.min())
        if np.isfinite(over_m := -offset[np.argmin(distance), 2]):
            under = Text("{}, {:,.0f} m under it", text, -over_m)
            text = under if over_m < 0.0 else Text("{}, {:,.0f} m over it", text, over_m)
        if self.scan is not None:
            text = Text("{}, where the scan, if it is of another place, may hide all", text)
        return Text("{}: check position, height, and whether its angles are degrees", text)

    def report(self, reporter: Reporter) -> None:
        """Report that there is no scan, or the share of views that it covers."""
        if self.scan is None:
            reporter.log(
                Text(
                    "sight: view only: houses hide no tile; with {}, what stands in a scan does",
                    "--scan",
                )
            )
            return
        report_uncovered(self.sights.values(), reporter)
        if np.isnan(self.road.height).all():
            reporter.warn(
                "the tiles have no heights: those of the scan's ground count, and levels one above "
                "another are not distinguished",
            )  # fmt: skip


def road_near(sight: Sight, road: SightTiles) -> float:
    """Return the height of the road near a sensor, metres; NaN where it is unknown.

    Parameters
    ----------
    sight : Sight
        Sight of the sensor; the tiles in its view count, hidden ones too.
    road : SightTiles
        All tiles.
    """
    centres = road.centres[(sight.state != OUT_OF_VIEW) & np.isfinite(road.height)]
    if len(centres) == 0:
        return float("nan")
    near = np.argsort(np.hypot(*(centres[:, :2] - sight.pose.position[:2]).T), kind="stable")
    return float(np.median(centres[near[:ROAD_TILES], 2]))


def sight_owners(poses: Sequence[Pose]) -> Integers:
    """Return, for each pose of a track, the pose whose sight it shares: an earlier one, or itself.

    Parameters
    ----------
    poses : sequence of Pose
        In order of time.

    Returns
    -------
    (n,) int64 array
        Indices into `poses`.
    """
    owner_of, owners = list[int](), list[_SightOwner]()
    for number, pose in enumerate(poses):
        if pose.evidence.get("event") == "moved":
            owners = []
        new = _SightOwner.of(number, pose)
        owner = next((head for head in reversed(owners) if head.is_near(new)), new)
        other_owners = [head for head in owners if head.number != owner.number]
        owners = [*other_owners, owner][-_VIEWS_COMPARED:]
        owner_of.append(owner.number)
    return np.array(owner_of, np.int64)


class _SightOwner(NamedTuple):
    """A pose with a sight of its own, which later poses may share."""

    number: int
    pose: Pose
    position: Floats
    turn: scipy.spatial.transform.Rotation

    @classmethod
    def of(cls, number: int, pose: Pose) -> _SightOwner:
        turn = scipy.spatial.transform.Rotation.from_quat(pose.quaternion)
        return cls(number, pose, pose.position, turn)

    def is_near(self, other: _SightOwner) -> bool:
        """Return whether another pose may share the sight."""
        if self.pose.view != other.pose.view:
            return False
        apart_m = float(np.linalg.norm(self.position - other.position))
        if apart_m > _VIEW_SHARED_M:
            return False
        apart_deg = math.degrees((other.turn.inv() * self.turn).magnitude())
        return apart_deg <= _VIEW_SHARED_DEG


def first_since_move(poses: Sequence[Pose]) -> Integers:
    """Return, for each pose of a track, the first pose since the sensor was moved last.

    Parameters
    ----------
    poses : sequence of Pose
        In order of time.

    Returns
    -------
    (n,) int64 array
        Indices into `poses`.
    """
    moved = [k == 0 or pose.evidence.get("event") == "moved" for k, pose in enumerate(poses)]
    return np.maximum.accumulate(np.where(moved, np.arange(len(poses)), 0))


def sight_of_tiles(tile_id: Integers, pose: Pose, road: SightTiles) -> Sight:
    """Return a sight from the tiles in sight; all other tiles in the view are hidden.

    Parameters
    ----------
    tile_id : (n,) int64 array
        The tiles in sight.
    pose : Pose
        The sensor's pose, with the view in effect.
    road : SightTiles
        All tiles.
    """
    seen = np.isin(road.tile_id, tile_id)
    view_sight = find_sight(pose, road)
    in_view = seen | (view_sight.state != OUT_OF_VIEW)
    state = np.where(seen, IN_SIGHT, np.where(in_view, HIDDEN, OUT_OF_VIEW))
    return replace(view_sight, state=state.astype(np.uint8))
