"""Whether the roads of a map lie elsewhere in a scan: roads are open to the sky, houses are not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import shapely

from gis_radar.base import Floats, Grid, Reporter
from gis_radar.hdmap import LaneletMap
from gis_radar.scans.columns import ScanColumns, read_columns
from gis_radar.scans.roads import Roads, roads_of_map
from gis_radar.scans.scan import Scan, box_with_margin

_HIGH_M, _AROUND_M = 2.5, 2.5  # over the lowest point around: higher than most cars
_STEP_M, _REACH_M = 1.0, 16.0  # of the places that are tried
# Places within `_SAME_M` are one. Where the roads are, this share of what stands over them at any
# other place stands over them at most: 0.07 to 0.36 on four simulated sites. Where there are two
# with less than `_LEAST_ELSEWHERE`, as beside an avenue in fields, the place is not known.
_SAME_M, _OPEN_SHARE, _LEAST_HIGH, _LEAST_ELSEWHERE = 4.0, 0.5, 0.05, 0.01
_LEAST_POINTS, _MOST_POINTS = 400, 5000  # of the roads that are compared
# Roads are as open to the sky as what lies beside them where the share that something stands over
# is so large, and so many times that of the usual place around: 0.02 to 0.07 times on four
# simulated sites, 0.8 to 1.3 times with most scans that were turned by 3 deg and more, or moved by
# 50 m.
_NO_ROAD_SHARE, _NO_ROAD_TIMES = 0.1, (0.7, 1.5)
_EDGE_M = 1.25  # of roads, over which crowns and roofs reach
_NEAR_M = 200.0  # of a sensor
BESIDE_M = _REACH_M + _AROUND_M  # of roads: what is compared with them
_SCAN_CELL_M, MOST_COMPARED = 1.0, 4_000_000  # around the roads of a map; a whole city has more


def warn_shifted(columns: ScanColumns, xy: Floats, path: str | Path, reporter: Reporter) -> bool:
    """Warn where the roads are open to the sky at one place alone, and the map has them elsewhere.

    It also warns where there is no such place, and roads are no opener than what is beside them.

    Parameters
    ----------
    columns : ScanColumns
        Highest and lowest points of the scan around the roads.
    xy : (n, 2) array
        Points on the middle of roads or lanes, in the grid of the columns, metres.
    path : str or Path
        The scan.
    reporter : Reporter
        Receives the warning.

    Returns
    -------
    bool
        Whether it was warned.
    """
    grid, xy = columns.grid, xy[:: 1 + len(xy) // _MOST_POINTS]
    size = 2 * round(_AROUND_M / grid.cell_m) + 1
    ground = scipy.ndimage.minimum_filter(columns.low, size, mode="nearest")
    side = np.arange(-_REACH_M, _REACH_M + _STEP_M, _STEP_M)
    moves = np.array(list(product(side, side)))
    column, row = grid.cells(*(xy.T[:, None] + side[:, None]))
    column, row = np.clip(column, -1, grid.columns), np.clip(row, -1, grid.rows)
    known, over = (
        np.concatenate([np.pad(cells, (0, 1))[across, row].sum(axis=1) for across in column])
        for cells in (np.isfinite(columns.low), columns.top > ground + _HIGH_M)
    )
    if known.min() < _LEAST_POINTS:
        return False
    share = over / known
    here, best = share[len(share) // 2], moves[share.argmin()]
    elsewhere = share[np.hypot(*(moves - best).T) >= _SAME_M].min()
    is_alone = elsewhere >= max(share.min() / _OPEN_SHARE, _LEAST_ELSEWHERE)
    if here < _LEAST_HIGH or np.hypot(*best) < _SAME_M or not is_alone:
        return _warn_no_roads(here, float(np.median(share)), path, reporter)
    reporter.warn(
        "{}: the roads of the map fit the scan {:.0f} m to the east and {:.0f} m to the north of "
        "where they are: trees or houses stand over {:.0%} of them there, over {:.0%} here; is the "
        "map or the scan off its place?",
        path, *best.tolist(), share.min(), here,
    )  # fmt: skip
    return True


def _warn_no_roads(here: float, usual: float, path: str | Path, reporter: Reporter) -> bool:
    """Warn where as much stands over the roads as over what lies beside them; return whether."""
    low, high = _NO_ROAD_TIMES
    if here < _NO_ROAD_SHARE or not low * usual <= here <= high * usual:
        return False
    reporter.warn(
        "{}: trees or houses stand over {:.0%} of the map's roads, over {:.0%} of the places "
        "beside them: is the scan or the map of another place, or turned, or do crowns close over "
        "the roads?",
        path, here, usual,
    )  # fmt: skip
    return True


def read_shifted(
    scans: Sequence[Scan], roads: Roads | LaneletMap, reporter: Reporter,
    *, near: Floats | None = None,
) -> bool:  # fmt: skip
    """Read scans around the roads of a map, and warn as :func:`warn_roads_shifted`.

    Parameters
    ----------
    scans : sequence of Scan
        Airborne scans, whole.
    roads : Roads or LaneletMap
        The roads.
    reporter : Reporter
        Receives the warning.
    near : (2,) array, optional
        Only roads within `_NEAR_M` of this place, metres.
    """
    roads = roads_of_map(roads) if isinstance(roads, LaneletMap) else roads
    area: Any = roads.area
    if near is not None:
        area = shapely.intersection(area, shapely.Point(near).buffer(_NEAR_M))
    if area.is_empty:
        return False
    columns = columns_around(area)
    read_columns(scans, [columns], box_with_margin(area.bounds, BESIDE_M), roads.crs)
    return warn_roads_shifted(columns, area, scans[0].path, reporter)


def columns_around(area: Any) -> ScanColumns:
    """Return columns, to be filled, of the roads and `BESIDE_M` around; of a whole city, none."""
    box = box_with_margin(area.bounds, BESIDE_M)
    grid = Grid.around(np.array(box[::2]), np.array(box[1::2]), _SCAN_CELL_M)
    is_city = grid.columns * grid.rows > MOST_COMPARED
    grid = replace(grid, columns=0, rows=0) if is_city else grid
    return ScanColumns(grid=grid, names=("top", "low"))


def warn_roads_shifted(columns: ScanColumns, area: Any, path: Path, reporter: Reporter) -> bool:
    """Warn as :func:`warn_shifted` by the columns around the area of roads, filled."""
    if columns.grid.columns == 0:  # a whole city, whose roads take long to narrow
        return False
    middle = shapely.buffer(area, -_EDGE_M)
    shapely.prepare(middle)
    grid = columns.grid
    x = grid.centres(np.arange(grid.columns))[:, 0]
    y = grid.centres(np.arange(grid.rows) * grid.columns)[:, 1]
    inside = np.flatnonzero(shapely.contains_xy(middle, x, y[:, None]))
    return warn_shifted(columns, grid.centres(inside), path, reporter)
