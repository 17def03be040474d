"""What a heat map is asked for: tiles that fit, a moment, intervals."""

from __future__ import annotations

from zoneinfo import ZoneInfo

import geopandas as gpd
import numpy as np

from gis_radar.clock import interval_steps, iso_from_step, seconds_from_iso, step_of
from gis_radar.crs import metric_crs
from gis_radar.errors import InputError, UsageError
from gis_radar.heatmap.calendar import follows_utc, local_intervals
from gis_radar.heatmap.tally import MOST_COLUMNS
from gis_radar.heatmap.timeline import (
    Timeline,
    aligned,
    aligned_with,
    intervals_with,
    those_with,
)
from gis_radar.occupancy.runs import Runs
from gis_radar.progress import Reporter
from gis_radar.tiles import COLUMNS, fingerprint

MOST_ROWS = 100_000_000  # of the long layer: about 35 GB of GeoPackage


def checked(tiles: gpd.GeoDataFrame, wanted: str) -> gpd.GeoDataFrame:
    """Return the tiles with their own columns only; refuse those of another fingerprint."""
    missing = [name for name in COLUMNS if name not in tiles]
    if missing:
        raise InputError(f"the tiles lack the column(s) {', '.join(missing)}")
    metric_crs(tiles.crs, what="tiles")
    got = fingerprint(tiles)
    if got != wanted:
        raise InputError(
            f"the tiles have the fingerprint {got}, the occupancy was made with {wanted}",
            hint="use the tiles that the occupancy was made with",
        )
    attributes = tiles[list(COLUMNS)].reset_index(drop=True)
    shapes = tiles.geometry.reset_index(drop=True)
    return gpd.GeoDataFrame(attributes, geometry=shapes, crs=tiles.crs)


def whole_of(runs: Runs, at: str | None) -> Timeline:
    """Return the whole time, or the step that contains `at`, as one interval."""
    first, last = int(runs.first[0]), int(runs.last[-1])
    if at is not None:
        moment = moment_of(at, "at")
        first = last = int(step_of(np.array([moment]))[0])
        nearest = runs.nearest(first)
        if nearest != first:
            raise InputError(
                f"no sensor delivered a frame at {at}, in the step from {iso_from_step(first)}",
                hint=f"the nearest step with a frame begins at {iso_from_step(nearest)}",
            )
    return Timeline(begin=np.array([first]), end=np.array([last + 1]))


def moment_of(text: str, what: str) -> float:
    """Return a time that a caller gave as UNIX seconds."""
    try:
        return seconds_from_iso(text, what=what)
    except InputError as error:
        raise UsageError(error.message, hint=error.hint) from error


def intervals_of(
    runs: Runs, interval: str, zone: ZoneInfo | None, tiles: int, reporter: Reporter
) -> Timeline:
    """Return the intervals; where there are very many, only those with a frame."""
    steps = interval_steps(interval)
    first, last = int(runs.first[0]), int(runs.last[-1])
    local = None
    if zone is not None and not follows_utc(steps):
        local = local_intervals(first, last, steps, zone)
    count = last // steps - first // steps + 1 if local is None else len(local)
    if count <= MOST_COLUMNS:
        return aligned(first, last, steps) if local is None else local
    kept = None if local is None else those_with(local, runs)
    filled = intervals_with(runs, steps) if kept is None else len(kept)
    if filled * tiles > MOST_ROWS:
        raise UsageError(
            f"{filled} intervals of {interval} for {tiles} tiles are more than a heat map can hold",
            hint="use a longer interval",
        )
    said = f"only the {filled} intervals in which a sensor delivered a frame are kept"
    if filled > MOST_COLUMNS:
        said += (
            f"; more than {MOST_COLUMNS}, so they are rows of occupancy_by_interval, "
            "not columns and bands"
        )
    reporter.log(said)
    return aligned_with(runs, steps) if kept is None else kept
