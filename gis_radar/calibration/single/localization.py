"""Localize a sensor from a recording, the lanes and a rough guess, in memory or from files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.base import (
    QUIET,
    SILENT,
    Floats,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    UsageError,
    as_points,
    looks_like_degrees,
    paths_of,
    reprojected_position,
    yaw_from_compass,
)
from gis_radar.calibration.range_scale import measure_range_scale
from gis_radar.calibration.registration.traces import LEAST_FRAMES, Moving
from gis_radar.calibration.scan.pose_update import closed_along, updated_by_scan
from gis_radar.calibration.scan.scan_check import (
    CLEAR_SIGMAS,
    LEAST_COVERED,
    align,
    check_against_scan,
    require_scans_near,
)
from gis_radar.calibration.scan.scan_check_result import CONFIRMS, DOUBTS, ScanCheck
from gis_radar.calibration.single.icp import by_icp
from gis_radar.calibration.single.lane_method import by_lanes
from gis_radar.calibration.single.moving import read_moving
from gis_radar.calibration.single.result import AmbiguousError, Localization, Problem
from gis_radar.calibration.unit_mistakes import NOT_FITTED
from gis_radar.hdmap import LaneletMap, make_tiles, read_map
from gis_radar.poses import Pose, View
from gis_radar.recordings import open_recording
from gis_radar.scans import Sight, SightScan, SightTiles, find_sight, read_road, road_crs

FIGURE_TILE_M = 2.0  # length of the tiles in the figure of what a sensor sees
MOST_TRIES = 5  # recordings tried for a pose, one after the other: enough for a quiet day or two
METHODS: dict[str, Callable[[Problem, Moving, Reporter], Localization]] = {
    "lane": by_lanes,
    "icp": by_icp,
}


def localize_one(
    recording: str | Path,
    roads: LaneletMap,
    road_points: Floats,
    *,
    guess: tuple[float, ...],
    heading: float | None = None,
    method: str = "lane",
    reporter: Reporter = QUIET,
) -> Localization:
    """Find the pose of a sensor from one recording, in the map's CRS; see :func:`localize`."""
    if method not in METHODS:
        raise UsageError("method is {}, expected one of {}", repr(method), ", ".join(METHODS))
    if len(guess) not in {2, 3}:
        raise UsageError("guess has {} numbers, expected easting, northing[, height]", len(guess))
    if not all(math.isfinite(number) for number in guess) or (
        heading is not None and not math.isfinite(heading)
    ):
        raise UsageError("guess and heading must be finite numbers")
    if looks_like_degrees(*guess[:2]):
        raise UsageError(
            "guess {:g}, {:g} looks like degrees",
            guess[0],
            guess[1],
            hint=Text(
                "give metres in the CRS of the map; {} takes another metric one", "--guess-crs"
            ),
        )
    open_recording(recording).require_elevation("its height, pitch and roll cannot be found")
    moving = read_moving(recording, reporter=reporter)
    if moving.frames < LEAST_FRAMES:
        raise NoAnswerError(
            "{}: {} frames, at least {} are needed",
            recording,
            moving.frames,
            LEAST_FRAMES,
            hint="record longer: 100 s are a good length",
        )
    scale = measure_range_scale(moving)
    if scale is not None:
        scale.require_one(Path(recording).stem)
    problem = Problem(
        name=Path(recording).stem,
        roads=roads,
        road=np.asarray(road_points, dtype=np.float64),
        guess=np.asarray(guess, dtype=np.float64),
        heading=None if heading is None else math.radians(heading),
        evidence={"range_scale": NOT_FITTED if scale is None else scale.evidence()},
    )
    return METHODS[method](problem, moving, reporter)


