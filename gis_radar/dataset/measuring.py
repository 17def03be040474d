"""Measure a site: make the hours of a dataset, and make again those that recordings change."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np

from gis_radar.base import (
    QUIET,
    InputError,
    NoAnswerError,
    OutputError,
    Reporter,
    Text,
    UsageError,
    iso_from_step,
    name_of,
    replacing_folder,
    zone_of,
)
from gis_radar.calibration import (
    Finding,
    LaneMap,
    RecordedSensor,
    SensorClock,
    check_plausibility,
    lanelets_of,
    refuse_implausible,
)
from gis_radar.dataset.dataset import Dataset, open_dataset
from gis_radar.dataset.files.manifest import (
    Manifest,
    create_dataset,
    heights_digest,
    locked_for_writing,
    require_same_settings,
)
from gis_radar.dataset.files.pose_book import PoseBook
from gis_radar.dataset.files.registry import (
    RecordingEntry,
    Registry,
    entry_of,
    refuse_swapped,
    refuse_two_sensors,
    touched_hours,
)
from gis_radar.dataset.hours import remarks
from gis_radar.dataset.hours.job import HourSite, MadeHour, MeasureSettings
from gis_radar.dataset.hours.making import update_dataset
from gis_radar.hdmap import LaneGraph, LaneletMap, fingerprint, lane_graph, require_tiles
from gis_radar.measures import Filters, PlacedRecording, RecordingCounts, SightBook, validity_of
from gis_radar.poses import Pose, PoseTrack, as_tracks
from gis_radar.recordings import Recording, as_recordings
from gis_radar.scans import VIEW_ONLY, SightScan, SightTiles, open_sight
from gis_radar.tracking import map_of_tiles


@dataclass(frozen=True, kw_only=True)
class _Inputs:
    """Checked arguments of a call of `measure`: the site, and the recordings to add."""

    map_file: str | Path | None
    roads: LaneletMap | None
    manifest: Manifest
    tiles: gpd.GeoDataFrame
    graph: LaneGraph | None
    settings: MeasureSettings
    sources: dict[str, PlacedRecording]
    entries: list[RecordingEntry]
    poses: PoseBook
    book: SightBook
    findings: tuple[Finding, ...] = ()

    def manifest_with_findings(self, before: Manifest, registry: Registry) -> Manifest:
        """Return a manifest with the findings added; earlier ones of other recordings stay."""
        own_digests = {each.digest for each in self.entries}
        other_sensors = {each.sensor for each in registry.entries if each.digest not in own_digests}
        earlier = {name: each for name, each in before.findings.items() if name in other_sensors}
        records = {
            each.sensor: each.joined(earlier.get(each.sensor, each)).record
            for each in self.findings
        }
        return replace(before, checks=before.checks | records)


def measure(
    recordings: str | Path | Recording | Sequence[str | Path | Recording],
    poses: Pose | PoseTrack | str | Path | Sequence[Pose | PoseTrack | str | Path],
    tiles: gpd.GeoDataFrame,
    map: str | Path | None,  # noqa: A002 - the word of the contract
    folder: str | Path,
    *,
    scans: str | Path | Sequence[str | Path] = (),
    scan_crs: Any = None,
    sight_cache: str | Path | None = None,
    filters: Filters | None = None,
    cycles: Mapping[str, float] | None = None,
    clocks: Mapping[str, SensorClock] | None = None,
    hits_only: bool = False,
    only: bool = False,
    timezone: str = "UTC",
    before_hour: int | None = None,
    check: bool = True,
    accept: Collection[str] = (),
    processes: int = 1,
    reporter: Reporter = QUIET,
) -> Dataset:
    """Measure what happens on the tiles of a site, and write or add to a dataset.

    Detections are moved to the map and assigned to the tiles under them, once a tile and step; from
    the range rates of all sensors vehicles are followed, and what they occupy and hide. The hour is
    the unit: hours that recordings reach into are made (again), all others stay as they are.

    Parameters
    ----------
    recordings : one or a sequence
        Files, or what :func:`gis_radar.open_recording` returns.
    poses : one or a sequence of Pose, PoseTrack or their files
        As many as recordings, in order. A pose without a view gets the default one.
    tiles : GeoDataFrame
        From :func:`gis_radar.read_tiles`.
    map : str or Path, optional
        The Lanelet2 map from which the tiles were made; CRS and origin are taken from the tiles.
        Hits alone need none.
    folder : str or Path
        The dataset: a new one, or one of the same tiles to add to.
    scans : path or sequence of paths
        Airborne scans, whole and not masked: what stands in them hides tiles. Without them, all
        tiles in the view count as seen.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    sight_cache : str or Path, optional
        A folder in which the sights of the poses by the scans are kept for other calls.
    filters : Filters, optional
        Filters of the detections that count as hits; by default all do.
    cycles : mapping, optional
        Seconds from frame to frame, of sensors slower than 10 Hz.
    clocks : mapping, optional
        How far the clocks of sensors are ahead, by sensor.
    hits_only : bool
        Leave out the vehicles.
    only : bool
        Keep only these recordings in the dataset: others are withdrawn, and a dataset with other
        tiles or settings is made anew.
    timezone : str
        Time zone of the site, for a new dataset.
    before_hour : int, optional
        Make only hours before this one (since 1970); a later call makes the others, for which
        further recordings are expected.
    check : bool
        Check whether poses, recordings and map fit each other.
    accept : collection of str
        Names of sensors that are used although they do not fit.
    processes : int
        Number of hours, or of blocks of an hour, made in parallel.
    reporter : Reporter
        Receives progress and warnings.

    Returns
    -------
    Dataset

    Raises
    ------
    UsageError
        If there are not as many poses as recordings, or vehicles are asked for without a map.
    InputError
        If a recording is damaged, given for two sensors, or contradicts another; if the dataset has
        other tiles, another map or other settings; or if a recording that an hour needs is
        missing or changed.
    NoAnswerError
        If no sensor sees any tile; ImplausibleError where poses and recordings do not fit.
    OutputError
        If the dataset cannot be written, or another run is writing it.

    Examples
    --------
    >>> import gis_radar as gr
    >>> sample = gr.sample_folder()
    >>> tiles = gr.make_tiles(gr.read_map(sample / "junction.osm"))
    >>> pose = gr.read_pose(sample / "R1.json")
    >>> ds = gr.measure([sample / "R1.parquet"], [pose], tiles, sample / "junction.osm", "site")
    >>> ds.sensors
    ['R1']
    >>> gr.open_dataset("site").has_vehicles
    True
    >>> gr.make_traffic(ds, interval="1min").figures()["lanes"] > 10
    True
    """
    opened, tracks = as_recordings(recordings), as_tracks(poses)
    if len(opened) != len(tracks) or not opened:
        raise UsageError("{} recordings, but {} poses", len(opened), len(tracks))
    if map is None and not hits_only:
        raise UsageError(
            "vehicles need the map that the tiles were made from",
            hint=Text("give it by {}, or leave vehicles out by {}", "--map", "--hits-only"),
        )
    settings = MeasureSettings(filters=filters or Filters(), vehicles=not hits_only)
    zone_of(timezone)
    require_tiles(tiles, what="tiles")
    tiles = tiles.sort_values("tile_id", ignore_index=True)
    road = SightTiles.of(tiles)
    scan = open_sight(road, scans=scans, scan_crs=scan_crs, cache=sight_cache, reporter=reporter)
    book = SightBook(road=road, scan=scan)
    refuse_swapped(opened, tracks)
    sources = book.place(opened, tracks, clocks, reporter)
    given = _checked_inputs(sources, book, tiles, map, cycles, settings, timezone, reporter)
    if Manifest.is_there(folder := Path(folder)) and not only:  # the check of poses takes long
        _as_before(given, folder)
    if check:
        given = _with_findings(given, accept, reporter)
    for each in given.entries:
        for line in given.sources[each.path].track.warn_uncertain(each.first_time, each.last_time):
            reporter.warn(line)
    with locked_for_writing(folder, reporter):
        if only and Manifest.is_there(folder) and not Manifest.read(folder).is_as(given.manifest):
            made = _replace(given, folder, processes, reporter, before_hour=before_hour)
        else:
            made = _add(given, folder, processes, reporter, only=only, before_hour=before_hour)
    dataset = open_dataset(folder, reporter=reporter)
    if made:
        _remark_on_recordings(given, made, reporter)
        if given.roads is not None and dataset.has_vehicles:
            lanes = given.roads.lanes()
            remarks.remark_on_counting_lines(dataset, given.tiles, lanes, reporter)
    return dataset


def _checked_inputs(
    sources: Sequence[PlacedRecording], book: SightBook, tiles: gpd.GeoDataFrame,
    map_path: str | Path | None, cycles: Mapping[str, float] | None, settings: MeasureSettings,
    timezone: str, reporter: Reporter,
) -> _Inputs:  # fmt: skip
    """Check all arguments before anything is written."""
    roads, digest = None, ""
    if map_path is not None:
        roads, described = map_of_tiles(map_path, tiles, reporter)
        digest = described["digest"]
    sensors = sorted({source.track.sensor for source in sources})
    validity_s = validity_of(cycles, sensors)
    poses, entries = PoseBook(), list[RecordingEntry]()
    placed = dict[str, PlacedRecording]()
    for source in sources:
        name = source.track_name
        poses.tracks[name], poses.sights[name] = source.track, source.sights
        entries.append(entry_of(source, validity_s[source.track.sensor]))
        placed[entries[-1].path] = source
    entries = _without_duplicates(entries, reporter)
    _refuse_clearance(settings.filters, book.road, entries)
    graph, settings = _lane_graph(roads, settings, entries, reporter)
    manifest = manifest_of(tiles, digest, book.scan, settings, timezone)
    return _Inputs(
        map_file=map_path, roads=roads, manifest=manifest, tiles=tiles, graph=graph,
        settings=settings,
        sources=placed, entries=entries, poses=poses, book=book,
    )  # fmt: skip


def _with_findings(given: _Inputs, accept: Collection[str], reporter: Reporter) -> _Inputs:
    """Check whether poses, recordings and map fit; keep the findings for the manifest."""
    by_sensor: dict[str, list[PlacedRecording]] = {}
    for _, source in sorted(given.sources.items()):
        by_sensor.setdefault(source.track.sensor, []).append(source)
    sensors = {
        name: RecordedSensor(
            recordings=[each.recording for each in found],
            tracks=[each.track for each in found], clock=found[0].clock,
        )
        for name, found in by_sensor.items()
    }  # fmt: skip
    lanelets = lanelets_of(given.tiles) if given.roads is None else given.roads.lanelets
    lanes = LaneMap.of_tiles(lanelets, given.book.road)
    if unknown := sorted({*accept} - sensors.keys()):
        raise UsageError("{}: no sensor of that name is given", Text(", ").join(unknown))
    findings = check_plausibility(sensors, lanes, reporter=reporter)
    refuse_implausible(findings, accept, reporter)
    return replace(given, findings=tuple(_dated(each, given.entries) for each in findings))


def _dated(finding: Finding, entries: Sequence[RecordingEntry]) -> Finding:
    """Return a finding with the times of the recordings that it rests on."""
    steps = [step for each in entries if each.sensor == finding.sensor for step in each.steps]
    return replace(finding, since=iso_from_step(min(steps)), until=iso_from_step(max(steps)))


def manifest_of(
    tiles: gpd.GeoDataFrame, digest: str, scan: SightScan | None, settings: MeasureSettings,
    timezone: str,
) -> Manifest:  # fmt: skip
    """Return the manifest of a new dataset, given the map's digest and the source of its sights."""
    west, south = np.floor(tiles.total_bounds[:2]).astype(int).tolist()
    return Manifest(
        map=digest, fingerprint=fingerprint(tiles), crs=name_of(tiles.crs),
        origin=(west, south), timezone=timezone, heights=heights_digest(tiles),
        settings={"sight": scan.describe() if scan else VIEW_ONLY, **settings.as_dict()},
    )  # fmt: skip


