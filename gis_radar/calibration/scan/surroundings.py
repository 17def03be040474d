"""Find what stands around a sensor: in its recording, and in an airborne scan of the place.

In a recording these are facades, crowns and poles, hit repeatedly at one place; in a scan the
crowns of trees, and where walls rise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from gis_radar.base import CELL_M, QUIET, Booleans, Floats, Grid, Integers, Reporter
from gis_radar.calibration.registration.traces import FRAMES, MIN_SPEED_MPS
from gis_radar.poses import Pose
from gis_radar.recordings import RangeCounts, Recording, RollingWindow, as_recording
from gis_radar.scans import (
    ScanColumns,
    box_with_margin,
    ground_under,
    nearest_known,
    open_scan,
    read_columns,
)

# Sensitivity (a sensor of a simulated town, at its true pose and 3.5 m beside it): with TALL_M,
# OVERHEAD_M or LEAST_SPANS halved or doubled, as CLOSE_M of the scan check, the verdicts stay
# `confirms` and `doubts`; the score moves by up to 0.09 at the true pose, and beside it by up to
# 0.10, with CLOSE_M doubled by 0.24.
SLOW_MPS = 1.0  # largest absolute range rate of what stands: leaves rustle up to here
# Least number of the SPANS equal parts of the window in which a standing cell is hit: people and
# vehicles that wait or pass are hit in fewer.
LEAST_SPANS = 8
OVERHEAD_M = 2.0  # least height over the ground of detections: above parked cars, people, shrubs
TALL_M = 2.5  # least height of a step in the scan at a wall or crown: above vans and hedges
SPANS = 20  # equal parts of the window, in which hits of a cell are looked for
PATCH_M = 8.0  # side of the patches that count as one: a tree, or a piece of wall
JUMP_CELLS = 3  # window in which a step is looked for, cells of 0.5 m
GAP_CELLS = 3  # holes of the scan up to so many cells are filled
GROUND_CELLS = 4  # side of a cell of the ground, cells of 0.5 m
WIDEST_ROOF_M = 40.0  # in scans without classes: opening that removes roofs from the ground
LEAST_GROUND = 0.01  # a scan with a smaller share of points in classes of ground is not classified


@dataclass(frozen=True, kw_only=True)
class LevelFrame:
    """A level frame at a sensor, turned by its yaw, with the map's heights.

    In this frame results do not depend on the site's place on earth and orientation.

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

    def from_map(self, xyz: Floats) -> Floats:
        """Move (n, 3) points from the map into the frame."""
        return np.column_stack([(xyz[:, :2] - self.pose.position[:2]) @ self._turn, xyz[:, 2]])

    def to_map(self, xyz: Floats) -> Floats:
        """Move (n, 2) or (n, 3) points from the frame into the map."""
        flat = xyz[:, :2] @ self._turn.T + self.pose.position[:2]
        return np.column_stack([flat, xyz[:, 2:]])

    def from_sensor(self, xyz: Floats) -> Floats:
        """Move (n, 3) points from the sensor frame into the frame."""
        return self.from_map(self.pose.to_map(xyz))

    @staticmethod
    def cells(points: Floats, size: int) -> tuple[Integers, Integers]:
        """Return row and column, ahead and left, of points in a grid of `size` cells a side.

        The sensor is in the grid's middle; points beyond its edge count to the outermost.
        """
        half = size // 2
        grid = Grid(cell_m=CELL_M, west=-half, south=-half, columns=size, rows=size)
        return grid.nearest(points[:, 0], points[:, 1])


@dataclass(frozen=True, kw_only=True)
class Slow:
    """Detections that hardly move, from the last frames of a recording.

    Parameters
    ----------
    points : (n, 3) array
        Sensor frame, metres.
    rustles : (n,) bool array
        Whether they move like leaves rather than not at all.
    span : (n,) array
        Number of the equal part of the window, from 0.
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
        """99th percentile of the distances, metres."""
        if len(self.points) == 0:
            return 0.0
        return float(np.percentile(np.linalg.norm(self.points, axis=1), 99.0))


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Standing cells: cells of the plane over which something stands, in a pose's level frame.

    Parameters
    ----------
    points : (n, 3) array
        Mean place of the detections over each cell: ahead, left, height; metres.
    rustles : (n,) array
        Share of these detections that move like leaves.
    """

    points: Floats
    rustles: Floats

    def __len__(self) -> int:
        return len(self.points)

    @property
    def patch(self) -> Integers:
        """Number of the patch, a square of `PATCH_M`, in which each cell is."""
        squares = np.floor(self.points[:, :2] / PATCH_M).astype(np.int64)
        return np.asarray(np.unique(squares, axis=0, return_inverse=True)[1])

    @property
    def patches(self) -> int:
        """Number of patches."""
        return len(np.unique(self.patch))


