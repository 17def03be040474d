"""Follow vehicles from what sensors send: the tracker of recordings, over blocks of a minute.

A block is followed once frames a minute after it are there, with a minute around it, so its
vehicles are known one to two minutes later and do not change any more. What is the same as for
recordings is done by the same code: only the blocks are shorter.
"""

from __future__ import annotations

import secrets
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.arrays import Integers
from gis_radar.errors import InputError, OutputError
from gis_radar.lanelets.graph import LaneGraph
from gis_radar.live.detections import FrameDetections, unpack_detections
from gis_radar.live.hits_folder.folder import runs_of_frames, table_of_frames
from gis_radar.live.hours import HOUR_STEPS, LIVE_RECORDING, hour_name, hour_of
from gis_radar.live.vehicles.clocks import MonotonicFilter, SensorFrame
from gis_radar.live.vehicles.folder import write_vehicle_hour
from gis_radar.live.vehicles.occupancy import Finished, LiveOccupancy
from gis_radar.live.vehicles.settings import DEFAULTS, FollowSettings
from gis_radar.live.vehicles.store import DetectionRow, FollowedPose, StoredBatch, VehicleStore
from gis_radar.measures.validity import Runs, union
from gis_radar.poses.pose import pose_from_dict
from gis_radar.recordings.recording import Detections
from gis_radar.steps import STEP_US, STEPS_PER_SECOND
from gis_radar.tracking.batches import BatchMaker
from gis_radar.tracking.blocks import Block
from gis_radar.tracking.detections import MapDetections, map_detections
from gis_radar.tracking.tables import FRAMES
from gis_radar.tracking.tracker import vehicles_in
from gis_radar.tracking.visibility import SensorView

POSES_KEPT = 1_000  # named last; fusion names those anew that it did not name for long


@dataclass(frozen=True, kw_only=True)
class FollowedSite:
    """What following needs to know of a site.

    Parameters
    ----------
    sensors : sequence of str
        Their names, ascending.
    tiles : GeoDataFrame
        As from :func:`gis_radar.read_tiles`.
    fingerprint : str
        Of the tiles.
    graph : LaneGraph
        The lanes.
    map, sight : dict, object
        As a manifest has them.
    folder : Path
        Of the live system's files.
    """

    sensors: Sequence[str]
    tiles: gpd.GeoDataFrame
    fingerprint: str
    graph: LaneGraph
    map: dict[str, Any]
    sight: Any
    folder: Path

    def path_of(self, hour: int) -> Path:
        """Return the folder of an hour since 1970."""
        return self.folder / "vehicles" / hour_name(hour)

    def put_aside(self, first: int) -> list[tuple[str, str]]:
        """Give folders of an hour and later ones other names; return those before and after.

        Raises
        ------
        OutputError
            If one cannot be renamed.
        """
        done: list[tuple[str, str]] = []
        for path in sorted((self.folder / "vehicles").glob("*Z")):
            hour = hour_of(path.name)
            if hour is not None and hour >= first:
                other = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
                try:
                    path.rename(other)
                except OSError as error:
                    raise OutputError(f"{path}: cannot be put aside: {error.strerror}") from error
                done.append((path.name, other.name))
        return done


@dataclass(frozen=True, kw_only=True)
class _Held:
    """Frames of a sensor in one view, in memory until no block needs them."""

    sensor: str
    view: str
    pose: int
    steps: Integers
    detections: MapDetections

    def before(self, time_us: int) -> _Held:
        """Return those before a time."""
        return replace(
            self, steps=self.steps[self.steps * STEP_US < time_us],
            detections=self.detections.take(self.detections.time < time_us / 1e6),
        )  # fmt: skip


