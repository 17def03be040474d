"""Views: which tiles a sensor sees from where it stands, and the recordings made there.

A pose track corrects a pose by centimetres, and each correction adds or removes a tile at the rim
of the view. So a pose shares the view of an earlier one of its track that is near enough, unless a
pose `moved` stands between them. Views follow from the track alone, not from what was recorded;
detections are moved to the map by the poses as they are.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from gis_radar.arrays import Floats, Integers
from gis_radar.calibration import SensorClock
from gis_radar.crs import require_same
from gis_radar.errors import NoAnswerError
from gis_radar.measures.settings import DEFAULTS, HitSettings
from gis_radar.poses.files import PoseTrack
from gis_radar.poses.pose import Pose
from gis_radar.progress import Reporter
from gis_radar.recordings.recording import Recording, as_recording
from gis_radar.sight import (
    HIDDEN,
    IN_SIGHT,
    OUT_OF_VIEW,
    Sight,
    SightSource,
    SightTiles,
    find_sight,
    report_uncovered,
)
from gis_radar.texts import Text


def name_of_view(tiles: Integers) -> str:
    """Return the name of a view: equal for equal sets of tiles, whatever pose sees them."""
    return hashlib.blake2b(np.sort(tiles).tobytes(), digest_size=8).hexdigest()


@dataclass(kw_only=True)
class ViewBook:
    """The views met so far, each by its name.

    Parameters
    ----------
    road : SightTiles
        All tiles.
    scan : SightScan or SightFile, optional
        What hides tiles; without it, a view is all that is within range and angles.
    settings : HitSettings
        Which poses share a view.
    tiles : dict
        By view, the ids of its tiles.
    road_m : dict
        By sensor and view, the height of the road near the sensor, metres; NaN where it is not
        known.
    sights : dict
        By sensor and view, the sight that it was made from.
    """

    road: SightTiles
    scan: SightSource | None = None
    settings: HitSettings = DEFAULTS
    tiles: dict[str, Integers] = field(default_factory=dict)
    road_m: dict[tuple[str, str], float] = field(default_factory=dict)
    sights: dict[tuple[str, str], Sight] = field(default_factory=dict)

    def enter(self, track: PoseTrack) -> tuple[str, ...]:
        """Return the name of what each pose of a track sees, and remember the tiles."""
        standing = standing_for(track.poses, self.settings)
        if self.scan is not None:
            self.scan.read(self._looked_from(track))
        names = {index: self._name(track.poses[index]) for index in np.unique(standing).tolist()}
        return tuple(names[index] for index in standing.tolist())

    def see(self, pose: Pose) -> str:
        """Return the name of what a single pose sees, and remember the tiles."""
        if self.scan is not None:
            self.scan.read([pose])
        return self._name(pose)

    def _looked_from(self, track: PoseTrack) -> list[Pose]:
        """Return the poses of a track that stand for all of them."""
        return [track.poses[index] for index in np.unique(standing_for(track.poses, self.settings))]

    def enter_all(self, tracks: Sequence[PoseTrack], reporter: Reporter) -> list[tuple[str, ...]]:
        """Return the views of each track's poses; warn of sensors that see no tile.

        Raises
        ------
        NoAnswerError
            If no sensor sees any tile.
        """
        different = {id(track): track for track in tracks}
        looks = [pose for track in different.values() for pose in self._looked_from(track)]
        if self.scan is not None and len(looks) <= self.scan.settings.windows_kept:
            self.scan.read(looks)  # in one pass
        views = {key: self.enter(track) for key, track in different.items()}
        blind = [
            track.sensor
            for track in tracks
            if not any(len(self.tiles[name]) for name in set(views[id(track)]))
        ]
        if len(blind) == len(tracks):
            raise NoAnswerError(
                "no tile lies in the view of {}",
                ", ".join(blind),
                hint="poses, heights and tiles do not fit each other",
            )
        for sensor in blind:
            reporter.warn("no tile lies in the view of {}", sensor)
        return [views[id(track)] for track in tracks]

    def keep(self, views: Collection[tuple[str, str]]) -> None:
        """Forget all views but these, by sensor and name; they are made anew where one is met."""
        names = {name for _, name in views}
        self.tiles = {name: tiles for name, tiles in self.tiles.items() if name in names}
        self.road_m = {key: height for key, height in self.road_m.items() if key in views}
        self.sights = {key: sight for key, sight in self.sights.items() if key in views}

    def report(self, reporter: Reporter) -> None:
        """Report that there is no scan, or what it does not cover."""
        if self.scan is None:
            reporter.log(
                Text(
                    "sight: view only: houses hide no tile; with {}, what stands in a scan does",
                    "--scan",
                )
            )
            return
        report_uncovered(self.sights.values(), reporter, self.scan.settings)
        if np.isnan(self.road.height).all():
            reporter.warn(
                "the tiles have no heights: those of the scan's ground count, and levels one above "
                "another are not distinguished",
            )  # fmt: skip

    def _name(self, pose: Pose) -> str:
        sight = find_sight(pose, self.road, self.scan)
        name = name_of_view(sight.seen)
        self.tiles[name] = sight.seen
        self.sights[pose.sensor, name] = sight
        self.road_m[pose.sensor, name] = road_near(sight, self.road, self.settings)
        return name


def road_near(sight: Sight, road: SightTiles, settings: HitSettings = DEFAULTS) -> float:
    """Return the height of the road near a sensor, metres; NaN where it is not known.

    Parameters
    ----------
    sight : Sight
        What the sensor sees: tiles in its view count.
    road : SightTiles
        All tiles.
    settings : HitSettings
        How many of the nearest tiles count.
    """
    centres = road.centres[(sight.state != OUT_OF_VIEW) & np.isfinite(road.height)]
    if len(centres) == 0:
        return float("nan")
    near = np.argsort(np.hypot(*(centres[:, :2] - sight.pose.position[:2]).T), kind="stable")
    return float(np.median(centres[near[: settings.road_tiles], 2]))


@dataclass(frozen=True, kw_only=True)
class PlacedRecording:
    """A recording with what is known of its sensor.

    Parameters
    ----------
    recording, track : Recording, PoseTrack
        What is read, and where its sensor stood.
    views : sequence of str
        The view of each pose of the track.
    clock : SensorClock, optional
        How far the sensor's clock is ahead.
    """

    recording: Recording
    track: PoseTrack
    views: Sequence[str]
    clock: SensorClock | None

    @property
    def right_clock(self) -> SensorClock:
        """The sensor's clock; where nothing is known of it, it is right."""
        return self.clock or SensorClock(offset_s=0.0)

    def record(self, rows: int, met: Collection[int]) -> dict[str, Any]:
        """Return the entry of a manifest.

        Parameters
        ----------
        rows : int
            How many were read.
        met : collection of int
            Poses of the track that were in force at a frame; where there are none, the first one
            is named.
        """
        poses = self.track.poses[min(met, default=0) : max(met, default=0) + 1]
        return {
            "recording": self.recording.path.name,
            "rows": rows,
            "sensor": self.track.sensor,
            "poses": [pose.as_dict() for pose in poses],
            **({} if self.clock is None else {"clock": self.clock.as_dict()}),
        }