def _refuse_clearance(
    filters: Filters, road: SightTiles, entries: Sequence[RecordingEntry]
) -> None:
    """Refuse a filter by clearance where road or detections have no heights."""
    if filters.clearance is None:
        return
    if np.isnan(road.height).all():
        raise InputError(
            "the tiles have no road heights, which the clearance filter needs",
            hint=Text("make the tiles with {}, or from a map with ele", "--road"),
        )
    for each in entries:
        if not each.has_elevation:
            raise InputError(
                "{}: the sensor measures no elevation (z is empty): a clearance means "
                "nothing for it",
                each.path,
                hint="leave the clearance away",
            )


def _without_duplicates(
    entries: Sequence[RecordingEntry], reporter: Reporter
) -> list[RecordingEntry]:
    """Return each recording once; refuse one that is given for two sensors."""
    by_digest: dict[str, RecordingEntry] = {}
    for entry in entries:
        first = by_digest.setdefault(entry.digest, entry)
        if first.sensor != entry.sensor:
            refuse_two_sensors(entry, first)
        if first is not entry:
            if not first.has_same_inputs(entry):
                raise InputError(
                    "{}: is given twice for {}, with different poses",
                    entry.path,
                    entry.sensor,
                    hint="give it once",
                )
            reporter.warn("{}: is the same as {}: it counts once", entry.path, first.path)
    return list(by_digest.values())