@dataclass(kw_only=True)
class VehicleFollower:
    """Follows the vehicles of a site, block by block.

    `take`, `due` and `begin` are for one thread, `finish` and `write_hour` for one other at most.

    Parameters
    ----------
    site : FollowedSite
        The site.
    store : VehicleStore
        Detections and batches on disk.
    settings : FollowSettings
        Blocks.
    """

    site: FollowedSite
    store: VehicleStore
    settings: FollowSettings = DEFAULTS
    late: int = 0
    unknown: int = 0
    skipped_steps: int = 0
    newest_step: int = -1
    done: int | None = None
    _held: list[_Held] = field(default_factory=list)
    _validity: dict[str, float] = field(default_factory=dict)
    _order: MonotonicFilter = field(default_factory=MonotonicFilter)
    _unstored: list[DetectionRow] = field(default_factory=list)
    _anew: dict[str, int] = field(default_factory=dict)
    _from_before: list[SensorFrame] = field(default_factory=list)
    _poses: dict[int, tuple[FollowedPose, Any]] = field(default_factory=dict)
    _road_m: dict[tuple[str, str], float] = field(default_factory=dict)
    _not_due: int = -1  # up to which newest step no block is due

    def __post_init__(self) -> None:
        self._tracker = self.settings.tracker()
        self._maker = BatchMaker(self.site.graph, self._tracker)
        self._occupancy = LiveOccupancy(self.site.tiles)
        self._number = {name: k for k, name in enumerate(self.site.sensors)}
        for view, road_m in self.store.views():
            self.add_view(view, road_m)
        for number, pose in self.store.poses().items():
            self.add_pose(number, pose)
        if (edge := self.store.edge()) is not None:
            self._maker.take_up(edge)
            self.done = self.newest_step = edge.step

    def add_view(self, view: SensorView, road_m: float) -> None:
        """Take in what a sensor sees from a pose, and the height of the road near it."""
        self._road_m[view.sensor, view.view] = road_m
        self._occupancy.add_view(view)

    def add_pose(self, number: int, pose: FollowedPose) -> None:
        """Take in a pose, by the id of its row in the store."""
        known = pose_from_dict(pose.content, what=f"the pose of {pose.sensor}")
        self._poses.pop(number, None)
        self._poses[number] = (pose, known)  # those used last are last

    def knows(self, number: int) -> bool:
        """Return whether a pose is known, by the id of its row in the store."""
        return number in self._poses

    def again(self, first: int) -> Iterator[Finished]:
        """Yield what stored blocks from a step on add, as it was before a restart."""
        poses = self.store.poses()
        for each in self.store.batches(first, 2**62):
            self._validity |= _validity_of(each.poses, poses)
            yield self._occupancy.add(each.batch, self._validity, self.site.graph.origin)

    def resume(self) -> None:
        """Take the frames that the store holds, as they came before a restart."""
        for rows in self.store.seconds():
            found: list[SensorFrame] = []
            for row in rows:
                with suppress(InputError):
                    _, frames = unpack_detections(row.content)
                    found += [
                        SensorFrame(row.sensor, row.pose, each) for each in frames
                        if each.time_us == row.time_us
                    ]  # fmt: skip
            late = self.late
            self._follow(self._order.take(self._known(found))[0])
            self.late = late  # counted when it came

    def take(self, frames: Sequence[SensorFrame]) -> MapDetections:
        """Take frames; return the detections of those that are followed, for the map of now."""
        known = self._known(frames)
        self.unknown += len(frames) - len(known)
        passed, anew = self._order.take(known)
        if self._of_before(passed):
            self._from_before += passed
            return MapDetections.none()
        for sensor, since_us in anew.items():
            if not self._of_before([each for each in passed if each.sensor == sensor]):
                self._leave_out(sensor, since_us)
        self.late += len(self._from_before)
        self._from_before = []
        self._unstored += [each.row() for each in passed]
        return self._follow(passed)

    def keep(self) -> None:
        """Bring the frames that were taken to the disk.

        Raises
        ------
        OutputError
            If it is full: they are followed all the same, but gone with a restart.
        """
        rows, self._unstored = self._unstored, []
        if rows or self._anew:
            self.store.add_frames(rows, self._anew)
            self._anew = {}

    @property
    def begins_anew(self) -> int | None:
        """The first step that is followed anew where all sensors' clocks were set back, if so."""
        return min((each.step for each in self._from_before), default=None)

    def successor(self) -> VehicleFollower:
        """Return who goes on with what the store holds, and the frames of :attr:`begins_anew`.

        For who has dropped from the store what was followed from there on.
        """
        with suppress(OutputError):  # followed by nobody, then
            self.keep()
            self.store.add_frames([each.row() for each in self._from_before])
        return VehicleFollower(
            site=self.site, store=self.store, settings=self.settings, late=self.late,
            unknown=self.unknown, skipped_steps=self.skipped_steps,
            _order=MonotonicFilter(repeated=self.repeated),
        )  # fmt: skip

    @property
    def repeated(self) -> int:
        """Frames that came twice."""
        return self._order.repeated

    def _known(self, frames: Sequence[SensorFrame]) -> list[SensorFrame]:
        poses = self._poses
        return [
            each for each in frames
            if each.sensor in self._number and each.pose in poses
            and poses[each.pose][0].sensor == each.sensor
        ]  # fmt: skip

    def _of_before(self, frames: Sequence[SensorFrame]) -> bool:
        """Return whether all frames are a block or more before what was followed."""
        if not frames:
            return bool(self._from_before)
        done = self.done
        return done is not None and all(e.step <= done - self.settings.steps for e in frames)

    def _leave_out(self, sensor: str, since_us: int) -> None:
        """Leave out what a sensor sent with times that it now gives anew."""
        held = [e if e.sensor != sensor else e.before(since_us) for e in self._held]
        self._held = [each for each in held if len(each.steps)]
        last = -1 if self.done is None else self.done
        self.newest_step = max((int(each.steps[-1]) for each in self._held), default=last)
        self._not_due = -1
        self._unstored = [
            each for each in self._unstored if each.sensor != sensor or each.time_us < since_us
        ]
        self._anew[sensor] = min(since_us, self._anew.get(sensor, since_us))

    def _follow(self, frames: Sequence[SensorFrame]) -> MapDetections:
        by_pose: dict[int, list[FrameDetections]] = {}
        for each in frames:
            by_pose.setdefault(each.pose, []).append(each.detections)
        for number in by_pose:
            self._poses[number] = self._poses.pop(number)
        found = [self._hold(pose, mine) for pose, mine in by_pose.items()]
        return MapDetections.join([each.detections for each in found])

    def _hold(self, number: int, frames: Sequence[FrameDetections]) -> _Held:
        pose, placed = self._poses[number]
        rows = [each.as_rows() for each in frames]
        detections = map_detections(
            Detections(
                time=np.concatenate([each.time for each in rows]),
                points=np.concatenate([each.points for each in rows]),
                range_rate=np.concatenate([each.range_rate for each in rows]),
                rcs=np.concatenate([each.rcs for each in rows]), further=rows[0].further,
            ),
            placed, self._number[pose.sensor], self.site.graph, self._tracker.detections,
            road_m=self._road_m.get((pose.sensor, pose.view), np.nan),
        )  # fmt: skip
        steps = np.unique(np.array([each.time_us // STEP_US for each in frames]))
        if self.done is not None:
            self.late += int((steps <= self.done).sum())
        self.newest_step = max(self.newest_step, int(steps[-1]))
        made = _Held(
            sensor=pose.sensor, view=pose.view, pose=number, steps=steps, detections=detections
        )
        self._held.append(made)
        return made

    def due(self, *, everything: bool = False) -> tuple[int, int] | None:
        """Return the first step of the next block and the one after its last, once it is due.

        Parameters
        ----------
        everything : bool
            Whether no more frames come.
        """
        if self.newest_step <= self._not_due and not everything:
            return None
        done = -(2**62) if self.done is None else self.done
        later = [each.steps[each.steps > done] for each in self._held if each.steps[-1] > done]
        if not later:
            return None
        first = min(int(each[0]) for each in later)
        limits, late = self.settings, round(self.settings.late_s * STEPS_PER_SECOND)
        begin = max(done + 1, first // limits.steps * limits.steps)
        end = (begin // limits.steps + 1) * limits.steps
        behind = self.newest_step - end - limits.margin_steps - limits.behind_steps
        if behind > 0 and not everything:  # following takes longer than the traffic
            until = (self.newest_step - limits.margin_steps) // limits.steps * limits.steps
            self.skipped_steps += until - begin
            self.done = until - 1
            return self.due()
        if everything or self.newest_step >= end + limits.margin_steps + late:
            return begin, end
        self._not_due = end + limits.margin_steps + late - 1
        return None

    def begin(self, span: tuple[int, int]) -> tuple[Block, tuple[int, ...]]:
        """Return the block of a span of :meth:`due`, and the poses in it; it counts as done."""
        begin, end = span
        margin, held = self.settings.margin_steps, self._held
        from_s, to_s = ((each) / STEPS_PER_SECOND for each in (begin - margin, end + margin))
        parts = [
            each.detections.take((each.detections.time >= from_s) & (each.detections.time < to_s))
            for each in held
        ]
        known = table_of_frames(pd.concat([FRAMES.empty(), *_frames(held)], ignore_index=True))
        frames, before = (
            _frames_within(known, begin, end),
            _frames_within(known, begin - margin, begin),
        )
        goes_on = self.newest_step >= end
        self.done = last = end - 1 if goes_on else int(frames["last_step"].max())
        poses = {each.pose for each in held if ((each.steps >= begin) & (each.steps <= last)).any()}
        block = Block(
            first_step=int(frames["first_step"].min()) if before.empty else begin, last_step=last,
            detections=MapDetections.join(parts), frames=frames, frames_before=before, begins=False,
            ends=False,
        )  # fmt: skip
        self._held = [each for each in held if each.steps[-1] > last - margin]
        self._forget_poses(poses | {each.pose for each in self._held})
        return block, tuple(sorted(poses))

    def _forget_poses(self, needed: set[int]) -> None:
        """Drop poses that were not used for long: a sensor that follows has one in 5 s."""
        old = [each for each in [*self._poses][:-POSES_KEPT] if each not in needed]
        for number in old:
            del self._poses[number]
        if old:
            self.store.forget_poses([*self._poses])
        views = {(each.sensor, each.view) for each, _ in self._poses.values()}
        self._road_m = {each: self._road_m[each] for each in views if each in self._road_m}
        self._occupancy.keep_views(views)

    def finish(
        self, block: Block, poses: tuple[int, ...], *, unwritten: Collection[int] = ()
    ) -> Finished:
        """Follow the vehicles of a block, store them, and return what they add.

        Parameters
        ----------
        block, poses : Block, tuple of int
            As from :meth:`begin`.
        unwritten : collection of int
            Hours since 1970 of which the batches stay, besides those of the hour before.
        """
        batch = self._maker.batch(
            block, vehicles_in(block.detections, self.site.graph, self._tracker)
        )
        self._maker.forget_lanes()
        self._validity |= _validity_of(poses, {k: self._poses[k][0] for k in poses})
        found = self._occupancy.add(batch, self._validity, self.site.graph.origin)
        needed = block.last_step + 1 - self.settings.margin_steps
        hour = min(block.last_step // HOUR_STEPS, *unwritten, 2**62)
        self.store.add_batch(
            StoredBatch(batch=batch, poses=poses), self._maker.edge(), needed_us=needed * STEP_US,
            kept_step=(hour - 1) * HOUR_STEPS,
        )  # fmt: skip
        return found

    def write_hour(self, hour: int) -> Path | None:
        """Write the folder of an hour since 1970 from its pieces, whole; None without any."""
        begin = hour * HOUR_STEPS
        found = list(self.store.batches(begin, begin + HOUR_STEPS - 1))
        if not found:
            return None
        met = sorted({number for each in found for number in each.poses})
        poses = self.store.poses()
        first, last = found[0].batch.first_step, found[-1].batch.last_step
        manifest = {
            "fingerprint": self.site.fingerprint, "map": self.site.map, "sight": self.site.sight,
            "validity_s": _validity_of(met, poses), "settings": {"vehicles": asdict(self._tracker)},
            "sources": _sources(met, poses),
        }  # fmt: skip
        views = [view for view, _ in self.store.views()]
        path = self.site.path_of(hour)
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_vehicle_hour(path, tiles=self.site.tiles, views=views, manifest=manifest) as out:
            *_, before = [None, *self.store.batches(begin - self.settings.steps, begin - 1)]
            if before is not None and before.batch.last_step == first - 1:
                out.warm_up(before.batch)
            for each in found:
                table = each.batch.vehicles
                cut = (table["first_step"] <= first) | (table["last_step"] >= last)
                out.add(replace(each.batch, vehicles=table.assign(continues=cut)))
        return path


def _validity_of(met: Sequence[int], poses: Mapping[int, FollowedPose]) -> dict[str, float]:
    """Return by sensor how long its frames are valid, by the latest of some poses."""
    return {poses[number].sensor: poses[number].validity_s for number in met}


def _sources(met: Sequence[int], poses: Mapping[int, FollowedPose]) -> list[dict[str, Any]]:
    """Return the entries of the manifest: one a sensor, with the poses that counted."""
    found: dict[str, dict[str, Any]] = {}
    for number in met:
        entry = {"recording": LIVE_RECORDING, "rows": 0, "sensor": poses[number].sensor}
        mine = found.setdefault(poses[number].sensor, entry | {"poses": []})
        mine["poses"].append(poses[number].content)
    return list(found.values())


def _frames(held: Sequence[_Held]) -> Iterator[pd.DataFrame]:
    """Yield the runs of frames of each sensor and view."""
    by_view: dict[tuple[str, str], list[Integers]] = {}
    for each in held:
        by_view.setdefault((each.sensor, each.view), []).append(each.steps)
    for key, steps in by_view.items():
        every = np.unique(np.concatenate(steps))
        yield runs_of_frames(*key, union([Runs(first=every, last=every)]))


def _frames_within(frames: pd.DataFrame, begin: int, end: int) -> pd.DataFrame:
    """Return the runs of frames from a step to the one before another."""
    first, last = frames["first_step"].clip(lower=begin), frames["last_step"].clip(upper=end - 1)
    return table_of_frames(frames.assign(first_step=first, last_step=last)[first <= last])
