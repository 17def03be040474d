"""Joint calibration of a site's sensors by correspondences: vehicles that two of them see."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar.base import (
    QUIET,
    SILENT,
    Floats,
    InputError,
    Level,
    NoAnswerError,
    Reporter,
    Text,
    UsageError,
    atomic_writes,
    card,
    checked,
    folder_to_fill,
)
from gis_radar.calibration.registration.lanes import MARGIN_M, Lanes, sample_lanes
from gis_radar.calibration.registration.traces import Moving
from gis_radar.calibration.scan.scan_check import check_against_scan, require_scans_near
from gis_radar.calibration.scan.scan_check_result import CONFIRMS, ScanCheck
from gis_radar.calibration.several.network import CLASH_HINT, Solved, solve_network
from gis_radar.calibration.several.placing import Station
from gis_radar.calibration.several.swapped_guesses import by_name, swapped_guesses
from gis_radar.calibration.single.localization import (
    localize_one,
    localize_with_scan,
    read_ground,
    refuse_both,
    start_in_map,
    warn_unobservable,
)
from gis_radar.calibration.single.moving import (
    NO_OFFSET,
    Span,
    best_end,
    common_time,
    read_span,
    read_until,
    refuse_equal,
)
from gis_radar.calibration.single.result import AmbiguousError, Localization
from gis_radar.calibration.timing.clocks import SensorClock
from gis_radar.hdmap import LaneletMap
from gis_radar.poses import Pose

# Length of the part of long recordings that is used, seconds: 2000 frames.
_COMMON_S = 100.0

_STAGE = "finding the poses together"
_READING = "reading what moved"
WITHOUT = Text("the other sensors have their poses; does each guess belong to its recording?")
_AWAY = "it did not record while the others did"


@dataclass(frozen=True, kw_only=True)
class JointCalibration:
    """Result of a joint calibration.

    Parameters
    ----------
    found : dict of str to Localization
        By sensor. With correspondences, `together` in its pose's evidence names the other sensors,
        the number of pairs of tracks, and sigma before and after (m, degrees).
    refused : dict of str to str
        By sensor without a trustworthy pose: the reason.
    pairs : dict of (str, str) to int
        Number of vehicles that two sensors share.
    """

    found: dict[str, Localization]
    refused: dict[str, str]
    pairs: dict[tuple[str, str], int]

    @property
    def failure(self) -> NoAnswerError | None:
        """Error that names all refused sensors in one line; None where every sensor has a pose."""
        if not self.refused:
            return None
        return NoAnswerError(by_name(self.refused), hint=WITHOUT)

    def figures(self) -> dict[str, str]:
        """Return one line of text for each sensor."""
        lines = {name: _result_line(found.pose) for name, found in self.found.items()}
        return lines | {name: Text("no answer: {}", why) for name, why in self.refused.items()}

    def write(self, folder: str | Path) -> list[Path]:
        """Write a pose file for each sensor into a folder, all or none, and return them."""
        folder = Path(folder)
        paths = [folder / f"{name}.json" for name in self.found]
        with folder_to_fill(folder), atomic_writes(paths[0]) as (private, places):
            for found, path in zip(self.found.values(), paths, strict=True):
                found.pose.write(private / path.name)
                places[private / path.name] = path
        return paths

    def _repr_html_(self) -> str:
        return card("Sensors together", self.figures())

    def __repr__(self) -> str:
        figures = "; ".join(f"{name}: {text}" for name, text in self.figures().items())
        return f"JointCalibration({figures})"


@checked
def localize_together(
    recordings: Sequence[str | Path],
    roads: LaneletMap | str | Path,
    road: Floats | str | Path,
    *,
    guesses: Sequence[Sequence[float]],
    guess_crs: Any = None,
    headings: Sequence[float] | None = None,
    compasses: Sequence[float] | None = None,
    crs: Any = None,
    origin: tuple[float, float] | None = None,
    scans: Sequence[str | Path] = (),
    scan_crs: Any = None,
    reporter: Reporter = QUIET,
) -> JointCalibration:
    """Find the poses of several sensors that recorded at the same time.

    Each is localized by itself, by the method `lane`. Then the poses are adjusted together by
    vehicles that two sensors see at the same time. A sensor with several poses that fit alike, or
    whose place along a straight road is not fixed, is placed by its neighbours. With scans, each
    adjusted pose is checked against them.

    Parameters
    ----------
    recordings : sequence of paths
        One a sensor, which is named after the file; they overlap in time.
    roads, road, crs, origin
        As for :func:`gis_radar.localize`.
    guesses : sequence of (easting, northing) or (easting, northing, height)
        As many as recordings, in order; each within 15 m of the truth.
    guess_crs : CRS, str or int, optional
        The guesses' coordinate system, where it is not the map's.
    headings : sequence of float, optional
        Yaw of each sensor, degrees counter-clockwise from grid east, within 25 degrees of the
        truth.
    compasses : sequence of float, optional
        The same as compass bearings: degrees clockwise from true north.
    scans, scan_crs
        As for :func:`gis_radar.localize`: where the traffic in front of a sensor fits several
        poses, the scan check decides first.
    reporter : Reporter
        Receives progress and remarks.

    Raises
    ------
    UsageError
        If there are fewer than two recordings, not as many guesses, or a sensor twice.
    InputError
        If a file cannot be read, two recordings have no time in common, or no scan has points
        within 300 m of a guess.
    NoAnswerError
        If no sensor has a trustworthy pose.
    """
    paths = [Path(each) for each in recordings]
    _check_counts(paths, guesses, headings, compasses)
    roads, points = read_ground(roads, road, crs=crs, origin=origin, reporter=reporter)
    none = [None] * len(paths)
    starts = [
        start_in_map(roads, guess, guess_crs, heading, compass)
        for guess, heading, compass in zip(
            guesses, headings or none, compasses or none, strict=True
        )
    ]
    places, yaws = zip(*starts, strict=True)
    for path, place in zip(paths, places, strict=True) if scans else ():
        require_scans_near(scans, roads.crs, place, name=path.stem, scan_crs=scan_crs)
    return locate_all(
        paths, roads, points, guesses=places, headings=yaws, scans=scans,
        scan_crs=scan_crs, reporter=reporter,
    )  # fmt: skip


def locate_all(
    recordings: Sequence[Path],
    roads: LaneletMap,
    road_points: Floats,
    *,
    guesses: Sequence[tuple[float, ...]],
    headings: Sequence[float | None] | None = None,
    scans: Sequence[str | Path] = (),
    scan_crs: Any = None,
    reporter: Reporter = QUIET,
) -> JointCalibration:
    """Find the poses of several sensors, with map and road in memory.

    Parameters
    ----------
    recordings, guesses, headings, scans, scan_crs, reporter
        As for :func:`localize_together`; guesses in the map's CRS.
    roads, road_points
        As for :func:`gis_radar.localize`.
    """
    end = common_time(recordings)
    named = partial(_check_named, scans=scans, scan_crs=scan_crs, reporter=reporter)
    check = named if scans else None
    yaws = [None] * len(guesses) if headings is None else headings
    single = partial(localize_one, roads=roads, road_points=road_points, reporter=reporter)
    localizers = [
        partial(single, guess=guess, heading=heading)
        for guess, heading in zip(guesses, yaws, strict=True)
    ]
    if check is not None:
        compare = partial(check, reporter=SILENT)
        localizers = [
            partial(localize_with_scan, localize=localizer, check_pose=compare, reporter=reporter)
            for localizer in localizers
        ]
    answers, refused = _localize_each(recordings, localizers, reporter)
    used = {path.stem: path for path in recordings if path.stem in answers}
    solved = adjust_poses(
        used, {name: tuple(each.pose for each in found) for name, found in answers.items()},
        roads, road_points, end=end, reporter=reporter,
    )  # fmt: skip
    reporter.progress(_STAGE, len(recordings) + 1, len(recordings) + 1)
    confirmed: dict[str, Localization] = {}
    if check is not None:
        confirmed = _confirmed_by_scan({n: answers[n] for n in solved.refused}, used, compare)
    for name in confirmed:
        reporter.warn("{}; what stands in the scan confirms that of {}", solved.refused[name], name)
    if not solved.poses and not confirmed:
        reasons = Text("; ").join(dict.fromkeys(solved.refused.values()))
        raise NoAnswerError(reasons, hint=CLASH_HINT)
    if len(used) > 1:
        _warn_unmatched(solved, reporter)
    placed = {
        name: _with_pose(answers[name][solved.chosen[name]], solved.poses[name])
        for name in used if name in solved.poses
    }  # fmt: skip
    if check is not None:
        placed = {n: each.with_scan_check(check(used[n], each.pose)) for n, each in placed.items()}
    starts = {path.stem: (path, guess) for path, guess in zip(recordings, guesses, strict=True)}
    poses = {name: each.pose for name, each in placed.items()}
    swapped = swapped_guesses(poses, solved.pairs, starts, used, partial(single, reporter=SILENT))
    placed = {name: each for name, each in placed.items() if name not in swapped}
    if swapped and not placed | confirmed:
        raise NoAnswerError(by_name(swapped), hint="give guesses in the order of recordings")
    found = {name: (placed | confirmed)[name] for name in used if name in placed | confirmed}
    warn_unobservable(found.values(), scanned=check is not None, reporter=reporter)
    texts = {name: error.message for name, error in refused.items()} | solved.refused | swapped
    unanswered = {name: text for name, text in texts.items() if name not in found}
    return JointCalibration(found=found, refused=unanswered, pairs=solved.pairs)


def _warn_unmatched(solved: Solved, reporter: Reporter) -> None:
    """Warn of sensors with a pose but without correspondences."""
    for name, reason in solved.unmatched.items():
        if name in solved.poses:
            reporter.warn("{}: {}", name, reason)


def _confirmed_by_scan(
    refused: Mapping[str, tuple[Localization, ...]],
    recordings: Mapping[str, Path],
    check_pose: Callable[[Path, Pose], ScanCheck],
) -> dict[str, Localization]:
    """Return the unambiguous localizations of refused sensors that the scan check confirms."""
    unambiguous = {name: answers[0] for name, answers in refused.items() if len(answers) == 1}
    checks = {name: check_pose(recordings[name], found.pose) for name, found in unambiguous.items()}
    return {
        name: unambiguous[name].with_scan_check(check)
        for name, check in checks.items()
        if check.verdict == CONFIRMS
    }


def _localize_each(
    recordings: Sequence[Path],
    localizers: Sequence[Callable[[Path], Localization]],
    reporter: Reporter,
) -> tuple[dict[str, tuple[Localization, ...]], dict[str, NoAnswerError]]:
    """Localize each sensor by itself; return localizations (several if ambiguous), and refusals.

    Raises
    ------
    NoAnswerError
        If no sensor has an unambiguous localization.
    """
    answers: dict[str, tuple[Localization, ...]] = {}
    refused: dict[str, NoAnswerError] = {}
    for done, (recording, localize_sensor) in enumerate(zip(recordings, localizers, strict=True)):
        reporter.progress(_STAGE, done, len(recordings) + 1)
        try:
            answers[recording.stem] = (localize_sensor(recording),)
        except AmbiguousError as error:
            answers[recording.stem] = error.answers
            refused[recording.stem] = error
        except NoAnswerError as error:
            refused[recording.stem] = error
    reporter.progress(_STAGE, len(recordings), len(recordings) + 1)
    if all(name in refused for name in answers):
        raise NoAnswerError(Text("; ").join(error.message for error in refused.values()),
                            hint="at least one sensor must have an answer of its own")  # fmt: skip
    return answers, refused


@dataclass(frozen=True)
class _Named(Reporter):
    """Reporter that forwards progress, and messages with the sensor's name prefixed."""

    name: str
    reporter: Reporter

    def progress(self, stage: str, done: int, total: int | None) -> None:
        self.reporter.progress(stage, done, total)

    def log(self, message: str, level: Level = "info") -> None:
        self.reporter.log(Text("{}: {}", self.name, message), level)


