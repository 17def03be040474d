"""Sight: which tiles a sensor sees from one pose, and what hides the others.

Sight depends on pose, tiles and scan alone. A ray runs from the sensor to each tile in its view,
over the cells of the scan, and is blocked where it runs through a body that stands, the ground or a
deck. Without a scan, all tiles in the view count as in sight: `view only`.
"""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
from numpy.typing import NDArray

from gis_radar.base import (
    QUIET,
    Booleans,
    Box,
    Floats,
    Grid,
    InputError,
    Integers,
    Reporter,
    Text,
    UsageError,
    atomic_write,
    checked,
    paths_of,
)
from gis_radar.poses import Pose, View, as_pose
from gis_radar.scans.columns import LEAST_GROUND, ScanColumns, read_columns
from gis_radar.scans.scan import Scan, box_with_margin, open_scan, warn_inexact
from gis_radar.scans.shift import warn_shifted
from gis_radar.scans.sight.obstacles import (
    OBSTACLE_CELL_M,
    WIDEST_ROOF_M,
    Obstacles,
    RoadHeights,
    find_obstacles,
    follow_rays,
    road_heights,
)
from gis_radar.scans.sight.tiles import SightTiles

OUT_OF_VIEW, IN_SIGHT, HIDDEN = 0, 1, 2
STATES = ("out of view", "in sight", "hidden")
_NOTHING, _STANDING, _GROUND, _DECK = 0, 1, 2, 3
HIDERS = ("", "something that stands", "the ground", "a deck")
VIEW_ONLY = "view only"

_SIGHT_METHOD = 1  # raised whenever the same scan, tiles and pose would give another sight
TARGET_M = 0.6  # height over the road of the point of a tile that must be seen (the contract)
# Windows of the scan begin at multiples of _WINDOW_M, so that poses of a track share them;
# WINDOWS_KEPT of them stay in memory, 10 MB each.
_WINDOW_M, WINDOWS_KEPT = 64.0, 8
# Length over places without scan from which on a ray that is not blocked is uncertain: the tile is
# in sight, but not covered.
_UNKNOWN_M = 10.0
# Warn where the scan decides less than this share of the tiles in the view: the rim of a view
# reaches beyond most scans, and a tenth of it hardly changes a map.
_LEAST_COVERED = 0.9
# Median difference of road heights, scan against tiles, above which their vertical systems differ.
_OFFSET_M = 2.0
_ARRAYS = ("state", "hider", "hidden_at_m", "uncovered")  # of a sight, in a file of the cache
_DAMAGED = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True, kw_only=True)
class Sight:
    """The sight of a sensor from one pose: the state of each tile.

    Parameters
    ----------
    pose : Pose
        Pose of the sensor.
    tile_id : (n,) int64 array
        Ids of all tiles.
    state : (n,) uint8 array
        `OUT_OF_VIEW`, `IN_SIGHT` or `HIDDEN` for each.
    hider : (n,) uint8 array
        Obstacle that hides a tile: `_NOTHING`, `_STANDING`, `_GROUND` or `_DECK`.
    hidden_at_m : (n,) array
        Horizontal distance from the sensor to the obstacle's begin, metres; NaN without one.
    uncovered : (n,) bool array
        Tiles in sight whose ray passes more than `_UNKNOWN_M` over places without scan.
    scan : str
        Digest of the scan; `view only` without one.
    """

    pose: Pose
    tile_id: Integers = field(repr=False)
    state: NDArray[np.uint8] = field(repr=False)
    hider: NDArray[np.uint8] = field(repr=False)
    hidden_at_m: Floats = field(repr=False)
    uncovered: Booleans = field(repr=False)
    scan: str = VIEW_ONLY

    @property
    def seen(self) -> Integers:
        """Ids of the tiles in sight, in the order of the tiles."""
        return np.asarray(self.tile_id[self.state == IN_SIGHT])

    @property
    def covered(self) -> float:
        """Share of the tiles in the view that the scan decides, 0 to 1; 0 without a scan."""
        in_view = np.count_nonzero(self.state != OUT_OF_VIEW)
        if self.scan == VIEW_ONLY or in_view == 0:
            return 0.0
        return 1.0 - float(np.count_nonzero(self.uncovered) / in_view)

    def figures(self) -> dict[str, Any]:
        """Return how many tiles are in sight and hidden, and the share that the scan decides."""
        counts = np.bincount(self.state, minlength=3)
        return {
            "in_sight": int(counts[IN_SIGHT]),
            "hidden": int(counts[HIDDEN]),
            "covered": round(self.covered, 3),
        }

    def __repr__(self) -> str:
        counts = np.bincount(self.state, minlength=3)
        return (
            f"Sight({self.pose.sensor}: {counts[IN_SIGHT]} tiles in sight, "
            f"{counts[HIDDEN]} hidden, {counts[OUT_OF_VIEW]} out of view)"
        )


