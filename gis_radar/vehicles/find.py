"""Find vehicles in the recordings of a site, block by block, and write them as a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import geopandas as gpd

from gis_radar.clocks import SensorClock
from gis_radar.errors import UsageError
from gis_radar.lanelets.graph import lane_graph
from gis_radar.occupancy.frame_steps import holds_of
from gis_radar.occupancy.views import PlacedRecording, ViewBook, place_recordings
from gis_radar.poses.files import PoseTrack, as_track
from gis_radar.poses.pose import Pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.recordings.recording import Recording
from gis_radar.sight import SightTiles, describe_sight, open_sight
from gis_radar.tiles.tiles import fingerprint
from gis_radar.vehicles.blocks import ALWAYS, SourceReader
from gis_radar.vehicles.folder import Vehicles, read_vehicles, write_vehicles
from gis_radar.vehicles.hours import report_vehicles, write_driven
from gis_radar.vehicles.map_check import map_of_tiles
from gis_radar.vehicles.pieces import PieceMaker
from gis_radar.vehicles.provenance import Provenance
from gis_radar.vehicles.settings import DEFAULTS, VehicleSettings
from gis_radar.vehicles.tracker import vehicles_in
from gis_radar.vehicles.visibility import SensorView


def find_vehicles(
    recordings: Sequence[str | Path | Recording],
    poses: Sequence[Pose | PoseTrack],
    tiles: gpd.GeoDataFrame,
    map_path: str | Path,
    folder: str | Path,
    *,
    scans: Sequence[str | Path] = (),
    scan_crs: Any = None,
    sight: str | Path | None = None,
    sight_cache: str | Path | None = None,
    cycles: Mapping[str, float] | None = None,
    clocks: Mapping[str, SensorClock] | None = None,
    span: tuple[int, int] | None = None,
    settings: VehicleSettings = DEFAULTS,
    reporter: Reporter = QUIET,
) -> Vehicles:
    """Follow the vehicles that radars see, and say which tiles they covered when.

    All sensors are taken together. Memory does not grow with the length of the recordings: they
    are read in blocks of minutes that overlap.

    Parameters
    ----------
    recordings : sequence
        Files, or what :func:`gis_radar.recordings.recording.open_recording` returns; several of one
        sensor are read as one.
    poses : sequence of Pose or PoseTrack
        As many as recordings, in order. A pose without a view gets the default one.
    tiles : GeoDataFrame
        As from :func:`gis_radar.tiles.tiles.read_tiles`.
    map_path : str or Path
        The Lanelet2 map that the tiles were made from; its system and origin are the tiles'.
    folder : str or Path
        Where the vehicles go; it appears whole or not at all.
    scans : sequence of paths
        Airborne scans, whole and not masked: what stands in them hides tiles.
    scan_crs : CRS, str or int, optional
        The scans' coordinate system, for files without one.
    sight : str or Path, optional
        A file of :func:`gis_radar.write_sights`, in place of scans.
    sight_cache : str or Path, optional
        A folder in which what each pose sees by the scans is kept, for other calls.
    cycles : mapping, optional
        Seconds from frame to frame, of sensors slower than 10 Hz.
    clocks : mapping, optional
        How far the clocks of sensors are ahead, by sensor.
    span : (int, int), optional
        First and last step of a part of the recordings, at whole hours: only its vehicles are
        written, to be joined with those of other hours. What was a minute
        before and after helps to know them.
    settings : VehicleSettings
        Constants of the algorithms; written to the manifest.
    reporter : Reporter
        Receives progress and warnings.

    Returns
    -------
    Vehicles

    Raises
    ------
    UsageError
        If there are not as many poses as recordings.
    InputError
        If a recording is damaged or without range rates, a CRS differs, or the map is not that of
        the tiles.
    NoAnswerError
        If no sensor sees any tile, or no lanelet is for vehicles.
    """
    if len(recordings) != len(poses) or not recordings:
        raise UsageError(f"{len(recordings)} recordings, but {len(poses)} poses")
    tracks = [as_track(pose) for pose in poses]
    roads, described = map_of_tiles(map_path, tiles, reporter)
    graph = lane_graph(roads.lanelets)
    book = ViewBook(road=SightTiles.of(tiles))
    book.scan = open_sight(
        book.road,
        scans=scans,
        scan_crs=scan_crs,
        sight=sight,
        cache=sight_cache,
        reporter=reporter,
    )
    sources = place_recordings(recordings, tracks, book, clocks, reporter)
    book.report(reporter)
    reader = SourceReader(sources, graph, book.road_m, settings, reporter, span or ALWAYS)
    provenance = Provenance(
        fingerprint=fingerprint(tiles), map=described, sight=describe_sight(book.scan),
        hold_s=holds_of(cycles, reader.sensors), settings={"vehicles": asdict(settings)},
        sources=[],
    )  # fmt: skip
    makes = PieceMaker(graph, settings)
    with write_vehicles(
        folder, tiles=tiles, views=_sensor_views(sources, book), provenance=provenance,
        reporter=reporter,
    ) as writer:  # fmt: skip
        for block in reader.blocks():
            motions = vehicles_in(block.echoes, graph, settings)
            if block.begins and (margin := block.margin) is not None:
                writer.warm_up(makes.piece(margin, motions))
            writer.add(makes.piece(block, motions))
        writer.name_sources(reader.records())
        seen = makes.on_lanes(reader.sensors)
        if span is not None:
            write_driven(writer.folder, seen)
    for line in reader.warnings():
        reporter.log(line, "warning")
    found = read_vehicles(folder)
    if span is None:
        report_vehicles(found, seen, settings, reporter)
    return found


def _sensor_views(sources: Sequence[PlacedRecording], book: ViewBook) -> list[SensorView]:
    """Return where each sensor stood in each of its views."""
    found: dict[tuple[str, str], SensorView] = {}
    for source in sources:
        for pose, view in zip(source.track.poses, source.views, strict=True):
            made = SensorView(
                sensor=pose.sensor, view=view, tile_id=book.tiles[view], position=pose.position
            )
            found.setdefault((pose.sensor, view), made)
    return list(found.values())
