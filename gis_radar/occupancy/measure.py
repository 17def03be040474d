"""Measure occupancy: one pass over recordings, from detections to hits, frames and frame log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.arrays import Floats, Integers
from gis_radar.clocks import SensorClock
from gis_radar.errors import InputError, UsageError
from gis_radar.files import whole_folder
from gis_radar.occupancy.folder import (
    HITS_FILE,
    OWNED,
    Occupancy,
    frames_of,
    frames_table,
    read_occupancy,
    views_table,
)
from gis_radar.occupancy.frame_log import (
    FRAME_LOG,
    FrameIndex,
    frame_rows,
    merge_frame_logs,
    rows_of,
    whole_frames,
)
from gis_radar.occupancy.frame_steps import (
    FrameTimes,
    Runs,
    holds_of,
    steps_held,
    union,
)
from gis_radar.occupancy.hits import HITS, Rows, SortedTableWriter, distinct, merge_rows
from gis_radar.occupancy.settings import DEFAULTS, Filters, OccupancySettings
from gis_radar.occupancy.views import PlacedRecording, ViewBook, place_recordings, places_of
from gis_radar.poses.files import PoseTrack, as_track
from gis_radar.poses.pose import Pose, View
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.recording import Detections, RangeCounts, Recording
from gis_radar.sight import (
    MovementCounter,
    MovingHits,
    SightTiles,
    describe_sight,
    find_contradictions,
    open_sight,
    report_contradictions,
)
from gis_radar.sight.settings import DEFAULTS as SIGHT_DEFAULTS
from gis_radar.steps import STEP_US, iso_from_step, step_of
from gis_radar.tiles.lookup import TileEngine, TileGrid

STAGE = "occupancy"


def measure_occupancy(
    recordings: Sequence[str | Path | Recording],
    poses: Sequence[Pose | PoseTrack],
    tiles: gpd.GeoDataFrame,
    folder: str | Path,
    *,
    filters: Filters | None = None,
    cycles: Mapping[str, float] | None = None,
    clocks: Mapping[str, SensorClock] | None = None,
    engine: Callable[[Floats], TileEngine] = TileGrid,
    pairs: bool = False,
    scans: Sequence[str | Path] = (),
    scan_crs: Any = None,
    sight: str | Path | None = None,
    settings: OccupancySettings = DEFAULTS,
    reporter: Reporter = QUIET,
) -> Occupancy:
    """Find which tiles were hit in which steps, and write that as a folder.

    Detections are moved to the map, assigned to the tiles under them, and counted once a
    tile and step, whatever the number of detections, frames and sensors in that step (the paper,
    "Local Sensor Data Processing" and "Global Occupancy Heat Map").

    Parameters
    ----------
    recordings : sequence
        Files, or what :func:`gis_radar.recordings.recording.open_recording` returns.
    poses : sequence of Pose or PoseTrack
        As many as recordings, in order. A pose without a view gets the default one.
    tiles : GeoDataFrame
        As from :func:`gis_radar.tiles.tiles.read_tiles`.
    folder : str or Path
        Where the occupancy goes; it appears whole or not at all.
    filters : Filters, optional
        Which detections count; without it, all.
    cycles : mapping, optional
        Seconds from frame to frame, of sensors slower than 10 Hz: a frame covers the steps up to
        its sensor's next one, but none later than 1.5 cycles; without it, than 100 ms
        (:mod:`gis_radar.occupancy.frame_steps`).
    clocks : mapping, optional
        How far the clocks of sensors are ahead, by sensor; times are corrected by it.
    engine : type
        :class:`TileGrid` or :class:`TileTree`; both give the same.
    pairs : bool
        Also write `hits.parquet`, for other programs: the pairs (step, tile_id).
    scans : sequence of paths
        Airborne scans (LAS, LAZ, COPC), whole and not masked: what stands in them hides tiles.
        Without them, all in the view counts as seen.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    sight : str or Path, optional
        A file of :func:`gis_radar.write_sights`, in place of scans.
    settings : OccupancySettings
        Constants of the algorithm; written to the manifest.
    reporter : Reporter
        Receives progress and warnings.

    Returns
    -------
    Occupancy

    Raises
    ------
    UsageError
        If there are not as many poses as recordings, or both scans and a file of sight.
    InputError
        If a recording is damaged, a CRS differs, or heights are asked for and unknown.
    NoAnswerError
        If no sensor sees any tile.

    Examples
    --------
    >>> import gis_radar as gr
    >>> sample = gr.sample_folder()
    >>> tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    >>> pose = gr.read_pose(sample / "R1.json")
    >>> gr.measure_occupancy([sample / "R1.parquet"], [pose], tiles, "occupancy")
    Occupancy(R1 100.0 s covered by frames, 2948 tiles seen)
    """
    if len(recordings) != len(poses) or not recordings:
        raise UsageError(f"{len(recordings)} recordings, but {len(poses)} poses")
    tracks = [as_track(pose) for pose in poses]
    target = _target(tiles, filters or Filters(), engine, settings)
    target.views.scan = open_sight(
        target.views.road, scans=scans, scan_crs=scan_crs, sight=sight, reporter=reporter
    )
    sources = place_recordings(recordings, tracks, target.views, clocks, reporter)
    _refuse_clearance([source.recording for source in sources], target.filters)
    holds = holds_of(cycles, sorted({track.sensor for track in tracks}), settings)
    with whole_folder(Path(folder), owned=OWNED, reporter=reporter) as part:
        passes = _read_all(sources, target, part, reporter)
        frames = frames_table(pd.concat([each.frames() for each in passes]))
        Occupancy(
            fingerprint=target.fingerprint,
            frames=frames,
            views=views_table(frames, target.views.tiles),
            hits_by_sensor=lambda names: HITS.read(part / HITS_FILE, names),
            sources=[each.record(target) for each in passes],
            frame_log=lambda names: merge_frame_logs(
                [FRAME_LOG.read(each.log.path, names) for each in passes]
            ),
            hold_s=holds,
        ).write_beside_hits(part, pairs=pairs)
        for each in passes:
            each.log.path.unlink()
    target.views.report(reporter)
    report_contradictions(
        find_contradictions(_moving_hits(passes, target), target.views.road), reporter
    )
    for line in _warnings(passes, target.views, holds, settings):
        reporter.log(line, "warning")
    return read_occupancy(folder)


@dataclass(frozen=True, kw_only=True)
class Target:
    """What detections are assigned to, the same for all recordings: tiles, views, filters."""

    fingerprint: str
    tile_id: Integers
    road_height: Floats
    engine: TileEngine
    views: ViewBook
    filters: Filters
    settings: OccupancySettings


@dataclass(kw_only=True)
class RecordingPass:
    """What one pass over a recording gives beside its hits.

    Parameters
    ----------
    source : PlacedRecording
        What was read.
    log : SortedTableWriter
        One row a frame, on disk.
    runs : dict
        Steps with a frame, by view.
    poses : set of int
        Poses of the track that were in force at a frame.
    times : FrameTimes
        First and last frame, and the gaps between frames.
    ranges : RangeCounts
        Ranges of all detections.
    rows : int
        Rows read.
    hits : int
        Frames on tiles: how often a tile was hit by a frame.
    level : bool
        Whether the sensor measures no elevation.
    movement : dict
        What moves on the tiles, by the view that the sensor had first where it stood; empty where
        sight is the view alone.
    """

    source: PlacedRecording
    log: SortedTableWriter
    runs: dict[str, list[Runs]] = field(default_factory=dict)
    poses: set[int] = field(default_factory=set)
    times: FrameTimes = field(default_factory=FrameTimes)
    ranges: RangeCounts = field(default_factory=RangeCounts)
    rows: int = 0
    hits: int = 0
    level: bool = False
    movement: dict[str, MovementCounter] = field(default_factory=dict)

    def frames(self) -> pd.DataFrame:
        """Return the runs of steps with a frame, by view."""
        sensor = self.source.track.sensor
        return pd.concat([frames_of(sensor, view, union(runs)) for view, runs in self.runs.items()])

    def record(self, target: Target) -> dict[str, Any]:
        """Return the entry of the manifest for this recording, with the poses that it met."""
        return {
            **self.source.record(self.rows, self.poses),
            "filters": asdict(target.filters),
            "settings": asdict(target.settings),
            "sight": describe_sight(target.views.scan),
            **({"elevation": False} if self.level else {}),
        }


def _read_all(
    sources: list[PlacedRecording], target: Target, folder: Path, reporter: Reporter
) -> list[RecordingPass]:
    """Read all recordings side by side; write their merged hits, return all else."""
    known = [source.recording.rows for source in sources]
    total = None if None in known else sum(rows for rows in known if rows is not None)
    sensors = sorted({source.track.sensor for source in sources})
    with ExitStack() as logs:
        passes = []
        for number, source in enumerate(sources):
            path, sensor = folder / f"{number}.part", source.track.sensor
            log = SortedTableWriter(FRAME_LOG, path, target.fingerprint, [sensor])
            passes.append(RecordingPass(source=source, log=logs.enter_context(log)))

        def count_rows() -> None:
            reporter.progress(STAGE, sum(each.rows for each in passes), total)

        numbers = [sensors.index(source.track.sensor) for source in sources]
        streams = [
            _hits(each, number, target, count_rows)
            for each, number in zip(passes, numbers, strict=True)
        ]
        HITS.write(merge_rows(streams, 3), folder / HITS_FILE, target.fingerprint, sensors)
    return passes


def _hits(
    found: RecordingPass, number: int, target: Target, count_rows: Callable[[], None]
) -> Iterator[Rows]:
    """Yield the hits of frames as (step, tile, sensor); add all else to `found` on the way."""
    source = found.source
    clock = source.clock or SensorClock(offset_s=0.0)
    places = places_of(source.track.poses)
    for read in whole_frames(source.recording.read()):
        piece = replace(read, time=clock.corrected(read.time))
        shift_us = np.rint((piece.time - read.time) * 1e6).astype(np.int64)
        pose_of_row = source.track.at(piece.time)
        for index in np.unique(pose_of_row).tolist():
            now = pose_of_row == index
            part = piece if now.all() else rows_of(piece, now)
            frames = FrameIndex.of(part.time)
            pose, view = source.track.poses[index], source.views[index]
            road_m = target.views.road_m[source.track.sensor, view]
            frame, tile = _tiles_hit(part, frames, pose, target, road_m)
            step = step_of(frames.time)
            tiles_hit = np.bincount(frame, minlength=len(step))
            tiles_seen = np.full(len(step), len(target.views.tiles[view]))
            if target.views.scan is not None:
                first = source.views[places[index]]
                counter = MovementCounter(tiles=target.views.road, engine=target.engine)
                found.movement.setdefault(first, counter).add(part, pose, road_m=road_m)
            found.log.add(
                frame_rows(part, frames, tiles_hit, tiles_seen, shift_us[now], target.settings)
            )
            found.runs.setdefault(view, []).append(union([Runs(first=step, last=step)]))
            found.poses.add(index)
            found.hits += len(frame)
            found.times.add(frames.time_us)
            yield step[frame], target.tile_id[tile], np.full(len(frame), number)
        found.ranges.add(piece)
        found.level |= bool(np.isnan(piece.points[piece.present, 2]).any())
        found.rows += len(piece)
        count_rows()


def _tiles_hit(
    piece: Detections, frames: FrameIndex, pose: Pose, target: Target, road_m: float
) -> Rows:
    """Return the pairs of a frame and a tile (positions) that it hit, each once."""
    keep = target.filters.keep_detections(piece)
    level = np.isnan(piece.points[:, 2])
    if level.any():  # nearer than the road: not on it
        keep &= ~(level & (piece.range_m <= np.nan_to_num(pose.height - road_m)))
    points, frame = piece.points[keep], frames.of_row[keep]
    place = pose.to_map(points, road_m=road_m)
    point, tile = target.engine.assign(place[:, 0], place[:, 1])
    if target.filters.clearance is not None:
        range_m = np.linalg.norm(points, axis=1)[point]
        fits = target.filters.keep_pairs(point, place[point, 2], range_m, target.road_height[tile])
        point, tile = point[fits], tile[fits]
    return distinct(frame[point], tile)


def _refuse_clearance(recordings: Sequence[Recording], filters: Filters) -> None:
    for recording in recordings if filters.clearance is not None else ():
        if not recording.measures_elevation():
            raise InputError(
                f"{recording.path}: the sensor measures no elevation (z is empty): a clearance "
                "means nothing for it",
                hint="leave the clearance away",
            )


def _target(
    tiles: gpd.GeoDataFrame, filters: Filters, engine: Callable[[Floats], TileEngine],
    settings: OccupancySettings,
) -> Target:  # fmt: skip
    road = SightTiles.of(tiles)
    if filters.clearance is not None and np.isnan(road.height).all():
        raise InputError(
            "the tiles have no road heights, which the clearance filter needs",
            hint="make the tiles with --road, or from a map with ele",
        )
    return Target(
        fingerprint=road.fingerprint,
        tile_id=road.tile_id,
        road_height=road.height,
        engine=engine(road.quads),
        views=ViewBook(road=road, settings=settings),
        filters=filters,
        settings=settings,
    )


def _moving_hits(passes: list[RecordingPass], target: Target) -> list[MovingHits]:
    """Return what moved on the tiles in each view, of all recordings of a sensor together."""
    together: dict[tuple[str, str], list[MovementCounter]] = {}
    for each in passes:
        for view, counter in each.movement.items():
            together.setdefault((each.source.track.sensor, view), []).append(counter)
    hits = [MovingHits.of(target.views.sights[key], found) for key, found in together.items()]
    return [each for each in hits if each.frames >= SIGHT_DEFAULTS.judged_frames]


def _warnings(
    passes: list[RecordingPass], book: ViewBook, holds: Mapping[str, float],
    settings: OccupancySettings,
) -> Iterator[str]:  # fmt: skip
    """Yield what does not fit in views, cycles and clocks, given what was recorded."""
    spans: dict[str, tuple[int, int]] = {}
    for each in passes:
        file, sensor = each.source.recording.path.name, each.source.track.sensor
        reached_m, cycle_us = each.ranges.reached_m(settings.range_share), each.times.cycle_us
        view = each.source.track.poses[0].view or View()
        if each.hits == 0:
            yield (
                f"{file}: no detection of {sensor} lies on a tile: all reads as observed and "
                "empty; do pose, tiles and filters fit the recording, and are its positions metres?"
            )
        if 0 < reached_m < settings.reach_share * view.max_range_m:
            yield (
                f"{file}: {100 * settings.range_share:g} % of the detections lie within "
                f"{reached_m:.0f} m, but the view of {sensor} reaches {view.max_range_m:g} m: what "
                "lies beyond reads as observed and empty; set the view's max_range_m or --max-range"
            )
        covered_us = (1 + steps_held(holds[sensor])) * STEP_US
        if settings.slow_cycle * covered_us < cycle_us < np.inf:
            cycle_ms, empty = round(cycle_us / 1000), 100.0 * (1.0 - covered_us / cycle_us)
            yield (
                f"{file}: {sensor} delivers every {cycle_ms} ms, and a frame holds "
                f"{1000 * holds[sensor]:g} ms: {empty:.0f} % of the 50 ms steps read as not "
                f"observed by it; --cycle {sensor}={cycle_ms}ms lets a frame cover its whole cycle"
            )
        if each.level:
            roads = {each.source.views[index] for index in each.poses}
            heights = sorted({f"{book.road_m[sensor, name]:.1f}" for name in roads})
            yield (
                f"{file}: {sensor} measures no elevation: its detections are placed at the height "
                f"of the road near it ({', '.join(heights)} m)"
            )
        if each.times.first_us < settings.clock_set_s * 1e6:
            begin = iso_from_step(each.times.first_us // STEP_US)
            yield (
                f"{file}: times begin at {begin}: the clock of {sensor} may count since it was "
                "switched on; gis-radar clocks finds its offset"
            )
        first, last = spans.get(sensor, (each.times.first_us, each.times.last_us))
        spans[sensor] = min(first, each.times.first_us), max(last, each.times.last_us)
    for (one, (begin_us, end_us)), (other, (first, last)) in combinations(spans.items(), 2):
        if (apart_us := max(first - end_us, begin_us - last)) > 0:
            yield (
                f"{one} and {other} have no time in common: {apart_us / 1e6:,.0f} s lie between "
                "them; if they were recorded together, a clock is off: gis-radar clocks finds by "
                "how much"
            )