def localize(
    recordings: str | Path | Sequence[str | Path],
    roads: LaneletMap | str | Path,
    road: Floats | str | Path,
    *,
    guess: Sequence[float],
    guess_crs: Any = None,
    heading: float | None = None,
    compass: float | str | None = None,
    crs: Any = None,
    origin: tuple[float, float] | None = None,
    method: str = "lane",
    scans: str | Path | Sequence[str | Path] = (),
    scan_crs: Any = None,
    sensor: str | None = None,
    view: View | None = None,
    figure: str | Path | None = None,
    reporter: Reporter = QUIET,
) -> Localization:
    """Find the pose of a sensor from its recordings, the lanes, the scanned road and a rough guess.

    Take guess and compass to the map's CRS, localize by the first recording that gives a pose,
    update and check it by scans where there are some, and draw the figure.

    Parameters
    ----------
    recordings : path or sequence of paths
        Recordings of one sensor at one place, of which the last 2000 frames count. The first that
        gives a pose counts, so that adding recordings changes nothing. Five are tried at most: the
        first four, and the last.
    roads : LaneletMap, str or Path
        The lanes, or a file of a Lanelet2 map.
    road : (n, 3) array, str or Path
        Points of the road's surface in the map's CRS, as :func:`gis_radar.read_road` gives them,
        or their file, as :func:`gis_radar.mask_road` makes it.
    guess : (easting, northing) or (easting, northing, height)
        Within 15 m of the truth; the height only helps `icp`.
    guess_crs : CRS, str or int, optional
        The guess's coordinate system, where it is not the map's.
    heading : float, optional
        Yaw in degrees, counter-clockwise from grid east, within 25 degrees of the truth; without
        it the heading is searched.
    compass : float or str, optional
        The same as a bearing: degrees clockwise from true north, or a word such as `north-east`.
    crs : CRS, str or int, optional
        The map frame, where the map is a file; that of the road's file where it is not given.
    origin : (easting, northing), optional
        Map-frame position of its local (0, 0), for maps without latitudes and longitudes.
    method : str
        `lane`, traces against lanes; or `icp`, the paper's, traces against the road's surface.
    scans : path or sequence of paths
        Airborne scans, whole: what stands in them measures the pose a second time and checks it
        (:func:`gis_radar.check_against_scan`); with them the range that the recording reaches
        (99.9th percentile) becomes the view's `max_range_m`, unless a view is given.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files that do not state it.
    sensor : str, optional
        The sensor's name; by default the recording's file name.
    view : View, optional
        The view of the sensor, which goes into the pose.
    figure : str or Path, optional
        Draw the traces over lanes and scan into this PNG, as
        :meth:`gis_radar.calibration.Localization.draw` does.
    reporter : Reporter
        Receives progress and remarks.

    Raises
    ------
    UsageError
        If both heading and compass are given, or `crs` or `origin` beside a map that is read
        already; if there is no such method, or the guess is no position in metres.
    InputError
        If a file cannot be read, or scans, map and guess do not overlap.
    NoAnswerError
        If none of the recordings gives a trustworthy pose, with the reason of the first: no
        traffic, too few frames, ranges that do not change as the range rates state, a guess too far
        off, several answers, a mirrored recording.
    """
    refuse_both(heading, compass)
    roads, points = read_ground(roads, road, crs=crs, origin=origin, reporter=reporter)
    place, heading = start_in_map(roads, guess, guess_crs, heading, compass)
    scans = paths_of(scans)
    if scans:
        require_scans_near(scans, roads.crs, place, scan_crs=scan_crs)
    ask = partial(
        localize_one, roads=roads, road_points=points,
        guess=place, heading=heading, method=method, reporter=reporter,
    )  # fmt: skip
    look_at = None
    if scans:
        look_at = partial(check_against_scan, scans=scans, scan_crs=scan_crs, reporter=reporter)
        compare = partial(look_at, reporter=SILENT)  # of several poses one is told, in the end
        ask = partial(localize_with_scan, localize=ask, look_at=compare, reporter=reporter)
    recording, found = _first_answer(_tried(recordings), ask, reporter)
    pose = replace(found.pose, sensor=sensor or found.pose.sensor, view=view)
    found = replace(found, pose=pose, recording=recording.name)
    look = None if look_at is None else look_at(recording, pose)
    if look is not None:
        found = found.with_scan_check(look)
    warn_of_open([found], scanned=look is not None, reporter=reporter)
    if figure is not None:
        seen = _sight(found.pose, roads, points, scans, scan_crs, reporter) if scans else None
        found.draw(figure, roads, points, look=look, seen=seen)
    return found


def warn_of_open(found: Iterable[Localization], *, scanned: bool, reporter: Reporter) -> None:
    """Warn of poses of which the traffic, and a scan if there is one, leave something open."""
    for each in found:
        if line := each.left_open(scanned=scanned):
            reporter.warn(line)


def refuse_both(heading: Any, compass: Any) -> None:
    """Refuse a heading together with a compass bearing."""
    if heading is not None and compass is not None:
        raise UsageError("both heading and compass are given", hint="give one of them")


def read_ground(
    roads: LaneletMap | str | Path,
    road: Floats | str | Path,
    *,
    crs: Any,
    origin: tuple[float, float] | None,
    reporter: Reporter,
) -> tuple[LaneletMap, Floats]:
    """Read what is a file: a map, and the scanned road in its CRS; see :func:`localize`."""
    if isinstance(roads, LaneletMap):
        if crs is not None or origin is not None:
            raise UsageError("crs and origin are for files of maps: the map has its own")
    else:
        frame = road_crs(road) if crs is None and isinstance(road, str | Path) else crs
        roads = read_map(roads, crs=frame, origin=origin, reporter=reporter)
    return roads, read_road(road, roads.crs) if isinstance(road, str | Path) else as_points(road)


def start_in_map(
    roads: LaneletMap,
    guess: Sequence[float],
    guess_crs: Any,
    heading: float | None,
    compass: float | str | None,
) -> tuple[tuple[float, ...], float | None]:
    """Return guess (m) and heading (degrees, grid) in the coordinate system of a map."""
    place = tuple(float(number) for number in guess)
    if guess_crs is not None:
        place = reprojected_position(place, guess_crs, roads.crs)
    if compass is not None:
        heading = yaw_from_compass(compass, roads.crs, place[0], place[1])
    return place, heading


