"""Recipes from files to files, which commands share with the stages of a site.

Further options are passed to the library's function named in each docstring. Each recipe imports
what it calls, so that a command loads only the rooms that it uses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gis_radar.base import (
    GisRadarError,
    InputError,
    Reporter,
    Text,
    UsageError,
    name_of,
    require_same,
)
from gis_radar.poses import Pose, PoseTrack

if TYPE_CHECKING:
    import geopandas as gpd

    from gis_radar.calibration import SensorClock
    from gis_radar.dataset import Dataset
    from gis_radar.scans import MovingHits, Sight, SightSource, SightTiles

AUTO = "auto"  # offsets of clocks are measured in the recordings


def split_map(
    map_file: Path, output: Path, *, road: Path | None = None, reporter: Reporter,
    crs: str | None = None, origin: tuple[float, float] | None = None,
    streets: Path | None = None, street_field: str | None = None, **options: Any,
) -> dict[str, Any]:  # fmt: skip
    """Split the lanes of a map into tiles and write them; return figures.

    Tiles take their heights from the scanned road, if given; lanes without a street's name take it
    from the layer `streets`. Options are those of :func:`gis_radar.make_tiles`.
    """
    from gis_radar.hdmap import fingerprint, make_tiles, read_map, write_tiles
    from gis_radar.scans import read_road

    roads = read_map(map_file, crs=crs, origin=origin, reporter=reporter)
    points = None if road is None else read_road(road, roads.crs)
    table = make_tiles(roads, road=points, reporter=reporter, **options)
    ways = roads.lanes(streets=streets, street_field=street_field, reporter=reporter)
    tiled = ways[ways["lane"].isin(table["lane"])]
    stops = roads.stop_lines()
    write_tiles(table, output, problems=roads.problems, lanes=tiled, stop_lines=stops)
    actions = roads.problems["action"].value_counts()
    return {
        "crs": name_of(roads.crs),
        "lanelets": len(roads.lanelets),
        "lanelets_tiled": int(table["lanelet_id"].nunique()),
        "repaired": int(actions.get("repaired", 0)),
        "left_out": int(actions.get("left out", 0)),
        "problems": len(roads.problems),
        "lanes": len(tiled),
        "streets": int(tiled["street"].nunique()),
        "stop_lines": int(stops["stop_line"].nunique()),
        "tiles": len(table),
        "with_height": int(table["height_m"].notna().sum()),
        "fingerprint": fingerprint(table),
    }


def mask_scans(
    scans: Sequence[Path], map_file: Path, output: Path, *, reporter: Reporter,
    engine: str, scan_crs: str | None, **options: Any,
) -> tuple[list[Path], dict[str, Any]]:  # fmt: skip
    """Mask the road out of the scans and write it; return the files written, and figures.

    Options are those of :func:`gis_radar.scans.read_roads`.
    """
    from gis_radar.scans import mask_road, read_roads, require_road_name

    require_road_name(output)
    roads = read_roads(map_file, reporter=reporter, **options)
    road = mask_road(scans, roads, engine=engine, scan_crs=scan_crs, reporter=reporter)
    return road.write(output), road.figures()


def measure_site(
    sensors: Mapping[str, tuple[Sequence[Path], PoseTrack]], tile_file: Path, map_file: Path,
    output: Path, *, reporter: Reporter, accept: Sequence[str] = (), only: bool = True,
    **options: Any,
) -> tuple[Dataset, dict[str, GisRadarError]]:  # fmt: skip
    """Measure the recordings of several sensors, by name, without sensors that are refused.

    It returns the dataset, and the error of each sensor that was left out. Options are those of
    :func:`measure_recordings`.
    """
    from gis_radar.calibration import ImplausibleError

    left, refused = dict(sensors), dict[str, GisRadarError]()
    while True:
        recordings = [path for paths, _ in left.values() for path in paths]
        tracks = [track for paths, track in left.values() for _ in paths]
        try:
            made = measure_recordings(
                recordings, tracks, tile_file, map_file, output, only=only, reporter=reporter,
                accept=[name for name in accept if name in left], **options,
            )  # fmt: skip
        except ImplausibleError as error:
            found = error.findings
            if len(found) == len(left):
                kept = next((each for each in found if each.is_of_clocks), None)
                if kept is None:
                    raise
                # without other sensors, the offset of a clock does not matter: keep one
                found = tuple(each for each in found if each is not kept)
            for each in found:
                reporter.warn("{} is left out: {}", each.sensor, each.text_with_advice)
                refused[each.sensor] = each.refusal
                del left[each.sensor]
        except InputError as error:
            named = [n for n, (paths, _) in left.items() if _names_one(error.message, paths)]
            if not named or len(left) == 1:
                raise
            reporter.warn("{} is left out: {}", named[0], error.message)
            refused[named[0]] = error
            del left[named[0]]
        else:
            return made, refused


def _names_one(message: str, paths: Sequence[Path]) -> bool:
    """Return whether a message begins with the name of one of some files."""
    return any(message.startswith(f"{name}:") for path in paths for name in (path, path.resolve()))


def measure_recordings(
    recordings: Sequence[Path], tracks: Sequence[PoseTrack], tile_file: Path,
    map_file: Path | None, output: Path, *, filters: Mapping[str, Any],
    clocks: str | Path | None, reporter: Reporter, processes: int | None = None, **options: Any,
) -> Dataset:  # fmt: skip
    """Measure recordings, with the clocks of a file or, for `auto`, measured here.

    It returns the dataset. Options are those of :func:`gis_radar.measure`.
    """
    from gis_radar.base import workers_here
    from gis_radar.dataset import measure
    from gis_radar.hdmap import read_tiles
    from gis_radar.measures import Filters

    kept, tiles = Filters(**filters), read_tiles(tile_file)
    known = {} if clocks is None else _clocks(clocks, recordings, tracks, tiles, reporter)
    return measure(
        recordings, tracks, tiles, map_file, output,
        filters=kept, clocks=known, processes=processes or workers_here(), reporter=reporter,
        **options,
    )  # fmt: skip


def see_tiles(
    tracks: Sequence[PoseTrack], tile_file: Path, output: Path, *, scans: Sequence[Path],
    scan_crs: str | None, recordings: Sequence[Path], reporter: Reporter,
) -> dict[str, Any]:  # fmt: skip
    """Write the sights of sensors, corrected by recordings if given; return figures by sensor.

    Recordings with equal poses are added up. The figures of a sensor are those of its last pose.

    Raises
    ------
    UsageError
        If recordings are given, but not as many as poses.
    """
    from gis_radar.hdmap import read_tiles
    from gis_radar.scans import (
        SightTiles,
        find_contradictions,
        open_sight,
        report_contradictions,
        report_uncovered,
        write_sights,
    )

    if recordings and len(recordings) != len(tracks):
        raise UsageError("{} recordings, but {} poses", len(recordings), len(tracks))
    tiles = read_tiles(tile_file)
    for track in tracks:
        what = Text("the pose of {}", track.sensor)
        require_same(track.poses[0].crs, tiles.crs, what=what, other_what="the tiles")
    road = SightTiles.of(tiles)
    source = open_sight(road, scans=scans, scan_crs=scan_crs, reporter=reporter)
    different = [
        track for k, track in enumerate(tracks)
        if not any(track.poses == each.poses for each in tracks[:k])
    ]  # fmt: skip
    found, place_of = _sights(different, road, source)
    report_uncovered(found, reporter)
    hits = []
    for track in different if recordings else ():
        pairs = zip(recordings, tracks, strict=True)
        mine = [recording for recording, each in pairs if each.poses == track.poses]
        hits += _moving_hits(
            mine, track, {id(sight.pose): sight for sight in found}, road, reporter
        )
    compared = find_contradictions(hits, road)
    report_contradictions(compared, reporter)
    by_place = {id(each.sight.pose): each for each in compared}
    written = [
        by_place[id(place)].corrected(sight) if id(place) in by_place else sight
        for sight, place in zip(found, place_of, strict=True)
    ]
    written.sort(key=lambda sight: sight.pose.sensor)  # equal files for any order of the input
    write_sights(written, tiles, output, contradictions=compared)
    figures = {each.pose.sensor: each.figures() for each in written}
    for each in compared:
        figures[each.sight.pose.sensor]["contradicted"] = each.tiles
    return figures


def _sights(
    tracks: Sequence[PoseTrack], road: SightTiles, source: SightSource | None
) -> tuple[list[Sight], list[Pose]]:
    """Return the different sights of tracks, and for each the first pose at its place."""
    from gis_radar.measures import places_of, standing_for
    from gis_radar.scans import find_sight

    found: list[Sight] = []
    place_of: list[Pose] = []
    for track in tracks:
        heads, first = np.unique(standing_for(track.poses)).tolist(), places_of(track.poses)
        found += [find_sight(track.poses[head], road, source) for head in heads]
        place_of += [track.poses[first[head]] for head in heads]
    return found, place_of


def _moving_hits(
    recordings: Sequence[Path], track: PoseTrack, sights: Mapping[int, Sight], road: SightTiles,
    reporter: Reporter,
) -> list[MovingHits]:  # fmt: skip
    """Return the movement on tiles for each place of the sensor with enough frames."""
    from gis_radar.measures import count_movement, road_near, standing_for
    from gis_radar.scans import JUDGED_FRAMES, MovingHits

    standing = standing_for(track.poses).tolist()
    near = {k: road_near(sights[id(track.poses[k])], road) for k in dict.fromkeys(standing)}
    movement, frames = count_movement(
        recordings, track, road, [near[k] for k in standing], reporter
    )
    hits = [
        MovingHits(sight=sights[id(track.poses[k])], count=count, frames=frames[k])
        for k, count in movement.items()
    ]
    for each in hits:
        if each.frames < JUDGED_FRAMES:
            reporter.warn(
                "{}: {} frames from one place are too few to correct its sight by, {} are needed",
                track.sensor,
                each.frames,
                JUDGED_FRAMES,
            )
    return [each for each in hits if each.frames >= JUDGED_FRAMES]


def _clocks(
    source: str | Path, recordings: Sequence[Path], tracks: Sequence[PoseTrack],
    tiles: gpd.GeoDataFrame, reporter: Reporter,
) -> dict[str, SensorClock]:  # fmt: skip
    """Return clocks from a file, or measured in recordings; warn of sensors without one."""
    from gis_radar.calibration import measure_clocks, read_clocks

    if source == AUTO:
        found = measure_clocks(recordings, tracks, tiles, reporter=reporter)
        for sensor, text in found.figures().items():
            line = Text("clock of {}: {}", sensor, text)
            if sensor == "reference":
                line = Text("clocks are corrected to that of {}", text)
            reporter.log(line)
        clocks = dict(found.clocks)
    else:
        clocks = read_clocks(source)
    for sensor in sorted({track.sensor for track in tracks} - clocks.keys()):
        reporter.warn("the clock of {} is not corrected: its offset is not known", sensor)
    return clocks