def _lane_graph(
    roads: LaneletMap | None, settings: MeasureSettings, entries: Sequence[RecordingEntry],
    reporter: Reporter,
) -> tuple[LaneGraph | None, MeasureSettings]:  # fmt: skip
    """Return lanes and settings; without vehicles where lanes or range rates are missing."""
    if not settings.vehicles or roads is None:
        return None, settings
    reason = ""
    try:
        graph = lane_graph(roads.lanelets)
    except NoAnswerError as error:
        reason = error.message
    if without_rates := [each.path for each in entries if not each.has_rates]:
        reason = Text("{}: has no range rates, by which vehicles are found", without_rates[0])
    if not reason:
        return graph, settings
    reporter.warn("{}: only hits are measured", reason)
    return None, replace(settings, vehicles=False)


def _replace(
    given: _Inputs, folder: Path, processes: int, reporter: Reporter, *, before_hour: int | None
) -> list[MadeHour]:
    """Make a dataset beside one with other tiles or settings, and replace that when complete."""
    with replacing_folder(folder) as fresh:
        return _add(given, fresh, processes, reporter, only=True, before_hour=before_hour)


def _add(
    given: _Inputs, folder: Path, processes: int, reporter: Reporter, *, only: bool,
    before_hour: int | None,
) -> list[MadeHour]:  # fmt: skip
    """Add recordings to a dataset; the caller is its only writer."""
    is_new = not Manifest.is_there(folder)
    manifest = given.manifest if is_new else Manifest.read(folder)
    given = given if is_new else _as_before(given, folder)
    before = Registry(folder=folder, fingerprint=manifest.fingerprint)
    before = before if is_new else Registry.read(folder, manifest.fingerprint)
    _remark_on_changes(before, given, manifest, reporter)
    registry = _merged_registry(before, given, only=only)
    with_findings = given.manifest_with_findings(manifest, registry)
    new_doubts = {name: with_findings.checks[name] for name in with_findings.doubts}
    doubted = replace(manifest, checks=manifest.checks | new_doubts)
    site = HourSite(
        folder=folder, tiles=given.tiles, graph=given.graph, origin=manifest.origin,
        settings=given.settings,
    )  # fmt: skip
    if is_new:
        try:
            create_dataset(
                folder, doubted, given.tiles, map_file=given.map_file, **_layers(given.roads)
            )
        except OutputError:  # a folder without a manifest is no dataset
            shutil.rmtree(folder, ignore_errors=True)
            raise
    elif doubted.checks != manifest.checks:
        doubted.write(folder)  # before the hours that are doubted
    try:
        made = update_dataset(
            site, before, registry, just_read=given.entries, before_hour=before_hour,
            processes=processes, reporter=reporter,
        )  # fmt: skip
    except (InputError, MemoryError):
        if is_new:  # leave no new folder behind
            shutil.rmtree(folder, ignore_errors=True)
        raise
    if with_findings.checks != doubted.checks:
        with_findings.write(folder)
    return made