def place_recordings(
    recordings: Sequence[str | Path | Recording],
    tracks: Sequence[PoseTrack],
    book: ViewBook,
    clocks: Mapping[str, SensorClock] | None,
    reporter: Reporter,
) -> list[PlacedRecording]:
    """Return recordings with their tracks, clocks, and views, which are entered into the book.

    Raises
    ------
    InputError
        If a recording cannot be opened, or a pose is not in the tiles' coordinate system.
    NoAnswerError
        If no sensor sees any tile.
    """
    for track in tracks:
        what = Text("the pose of {}", track.sensor)
        require_same(track.poses[0].crs, book.road.crs, what=what, other_what="the tiles")
    views = book.enter_all(tracks, reporter)
    return [
        PlacedRecording(
            recording=as_recording(recording), track=track, views=names,
            clock=(clocks or {}).get(track.sensor),
        )
        for recording, track, names in zip(recordings, tracks, views, strict=True)
    ]  # fmt: skip


def standing_for(poses: Sequence[Pose], settings: HitSettings = DEFAULTS) -> Integers:
    """Return for each pose of a track the one whose view it shares: an earlier one, or itself.

    Parameters
    ----------
    poses : sequence of Pose
        In order of time.
    settings : HitSettings
        Which of them share a view.

    Returns
    -------
    (n,) int64 array
        Indices into `poses`.
    """
    standing = SharedViews(settings)
    return np.array([standing.add(pose) for pose in poses], np.int64)


class SharedViews:
    """Which pose of a track stands for each, as poses come.

    Parameters
    ----------
    settings : HitSettings
        Which of them share a view.
    heads : sequence of (int, Pose)
        Where a track is taken up again: the latest numbers that :meth:`add` returned, with their
        poses, the one in force last.
    """

    def __init__(
        self, settings: HitSettings = DEFAULTS, heads: Sequence[tuple[int, Pose]] = ()
    ) -> None:
        self._settings, self._count = settings, 0
        found = [_Head.of(number, pose) for number, pose in heads]
        self._heads: list[_Head] = found[-settings.views_compared :]

    @property
    def heads(self) -> list[int]:
        """Numbers of the poses that may stand for the next one, the one in force last."""
        return [head.number for head in self._heads]

    def add(self, pose: Pose, number: int | None = None) -> int:
        """Return the number of the pose that stands for the next one; its own where none does.

        Parameters
        ----------
        pose : Pose
            The next one.
        number : int, optional
            Its own; by default its place in the track, from 0.
        """
        number = self._count if number is None else number
        self._count += 1
        if pose.evidence.get("event") == "moved":
            self._heads = []
        new = _Head.of(number, pose)
        alike = [head for head in self._heads if head.is_near(new, self._settings)]
        found = alike[-1] if alike else new
        others = [head for head in self._heads if head.number != found.number]
        self._heads = [*others, found][-self._settings.views_compared :]
        return found.number


class _Head(NamedTuple):
    """A pose that stands for itself."""

    number: int
    pose: Pose
    position: Floats
    turn: scipy.spatial.transform.Rotation

    @classmethod
    def of(cls, number: int, pose: Pose) -> _Head:
        turn = scipy.spatial.transform.Rotation.from_quat(pose.quaternion)
        return cls(number, pose, pose.position, turn)

    def is_near(self, other: _Head, settings: HitSettings) -> bool:
        """Return whether another pose shares the view."""
        if self.pose.view != other.pose.view:
            return False
        apart_m = float(np.linalg.norm(self.position - other.position))
        if apart_m > settings.view_shared_m:
            return False
        apart_deg = math.degrees((other.turn.inv() * self.turn).magnitude())
        return apart_deg <= settings.view_shared_deg


def places_of(poses: Sequence[Pose]) -> Integers:
    """Return for each pose of a track the first one where the sensor stood then: it may move.

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
    """Return the sight of a sensor from the tiles that it sees: the others of its view are hidden.

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
    found = find_sight(pose, road)
    in_view = seen | (found.state != OUT_OF_VIEW)
    state = np.where(seen, IN_SIGHT, np.where(in_view, HIDDEN, OUT_OF_VIEW))
    return replace(found, state=state.astype(np.uint8))