def _check_named(
    recording: Path, pose: Pose, *, scans: Sequence[str | Path], scan_crs: Any, reporter: Reporter
) -> ScanCheck:
    """Check a sensor's pose against the scan; messages name the sensor."""
    named = _Named(pose.sensor, reporter)
    return check_against_scan(recording, pose, scans, scan_crs=scan_crs, reporter=named)


def adjust_poses(
    recordings: Mapping[str, Path | Sequence[Path]],
    poses: Mapping[str, tuple[Pose, ...]],
    roads: LaneletMap,
    road_points: Floats,
    *,
    end: float | None = None,
    clocks: Mapping[str, SensorClock] | None = None,
    reporter: Reporter = QUIET,
) -> Solved:
    """Adjust poses of sensors by the vehicles that they see at the same time.

    Parameters
    ----------
    recordings : mapping of str to Path or sequence of Path
        By sensor.
    poses : mapping of str to tuple of Pose
        By sensor: its pose by single localization with covariance, or several that fit alike.
    roads, road_points
        As for :func:`gis_radar.localize`.
    end : float, optional
        End of the 100 s of the recordings that are used, UNIX seconds; by default the first 100 s
        in which most sensors recorded.
    clocks : mapping of str to SensorClock, optional
        Measured clocks, to correct the times of their sensors.
    reporter : Reporter
        Receives progress and remarks.

    Returns
    -------
    Solved
        No sensor has a pose where all contradict each other. Sensors whose recordings cannot be
        read have no correspondences.
    """
    corrections = {name: (clocks or {}).get(name, NO_OFFSET) for name in recordings}
    paths = {name: [each] if isinstance(each, Path) else each for name, each in recordings.items()}
    reasons: dict[str, str] = {}
    spans: dict[str, list[Span]] = {name: [] for name in paths}
    for name, sensor_paths in paths.items():
        for path in sensor_paths:
            with _note_error(reasons, name):
                spans[name].append(read_span(path, corrections[name]))
    until = best_end(spans, _COMMON_S) if end is None else end
    stations = []
    for done, (name, sensor_spans) in enumerate(spans.items()):
        reporter.progress(_READING, done, len(spans))
        overlapping = [each for each in sensor_spans if each.shared_s(until - _COMMON_S, until)]
        moving = read_until([], until)
        with _note_error(reasons, name):
            moving = read_until(overlapping, until, corrections[name])
        if not moving.frames:
            reasons.setdefault(name, _AWAY)
        clock_s = _known_sigma_s(corrections[name])
        stations.append(Station(name=name, moving=moving, poses=poses[name], clock_s=clock_s))
    refuse_equal({each.name: each.moving for each in stations})
    reporter.progress(_READING, len(spans), len(spans))
    places = np.array([pose.position[:2] for each in stations for pose in each.poses])
    lanes = _lanes_of_all([each.moving for each in stations], places, roads, road_points)
    solved = solve_network(stations, lanes)
    for remark in solved.remarks:
        reporter.warn(remark)
    unmatched = {name: reasons.get(name, text) for name, text in solved.unmatched.items()}
    return replace(solved, unmatched=unmatched)