def _remark_on_changes(
    before: Registry, given: _Inputs, manifest: Manifest, reporter: Reporter
) -> None:
    """Report recordings placed or timed otherwise than before, and a time zone that is kept."""
    by_digest = {each.digest: each for each in before.entries}
    for entry in given.entries:
        earlier = by_digest.get(entry.digest)
        if earlier is not None and not earlier.has_same_inputs(entry):
            reporter.log(
                Text("{}: is placed or timed otherwise than before: made again", entry.path)
            )
    if given.manifest.timezone not in {manifest.timezone, "UTC"}:
        reporter.warn("the dataset stays in the time zone {}", manifest.timezone)


def _layers(roads: LaneletMap | None) -> dict[str, gpd.GeoDataFrame]:
    """Return the layers beside the tiles."""
    if roads is None:
        return {}
    return {"problems": roads.problems, "lanes": roads.lanes(), "stop_lines": roads.stop_lines()}


def _as_before(given: _Inputs, folder: Path) -> _Inputs:
    """Refuse other settings than those of a dataset; leave out vehicles if it does."""
    before = Manifest.read(folder)
    if given.settings.vehicles and not before.settings.get("vehicles"):
        settings = replace(given.settings, vehicles=False)
        manifest = replace(given.manifest, settings=given.manifest.settings | {"vehicles": False})
        given = replace(given, settings=settings, manifest=manifest, graph=None)
    require_same_settings(folder, before, given.manifest)
    return given


