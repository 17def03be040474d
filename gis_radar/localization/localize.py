"""Localize: from a recording, the lanes and a rough guess to a pose."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from gis_radar.arrays import Floats
from gis_radar.errors import NoAnswerError, UsageError
from gis_radar.lanelets import LaneletMap
from gis_radar.localization.icp import by_icp
from gis_radar.localization.lane_method import by_lanes
from gis_radar.localization.result import Localization, Problem
from gis_radar.localization.settings import DEFAULTS, LocalizationSettings
from gis_radar.localization.traces import Moving, read_moving
from gis_radar.progress import QUIET, Reporter

METHODS: dict[str, Callable[[Problem, Moving, Reporter, LocalizationSettings], Localization]] = {
    "lane": by_lanes,
    "icp": by_icp,
}


def localize(
    recording: str | Path,
    roads: LaneletMap,
    road_points: Floats,
    *,
    guess: tuple[float, ...],
    heading: float | None = None,
    method: str = "lane",
    settings: LocalizationSettings = DEFAULTS,
    reporter: Reporter = QUIET,
) -> Localization:
    """Find the pose of the sensor that made a recording.

    Parameters
    ----------
    recording : str or Path
        A recording; its last 2000 frames count.
    roads : LaneletMap
        The lanes.
    road_points : (n, 3) array
        Points of the road's surface in the map's CRS, as :func:`gis_radar.read_road` gives them.
    guess : (easting, northing) or (easting, northing, height)
        Within 15 m of the truth, in the map's CRS; the height only helps `icp`.
    heading : float, optional
        Yaw in degrees, counter-clockwise from grid east, within 25 degrees of the truth; without
        it the heading is searched.
    method : str
        `lane`, traces against lanes; or `icp`, the paper's, traces against the road's surface.
    settings : LocalizationSettings
        All constants of both methods; those that are not the defaults go into the evidence.
    reporter : Reporter
        Told the progress and remarks.

    Raises
    ------
    InputError
        If the recording cannot be read, or scan and map do not overlap.
    NoAnswerError
        If no trustworthy answer follows: no traffic, too few frames, a guess too far off, several
        answers, a mirrored recording.
    """
    if method not in METHODS:
        raise UsageError(f"method is {method!r}, expected one of {', '.join(METHODS)}")
    if not all(math.isfinite(number) for number in (*guess, heading or 0.0)):
        raise UsageError("guess and heading must be finite numbers")
    traces = settings.traces
    moving = read_moving(
        recording, frames=traces.frames, min_speed=traces.min_speed_mps, reporter=reporter
    )
    if moving.frames < traces.least_frames:
        raise NoAnswerError(
            f"{recording}: {moving.frames} frames, at least {traces.least_frames} are needed",
            hint="record longer: 100 s are a good length",
        )
    problem = Problem(
        name=Path(recording).stem,
        roads=roads,
        road=np.asarray(road_points, dtype=np.float64),
        guess=np.asarray(guess, dtype=np.float64),
        heading=None if heading is None else math.radians(heading),
    )
    found = METHODS[method](problem, moving, reporter, settings)
    changes = settings.changes()
    if not changes:
        return found
    evidence = {**found.pose.evidence, "settings": changes}
    return replace(found, pose=replace(found.pose, evidence=evidence))