def _lanes_of_all(
    moving: Sequence[Moving],
    places: Floats,
    roads: LaneletMap,
    road_points: Floats,
) -> Lanes:
    """Return the lanes within reach of any of several sensors.

    Parameters
    ----------
    moving : sequence of Moving
        Moving detections of each sensor.
    places : (n, 2) array
        Possible places of the sensors, easting and northing.
    roads, road_points
        As for :func:`gis_radar.localize`.
    """
    middle = places.mean(axis=0)
    ranges_m = [np.hypot(*each.points[:, :2].T) for each in moving if len(each)]
    seen_m = max((float(np.percentile(each, 99.5)) for each in ranges_m), default=0.0)
    spread_m = float(np.hypot(*(places - middle).T).max())
    return sample_lanes(
        roads.lanelets, road_points,
        place=middle, reach_m=spread_m + seen_m + MARGIN_M,
    )  # fmt: skip


def _known_sigma_s(clock: SensorClock) -> float | None:
    """Return the standard deviation of a measured clock, seconds; None where it is not known."""
    is_known = clock is not NO_OFFSET and math.isfinite(clock.sigma_s)
    return clock.sigma_s if is_known else None


@contextmanager
def _note_error(reasons: dict[str, str], name: str) -> Iterator[None]:
    """Record an InputError of one sensor in `reasons` instead of raising it."""
    try:
        yield
    except InputError as error:
        reasons[name] = error.message


