"""Check a site before its run: open the files that it names, and compare them with each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj import CRS

from gis_radar.base import (
    QUIET,
    SILENT,
    InputError,
    NoAnswerError,
    Reporter,
    Text,
    WarningList,
    iso_from_step,
    name_of,
    step_of,
    transformer,
    zone_of,
)
from gis_radar.calibration import (
    HEADS,
    Finding,
    LaneMap,
    RecordedSensor,
    SensorClock,
    check_plausibility,
    check_recordings,
    read_clocks,
    refuse_implausible,
)
from gis_radar.hdmap import LaneletMap, read_map
from gis_radar.poses import read_track
from gis_radar.recordings import (
    RangeCounts,
    Recording,
    format_of,
    known_formats,
    open_recording,
    time_warnings,
)
from gis_radar.scans import open_scan, read_road
from gis_radar.site.messages import error_in_site_words, in_site_words
from gis_radar.site.settings import Sensor, Site, read_site

# Farthest distance of a sensor from the nearest lane: the default range of a view. Beyond it, the
# map is of another place.
_NEAR_MAP_M = 300.0
# Recordings shorter than this are reported if the pose must be found: 100 s of traffic are a good
# length, half of that rarely suffices.
_LEAST_S = 60.0
# Greatest difference, hours, of a time zone from the sun's time at the site; the greatest in the
# world, in the west of China, is 3.2. With more, the zone is probably that of another place.
_ZONE_HOURS = 3.5
_ANGLE_SHARE = 0.999  # share of the detections within the measured view, as for its range


@dataclass(frozen=True, kw_only=True)
class SensorCheck:
    """Times, detections and measured view of a sensor's recordings.

    Parameters
    ----------
    begin, end : float
        First and last time, UNIX seconds; NaN where all recordings must be converted first.
    detections : int
        Number of detections.
    view : dict
        Measured `azimuth_deg`, `elevation_deg`, `max_range_m`; empty without detections.
    """

    begin: float
    end: float
    detections: int
    view: dict[str, float]

    def figures(self) -> dict[str, Any]:
        """Return figures by name."""
        if math.isnan(self.begin):
            return {"recordings": "converted by the run"}
        begin, end = (iso_from_step(int(step_of(np.array(t)))) for t in (self.begin, self.end))
        return {"begin": begin, "end": end, "detections": self.detections, **self.view}


@dataclass(frozen=True, kw_only=True)
class SiteCheck:
    """Result of a check of a site.

    Parameters
    ----------
    site : Site
        The site.
    crs : str
        Name of the map frame.
    lanelets : int
        Number of lanelets in the map.
    sensors : dict
        Check of each sensor's recordings, by name.
    findings : tuple of Finding
        Whether the given poses fit recordings and map, and what is wrong with recordings whose
        poses the run finds, by sensor.
    warnings : tuple of str
        Warnings to read before the run.
    """

    site: Site
    crs: str
    lanelets: int
    sensors: dict[str, SensorCheck]
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """Return figures by name."""
        return {
            "site": self.site.title,
            "crs": self.crs,
            "lanelets": self.lanelets,
            "sensors": {name: each.figures() for name, each in self.sensors.items()},
            **({"plausibility": self._table()} if self.findings else {}),
            "warnings": len(self.warnings),
        }

    def _table(self) -> list[list[str]]:
        return [list(HEADS), *(each.row for each in self.findings)]

    @property
    def failure(self) -> NoAnswerError | None:
        """Error that stops a run: sensors that do not fit and are not accepted; else None."""
        accepted = [each.name for each in self.site.sensor if each.accept]
        try:
            refuse_implausible(self.findings, accepted, SILENT)
        except NoAnswerError as error:
            error_in_site_words(error, self.site.timezone)
            return error
        return None


def check_site(path: str | Path, *, reporter: Reporter = QUIET) -> SiteCheck:
    """Check a site without running it: its file, map, scans, poses and recordings.

    Parameters
    ----------
    path : str or Path
        The site file, see :func:`read_site`.
    reporter : Reporter
        Receives progress, and all warnings.

    Returns
    -------
    SiteCheck
        The result, with the view that the detections of each sensor show.

    Raises
    ------
    InputError
        If the site file, the map, its streets, a scan, a pose or a recording is bad, or a guess is
        far from all lanes.

    Examples
    --------
    >>> import gis_radar as gr
    >>> found = gr.check_site(gr.sample_folder() / "SITE.toml")
    >>> found.lanelets, found.findings
    (48, ())
    """
    site = read_site(path)
    of_map = WarningList(shown=reporter)
    roads = read_map(
        site.map.file, crs=site.map.crs, origin=site.map.origin,
        reporter=of_map,
    )  # fmt: skip
    for line in of_map.warnings:
        reporter.warn(line)
    _check_scans(site, roads)
    for sensor in site.sensor:
        _refuse_far_sensor(sensor, roads)
    warnings = list(_zone_warning(site, roads))
    roads.lanes(
        streets=site.map.streets, street_field=site.map.street_field,
        reporter=WarningList(warnings=warnings),
    )  # fmt: skip
    sensor_checks: dict[str, SensorCheck] = {}
    recorded: dict[str, list[tuple[float, float, Path]]] = {}
    known = tuple(ending for each in known_formats() for ending in each.endings)
    for done, sensor in enumerate(site.sensor):
        reporter.progress("reading recordings", done, len(site.sensor))
        counts = _ViewCounts()
        for foreign in sensor.foreign:  # the run converts them, and refuses wrong content
            if not foreign.name.lower().endswith(known):
                format_of(str(foreign))  # raises, unless its content is of a known format
        readable = [path for path in sensor.recordings if path not in sensor.foreign]
        spans = [(*counts.add(open_recording(path)), path) for path in readable]
        sensor_checks[sensor.name] = _sensor_check(sensor, spans, counts, warnings)
        if spans:
            recorded[sensor.name] = spans
    reporter.progress("reading recordings", len(site.sensor), len(site.sensor))
    clocks = read_clocks(site.measure.clocks) if site.measure.clocks else {}
    warnings += time_warnings(
        {name: _corrected(spans, clocks.get(name)) for name, spans in recorded.items()}
    )
    findings = _check_poses(site, roads, clocks, reporter)
    accepted = {each.name for each in site.sensor if each.accept}
    warnings += [f.doubt for f in findings if f.doubt and (not f.refused or f.sensor in accepted)]
    folder = site.path.absolute().parent  # files are named from it, as in a run
    warnings = [in_site_words(line, site.timezone, folder) for line in warnings]
    for line in warnings:
        reporter.warn(line)
    return SiteCheck(
        site=site, crs=name_of(roads.crs), lanelets=len(roads.lanelets), sensors=sensor_checks,
        findings=findings, warnings=(*of_map.warnings, *warnings),
    )  # fmt: skip


def _corrected(
    spans: Sequence[tuple[float, float, Path]], clock: SensorClock | None
) -> list[tuple[float, float, Path]]:
    """Return spans of time as a right clock would have stamped them."""
    if clock is None:
        return list(spans)
    times = clock.corrected(np.array([span[:2] for span in spans])).tolist()
    return [(begin, end, path) for (begin, end), (*_, path) in zip(times, spans, strict=True)]


def _check_scans(site: Site, roads: LaneletMap) -> None:
    """Refuse scans that are bad, or none of which touches the map."""
    if site.scan is None:
        return
    west, south, east, north = (float(each) for each in roads.lanelets.total_bounds)
    if site.scan.road is not None:
        names, place = site.scan.road.name, read_road(site.scan.road, roads.crs)[:, :2]
        touches = bool(((place >= (west, south)) & (place <= (east, north))).all(axis=1).any())
    else:
        scans = [open_scan(path, crs=site.scan.crs) for path in site.scan.files]
        names = ", ".join(scan.path.name for scan in scans)
        touches = any(scan.touches((west, south, east, north), roads.crs) for scan in scans)
    if not touches:
        raise InputError(
            "{}: not where the map {} is",
            names,
            site.map.file.name,
            hint="choose the scans of the site, or their CRS with crs in [scan]",
        )


def _refuse_far_sensor(sensor: Sensor, roads: LaneletMap) -> None:
    """Refuse a guess or a pose that is far from all lanes."""
    if sensor.pose is not None:
        pose = read_track(sensor.pose).poses[0]
        if name_of(pose.crs) != name_of(roads.crs):
            raise InputError(
                "{}: is in {}, the map in {}",
                sensor.pose,
                name_of(pose.crs),
                name_of(roads.crs),
                hint="give the map the CRS of the pose with crs in [map]",
            )
        place = shapely.Point(pose.easting, pose.northing)
    else:
        place = shapely.Point((sensor.guess or ())[:2])
    far_m = float(shapely.distance(place, roads.lanelets.geometry.values).min())
    if far_m > _NEAR_MAP_M:
        raise InputError(
            "{} stands {:,.0f} m from the nearest lane of the map",
            sensor.name,
            far_m,
            hint="its position is in the CRS of the map; or this is the map of another place",
        )


def _check_poses(
    site: Site, roads: LaneletMap, clocks: Mapping[str, SensorClock], reporter: Reporter
) -> tuple[Finding, ...]:
    """Check given poses against recordings and map, and recordings alone where the run finds poses.

    What the run converts, it checks itself.
    """
    given, without_pose = dict[str, RecordedSensor](), dict[str, RecordedSensor]()
    for each in site.sensor:
        readable = [open_recording(path) for path in each.recordings if path not in each.foreign]
        if not readable:
            continue
        recorded = RecordedSensor(recordings=readable, clock=clocks.get(each.name))
        if each.pose is None:
            without_pose[each.name] = recorded
        else:
            given[each.name] = replace(recorded, tracks=[read_track(each.pose)] * len(readable))
    masked = site.scan and site.scan.road
    road = read_road(masked, roads.crs) if masked else np.empty((0, 3))
    lanes = LaneMap(lanelets=roads.lanelets, road=road)
    findings = check_plausibility(given, lanes, reporter=reporter) if given else ()
    if without_pose:
        findings = (*findings, *check_recordings(without_pose, reporter=reporter))
    return tuple(sorted(findings, key=lambda each: each.sensor))


def _zone_warning(site: Site, roads: LaneletMap) -> Iterator[str]:
    """Yield a warning where the time zone is probably that of another place."""
    west, south, east, north = roads.lanelets.total_bounds
    x, y = (west + east) / 2, (south + north) / 2
    longitude, _ = transformer(roads.crs, CRS.from_epsg(4326)).transform(x, y)
    offset = zone_of(site.timezone).utcoffset(datetime(2025, 1, 1))  # noqa: DTZ001 - of the zone
    hours = (offset.total_seconds() if offset else 0.0) / 3600.0
    off_hours = (hours - longitude / 15.0 + 12.0) % 24.0 - 12.0
    if abs(off_hours) > _ZONE_HOURS:
        yield Text(
            "timezone {} is {:.0f} hours from the sun at the site: choose the zone whose "
            "clocks people there follow",
            site.timezone,
            abs(off_hours),
        )


def _sensor_check(
    sensor: Sensor, spans: list[tuple[float, float, Path]], counts: _ViewCounts,
    warnings: list[str],
) -> SensorCheck:  # fmt: skip
    """Return the check of a sensor's recordings; add warnings to `warnings`."""
    if not spans:
        return SensorCheck(begin=math.nan, end=math.nan, detections=0, view={})
    longest = max(each[1] - each[0] for each in spans)
    if sensor.guess is not None and longest < _LEAST_S and not sensor.foreign:
        warnings.append(
            Text(
                "{}: {:.0f} s in one recording rarely suffice to find its pose, 100 s are a "
                "good length",
                sensor.name,
                longest,
            )
        )
    return SensorCheck(
        begin=min(each[0] for each in spans), end=max(each[1] for each in spans),
        detections=counts.detections, view=counts.view,
    )  # fmt: skip


