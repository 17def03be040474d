"""Measure occupancy: one pass over recordings, from detections to hits, frames and frame log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import combinations
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.arrays import Floats
from gis_radar.clocks import SensorClock
from gis_radar.errors import InputError, UsageError
from gis_radar.files import whole_folder
from gis_radar.occupancy.folder import (
    HITS_FILE,
    OWNED,
    Occupancy,
    frames_table,
    read_occupancy,
    views_table,
)
from gis_radar.occupancy.frame_log import (
    FRAME_LOG,
    merge_frame_logs,
)
from gis_radar.occupancy.frame_steps import (
    holds_of,
    steps_held,
)
from gis_radar.occupancy.hits import HITS, Rows, SortedTableWriter, merge_rows
from gis_radar.occupancy.plain_pass import count_plainly
from gis_radar.occupancy.recording_pass import RecordingPass, Target, count_recording
from gis_radar.occupancy.settings import DEFAULTS, Filters, OccupancySettings
from gis_radar.occupancy.views import PlacedRecording, ViewBook, place_recordings
from gis_radar.poses.files import PoseTrack, as_track
from gis_radar.poses.pose import Pose, View
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.overlaps import overlap_warnings
from gis_radar.recordings.recording import Recording
from gis_radar.recordings.speeds import odd_speeds
from gis_radar.sight import (
    MovementCounter,
    MovingHits,
    SightTiles,
    find_contradictions,
    find_gaps,
    gap_warning,
    open_sight,
    report_contradictions,
)
from gis_radar.sight.settings import DEFAULTS as SIGHT_DEFAULTS
from gis_radar.steps import STEP_US, iso_from_step
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
    sight_cache: str | Path | None = None,
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
        :class:`TileGrid`, compiled; :class:`TileTree` and others run in NumPy and give the same.
    pairs : bool
        Also write `hits.parquet`, for other programs: the pairs (step, tile_id).
    scans : sequence of paths
        Airborne scans (LAS, LAZ, COPC), whole and not masked: what stands in them hides tiles.
        Without them, all in the view counts as seen.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    sight : str or Path, optional
        A file of :func:`gis_radar.write_sights`, in place of scans.
    sight_cache : str or Path, optional
        A folder in which what each pose sees by the scans is kept, for other calls.
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
        target.views.road,
        scans=scans,
        scan_crs=scan_crs,
        sight=sight,
        cache=sight_cache,
        reporter=reporter,
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
    hits = _moving_hits(passes, target)
    if target.views.scan is not None:
        judged = [each for each in hits if each.frames >= SIGHT_DEFAULTS.judged_frames]
        report_contradictions(find_contradictions(judged, target.views.road), reporter)
    if gaps := gap_warning(find_gaps(hits, target.views.road)):
        reporter.log(gaps, "warning")
    for line in _warnings(passes, target.views, holds, settings):
        reporter.log(line, "warning")
    return read_occupancy(folder)


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
        rows = streams[0] if len(streams) == 1 else merge_rows(streams, 3)
        HITS.write(rows, folder / HITS_FILE, target.fingerprint, sensors)
    return passes


def _hits(
    found: RecordingPass, number: int, target: Target, count_rows: Callable[[], None]
) -> Iterator[Rows]:
    """Yield the hits of frames as (step, tile, sensor); add all else to `found` on the way."""
    count = count_recording if type(target.engine) is TileGrid else count_plainly
    for counted in count(found, target):
        found.note(counted.frames, target)
        yield counted.step, counted.tile, np.full(len(counted.step), number)
        count_rows()


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
    return [MovingHits.of(target.views.sights[key], found) for key, found in together.items()]


def _warnings(
    passes: list[RecordingPass], book: ViewBook, holds: Mapping[str, float],
    settings: OccupancySettings,
) -> Iterator[str]:  # fmt: skip
    """Yield what does not fit in views, cycles and clocks, given what was recorded."""
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
        if odd := odd_speeds(each.source.recording):
            yield f"{file}: {odd}; vehicles and poses need metres and m/s, positive when receding"
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
    yield from _time_warnings(passes)


def _time_warnings(passes: list[RecordingPass]) -> Iterator[str]:
    """Yield what is odd in when recordings were made: together, or one after the other."""
    held: dict[str, list[tuple[int, int, Path]]] = {}
    for each in passes:
        span = each.times.first_us, each.times.last_us, each.source.recording.path
        held.setdefault(each.source.track.sensor, []).append(span)
    for sensor, spans in held.items():
        yield from overlap_warnings(sensor, spans)
    whole = {
        sensor: (min(each[0] for each in spans), max(each[1] for each in spans))
        for sensor, spans in held.items()
    }
    for (one, (begin_us, end_us)), (other, (first, last)) in combinations(whole.items(), 2):
        if (apart_us := max(first - end_us, begin_us - last)) > 0:
            yield (
                f"{one} and {other} have no time in common: {apart_us / 1e6:,.0f} s lie between "
                "them; if they were recorded together, a clock is off: gis-radar clocks finds by "
                "how much"
            )
