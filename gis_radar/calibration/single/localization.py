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
from gis_radar.calibration.scan.pose_update import fix_open_direction, updated_by_scan
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
from gis_radar.scans import (
    Sight,
    SightScan,
    SightTiles,
    find_sight,
    open_scan,
    read_road,
    read_shifted,
    road_crs,
)

_FIGURE_TILE_M = 2.0  # length of the tiles in the figure of a sensor's sight
_MOST_RECORDINGS = 5  # most recordings that are tried for a pose: enough for a quiet day or two
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
    """Localize a sensor by one recording, with guess and road in the map's CRS.

    Parameters, errors and result are those of :func:`localize`.
    """
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

    Guess and compass are converted to the map's CRS; the first recording that gives a pose is used;
    scans update the pose and check it; the figure is drawn.

    Parameters
    ----------
    recordings : path or sequence of paths
        Recordings of one sensor at one place; of each the last 2000 frames are used. The first one
        that gives a pose decides, so that adding recordings changes nothing. Five are tried at
        most: the first four, and the last.
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
        The same as a compass bearing: degrees clockwise from true north, or a word such as
        `north-east`.
    crs : CRS, str or int, optional
        The map frame, where the map is a file; that of the road's file where it is not given.
    origin : (easting, northing), optional
        Map-frame position of its local (0, 0), for maps without latitudes and longitudes.
    method : str
        `lane`, traces against lanes; or `icp`, the paper's, traces against the road's surface.
    scans : path or sequence of paths
        Airborne scans, not masked: their static structures update the pose and check it
        (:func:`gis_radar.check_against_scan`). With scans the 99.9th percentile of the recording's
        ranges becomes the view's `max_range_m`, unless a view is given.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files that do not state it.
    sensor : str, optional
        The sensor's name; by default the recording's file name.
    view : View, optional
        The view of the sensor, written into the pose.
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
        traffic, too few frames, a scale of range that is not 1, a guess too far off, several poses
        that fit alike, a mirrored recording.
    """
    refuse_both(heading, compass)
    roads, points = read_ground(roads, road, crs=crs, origin=origin, reporter=reporter)
    place, heading = start_in_map(roads, guess, guess_crs, heading, compass)
    scans = paths_of(scans)
    if scans:
        require_scans_near(scans, roads.crs, place, scan_crs=scan_crs)
    localizer = partial(
        localize_one, roads=roads, road_points=points,
        guess=place, heading=heading, method=method, reporter=reporter,
    )  # fmt: skip
    check_pose = None
    if scans:
        check_pose = partial(check_against_scan, scans=scans, scan_crs=scan_crs, reporter=reporter)
        compare = partial(check_pose, reporter=SILENT)  # the final check alone reports
        localizer = partial(
            localize_with_scan, localize=localizer, check_pose=compare, reporter=reporter
        )
    recording, answer = _first_localization(_recordings_to_try(recordings), localizer, reporter)
    pose = replace(answer.pose, sensor=sensor or answer.pose.sensor, view=view)
    answer = replace(answer, pose=pose, recording=recording.name)
    check = None if check_pose is None else check_pose(recording, pose)
    if check is not None:
        answer = answer.with_scan_check(check)
    warn_unobservable([answer], scanned=check is not None, reporter=reporter)
    if scans:
        opened = [open_scan(each, crs=scan_crs) for each in scans]
        read_shifted(opened, roads, reporter, near=pose.position[:2])
    if figure is not None:
        seen = _sight(answer.pose, roads, points, scans, scan_crs, reporter) if scans else None
        answer.draw(figure, roads, points, scan_check=check, sight=seen)
    return answer


def warn_unobservable(
    localizations: Iterable[Localization], *, scanned: bool, reporter: Reporter
) -> None:
    """Warn of poses with components that neither the traffic nor a scan fixes."""
    for each in localizations:
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
    """Return the map and the scanned road in its CRS, read where they are files."""
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
    """Return guess (m) and heading (degrees from grid east) in the coordinate system of a map."""
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
    """Return the sensor's sight and its tiles, for the figure; warn where scans give none."""
    tiles_2m = make_tiles(roads, length_m=_FIGURE_TILE_M, road=points, reporter=SILENT)
    tiles = SightTiles.of(tiles_2m)
    try:
        return find_sight(pose, tiles, SightScan(scans, tiles, scan_crs=scan_crs)), tiles
    except InputError as error:
        reporter.warn("the figure does not show what {} sees: {}", pose.sensor, error)
        return None


