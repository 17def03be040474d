"""Find what stands in a recording: facades, crowns and poles, hit repeatedly at one place."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.arrays import Booleans, Floats, Integers
from gis_radar.grid import CELL_M, Grid
from gis_radar.poses.pose import Pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.recording import RangeCounts, Recording, RollingWindow, as_recording
from gis_radar.second_look.settings import DEFAULTS, SecondLookSettings

STAGE = "reading what stands"


@dataclass(frozen=True, kw_only=True)
class LevelFrame:
    """A level frame at a sensor, turned by its yaw, with the map's heights.

    In it, nothing depends on where on earth a site is and how it is turned.

    Parameters
    ----------
    pose : Pose
        The sensor.
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
        In which of the equal parts of the window they are.
    frames : int
        Length of the window.
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
        """Distance of the 99th percentile, metres."""
        if len(self.points) == 0:
            return 0.0
        return float(np.percentile(np.linalg.norm(self.points, axis=1), 99.0))


@dataclass(frozen=True, kw_only=True)
class Standing:
    """Cells of the plane over which something stands, in the level frame of a pose.

    Parameters
    ----------
    points : (n, 3) array
        Mean place of the detections over each cell: ahead, left, height; metres.
    rustles : (n,) array
        Share of them that move like leaves.
    patch_m : float
        Side of the squares that vote as one, metres.
    """

    points: Floats
    rustles: Floats
    patch_m: float = DEFAULTS.patch_m

    def __len__(self) -> int:
        return len(self.points)

    @property
    def patch(self) -> Integers:
        """Number of the square in which each cell is."""
        squares = np.floor(self.points[:, :2] / self.patch_m).astype(np.int64)
        return np.asarray(np.unique(squares, axis=0, return_inverse=True)[1])

    @property
    def patches(self) -> int:
        """How many such squares there are."""
        return len(np.unique(self.patch))


def read_slow(
    recording: str | Path | Recording,
    *,
    settings: SecondLookSettings = DEFAULTS,
    reporter: Reporter = QUIET,
) -> Slow:
    """Read what hardly moves in the last frames of a recording, in bounded memory.

    Raises
    ------
    InputError
        If the recording cannot be read.
    """
    source = as_recording(recording)
    slow_mps = settings.slow_mps
    window = RollingWindow(
        frames=settings.frames, keep=lambda piece: np.abs(piece.range_rate) <= slow_mps
    )
    ranges, done = RangeCounts(), 0
    for piece in source.read():
        ranges.add(piece)
        window.push(piece)
        done += len(piece)
        reporter.progress(STAGE, done, source.rows)
    slow = window.content()
    points: Any = slow.points.astype(np.float32)  # as recorded; there are many
    frame = np.searchsorted(slow.frame_times, slow.time)
    return Slow(
        points=points,
        rustles=np.abs(slow.range_rate.astype(np.float32)) > settings.still_mps,
        span=frame * settings.spans // len(window),
        frames=len(window),
        range_m=ranges.reached_m(),
    )


def standing(
    slow: Slow,
    level: LevelFrame,
    ground: Floats,
    *,
    reach_m: float,
    settings: SecondLookSettings = DEFAULTS,
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
        Farther away nothing counts.
    settings : SecondLookSettings
        How high over the ground, and how often.
    """
    points = level.from_sensor(slow.points)
    near = np.hypot(points[:, 0], points[:, 1]) < reach_m
    rows, columns = level.cells(points[near], len(ground))
    over = points[near, 2] - ground[rows, columns]
    # far under the ground: in a house whose roof was taken for the ground
    tall = ~(np.abs(over) < settings.overhead_m)
    points, span, rustles = points[near][tall], slow.span[near][tall], slow.rustles[near][tall]
    cell = rows[tall] * len(ground) + columns[tall]
    cells, place = np.unique(cell, return_inverse=True)
    hit = np.zeros((len(cells), settings.spans), bool)
    hit[place, span] = True
    kept = hit.sum(axis=1) >= settings.least_spans
    counts = np.bincount(place, minlength=len(cells))[kept]
    means = [
        np.bincount(place, values, minlength=len(cells))[kept] / counts
        for values in (*points.T, rustles)
    ]
    points = np.column_stack(means[:3])
    return Standing(points=points, rustles=means[3], patch_m=settings.patch_m)
