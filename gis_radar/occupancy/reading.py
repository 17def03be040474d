"""Read a recording into hits, frames and the frame log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.clocks.sensor_clock import SensorClock
from gis_radar.occupancy.cycles import Spoken, last_step
from gis_radar.occupancy.filters import Filters
from gis_radar.occupancy.frame_log import MOVING_MPS, WILD_MPS, DeliveryWriter, position_sums
from gis_radar.occupancy.hits import Hits, distinct
from gis_radar.occupancy.step_sets import Runs, union
from gis_radar.occupancy.views import ViewBook
from gis_radar.poses.files import PoseTrack
from gis_radar.poses.pose import Pose, View
from gis_radar.progress import Reporter
from gis_radar.recordings.recording import Detections, Recording
from gis_radar.steps import STEP_US, iso_from_step, step_of
from gis_radar.tiles.lookup import TileEngine

MOST_WAITING = 1 << 21
NO_FURTHER = pa.RecordBatch.from_pydict({})


def whole_frames(pieces: Iterator[Detections]) -> Iterator[Detections]:
    """Cut pieces at the borders of frames, so that none is split; further columns go.

    A frame of over two million rows is no frame of a radar, and is passed on in parts.
    """
    waiting: Detections | None = None
    for piece in pieces:
        rows = replace(piece, further=NO_FURTHER)
        joined = rows if waiting is None else _joined(waiting, rows)
        cut = int(np.searchsorted(joined.time, joined.time[-1], side="left"))
        if cut == 0 and len(joined) > MOST_WAITING:
            cut = len(joined)
        if cut:
            yield rows_of(joined, slice(0, cut))
        waiting = rows_of(joined, slice(cut, None))
    if waiting is not None and len(waiting):
        yield waiting


def _joined(one: Detections, other: Detections) -> Detections:
    return Detections(
        time=np.concatenate([one.time, other.time]),
        points=np.concatenate([one.points, other.points]),
        range_rate=np.concatenate([one.range_rate, other.range_rate]),
        rcs=np.concatenate([one.rcs, other.rcs]),
        further=NO_FURTHER,
    )


def rows_of(rows: Detections, part: slice | Booleans) -> Detections:
    """Return some of the rows, without further columns."""
    return Detections(
        time=rows.time[part],
        points=rows.points[part],
        range_rate=rows.range_rate[part],
        rcs=rows.rcs[part],
        further=NO_FURTHER,
    )


STAGE = "occupancy"
MOST_GAP_MS = 2000
SLOW = 1.1
CLOCKS_SET_S = 631_152_000.0  # 1990


@dataclass(frozen=True, kw_only=True)
class Site:
    """What all recordings share: tiles, their engine, the views, the filters."""

    fingerprint: str
    tile_id: Integers
    road_height: Floats
    engine: TileEngine
    views: ViewBook
    filters: Filters


@dataclass(kw_only=True)
class Gauge:
    """Rows read so far, over all recordings."""

    reporter: Reporter
    total: int | None
    rows: int = 0

    def add(self, rows: int) -> None:
        """Count rows, and say so."""
        self.rows += rows
        self.reporter.progress(STAGE, self.rows, self.total)


@dataclass(frozen=True, kw_only=True)
class Frames:
    """The frames of a piece: their times, and the rows that each has.

    Parameters
    ----------
    time : (f,) array
        UNIX seconds, corrected.
    begins : (f,) int64 array
        The first row of each frame.
    of_row : (n,) int64 array
        The frame of each row.
    """

    time: Floats
    begins: Integers
    of_row: Integers

    @classmethod
    def of(cls, time: Floats) -> Frames:
        """Find the frames of rows with the given times, ascending."""
        fresh = np.ones(len(time), np.bool_)
        np.not_equal(time[1:], time[:-1], out=fresh[1:])
        begins = np.flatnonzero(fresh)
        return cls(time=time[begins], begins=begins, of_row=np.cumsum(fresh) - 1)

    def count(self, flags: Booleans) -> Integers:
        """Return of how many of its rows each frame says so."""
        return np.add.reduceat(flags.astype(np.int64), self.begins)


@dataclass(kw_only=True)
class Reading:
    """One recording on its way through the site.

    Parameters
    ----------
    recording, track : Recording, PoseTrack
        What is read, and where its sensor stood.
    site, gauge : Site, Gauge
        What all recordings share.
    log : DeliveryWriter
        Takes one row a frame.
    views : sequence of str
        The view of each pose of the track.
    cycle_us : int
        How long a frame speaks.
    clock : SensorClock, optional
        How far the sensor's clock is ahead.
    """

    recording: Recording
    track: PoseTrack
    site: Site
    gauge: Gauge
    log: DeliveryWriter
    views: Sequence[str]
    cycle_us: int = STEP_US
    clock: SensorClock | None = None
    runs: dict[str, list[Runs]] = field(default_factory=dict)
    rows: int = 0
    first_s: float = np.inf
    last_s: float = -np.inf
    ranges: Integers = field(default_factory=lambda: np.zeros(4096, np.int64))
    gaps_ms: Integers = field(default_factory=lambda: np.zeros(MOST_GAP_MS, np.int64))

    def hits(self) -> Iterator[Hits]:
        """Read the recording; yield its hits, and note frames and ranges on the way."""
        spoken = Spoken()
        with self.log:
            for read in whole_frames(self.recording.read()):
                piece, shift_us = self._corrected(read)
                held = self.track.at(piece.time)
                for pose_index in np.unique(held):
                    now = held == pose_index
                    part = piece if now.all() else rows_of(piece, now)
                    yield self._hits_of(part, int(pose_index), shift_us[now], spoken)
                self._note(piece)
        yield spoken.rest()

    def _corrected(self, piece: Detections) -> tuple[Detections, Integers]:
        """Return a piece in the time of all sensors, and by how much that is later, in us."""
        if self.clock is None:
            return piece, np.zeros(len(piece), np.int64)
        time = self.clock.corrected(piece.time)
        shift_us = np.rint((time - piece.time) * 1e6).astype(np.int64)
        return replace(piece, time=time), shift_us

    def _hits_of(
        self, piece: Detections, pose_index: int, shift_us: Integers, spoken: Spoken
    ) -> Hits:
        pose, site = self.track.poses[pose_index], self.site
        frames = Frames.of(piece.time)
        frame, tile = self._tiles_hit(piece, frames, pose)
        first, last = step_of(frames.time), last_step(frames.time, self.cycle_us)
        view = self._note_frames(Runs(first=first, last=last), pose_index)
        speed = np.abs(piece.range_rate)
        self.log.add(
            np.rint(frames.time * 1e6).astype(np.int64),
            np.zeros(len(frames.time), np.int64),
            frames.count(piece.present),
            frames.count(speed >= MOVING_MPS),
            frames.count(speed > WILD_MPS),
            np.bincount(frame, minlength=len(frames.time)),
            np.full(len(frames.time), len(site.views.tiles[view])),
            position_sums(piece.points, frames.begins),
            shift_us[frames.begins],
        )
        return spoken.spread(first[frame], last[frame], site.tile_id[tile], int(first[-1]))

    def _tiles_hit(
        self, piece: Detections, frames: Frames, pose: Pose
    ) -> tuple[Integers, Integers]:
        """Return the pairs of a frame and a tile (positions) that it hit, each once."""
        keep = self.site.filters.keep_detections(piece)
        points, frame = piece.points[keep], frames.of_row[keep]
        footprint = pose.to_map(points)
        point, tile = self.site.engine.assign(footprint[:, 0], footprint[:, 1])
        if self.site.filters.clearance is not None:
            fits = self.site.filters.keep_pairs(
                point,
                footprint[point, 2],
                np.linalg.norm(points, axis=1)[point],
                self.site.road_height[tile],
            )
            point, tile = point[fits], tile[fits]
        return distinct(frame[point], tile)

    def _note_frames(self, runs: Runs, pose_index: int) -> str:
        name = self.views[pose_index]
        self.runs.setdefault(name, []).append(union([runs]))
        return name

    def _note(self, piece: Detections) -> None:
        squares = np.einsum("ij,ij->i", piece.points, piece.points)
        metres = np.sqrt(squares[piece.present])
        bins = np.minimum(metres, len(self.ranges) - 1).astype(np.int64)
        self.ranges += np.bincount(bins, minlength=len(self.ranges))
        gaps = np.rint(np.diff(piece.time) * 1000).astype(np.int64)
        gaps = gaps[(gaps > 0) & (gaps < MOST_GAP_MS)]
        self.gaps_ms += np.bincount(gaps, minlength=MOST_GAP_MS)
        self.rows += len(piece)
        self.first_s = min(self.first_s, float(piece.time[0]))
        self.last_s = max(self.last_s, float(piece.time[-1]))
        self.gauge.add(len(piece))

    def frames(self) -> pd.DataFrame:
        """Return the runs of steps with a frame, by view."""
        pieces = [
            pd.DataFrame({"view": view, "first_step": joined.first, "last_step": joined.last})
            for view, joined in ((view, union(runs)) for view, runs in self.runs.items())
        ]
        return pd.concat(pieces).assign(sensor=self.track.sensor)

    def warn_of_range(self) -> None:
        """Say so where the recording ends well before the view does."""
        share = np.cumsum(self.ranges) / max(int(self.ranges.sum()), 1)
        reached_m = int(np.searchsorted(share, 0.999)) + 1
        view = self.track.poses[0].view or View()
        if self.ranges.any() and reached_m < 0.8 * view.max_range_m:
            self.gauge.reporter.log(
                f"{self.recording.path.name}: 99.9 % of the detections lie within {reached_m} m, "
                f"but the view of {self.track.sensor} reaches {view.max_range_m:g} m: what lies "
                "beyond reads as observed and empty; set the view's max_range_m or --max-range",
                "warning",
            )

    def warn_of_cycle(self) -> None:
        """Say so where the sensor is slower than the steps and its cycle is not stated."""
        done = np.cumsum(self.gaps_ms)
        cycle_ms = int(np.searchsorted(done, done[-1] / 2)) if done[-1] else 0
        if self.cycle_us == STEP_US and cycle_ms * 1000 > SLOW * STEP_US:
            empty = 100.0 * (1.0 - STEP_US / (cycle_ms * 1000))
            self.gauge.reporter.log(
                f"{self.recording.path.name}: {self.track.sensor} delivers every {cycle_ms} ms: "
                f"{empty:.0f} % of the 50 ms steps are without a frame, and read as not observed "
                f"by it; --cycle {self.track.sensor}={cycle_ms}ms lets a frame speak for its cycle",
                "warning",
            )

    def source(self) -> dict[str, Any]:
        """Return what the manifest says of this recording, with the poses that it met."""
        first, last = self.track.at(np.array([self.first_s, self.last_s]))
        return {
            "recording": self.recording.path.name,
            "rows": self.rows,
            "sensor": self.track.sensor,
            "filters": asdict(self.site.filters),
            "poses": [pose.as_dict() for pose in self.track.poses[first : last + 1]],
            **({} if self.cycle_us == STEP_US else {"cycle_s": self.cycle_us / 1e6}),
            **({} if self.clock is None else {"clock": self.clock.as_dict()}),
        }


def warn_of_clocks(readings: list[Reading], reporter: Reporter) -> None:
    """Say so where time stamps cannot be those of a clock set to UTC."""
    for reading in readings:
        if reading.last_s < CLOCKS_SET_S:
            reporter.log(
                f"{reading.recording.path.name}: times begin at "
                f"{iso_from_step(int(step_of(np.array([reading.first_s]))[0]))}: the clock of "
                f"{reading.track.sensor} may count since it was switched on; "
                "gis-radar clocks finds its offset",
                "warning",
            )
    spans: dict[str, tuple[float, float]] = {}
    for reading in readings:
        first_s, last_s = spans.get(reading.track.sensor, (np.inf, -np.inf))
        span = min(first_s, reading.first_s), max(last_s, reading.last_s)
        spans[reading.track.sensor] = span
    for (one, (begin, end)), (other, (first, last)) in combinations(spans.items(), 2):
        if end < first or last < begin:
            apart_s = max(first - end, begin - last)
            reporter.log(
                f"{one} and {other} have no time in common: {apart_s:,.0f} s lie between them; "
                "if they were recorded together, a clock is off: gis-radar clocks finds by how "
                "much",
                "warning",
            )
