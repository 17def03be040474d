"""Find static structures around a sensor, in its recording and in an airborne scan.

In a recording these are cells with detections at all times: of facades, crowns of trees, poles. In
a scan they are plants, and steps of height at walls and rims of crowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from gis_radar.base import CELL_M, QUIET, Booleans, Floats, Grid, Integers, Reporter
from gis_radar.calibration.registration.traces import MIN_SPEED_MPS, WINDOW_FRAMES
from gis_radar.poses import Pose
from gis_radar.recordings import RangeCounts, Recording, RollingWindow, as_recording
from gis_radar.scans import (
    LEAST_GROUND,
    WIDEST_ROOF_M,
    ScanColumns,
    box_with_margin,
    ground_under,
    nearest_known,
    open_scan,
    read_columns,
)

# Sensitivity (a sensor of a simulated town, at its true pose and 3.5 m beside it): with TALL_M,
# _OVERHEAD_M or _LEAST_SPANS halved or doubled, as CLOSE_M of the scan check, the verdicts stay
# `confirms` and `doubts`; the score moves by up to 0.09 at the true pose, and beside it by up to
# 0.10, with CLOSE_M doubled by 0.24.
_SLOW_MPS = 1.0  # largest absolute range rate of static targets: leaves in wind reach it
# A cell is static with detections in _LEAST_SPANS of _SPANS equal spans of the window: people and
# vehicles that wait or pass are detected in fewer.
_LEAST_SPANS = 8
_OVERHEAD_M = 2.0  # least height over the ground of detections: above parked cars, people, shrubs
TALL_M = 2.5  # least step of height in the scan at a wall or crown: above vans and hedges
_SPANS = 20
_PATCH_M = 8.0  # side of the patches that are independent: a tree, or a section of wall
_JUMP_CELLS = 3  # width over which a step of height is measured, in cells of 0.5 m
_GAP_CELLS = 3  # gaps of the scan up to this distance are filled, in cells
_GROUND_CELLS = 4  # side of a cell of the ground, in cells


@dataclass(frozen=True, kw_only=True)
class LevelFrame:
    """Level frame at a sensor: x along its yaw, y to the left, z the map's heights.

    Results in this frame do not depend on the site's position and orientation in the map.

    Parameters
    ----------
    pose : Pose
        The sensor's pose.
    """

    pose: Pose

    @property
    def _turn(self) -> Floats:
        yaw = np.radians(self.pose.yaw)
        return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])

    def from_map(self, points: Floats) -> Floats:
        """Move (n, 3) points from the map into the frame."""
        return np.column_stack(
            [(points[:, :2] - self.pose.position[:2]) @ self._turn, points[:, 2]]
        )

    def to_map(self, points: Floats) -> Floats:
        """Move (n, 2) or (n, 3) points from the frame into the map."""
        flat = points[:, :2] @ self._turn.T + self.pose.position[:2]
        return np.column_stack([flat, points[:, 2:]])

    def from_sensor(self, points: Floats) -> Floats:
        """Move (n, 3) points from the sensor frame into the frame."""
        return self.from_map(self.pose.to_map(points))

    @staticmethod
    def cells(points: Floats, size: int) -> tuple[Integers, Integers]:
        """Return row and column, ahead and left, of points in a grid of `size` cells a side.

        The sensor is in the grid's middle; points beyond its edge go to the outermost cells.
        """
        half = size // 2
        grid = Grid(cell_m=CELL_M, west=-half, south=-half, columns=size, rows=size)
        return grid.nearest(points[:, 0], points[:, 1])


@dataclass(frozen=True, kw_only=True)
class Slow:
    """Detections of low range rate, from the last frames of a recording.

    Parameters
    ----------
    points : (n, 3) array
        Sensor frame, metres.
    rustles : (n,) bool array
        Whether their range rate is that of leaves in wind, not 0.
    span : (n,) array
        Number of the span of the window, 0 to `_SPANS` - 1.
    frames : int
        Length of the window, frames.
    range_m : float
        Slant range of 99.9 % of all detections of the recording, metres.
    """

    points: Floats = field(repr=False)
    rustles: Booleans = field(repr=False)
    span: Integers = field(repr=False)
    frames: int
    range_m: float = 0.0

    @property
    def reach_m(self) -> float:
        """99th percentile of the ranges, metres."""
        if len(self.points) == 0:
            return 0.0
        return float(np.percentile(np.linalg.norm(self.points, axis=1), 99.0))


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Static cells: cells of 0.5 m in a pose's level frame that have detections at all times.

    Parameters
    ----------
    points : (n, 3) array
        Mean position of the detections of each cell: ahead, left, height; metres.
    rustles : (n,) array
        Share of these detections that move like leaves in wind.
    """

    points: Floats
    rustles: Floats

    def __len__(self) -> int:
        return len(self.points)

    @property
    def patch(self) -> Integers:
        """Number of each cell's patch, a square of `_PATCH_M`."""
        squares = np.floor(self.points[:, :2] / _PATCH_M).astype(np.int64)
        return np.asarray(np.unique(squares, axis=0, return_inverse=True)[1])

    @property
    def patches(self) -> int:
        """Number of patches."""
        return len(np.unique(self.patch))


