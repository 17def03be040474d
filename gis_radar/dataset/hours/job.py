"""Hour job: make an hour's parts from the rows of all recordings in the hour's window.

The parts follow from the rows in the window, the poses, sights, tiles and settings, and from
nothing else: no file, no other hour.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import geopandas as gpd
import numpy as np
import pandas as pd

from gis_radar.base import InputError, Integers
from gis_radar.dataset.files import tables
from gis_radar.dataset.files.parts import Origin
from gis_radar.dataset.files.records import HourWriter
from gis_radar.hdmap import LaneGraph, TileGrid
from gis_radar.measures import (
    LONGEST_VALID_STEPS,
    Filters,
    HitTarget,
    HourWindow,
    PlacedRecording,
    PoseSight,
    RecordingCounts,
    SensorHour,
    ValidFrames,
    frame_columns,
    observed_runs,
    read_sensor,
    sorted_hits,
    valid_runs,
    valid_steps,
)
from gis_radar.recordings import detection_keys, keys_in_common
from gis_radar.scans import SightTiles
from gis_radar.tracking import BLOCK_MARGIN_STEPS, HourVehicles, vehicles_of_hour

HOUR_METHOD = 18
"""Raised whenever the same inputs would give other parts."""

MOST_EQUAL_FRAMES = 5  # equal frames of two sensors that may be chance
# Detections of a frame that is not equal to an earlier one of its sensor by chance
_LEAST_RICH = 10
_LEAST_COMPARED = 2  # least detections of frames that are compared: fewer may be equal by chance
# Numbers of detections of so many frames, so many of them different, are not alike by chance
_FRAMES_ALIKE, _LEAST_NUMBERS, _MOST_ALIKE = 16, 6, 50


@dataclass(frozen=True, kw_only=True)
class MeasureSettings:
    """Settings in effect for all hours of a dataset.

    Parameters
    ----------
    filters : Filters
        Filters of the detections that count as hits.
    vehicles : bool
        Whether vehicles are looked for.
    """

    filters: Filters = field(default_factory=Filters)
    vehicles: bool = True

    @property
    def margin(self) -> int:
        """Number of steps on either side of an hour from which its parts follow, too."""
        return max(LONGEST_VALID_STEPS, 2 * BLOCK_MARGIN_STEPS if self.vehicles else 0)

    def as_dict(self) -> dict[str, Any]:
        """Return all settings as the manifest holds them."""
        return dict(json.loads(json.dumps(asdict(self))))

    @classmethod
    def from_dict(cls, known: Mapping[str, Any]) -> Self:
        """Return the settings of a manifest; its other entries are ignored."""
        filters = dict(known["filters"])
        if filters["clearance"] is not None:
            filters["clearance"] = tuple(filters["clearance"])
        return cls(filters=Filters(**filters), vehicles=bool(known["vehicles"]))


@dataclass(frozen=True, kw_only=True)
class HourSite:
    """Inputs that all hours of a dataset have in common.

    Parameters
    ----------
    folder : Path
        Folder of the dataset.
    tiles : GeoDataFrame
        All tiles, by ascending id.
    graph : LaneGraph, optional
        The lanes; without them, no vehicles are looked for.
    origin : (int, int)
        Easting and northing from which tracks count, whole metres.
    settings : MeasureSettings
        Settings in effect.
    """

    folder: Path
    tiles: gpd.GeoDataFrame
    graph: LaneGraph | None
    origin: tuple[int, int]
    settings: MeasureSettings

    @cached_property
    def target(self) -> HitTarget:
        """The tiles and filters by which detections become hits."""
        road = SightTiles.of(self.tiles)
        return HitTarget(
            road=road, grid=TileGrid(road.quads), filters=self.settings.filters,
            rcs=self.settings.vehicles or self.settings.filters.min_rcs is not None,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class MadeHour:
    """Result of an hour besides its parts.

    Parameters
    ----------
    hour : int
        The hour since 1970.
    evidence : dict
        Counts by the path of the recording.
    vehicles : int
        Number of vehicles.
    on_lanes : list of DataFrame
        Places at which sensors see vehicles on their lanes.
    """

    hour: int
    evidence: dict[str, RecordingCounts]
    vehicles: int
    on_lanes: list[pd.DataFrame]


def make_hour(
    site: HourSite,
    hour: int,
    sources: Sequence[PlacedRecording],
    validity_s: Mapping[str, float],
    *,
    processes: int = 1,
) -> MadeHour:
    """Make the parts of an hour, and write them.

    Parameters
    ----------
    site : HourSite
        Inputs that all hours have in common.
    hour : int
        The hour since 1970.
    sources : sequence of PlacedRecording
        All recordings that reach into the window, those of a sensor by their first frame.
    validity_s : mapping
        By sensor, how long its frames are valid, seconds.
    processes : int
        Number of blocks of the hour in which vehicles are looked for in parallel.

    Raises
    ------
    InputError
        If a recording is damaged, two of one sensor differ in the time that both hold, or two
        sensors delivered the same frames.
    """
    window = HourWindow(hour=hour, margin=site.settings.margin)
    sensors = read_sensors(site, window, sources)
    evidence = {
        source.recording.path.as_posix(): counted
        for sensor in sensors
        for source, counted in zip(sensor.sources, sensor.evidence, strict=True)
    }
    sensors = [sensor for sensor in sensors if len(sensor.frames)]
    valid = [ValidFrames.of(each, valid_steps(validity_s[each.sensor])) for each in sensors]
    sight_runs = valid_runs(sensors, valid, window)
    sights = {each.name: each for sensor in sensors for each in sensor.sights}
    origin = Origin(
        fingerprint=site.target.road.fingerprint, method=HOUR_METHOD,
        inputs=digest_of_inputs(sensors, site.settings, validity_s),
    )  # fmt: skip
    vehicles, on_lanes = 0, list[pd.DataFrame]()
    with HourWriter(folder=site.folder, hour=hour, origin=origin) as writer:
        _write_hits(writer, sensors, valid, sight_runs, sights, site, window)
        # The counts of five sensors in an hour take 170 MB, and vehicles do not need them.
        sensors = [replace(each, counted=each.counted[:0].copy(), tile=[]) for each in sensors]
        if site.settings.vehicles and site.graph is not None:
            tracked = vehicles_of_hour(
                sensors, window, valid_runs=sight_runs, tiles=site.tiles, sights=sights,
                graph=site.graph, processes=processes,
            )  # fmt: skip
            _write_vehicles(writer, tracked, site.origin)
            vehicles, on_lanes = len(tracked.vehicles), tracked.on_lanes
    return MadeHour(hour=hour, evidence=evidence, vehicles=vehicles, on_lanes=on_lanes)


def read_sensors(
    site: HourSite,
    window: HourWindow,
    sources: Sequence[PlacedRecording],
    *,
    count_hits: bool = True,
) -> list[SensorHour]:
    """Read what all sensors delivered in a window, and refuse frames that contradict each other.

    Parameters and errors are those of :func:`make_hour`; if `count_hits` is False, frames are only
    compared.
    """
    by_sensor: dict[str, list[PlacedRecording]] = {}
    for source in sources:
        by_sensor.setdefault(source.track.sensor, []).append(source)
    sensors = [
        read_sensor(found, window, site.target, count_hits=count_hits)
        for _, found in sorted(by_sensor.items())
    ]
    refuse_equal_frames(sensors)
    _count_repeated(sensors)
    return sensors


def _count_repeated(sensors: Sequence[SensorHour]) -> None:
    """Count for each recording the frames that are equal to an earlier one of their sensor."""
    for each in sensors:
        rich = np.flatnonzero(each.frames.detections >= _LEAST_RICH)
        first = rich[np.unique(each.frames.hash[rich], return_index=True)[1]]
        repeated = np.bincount(each.source[np.setdiff1d(rich, first)], minlength=len(each.evidence))
        for counts, number in zip(each.evidence, repeated.tolist(), strict=True):
            counts.repeated = number


def refuse_equal_frames(sensors: Sequence[SensorHour]) -> None:
    """Refuse two sensors with the same frames, as if one recording were given for both.

    Raises
    ------
    InputError
        If there are two such sensors.
    """
    by_name = {each.sensor: each for each in sensors}
    keys = {
        name: each.frames.hash[each.frames.detections >= _LEAST_COMPARED]
        for name, each in by_name.items()
    }
    for name, other, equal in keys_in_common(keys):
        if len(equal) > MOST_EQUAL_FRAMES:
            first, second = (
                each.sources[int(each.source[np.flatnonzero(each.frames.hash == equal[0])[0]])]
                for each in (by_name[name], by_name[other])
            )
            raise InputError(
                "{}: {:,} frames of {} are those of {} in {}",
                second.recording.path, len(equal), other, name, first.recording.path,
                hint="give each sensor its own recording",
            )  # fmt: skip
    for name, other in _sensors_alike(by_name):
        raise InputError(
            "{}: its frames have the numbers of detections of those of {}, one after the other: is "
            "{} a copy with other times or places?",
            by_name[other].sources[0].recording.path, name, other,
            hint="give each sensor its own recording",
        )  # fmt: skip


def _sensors_alike(sensors: Mapping[str, SensorHour]) -> Iterator[tuple[str, str]]:
    """Yield two sensors whose frames have the same numbers of detections, one after the other.

    A copy whose values were changed keeps these numbers.
    """
    keys = {}
    for name, each in sensors.items():
        numbers = each.frames.detections
        runs = np.lib.stride_tricks.sliding_window_view(
            np.pad(numbers, (0, _FRAMES_ALIKE)), _FRAMES_ALIKE
        )
        different = 1 + np.count_nonzero(np.diff(np.sort(runs, axis=1), axis=1), axis=1)
        keys[name] = detection_keys(runs[different >= _LEAST_NUMBERS])
    for name, other, alike in keys_in_common(keys):
        if len(alike) > _MOST_ALIKE:
            yield name, other


def digest_of_inputs(
    sensors: Sequence[SensorHour], settings: MeasureSettings, validity_s: Mapping[str, float]
) -> str:
    """Return the digest of all inputs of an hour's parts but tiles and method.

    It is equal for equal rows in the window, in however many files they come.
    """
    digest = hashlib.sha256(json.dumps(settings.as_dict(), sort_keys=True).encode())
    for sensor in sensors:
        digest.update(f"{sensor.sensor} {validity_s[sensor.sensor]!r}".encode())
        numbers: dict[str, int] = {}
        number = np.empty(len(sensor.frames), np.int64)
        for k, source in enumerate(sensor.sources):
            in_source = sensor.source == k
            for index in np.unique(sensor.pose[in_source]).tolist():
                text = _placing_text(source, index)
                number[in_source & (sensor.pose == index)] = numbers.setdefault(text, len(numbers))
        digest.update(json.dumps(list(numbers)).encode())
        for column in (number, sensor.frames.time_us, sensor.frames.hash):
            digest.update(column.tobytes())
    return digest.hexdigest()


def _placing_text(source: PlacedRecording, index: int) -> str:
    """Return a pose, its sight and the clock as text, equal where all of them are."""
    pose_sight = source.sights[index]
    clock = None if source.clock is None else asdict(source.clock)
    sight = hashlib.sha256(pose_sight.tile_id.tobytes()).hexdigest()
    return json.dumps(
        [source.track.poses[index].as_dict(), pose_sight.name, pose_sight.road_m, sight, clock],
        sort_keys=True,
    )


def _write_hits(
    writer: HourWriter, sensors: Sequence[SensorHour], valid: Sequence[ValidFrames],
    sight_runs: pd.DataFrame, sights: Mapping[str, PoseSight], site: HourSite, window: HourWindow,
) -> None:  # fmt: skip
    ids = site.target.road.tile_id
    pairs = zip(sensors, valid, strict=True)
    writer.write(tables.FRAMES, (frame_columns(each, frames, window) for each, frames in pairs))
    writer.write(tables.HITS, sorted_hits(sensors, valid, ids, window))
    tile, first, last = observed_runs(sight_runs, sights, ids, window)
    writer.write(tables.OBSERVED, {"tile_id": ids[tile], "first_step": first, "last_step": last})


def _write_vehicles(writer: HourWriter, tracked: HourVehicles, origin: tuple[int, int]) -> None:
    tracks, on_lanes = tracked.tracks, tracked.tracks["lanelet_id"].notna().to_numpy()
    placed = {
        name: np.ma.masked_array(_hundredths(tracks[of].fillna(0.0)), ~on_lanes)
        for name, of in (("s_cm", "s_m"), ("d_cm", "d_m"))
    }
    lanelet = tracks["lanelet_id"].fillna(0).to_numpy(np.int64)
    writer.write(
        tables.TRACKS,
        {
            "vehicle": tracks["vehicle"], "step": tracks["step"],
            "x_cm": _hundredths(tracks["easting"] - origin[0]),
            "y_cm": _hundredths(tracks["northing"] - origin[1]),
            "heading_cdeg": _hundredths(tracks["heading"]),
            "speed_cms": _hundredths(tracks["speed"]),
            "lanelet_id": np.ma.masked_array(lanelet, ~on_lanes), **placed, "seen": tracks["seen"],
        },
    )  # fmt: skip
    writer.write(tables.VEHICLES, tracked.vehicles)
    writer.write(tables.CONTINUED, tracked.continued)
    speed = _hundredths(tracked.passages["speed"])
    writer.write(tables.PASSAGES, tracked.passages.assign(speed_cms=speed))
    writer.write(tables.OCCUPIED, tracked.occupied)
    writer.write(tables.VISIBLE, tracked.visible)


def _hundredths(values: pd.Series) -> Integers:
    return np.rint(values.to_numpy(np.float64) * 100.0).astype(np.int64)
