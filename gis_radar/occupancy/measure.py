"""Occupancy from recordings: detections to the map, into tiles, into steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from gis_radar.arrays import Floats
from gis_radar.clocks.sensor_clock import SensorClock
from gis_radar.crs import metric_crs, require_same
from gis_radar.errors import InputError, NoAnswerError, UsageError
from gis_radar.files import whole_folder
from gis_radar.occupancy.cycles import Cycles, cycles_us
from gis_radar.occupancy.filters import Filters
from gis_radar.occupancy.folder import OWNED, Occupancy, read_occupancy, write_tables
from gis_radar.occupancy.frame_log import DeliveryWriter, merge_deliveries, read_deliveries
from gis_radar.occupancy.hits import merge_hits, write_hits
from gis_radar.occupancy.reading import Gauge, Reading, Site, warn_of_clocks
from gis_radar.occupancy.step_sets import frames_table
from gis_radar.occupancy.views import ViewBook, views_table
from gis_radar.poses.files import PoseTrack, as_track
from gis_radar.poses.pose import Pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.recording import Recording, as_recording
from gis_radar.tiles.lookup import TileEngine, TileGrid
from gis_radar.tiles.tiles import fingerprint, quads


def measure_occupancy(
    recordings: Sequence[str | Path | Recording],
    poses: Sequence[Pose | PoseTrack],
    tiles: gpd.GeoDataFrame,
    folder: str | Path,
    *,
    filters: Filters | None = None,
    cycles: Cycles | None = None,
    clocks: Mapping[str, SensorClock] | None = None,
    engine: Callable[[Floats], TileEngine] = TileGrid,
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
    cycles : mapping or "auto", optional
        Seconds from frame to frame, by sensor, or "auto" to measure them: a frame then speaks
        for each step that ends within its cycle (:mod:`gis_radar.occupancy.cycles`). Without
        it, a frame speaks for the step it falls in, and for no other.
    clocks : mapping, optional
        How far the clocks of sensors are ahead, by sensor; times are corrected by it.
    engine : type
        :class:`TileGrid` or :class:`TileTree`; both give the same.
    reporter : Reporter
        Hears how far the work is.

    Returns
    -------
    Occupancy

    Raises
    ------
    UsageError
        If there are not as many poses as recordings.
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
    Occupancy(R1: 73.9 s of frames, 2931 tiles seen)
    """
    if len(recordings) != len(poses) or not recordings:
        raise UsageError(f"{len(recordings)} recordings, but {len(poses)} poses")
    opened = [as_recording(recording) for recording in recordings]
    tracks = [as_track(pose) for pose in poses]
    sensors = [track.sensor for track in tracks]
    site = _site_of(tiles, tracks, filters or Filters(), engine)
    views = _views_of(site, tracks, reporter)
    spans_us = cycles_us(cycles, opened, sensors)
    gauge = Gauge(reporter=reporter, total=_total(opened))
    with whole_folder(Path(folder), owned=OWNED) as part:
        readings = [
            Reading(
                recording=recording,
                track=track,
                site=site,
                gauge=gauge,
                log=DeliveryWriter(part / f"{number}.part", [track.sensor], site.fingerprint),
                views=views[number],
                cycle_us=spans_us[track.sensor],
                clock=(clocks or {}).get(track.sensor),
            )
            for number, (recording, track) in enumerate(zip(opened, tracks, strict=True))
        ]
        hits = merge_hits([reading.hits() for reading in readings])
        write_hits(hits, part / "hits.parquet", fingerprint=site.fingerprint)
        write_tables(_rest_of(readings, site), part)
        for reading in readings:
            reading.log.path.unlink()
    for reading in readings:
        reading.warn_of_range()
        reading.warn_of_cycle()
    warn_of_clocks(readings, reporter)
    return read_occupancy(folder)


def _rest_of(readings: list[Reading], site: Site) -> Occupancy:
    """Return all but the hits of what has been read."""
    frames = frames_table(pd.concat([reading.frames() for reading in readings]))
    return Occupancy(
        fingerprint=site.fingerprint,
        frames=frames,
        views=views_table(frames, site.views.tiles),
        hits=lambda: iter(()),
        sources=[reading.source() for reading in readings],
        deliveries=lambda sensors: merge_deliveries(
            [read_deliveries(reading.log.path, sensors) for reading in readings]
        ),
    )


def _views_of(site: Site, tracks: list[PoseTrack], reporter: Reporter) -> list[tuple[str, ...]]:
    """Return the views of each track's poses; refuse where no sensor sees a tile."""
    distinct = {id(track): track for track in tracks}
    views = {key: site.views.enter(track) for key, track in distinct.items()}
    blind = [
        track.sensor
        for track in tracks
        if not any(len(site.views.tiles[name]) for name in set(views[id(track)]))
    ]
    if len(blind) == len(tracks):
        raise NoAnswerError(
            f"no tile lies in the view of {', '.join(blind)}",
            hint="poses, heights and tiles do not fit each other",
        )
    for sensor in blind:
        reporter.log(f"no tile lies in the view of {sensor}", "warning")
    return [views[id(track)] for track in tracks]


def _total(recordings: list[Recording]) -> int | None:
    rows = [recording.rows for recording in recordings]
    return None if None in rows else sum(row for row in rows if row is not None)


def _site_of(
    tiles: gpd.GeoDataFrame,
    tracks: list[PoseTrack],
    filters: Filters,
    engine: Callable[[Floats], TileEngine],
) -> Site:
    crs = metric_crs(tiles.crs, what="tiles")
    for track in tracks:
        what = f"the pose of {track.sensor}"
        require_same(track.poses[0].crs, crs, what=what, other_what="the tiles")
    tile_id = tiles["tile_id"].to_numpy(np.int64)
    height = tiles["height_m"].to_numpy(np.float64)
    if filters.clearance is not None and np.isnan(height).all():
        raise InputError(
            "the tiles know no road heights, which the clearance filter needs",
            hint="make the tiles with --road, or from a map with ele",
        )
    middle = shapely.get_coordinates(shapely.centroid(tiles.geometry.array))
    return Site(
        fingerprint=fingerprint(tiles),
        tile_id=tile_id,
        road_height=height,
        engine=engine(quads(tiles)),
        views=ViewBook(tile_id=tile_id, centres=np.column_stack([middle, height])),
        filters=filters,
    )
