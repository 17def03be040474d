"""Occupancy from recordings: detections to the map, into tiles, into steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely

from gis_radar.arrays import Floats, Integers
from gis_radar.assignment import TileEngine, TileGrid
from gis_radar.clock import step_of
from gis_radar.crs import metric_crs, require_same
from gis_radar.detections import Detections, Recording, as_recording
from gis_radar.errors import InputError, NoAnswerError, UsageError
from gis_radar.occupancy.filters import Filters
from gis_radar.occupancy.folder import FILES, Occupancy, read_occupancy, write_tables
from gis_radar.occupancy.frames import frames_table
from gis_radar.occupancy.hits import Hits, merge_hits, unique_hits, write_hits
from gis_radar.occupancy.runs import Runs, union
from gis_radar.occupancy.views import ViewBook, views_table
from gis_radar.outputs import whole_folder
from gis_radar.pose import Pose, View
from gis_radar.pose_files import PoseTrack, as_track
from gis_radar.progress import QUIET, Reporter
from gis_radar.tiles import fingerprint, quads

STAGE = "occupancy"


def measure_occupancy(
    recordings: Sequence[str | Path | Recording],
    poses: Sequence[Pose | PoseTrack],
    tiles: gpd.GeoDataFrame,
    folder: str | Path,
    *,
    filters: Filters | None = None,
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
        Files, or what :func:`gis_radar.detections.open_recording` returns.
    poses : sequence of Pose or PoseTrack
        As many as recordings, in order. A pose without a view gets the default one.
    tiles : GeoDataFrame
        As from :func:`gis_radar.tiles.read_tiles`.
    folder : str or Path
        Where the occupancy goes; it appears whole or not at all.
    filters : Filters, optional
        Which detections count; without it, all.
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
    """
    if len(recordings) != len(poses) or not recordings:
        raise UsageError(f"{len(recordings)} recordings, but {len(poses)} poses")
    opened = [as_recording(recording) for recording in recordings]
    tracks = [as_track(pose) for pose in poses]
    site = _Site.of(tiles, tracks, filters or Filters(), engine)
    _refuse_blindness(site, tracks, reporter)
    gauge = _Gauge(reporter=reporter, total=_total(opened))
    readings = [
        _Reading(recording=recording, track=track, site=site, gauge=gauge)
        for recording, track in zip(opened, tracks, strict=True)
    ]
    with whole_folder(Path(folder), owned=FILES) as part:
        hits = merge_hits([reading.hits() for reading in readings])
        write_hits(hits, part / "hits.parquet", fingerprint=site.fingerprint)
        frames = frames_table(pd.concat([reading.frames() for reading in readings]))
        write_tables(
            Occupancy(
                fingerprint=site.fingerprint,
                frames=frames,
                views=views_table(frames, site.views.tiles),
                hits=lambda: iter(()),
                sources=[reading.source() for reading in readings],
            ),
            part,
        )
    for reading in readings:
        reading.warn_of_range()
    return read_occupancy(folder)


def _refuse_blindness(site: _Site, tracks: list[PoseTrack], reporter: Reporter) -> None:
    """Say which sensors see no tile at all; refuse where none sees any."""
    blind = [
        track.sensor
        for track in tracks
        if not any(len(site.views.tiles[site.views.enter(pose)]) for pose in track.poses)
    ]
    if len(blind) == len(tracks):
        raise NoAnswerError(
            f"no tile lies in the view of {', '.join(blind)}",
            hint="poses, heights and tiles do not fit each other",
        )
    for sensor in blind:
        reporter.log(f"no tile lies in the view of {sensor}", "warning")


def _total(recordings: list[Recording]) -> int | None:
    rows = [recording.rows for recording in recordings]
    return None if None in rows else sum(row for row in rows if row is not None)


@dataclass(frozen=True, kw_only=True)
class _Site:
    """What all recordings share: tiles, their engine, the views, the filters."""

    fingerprint: str
    tile_id: Integers
    road_height: Floats
    engine: TileEngine
    views: ViewBook
    filters: Filters

    @classmethod
    def of(
        cls,
        tiles: gpd.GeoDataFrame,
        tracks: list[PoseTrack],
        filters: Filters,
        engine: Callable[[Floats], TileEngine],
    ) -> _Site:
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
        return cls(
            fingerprint=fingerprint(tiles),
            tile_id=tile_id,
            road_height=height,
            engine=engine(quads(tiles)),
            views=ViewBook(tile_id=tile_id, centres=np.column_stack([middle, height])),
            filters=filters,
        )


@dataclass(kw_only=True)
class _Gauge:
    """Rows read so far, over all recordings."""

    reporter: Reporter
    total: int | None
    rows: int = 0

    def add(self, rows: int) -> None:
        self.rows += rows
        self.reporter.progress(STAGE, self.rows, self.total)


@dataclass(kw_only=True)
class _Reading:
    """One recording on its way through the site."""

    recording: Recording
    track: PoseTrack
    site: _Site
    gauge: _Gauge
    views: dict[int, str] = field(default_factory=dict)
    runs: dict[str, list[Runs]] = field(default_factory=dict)
    rows: int = 0
    ranges: Integers = field(default_factory=lambda: np.zeros(4096, np.int64))

    def hits(self) -> Iterator[Hits]:
        """Read the recording; yield its hits, and note frames and ranges on the way."""
        for detections in self.recording.read():
            step = step_of(detections.time)
            held = self.track.at(detections.time)
            for pose_index in np.unique(held):
                now = held == pose_index
                self._note_frames(step[now], pose_index)
                part = detections if now.all() else detections.take(now)
                yield self._hits_of(part, step[now], self.track.poses[pose_index])
            self._note_ranges(detections)
            self.rows += len(detections)
            self.gauge.add(len(detections))

    def _hits_of(self, detections: Detections, step: Integers, pose: Pose) -> Hits:
        keep = self.site.filters.keep_detections(detections)
        points, step = detections.points[keep], step[keep]
        footprint = pose.to_map(points)
        point, tile = self.site.engine.assign(footprint[:, 0], footprint[:, 1])
        fits = self.site.filters.keep_pairs(
            point,
            footprint[point, 2],
            np.linalg.norm(points, axis=1)[point],
            self.site.road_height[tile],
        )
        return unique_hits(step[point[fits]], self.site.tile_id[tile[fits]])

    def _note_frames(self, step: Integers, pose_index: int) -> None:
        if pose_index not in self.views:
            self.views[pose_index] = self.site.views.enter(self.track.poses[pose_index])
        self.runs.setdefault(self.views[pose_index], []).append(Runs.of(step))

    def _note_ranges(self, detections: Detections) -> None:
        metres = np.linalg.norm(detections.points[detections.present], axis=1)
        bins = np.minimum(metres, len(self.ranges) - 1).astype(np.int64)
        self.ranges += np.bincount(bins, minlength=len(self.ranges))

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

    def source(self) -> dict[str, Any]:
        """Return what the manifest says of this recording."""
        return {
            "recording": self.recording.path.name,
            "rows": self.rows,
            "sensor": self.track.sensor,
            "filters": asdict(self.site.filters),
            "poses": [pose.as_dict() for pose in self.track.poses],
        }