class _ViewCounts:
    """Histograms of range, azimuth and elevation, counted in batches."""

    def __init__(self) -> None:
        self._range = RangeCounts()
        self._azimuth = np.zeros(181, np.int64)  # by whole degrees from the x axis
        self._elevation = np.zeros(181, np.int64)
        self.detections = 0

    def add(self, recording: Recording) -> tuple[float, float]:
        """Count a recording; return its first and last time, UNIX seconds."""
        first, last = math.nan, math.nan
        for batch in recording.read():
            first = float(batch.time[0]) if math.isnan(first) else first
            last = float(batch.time[-1])
            self._range.add(batch)
            x, y, z = batch.points[batch.present].T
            self.detections += len(x)
            self._azimuth += _count_by_degree(y, x)
            self._elevation += _count_by_degree(z[np.isfinite(z)], np.hypot(x, y)[np.isfinite(z)])
        return first, last

    @property
    def view(self) -> dict[str, float]:
        """Full angles (degrees) and range (m) that hold nearly all detections."""
        if not self.detections:
            return {}
        seen = {
            "azimuth_deg": 2.0 * _angle_holding(self._azimuth, _ANGLE_SHARE),
            "max_range_m": self._range.reached_m(),
        }
        if self._elevation.any():
            half = min(90.0, _angle_holding(self._elevation, _ANGLE_SHARE))
            seen["elevation_deg"] = 2.0 * half
        return seen


def _count_by_degree(across: Any, along: Any) -> Any:
    """Return how many detections are off the x axis by each whole degree, (181,)."""
    angle = np.abs(np.degrees(np.arctan2(across, along)))
    return np.bincount(angle.astype(np.int64), minlength=181)[:181]


def _angle_holding(counts: Any, share: float) -> float:
    """Return the angle, in whole degrees, that holds a share of the detections."""
    return min(180.0, float(np.searchsorted(np.cumsum(counts) / counts.sum(), share)) + 1.0)