def _merged_registry(before: Registry, given: _Inputs, *, only: bool) -> Registry:
    """Add what is given to the registry, and remove the hours that it touches."""
    margin = given.settings.margin
    paths = {each.path for each in given.entries}
    digests = {each.digest: each for each in given.entries}
    sights = {each.pose: each.sights for each in given.entries}
    kept, replaced, added = list[RecordingEntry](), list[RecordingEntry](), list(given.entries)
    for entry in before.entries:
        given_entry = digests.get(entry.digest)
        if given_entry is not None and given_entry.sensor != entry.sensor:
            refuse_two_sensors(given_entry, entry)
        if given_entry is not None and given_entry.has_same_inputs(entry):
            added.remove(given_entry)
            kept.append(replace(entry, path=given_entry.path))
        elif only or given_entry is not None or entry.path in paths:
            replaced.append(entry)
        else:  # sights of the same pose that differ replace its own
            kept.append(replace(entry, sights=sights.get(entry.pose, entry.sights)))
    entries = tuple(sorted([*kept, *added], key=lambda each: each.key))
    poses = before.poses.joined(given.poses).of(each.pose for each in entries)
    joined = replace(before, entries=entries, poses=poses)
    hours = touched_hours({*before.hours, *joined.hours}, [*replaced, *added], margin)
    return joined.without_hours(hours)


def _remark_on_recordings(given: _Inputs, made: Sequence[MadeHour], reporter: Reporter) -> None:
    """Warn about inconsistencies in given recordings all of whose hours were made."""
    examined = []
    hours = {hour.hour for hour in made}
    for entry in given.entries:
        if not hours.issuperset(entry.own_hours):
            continue
        evidence = RecordingCounts()
        for hour in made:
            evidence.add(hour.evidence.get(entry.path, RecordingCounts()))
        source = given.sources[entry.path]
        examined.append(remarks.Examined(entry=entry, source=source, evidence=evidence))
    given.book.report(reporter)
    remarks.remark_on_recordings(examined, given.book, reporter)
    if given.settings.vehicles:
        on_lanes = [table for hour in made for table in hour.on_lanes]
        count = sum(hour.vehicles for hour in made)
        remarks.remark_on_vehicles(count, on_lanes, reporter)