def _first_localization(
    recordings: Sequence[Path], localizer: Callable[[Path], Localization], reporter: Reporter
) -> tuple[Path, Localization]:
    """Return the first recording that gives a pose, with its localization; refuse if none does."""
    refusals = []
    for recording in recordings:
        try:
            return recording, localizer(recording)
        except NoAnswerError as error:
            refusals.append(error)
            if len(recordings) > 1:
                reporter.log(Text("{} gives no pose: {}", recording.name, error.message))
    raise refusals[0]


def localize_with_scan(
    recording: Path,
    *,
    localize: Callable[[Path], Localization],
    check_pose: Callable[[Path, Pose], ScanCheck],
    reporter: Reporter,
) -> Localization:
    """Localize by traffic and by the static structures of a scan.

    Where the traffic fits several poses, the scan check decides: for the only one that it confirms,
    or for the only one that it does not doubt and prefers to each other one. The pose is then moved
    along a direction that the traffic does not fix, and updated by the offset at which structures
    fit best: see :mod:`gis_radar.calibration.scan.pose_update`.

    Parameters
    ----------
    recording : Path
        The sensor's recording.
    localize : callable
        Localizes by a recording.
    check_pose : callable
        Checks a pose against the scan.
    reporter : Reporter
        Receives a warning where the scan decided.

    Raises
    ------
    NoAnswerError
        As from `localize`; AmbiguousError where the scan decides for none of the poses.
    """
    answer = _choose_by_scan(recording, localize, check_pose, reporter)
    if answer.pose.evidence.get("method") != "lane":
        return answer  # the paper's method has no update
    check = check_pose(recording, answer.pose)
    moved, closed = fix_open_direction(answer.pose, check)
    if closed is not answer.pose:
        check = check_pose(recording, closed)
    pose = updated_by_scan(moved, check)  # not `closed`: the scan would count twice
    if pose is moved:
        pose = closed if check.verdict != DOUBTS else None
    pose = answer.pose if pose is None else pose
    moved_m = float(np.hypot(*(pose.position - answer.pose.position)[:2]))
    pose = replace(pose, evidence={**pose.evidence, "moved_by_scan_m": round(moved_m, 3)})
    return replace(answer, pose=pose, observable=bool(pose.evidence["observable"]))


def _choose_by_scan(
    recording: Path,
    localize: Callable[[Path], Localization],
    check_pose: Callable[[Path, Pose], ScanCheck],
    reporter: Reporter,
) -> Localization:
    """Localize; where several poses fit, choose the one that the scan confirms or prefers."""
    try:
        return localize(recording)
    except AmbiguousError as refusal:
        checked = [(answer, check_pose(recording, answer.pose)) for answer in refusal.answers]
        checks = [check for _, check in checked]
        chosen = [answer for answer, check in checked if check.verdict == CONFIRMS]
        if len(chosen) == 1:
            reporter.warn("{}; what stands in the scan confirms one of them", refusal.message)
            return chosen[0]
        chosen = [answer for answer, check in checked if _is_preferred(check, checks)]
        if len(chosen) != 1:
            refusal.hint = Text("record longer, or give a heading: the scan does not decide")
            raise
        reporter.warn("{}; what stands in the scan prefers one of them", refusal.message)
        return chosen[0]


def _is_preferred(check: ScanCheck, checks: Sequence[ScanCheck]) -> bool:
    """Return whether a check covers its pose, does not doubt it, and prefers it to all others."""
    if check.verdict == DOUBTS or not check.covered >= LEAST_COVERED:
        return False
    alignment = align(check.standing, check.structure)
    for other in checks:
        ahead, left, _ = check.level.from_map(other.pose.position[None])[0].tolist()
        offset = alignment.offset((ahead, left, other.pose.yaw - check.pose.yaw))
        if other is not check and alignment.z_score(alignment.here, offset) < CLEAR_SIGMAS:
            return False
    return True


def _recordings_to_try(recordings: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return the recordings to try for a pose, in order: all, or the first four and the last."""
    paths = paths_of(recordings)
    if not paths:
        raise UsageError("no recording is given")
    return paths if len(paths) <= _MOST_RECORDINGS else [*paths[: _MOST_RECORDINGS - 1], paths[-1]]