def _check_counts(
    paths: Sequence[Path],
    guesses: Sequence[Any],
    headings: Sequence[Any] | None,
    compasses: Sequence[Any] | None,
) -> None:
    if len(paths) < 2:
        raise UsageError(
            "{} recording, at least two are needed",
            len(paths),
            hint=Text("leave out {}", "--together"),
        )
    refuse_both(headings, compasses)
    given = {"guesses": guesses, "headings": headings, "compasses": compasses}
    for what, values in given.items():
        if values is not None and len(values) != len(paths):
            raise UsageError(
                "{} recordings, but {} {}", len(paths), len(values), what, hint="one each, in order"
            )
    names = [path.stem for path in paths]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(
            "two recordings are of {}", twice, hint="sensors are named after their files"
        )


def _with_pose(found: Localization, pose: Pose) -> Localization:
    observable = bool(pose.evidence.get("observable", found.observable))
    return replace(found, pose=pose, observable=observable)


def _result_line(pose: Pose) -> str:
    check, scale = pose.evidence.get("scan_check"), pose.evidence.get("range_scale")
    parts = [gain_line(pose)]
    if isinstance(scale, Mapping):
        parts.append(Text("scale of range {:.3f} ± {:.3f}", scale["factor"], scale["sigma"]))
    if check:
        parts.append(f"scan check: {check['verdict']}")
    return Text("; ").join(parts)


def gain_line(pose: Pose) -> str:
    """Return a line with a pose's sigma, alone and together, and its number of correspondences."""
    sigma, together = pose.parsed_evidence().sigma, pose.evidence.get("together")
    position = Text("position ± {:.2f} m", np.hypot(sigma["easting"], sigma["northing"]))
    turn = Text("yaw ± {:.2f} deg", sigma["yaw"])
    if together is None:
        return Text("{}, {}; alone", position, turn)
    before = {name: value["before"] for name, value in together["gained"].items()}
    return Text(
        "{} (alone {:.2f}), {} (alone {:.2f}); {} vehicles shared with {}",
        position,
        np.hypot(before["easting"], before["northing"]),
        turn,
        before["yaw"],
        together["pairs"],
        ", ".join(together["sensors"]),
    )
