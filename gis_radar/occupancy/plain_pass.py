"""The pass over a recording in NumPy, a sentence of the paper a line; any engine finds the tiles.

What :mod:`gis_radar.occupancy.counting_loop` compiles, bit for bit, at a quarter of its speed:
tests and benchmarks compare with it, and `--engine rtree` runs the paper's R-tree in it ("Local
Sensor Data Processing").
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gis_radar.arrays import Integers
from gis_radar.clocks import SensorClock
from gis_radar.occupancy.frame_log import FrameIndex, frame_rows, rows_of, whole_frames
from gis_radar.occupancy.hit_counter import Counted
from gis_radar.occupancy.hits import Rows, distinct
from gis_radar.occupancy.recording_pass import RecordingPass, Target
from gis_radar.poses.pose import Pose
from gis_radar.recordings.recording import Detections
from gis_radar.steps import step_of


def count_plainly(found: RecordingPass, target: Target) -> Iterator[Counted]:
    """Count a recording; arguments and results as of :func:`count_recording`."""
    source = found.source
    clock = source.clock or SensorClock(offset_s=0.0)
    for read in whole_frames(source.recording.read()):
        piece = replace(read, time=clock.corrected(read.time))
        shift_us = np.rint((piece.time - read.time) * 1e6).astype(np.int64)
        pose_of_row = source.track.at(piece.time)
        for index in np.unique(pose_of_row).tolist():
            now = pose_of_row == index
            part = piece if now.all() else rows_of(piece, now)
            yield _counted(part, shift_us[now], index, found, target)
        found.ranges.add(piece)
        found.level |= bool(np.isnan(piece.points[piece.present, 2]).any())
        found.rows += len(piece)


def _counted(
    part: Detections, shift_us: Integers, index: int, found: RecordingPass, target: Target
) -> Counted:
    """Count whole frames seen from one pose of the track."""
    pose, view = found.source.track.poses[index], found.source.views[index]
    road_m = target.views.road_m[found.source.track.sensor, view]
    frames = FrameIndex.of(part.time)
    frame, tile = _tiles_hit(part, frames, pose, target, road_m)
    hit = np.bincount(frame, minlength=len(frames.time))
    found.movement_at(index, target).add(part, pose, road_m=road_m)
    time_us, _, detections, moving, wild, hit, _, checksum, shift = frame_rows(
        part, frames, hit, hit, shift_us, target.settings
    )
    rows = (time_us, shift, detections, moving, wild, hit, checksum, np.full(len(hit), index))
    step = step_of(frames.time)[frame]
    return Counted(frames=np.column_stack(rows), step=step, tile=target.tile_id[tile])


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