def read_slow(recording: str | Path | Recording, *, reporter: Reporter = QUIET) -> Slow:
    """Read the slow detections of a recording's last frames, in bounded memory.

    Raises
    ------
    InputError
        If the recording cannot be read.
    """
    source = as_recording(recording)
    window = RollingWindow(
        frames=WINDOW_FRAMES,
        keep=lambda batch: (
            (np.abs(batch.range_rate) <= _SLOW_MPS) & np.isfinite(batch.points[:, 2])
        ),
    )
    ranges, done = RangeCounts(), 0
    for batch in source.read():
        ranges.add(batch)
        window.push(batch)
        done += len(batch)
        reporter.progress("reading what stands", done, source.rows)
    slow = window.content()
    frame = np.searchsorted(slow.frame_times, slow.time)
    single_precision: Any = slow.points.astype(np.float32)  # there are many
    return Slow(
        points=single_precision,
        rustles=np.abs(slow.range_rate.astype(np.float32)) > MIN_SPEED_MPS,
        span=frame * _SPANS // len(window),
        frames=len(window),
        range_m=ranges.reached_m(),
    )


def standing(
    slow: Slow,
    level: LevelFrame,
    ground: Floats,
    *,
    reach_m: float,
) -> Standing:
    """Return the static cells, with detections in `_LEAST_SPANS` of the window's spans.

    Parameters
    ----------
    slow : Slow
        Slow detections, from :func:`read_slow`.
    level : LevelFrame
        The level frame of the pose.
    ground : (cells, cells) array
        Height of the ground under the cells of that frame, NaN where unknown.
    reach_m : float
        Detections farther away are left out, metres.
    """
    points = level.from_sensor(slow.points)
    near = np.hypot(points[:, 0], points[:, 1]) < reach_m
    rows, columns = level.cells(points[near], len(ground))
    over = points[near, 2] - ground[rows, columns]
    # those far below are kept, too: there a roof was taken for the ground
    tall = ~(np.abs(over) < _OVERHEAD_M)
    points, span, rustles = points[near][tall], slow.span[near][tall], slow.rustles[near][tall]
    cells, place = np.unique(rows[tall] * len(ground) + columns[tall], return_inverse=True)
    hit = np.zeros((len(cells), _SPANS), bool)
    hit[place, span] = True
    static = hit.sum(axis=1) >= _LEAST_SPANS
    counts = np.bincount(place, minlength=len(cells))[static]
    means = [
        np.bincount(place, values, minlength=len(cells))[static] / counts
        for values in (*points.T, rustles)
    ]
    return Standing(points=np.column_stack(means[:3]), rustles=means[3])


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Structures of a scan: grids of cells in a pose's level frame, rows ahead and columns left.

    Parameters
    ----------
    top : (n, n) array
        Height of the highest point, metres; NaN where the scan has none.
    ground : (n, n) array
        Height of the ground, also under roofs and crowns, metres; NaN far from any point.
    canopy, roof : (n, n) bool array
        Plants higher than `TALL_M`, and buildings, by the classes of points.
    edge : (n, n) bool array
        Steps of height by more than `TALL_M`: walls, rims of crowns.
    classified : bool
        Whether the classes distinguish plants or buildings.
    """

    top: Floats = field(repr=False)
    ground: Floats = field(repr=False)
    canopy: Booleans = field(repr=False)
    roof: Booleans = field(repr=False)
    edge: Booleans = field(repr=False)
    classified: bool

    @property
    def visible(self) -> Booleans:
        """Cells in which a radar may detect a structure: edges and canopy."""
        return self.edge | self.canopy


def read_structure(
    scans: Sequence[str | Path],
    level: LevelFrame,
    *,
    reach_m: float,
    scan_crs: Any = None,
    reporter: Reporter = QUIET,
) -> Structure | None:
    """Read the structures around a sensor from airborne scans, in batches.

    Parameters
    ----------
    scans : sequence of paths
        LAS, LAZ or COPC.
    level : LevelFrame
        The level frame of the sensor's pose.
    reach_m : float
        Radius around the sensor, metres.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    reporter : Reporter
        Receives progress.

    Returns
    -------
    Structure, or None where no scan has a point there.

    Raises
    ------
    InputError
        If a scan is damaged; CrsError if it has no projected, metric coordinate system.
    """
    opened = [open_scan(scan, crs=scan_crs) for scan in scans]
    half = int(np.ceil(reach_m / CELL_M))
    grid = Grid(cell_m=CELL_M, west=-half, south=-half, columns=2 * half, rows=2 * half)
    columns = ScanColumns(grid=grid, from_map=level.from_map)
    east, north, _ = level.pose.position
    box = box_with_margin((east, north, east, north), reach_m * np.sqrt(2.0))
    ground_share = read_columns(opened, [columns], box, level.pose.crs, reporter=reporter)
    if columns.points == 0:
        return None
    return _structure(columns, classified=ground_share >= LEAST_GROUND)


def _structure(columns: ScanColumns, *, classified: bool) -> Structure:
    """Return the structures in the columns of a scan, with small gaps filled."""
    distance, index = nearest_known(np.isfinite(columns.top))
    top, plants, building = (
        np.where(distance <= _GAP_CELLS, grid[index], np.nan)
        for grid in (columns.top, columns.plants, columns.building)
    )
    ground = ground_under(
        np.minimum(columns.ground, columns.deck) if classified else columns.low,
        cell_m=CELL_M,
        coarse_cells=_GROUND_CELLS,
        widest_roof_m=WIDEST_ROOF_M,
        classified=classified,
    )
    below = scipy.ndimage.maximum_filter(np.where(np.isnan(top), -np.inf, top), _JUMP_CELLS)
    low = scipy.ndimage.minimum_filter(np.where(np.isnan(top), np.inf, top), _JUMP_CELLS)
    high = _without_isolated(np.nan_to_num(top - low, nan=0.0) > TALL_M)
    # the wall is between the last high cell and the first low one: take both
    edge = high | (
        scipy.ndimage.binary_dilation(high) & (np.nan_to_num(below - top, nan=0.0) > TALL_M)
    )
    canopy = _without_isolated(np.nan_to_num(plants - ground, nan=-1.0) > TALL_M)
    roof = _without_isolated(np.isfinite(building))
    # canopy over the middle of a roof is the roof; over its edge the radar may detect a tree
    return Structure(
        top=top, ground=ground, canopy=canopy & ~(roof & ~edge), roof=roof, edge=edge,
        classified=classified and bool((canopy | roof).any()),
    )  # fmt: skip


def _without_isolated(cells: Booleans) -> Booleans:
    """Return the set cells with at least two set neighbours among the eight."""
    around = scipy.ndimage.convolve(
        cells.astype(np.uint8), np.ones((3, 3), np.uint8), mode="constant"
    )
    return np.asarray(cells & (around >= 3))