def read_slow(recording: str | Path | Recording, *, reporter: Reporter = QUIET) -> Slow:
    """Read the detections that hardly move in a recording's last frames, in bounded memory.

    Raises
    ------
    InputError
        If the recording cannot be read.
    """
    source = as_recording(recording)
    window = RollingWindow(
        frames=FRAMES,
        keep=lambda batch: (np.abs(batch.range_rate) <= SLOW_MPS) & np.isfinite(batch.points[:, 2]),
    )
    ranges, done = RangeCounts(), 0
    for batch in source.read():
        ranges.add(batch)
        window.push(batch)
        done += len(batch)
        reporter.progress("reading what stands", done, source.rows)
    slow = window.content()
    frame = np.searchsorted(slow.frame_times, slow.time)
    as_recorded: Any = slow.points.astype(np.float32)  # there are many
    return Slow(
        points=as_recorded,
        rustles=np.abs(slow.range_rate.astype(np.float32)) > MIN_SPEED_MPS,
        span=frame * SPANS // len(window),
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
    """Find the cells over which something stands through most of the window.

    Parameters
    ----------
    slow : Slow
        From :func:`read_slow`.
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
    # far below the ground: in a house whose roof was taken for the ground
    tall = ~(np.abs(over) < OVERHEAD_M)
    points, span, rustles = points[near][tall], slow.span[near][tall], slow.rustles[near][tall]
    cells, place = np.unique(rows[tall] * len(ground) + columns[tall], return_inverse=True)
    hit = np.zeros((len(cells), SPANS), bool)
    hit[place, span] = True
    kept = hit.sum(axis=1) >= LEAST_SPANS
    counts = np.bincount(place, minlength=len(cells))[kept]
    means = [
        np.bincount(place, values, minlength=len(cells))[kept] / counts
        for values in (*points.T, rustles)
    ]
    return Standing(points=np.column_stack(means[:3]), rustles=means[3])


@dataclass(frozen=True, kw_only=True)
class Structure:
    """Grids of cells in the level frame of a pose, rows ahead and columns left.

    Parameters
    ----------
    top : (n, n) array
        Height of the highest point, metres; NaN where the scan has none.
    ground : (n, n) array
        Height of the ground, also under roofs and crowns; NaN far from any point.
    canopy, roof : (n, n) bool array
        Plants of more than `TALL_M` and buildings, by their classes; False without classes.
    edge : (n, n) bool array
        Where something rises by more than `TALL_M`: walls, rims of crowns.
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
        """Cells in which a radar may see something that stands."""
        return self.edge | self.canopy


def read_structure(
    scans: Sequence[str | Path],
    level: LevelFrame,
    *,
    reach_m: float,
    scan_crs: Any = None,
    reporter: Reporter = QUIET,
) -> Structure | None:
    """Read what stands around a sensor from airborne scans, in batches.

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
    window = ScanColumns(grid=grid, from_map=level.from_map)
    east, north, _ = level.pose.position
    box = box_with_margin((east, north, east, north), reach_m * np.sqrt(2.0))
    grounds = read_columns(opened, [window], box, level.pose.crs, reporter=reporter)
    if window.points == 0:
        return None
    return _structure(window, classified=grounds >= LEAST_GROUND)


def _structure(tops: ScanColumns, *, classified: bool) -> Structure:
    away, index = nearest_known(np.isfinite(tops.top))
    top, plants, building = (
        np.where(away <= GAP_CELLS, grid[index], np.nan)
        for grid in (tops.top, tops.plants, tops.building)
    )
    ground = ground_under(
        np.minimum(tops.ground, tops.deck) if classified else tops.low,
        cell_m=CELL_M,
        coarse_cells=GROUND_CELLS,
        widest_roof_m=WIDEST_ROOF_M,
        classified=classified,
    )
    below = scipy.ndimage.maximum_filter(np.where(np.isnan(top), -np.inf, top), JUMP_CELLS)
    low = scipy.ndimage.minimum_filter(np.where(np.isnan(top), np.inf, top), JUMP_CELLS)
    high = _solid(np.nan_to_num(top - low, nan=0.0) > TALL_M)
    # the wall itself runs between the last high cell and the first low one
    edge = high | (
        scipy.ndimage.binary_dilation(high) & (np.nan_to_num(below - top, nan=0.0) > TALL_M)
    )
    canopy = _solid(np.nan_to_num(plants - ground, nan=-1.0) > TALL_M)
    roof = _solid(np.isfinite(building))
    # a tree over a roof's edge is seen, one over the middle of a roof is taken for a roof
    return Structure(
        top=top, ground=ground, canopy=canopy & ~(roof & ~edge), roof=roof, edge=edge,
        classified=classified and bool((canopy | roof).any()),
    )  # fmt: skip


def _solid(cells: Booleans) -> Booleans:
    """Return the cells that are not isolated: three or more of the nine around are set."""
    around = scipy.ndimage.convolve(
        cells.astype(np.uint8), np.ones((3, 3), np.uint8), mode="constant"
    )
    return np.asarray(cells & (around >= 3))