def _sight(
    pose: Pose,
    roads: LaneletMap,
    points: Floats,
    scans: Sequence[str | Path],
    scan_crs: Any,
    reporter: Reporter,
) -> tuple[Sight, SightTiles] | None:
    """Return the sensor's sight of the lanes, for the figure; warn of a scan that does not fit."""
    large = make_tiles(roads, length_m=FIGURE_TILE_M, road=points, reporter=SILENT)
    tiles = SightTiles.of(large)
    try:
        return find_sight(pose, tiles, SightScan(scans, tiles, scan_crs=scan_crs)), tiles
    except InputError as error:
        reporter.warn("the figure does not show what {} sees: {}", pose.sensor, error)
        return None


def _first_answer(
    recordings: Sequence[Path], ask: Callable[[Path], Localization], reporter: Reporter
) -> tuple[Path, Localization]:
    """Return the first recording that gives a pose, and the pose; refuse where none does."""
    refusals = []
    for recording in recordings:
        try:
            return recording, ask(recording)
        except NoAnswerError as error:
            refusals.append(error)
            if len(recordings) > 1:
                reporter.log(Text("{} gives no pose: {}", recording.name, error.message))
    raise refusals[0]


def localize_with_scan(
    recording: Path,
    *,
    localize: Callable[[Path], Localization],
    look_at: Callable[[Path, Pose], ScanCheck],
    reporter: Reporter,
) -> Localization:
    """Localize by traffic and by what stands in a scan.

    Where the traffic fits several poses, the scan check decides. The pose is then closed along a
    direction that the traffic leaves open, and updated by where what stands fits the scan best: see
    :mod:`gis_radar.calibration.scan.pose_update`.

    The scan decides where it confirms exactly one pose, or where it does not doubt and prefers to
    each of the others exactly one. Places that the traffic rules out are not compared then.

    Parameters
    ----------
    recording : Path
        The sensor's recording.
    localize : callable
        Finds a pose from a recording.
    look_at : callable
        Checks a pose against the scan.
    reporter : Reporter
        Receives a warning where the scan decided.

    Raises
    ------
    NoAnswerError
        As by `localize`; AmbiguousError where the scan decides for none of the poses.
    """
    found = _decided(recording, localize, look_at, reporter)
    if found.pose.evidence.get("method") != "lane":
        return found  # the paper's method is kept as it is
    look = look_at(recording, found.pose)
    moved, closed = closed_along(found.pose, look)
    if closed is not found.pose:
        look = look_at(recording, closed)
    pose = updated_by_scan(moved, look)  # by the same scan: it does not count twice
    if pose is moved:
        pose = closed if look.verdict != DOUBTS else None
    pose = found.pose if pose is None else pose
    moved_m = float(np.hypot(*(pose.position - found.pose.position)[:2]))
    pose = replace(pose, evidence={**pose.evidence, "moved_by_scan_m": round(moved_m, 3)})
    return replace(found, pose=pose, observable=bool(pose.evidence["observable"]))


def _decided(
    recording: Path,
    localize: Callable[[Path], Localization],
    look_at: Callable[[Path, Pose], ScanCheck],
    reporter: Reporter,
) -> Localization:
    """Localize; where several poses fit, choose the one that the scan confirms or prefers."""
    try:
        return localize(recording)
    except AmbiguousError as refusal:
        looked = [(answer, look_at(recording, answer.pose)) for answer in refusal.answers]
        looks = [look for _, look in looked]
        found = [answer for answer, look in looked if look.verdict == CONFIRMS]
        if len(found) == 1:
            reporter.warn("{}; what stands in the scan confirms one of them", refusal.message)
            return found[0]
        found = [answer for answer, look in looked if _preferred(look, looks)]
        if len(found) != 1:
            refusal.hint = Text("record longer, or give a heading: the scan does not decide")
            raise
        reporter.warn("{}; what stands in the scan prefers one of them", refusal.message)
        return found[0]


def _preferred(look: ScanCheck, looks: Sequence[ScanCheck]) -> bool:
    """Return whether the scan, where there is one, does not doubt a pose and prefers it to all."""
    if look.verdict == DOUBTS or not look.covered >= LEAST_COVERED:
        return False
    alignment = align(look.standing, look.structure)
    for other in looks:
        ahead, left, _ = look.level.from_map(other.pose.position[None])[0].tolist()
        there = alignment.offset((ahead, left, other.pose.yaw - look.pose.yaw))
        if other is not look and alignment.z_score(alignment.here, there) < CLEAR_SIGMAS:
            return False
    return True


def _tried(recordings: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return the recordings to try for a pose, in order."""
    paths = paths_of(recordings)
    if not paths:
        raise UsageError("no recording is given")
    return paths if len(paths) <= MOST_TRIES else [*paths[: MOST_TRIES - 1], paths[-1]]