class SightScan:
    """Airborne scans of a place, and the obstacles in them around sensors.

    Each window around a sensor is read once; the scans are streamed, and a bounded number of
    windows is kept.

    Parameters
    ----------
    scans : sequence of paths
        LAS, LAZ or COPC, whole and not masked; classified or not.
    tiles : SightTiles
        Tiles; their heights distinguish the levels of roads.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    cache : Path, optional
        A folder that keeps the sight of each pose, for several processes at a time.
    reporter : Reporter
        Receives progress.

    Raises
    ------
    InputError
        If a scan is missing or damaged; CrsError if it has no projected, metric CRS.
    """

    def __init__(
        self,
        scans: Sequence[str | Path],
        tiles: SightTiles,
        *,
        scan_crs: Any = None,
        cache: Path | None = None,
        reporter: Reporter = QUIET,
    ) -> None:
        self.tiles, self.cache = tiles, cache
        self.scans: list[Scan] = [open_scan(scan, crs=scan_crs) for scan in scans]
        warn_inexact(self.scans, tiles.crs, reporter)
        self._reporter = reporter
        self._is_shifted = False  # whether a warning of it was given
        self._windows: dict[Box, Obstacles] = {}

    @cached_property
    def digest(self) -> str:
        """Digest of the content of the scans, independent of their order."""
        contents = []
        for scan in self.scans:
            with scan.path.open("rb") as file:
                contents.append(hashlib.file_digest(file, "blake2b").hexdigest())
        return hashlib.blake2b("".join(sorted(contents)).encode(), digest_size=16).hexdigest()

    @checked
    def read(self, poses: Sequence[Pose]) -> None:
        """Read, in one pass, the windows around poses whose sight is not in the cache.

        At most `WINDOWS_KEPT` windows stay in memory.
        """
        self._read_around(
            [pose for pose in poses if self.cache is None or not self._cache_file(pose).exists()]
        )

    def _read_around(self, poses: Sequence[Pose]) -> None:
        grids = {grid.bounds: grid for grid in map(self._window, poses)}
        new = [grid for box, grid in grids.items() if box not in self._windows]
        for group in (new[k : k + WINDOWS_KEPT] for k in range(0, len(new), WINDOWS_KEPT)):
            self._read(group, poses)

    def around(self, pose: Pose) -> Obstacles:
        """Return the obstacles around a pose; all poses of a window share them.

        Raises
        ------
        InputError
            If no scan has a point there, or its heights are of another vertical system.
        """
        box = self._window(pose).bounds
        if box not in self._windows:
            self._read_around([pose])
        return self._windows[box]

    def find(self, pose: Pose) -> Sight:
        """Return what a sensor sees from a pose.

        Raises
        ------
        InputError
            As of :meth:`around`.
        """
        if self.cache is None:
            return _sight_among(pose, self.tiles, self.around(pose), self.digest)
        path, ids = self._cache_file(pose), self.tiles.tile_id
        if (arrays := _read_arrays(path, len(ids))) is not None:
            return Sight(pose=pose, tile_id=ids, scan=self.digest, **arrays)
        sight = _sight_among(pose, self.tiles, self.around(pose), self.digest)
        _write_arrays(path, {name: getattr(sight, name) for name in _ARRAYS})
        return sight

    def _cache_file(self, pose: Pose) -> Path:
        """Return the file of a pose: its name is a digest of all that sight depends on."""
        place = [pose.position.tolist(), pose.quaternion.tolist(), asdict(pose.view or View())]
        digest = hashlib.blake2b(self._inputs_digest, digest_size=16)
        digest.update(json.dumps(place).encode())
        return (self.cache or Path()) / f"{digest.hexdigest()}.npz"

    @cached_property
    def _inputs_digest(self) -> bytes:
        """Digest of scan, tiles and method."""
        found = hashlib.blake2b(f"{self.digest} {_SIGHT_METHOD}".encode())
        found.update(self.tiles.fingerprint.encode() + self.tiles.height.tobytes())
        return found.digest()

    def describe(self) -> dict[str, Any]:
        """Return digest and files of the scans, and the method, for a manifest."""
        return {
            "scan": self.digest,
            "files": sorted(each.path.name for each in self.scans),
            "method": _SIGHT_METHOD,
        }

    def _window(self, pose: Pose) -> Grid:
        """Return the grid of the cells that a pose's view may reach."""
        view, side = pose.view or View(), _WINDOW_M
        east, north = pose.position[:2]
        reach_m = view.max_range_m + WIDEST_ROOF_M
        low = (np.floor(np.array([east, north]) - reach_m) // side * side).tolist()
        count = int(np.ceil(2.0 * (reach_m + side) / side) * side / OBSTACLE_CELL_M)
        west, south = (round(edge / OBSTACLE_CELL_M) for edge in low)
        return Grid(cell_m=OBSTACLE_CELL_M, west=west, south=south, columns=count, rows=count)

    def _read(self, grids: Sequence[Grid], poses: Sequence[Pose]) -> None:
        """Read the scans into windows around poses, and keep the obstacles found in each."""
        windows = [ScanColumns(grid=grid) for grid in grids]
        boxes = np.array([grid.bounds for grid in grids])
        box = (*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist())
        crs = self.tiles.crs
        ground = read_columns(
            self.scans, windows, box_with_margin(box, 1.0), crs, reporter=self._reporter
        )
        middle = self.tiles.quads.mean(axis=1)
        for window in windows:
            self._is_shifted = self._is_shifted or warn_shifted(
                window, middle, self.scans[0].path, self._reporter
            )
            bounds = window.grid.bounds
            if window.points == 0:
                pose = next(p for p in poses if self._window(p).bounds == bounds)
                raise self._no_points_error(pose)
            roads = road_heights(self.tiles.quads, self.tiles.height, window.grid)
            self._refuse_other_heights(window, roads)
            self._windows[bounds] = find_obstacles(window, roads, classified=ground >= LEAST_GROUND)
            while len(self._windows) > max(WINDOWS_KEPT, len(windows)):
                self._windows.pop(next(iter(self._windows)))

    def _refuse_other_heights(self, window: ScanColumns, roads: RoadHeights) -> None:
        """Refuse a scan whose heights of the road are not those of the tiles."""
        both = roads.road & np.isfinite(window.low)
        if not both.any():
            return
        levels = np.stack([roads.lowest[both], roads.highest[both]])
        off_m = window.low[both] - levels
        nearest = np.where(np.abs(off_m[0]) < np.abs(off_m[1]), off_m[0], off_m[1])
        offset_m = float(np.median(nearest))
        if abs(offset_m) > _OFFSET_M:
            raise InputError(
                "{}: its road is {:+.1f} m from the height of the tiles: two vertical "
                "systems, or the road of another place",
                self.scans[0].path,
                offset_m,
                hint=Text(
                    "make the tiles with {} from this scan, or take the scan in their heights",
                    "--road",
                ),
            )

    def _no_points_error(self, pose: Pose) -> InputError:
        """Return the error for a pose without a scanned point in its window."""
        names = ", ".join(str(scan.path) for scan in self.scans[:3])
        more, reach_m = " ..." if len(self.scans) > 3 else "", (pose.view or View()).max_range_m
        return InputError(
            "{}{}: no point within {:.0f} m of {}",
            names,
            more,
            reach_m,
            pose.sensor,
            hint=Text(
                "it stands at {:.0f} {:.0f} in {}; take the scan of that place, whole and "
                "not masked",
                pose.easting,
                pose.northing,
                pose.crs.name,
            ),
        )


def _read_arrays(path: Path, count: int) -> dict[str, Any] | None:
    """Return the arrays of a sight of `count` tiles; None where they are missing or damaged."""
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            found = {name: arrays[name] for name in _ARRAYS}
    except _DAMAGED:
        return None
    return found if all(values.shape == (count,) for values in found.values()) else None


def _write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write the arrays of a sight."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)


def find_sight(
    pose: Pose | str | Path,
    tiles: gpd.GeoDataFrame | SightTiles,
    source: SightScan | str | Path | Sequence[str | Path] | None = None,
    *,
    scan_crs: Any = None,
) -> Sight:
    """Find which tiles a sensor sees from one pose.

    A tile is in sight where its centre, `TARGET_M` over the road, lies within range, azimuth and
    elevation, and, with a scan, nothing that stands in it hides that point.

    Parameters
    ----------
    pose : Pose, str or Path
        Pose of the sensor, or its file; without a view, the default one counts.
    tiles : GeoDataFrame or SightTiles
        The tiles, in the pose's CRS. Where the road's height is unknown, that of the scan's ground
        counts; without a scan, any elevation is in view.
    source : path or sequence of paths, or SightScan, optional
        Airborne scans, whole and not masked, or what reads them once for several poses; without
        it, sight is the view alone.
    scan_crs : CRS, str or int, optional
        Coordinate system of scans that do not state it.

    Returns
    -------
    Sight

    Raises
    ------
    UsageError
        If `scan_crs` is given without files of scans.
    InputError
        If no scan has a point near the sensor, or the file is of another pose.

    Examples
    --------
    >>> import gis_radar as gr
    >>> sample = gr.sample_folder()
    >>> tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    >>> sight = gr.find_sight(sample / "R1.json", tiles)
    >>> sight.figures()["in_sight"] > 1000
    True
    """
    road = tiles if isinstance(tiles, SightTiles) else SightTiles.of(tiles)
    pose = as_pose(pose)
    if isinstance(source, str | Path | Sequence):
        source = SightScan(paths_of(source), road, scan_crs=scan_crs)
    elif scan_crs is not None:
        raise UsageError("scan_crs is for files of scans: an open scan has its own")
    return _sight_among(pose, road, None, VIEW_ONLY) if source is None else source.find(pose)


def _sight_among(pose: Pose, tiles: SightTiles, obstacles: Obstacles | None, scan: str) -> Sight:
    """Return what a sensor sees among obstacles; without them, all tiles in the view."""
    place = tiles.centres.copy()
    unknown = np.isnan(place[:, 2])
    if obstacles is not None and unknown.any():
        cells = obstacles.grid.nearest(*place[unknown, :2].T)
        place[unknown, 2] = obstacles.ground[cells]
        unknown = np.isnan(place[:, 2])
    place[:, 2] += TARGET_M
    points = pose.to_sensor(np.where(np.isnan(place), pose.height, place))
    points[unknown, 2] = np.nan
    in_view = (pose.view or View()).sees(points)
    state = np.where(in_view, IN_SIGHT, OUT_OF_VIEW).astype(np.uint8)
    sight = Sight(
        pose=pose,
        tile_id=tiles.tile_id,
        state=state,
        hider=np.zeros(len(state), np.uint8),
        hidden_at_m=np.full(len(state), np.nan),
        uncovered=np.zeros(len(state), np.bool_),
        scan=scan,
    )
    if obstacles is not None:
        _mark_hidden(sight, np.flatnonzero(in_view), place, obstacles)
    return sight


def report_uncovered(sights: Iterable[Sight], reporter: Reporter) -> None:
    """Report the share of each sensor's view that a scan covers, as a warning if it is small."""
    worst: dict[str, float] = {}
    for sight in sights:
        if sight.scan != VIEW_ONLY and sight.uncovered.any():
            worst[sight.pose.sensor] = min(sight.covered, worst.get(sight.pose.sensor, 1.0))
    for sensor, covered in worst.items():
        reporter.log(
            Text(
                "the scan covers {}% of the view of {}: what it does not cover counts as in sight",
                math.floor(100.0 * covered),
                sensor,
            ),
            "info" if covered >= _LEAST_COVERED else "warning",
        )


def _mark_hidden(sight: Sight, rows: Integers, place: Floats, obstacles: Obstacles) -> None:
    """Set, in a new sight, which of the tiles `rows` an obstacle hides, and which one."""
    targets = np.where(np.isnan(place[rows]), sight.pose.height, place[rows])
    west, south = obstacles.grid.corner
    begin_m, hider, unknown_m = follow_rays(
        sight.pose.position - (west, south, 0.0),
        targets - (west, south, 0.0),
        obstacles.grid.cell_m,
        obstacles.floor,
        obstacles.solid,
        obstacles.slab_low,
        obstacles.slab_high,
        obstacles.known,
    )
    hidden = hider != _NOTHING
    sight.state[rows[hidden]] = HIDDEN
    sight.hider[rows] = hider
    sight.hidden_at_m[rows] = begin_m
    sight.uncovered[rows] = ~hidden & (unknown_m > _UNKNOWN_M)
