"""Recipes from files to files, which commands share with the stages of a site.

Further options are passed to the library's function named in each docstring. Rooms load when a
recipe uses them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gis_radar import calibration, dataset, hdmap, measures
from gis_radar import scans as scan_room
from gis_radar.base import (
    GisRadarError,
    InputError,
    Reporter,
    Text,
    name_of,
    require_same,
    seconds_from_iso,
    workers_here,
)
from gis_radar.poses import PoseTrack
from gis_radar.recordings import open_recording

_MOMENT_S = 60.0  # error of the moment from which on a sensor does not fit


def split_map(
    map_file: Path, output: Path, *, road: Path | None = None, reporter: Reporter,
    crs: str | None = None, origin: tuple[float, float] | None = None,
    streets: Path | None = None, street_field: str | None = None, **options: Any,
) -> dict[str, Any]:  # fmt: skip
    """Split the lanes of a map into tiles and write them; return figures.

    Tiles take their heights from the scanned road, if given; lanes without a street's name take it
    from the layer `streets`. Options are those of :func:`gis_radar.make_tiles`.
    """
    roads = hdmap.read_map(map_file, crs=crs, origin=origin, reporter=reporter)
    points = None if road is None else scan_room.read_road(road, roads.crs)
    tiles = hdmap.make_tiles(roads, road=points, reporter=reporter, **options)
    lanes = roads.lanes(streets=streets, street_field=street_field, reporter=reporter)
    tiled_lanes = lanes[lanes["lane"].isin(tiles["lane"])]
    stops = roads.stop_lines()
    hdmap.write_tiles(tiles, output, problems=roads.problems, lanes=tiled_lanes, stop_lines=stops)
    actions = roads.problems["action"].value_counts()
    return {
        "crs": name_of(roads.crs),
        "lanelets": len(roads.lanelets),
        "lanelets_tiled": int(tiles["lanelet_id"].nunique()),
        "repaired": int(actions.get("repaired", 0)),
        "left_out": int(actions.get("left out", 0)),
        "problems": len(roads.problems),
        "lanes": len(tiled_lanes),
        "streets": int(tiled_lanes["street"].nunique()),
        "stop_lines": int(stops["stop_line"].nunique()),
        "tiles": len(tiles),
        "with_height": int(tiles["height_m"].notna().sum()),
        "fingerprint": hdmap.fingerprint(tiles),
    }


def mask_scans(
    scans: Sequence[Path], map_file: Path, output: Path, *, reporter: Reporter,
    engine: str, scan_crs: str | None, **options: Any,
) -> tuple[list[Path], dict[str, Any]]:  # fmt: skip
    """Mask the road out of the scans and write it; return the files written, and figures.

    Options are those of :func:`gis_radar.scans.read_roads`.
    """
    scan_room.require_road_name(output)
    roads = scan_room.read_roads(map_file, reporter=reporter, **options)
    road = scan_room.mask_road(scans, roads, engine=engine, scan_crs=scan_crs, reporter=reporter)
    return road.write(output), road.figures()


def measure_site(
    sensors: Mapping[str, tuple[Sequence[Path], PoseTrack]], tile_file: Path, map_file: Path,
    output: Path, *, reporter: Reporter, accept: Sequence[str] = (), only: bool = True,
    **options: Any,
) -> tuple[dataset.Dataset, dict[str, GisRadarError]]:  # fmt: skip
    """Measure the recordings of several sensors, by name, without sensors that are refused.

    A sensor that fits until a moment, as before a knock, keeps its recordings from before that
    moment. Returned are the dataset, and the error of each sensor that was left out, in whole or
    in part. Options are those of :func:`measure_recordings`.
    """
    remaining, refused = dict(sensors), dict[str, GisRadarError]()
    while True:
        recordings = [path for paths, _ in remaining.values() for path in paths]
        tracks = [track for paths, track in remaining.values() for _ in paths]
        try:
            measured = measure_recordings(
                recordings, tracks, tile_file, map_file, output, only=only, reporter=reporter,
                accept=[name for name in accept if name in remaining], **options,
            )  # fmt: skip
        except calibration.ImplausibleError as error:
            findings = error.findings
            earlier = {e.sensor: _before(e.moment, remaining[e.sensor][0]) for e in findings}
            if len(findings) == len(remaining) and not any(earlier.values()):
                clock_only = next((each for each in findings if each.is_of_clocks), None)
                if clock_only is None:
                    raise
                # without other sensors, the offset of a clock does not matter: leave one in
                findings = tuple(each for each in findings if each is not clock_only)
            for each in findings:
                template = "{} is left out: {}"
                _, track = remaining.pop(each.sensor)
                if earlier[each.sensor]:
                    template = "{} is left out but for its earlier recordings: {}"
                    remaining[each.sensor] = earlier[each.sensor], track
                reporter.warn(template, each.sensor, each.text_with_advice)
                refused[each.sensor] = each.refusal
        except InputError as error:
            failed = [n for n, (paths, _) in remaining.items() if files_of(error, paths)]
            if not failed or len(remaining) == 1:
                raise
            reporter.warn("{} is left out: {}", failed[0], error.message)
            refused[failed[0]] = error
            del remaining[failed[0]]
        else:
            return measured, refused


def _before(moment: str, paths: Sequence[Path]) -> list[Path]:
    """Return the recordings that end before a moment; none if there is no moment, or if all do.

    Those that end up to `_MOMENT_S` after it stay, too, as it has an error, unless none would be
    taken out.
    """
    if not moment:
        return []
    begin = seconds_from_iso(moment, what="moment")
    for late in (begin + _MOMENT_S, begin):
        earlier = [p for p in paths if not any(open_recording(p).read_between(late, math.inf))]
        if len(earlier) < len(paths):
            return earlier
    return []


def files_of(error: GisRadarError, paths: Sequence[Path]) -> list[Path]:
    """Return those files that an error is about."""
    return [each for each in paths if error.about in {str(each), str(each.resolve())}]


def measure_recordings(
    recordings: Sequence[Path], tracks: Sequence[PoseTrack], tile_file: Path,
    map_file: Path | None, output: Path, *, filters: Mapping[str, Any],
    clocks: Path | None, reporter: Reporter, processes: int | None = None, **options: Any,
) -> dataset.Dataset:  # fmt: skip
    """Measure recordings, with the clocks of a file; return the dataset.

    Options are those of :func:`gis_radar.measure`.
    """
    chosen, tiles = measures.Filters(**filters), hdmap.read_tiles(tile_file)
    known = {} if clocks is None else _clocks(clocks, tracks, reporter)
    measured = dataset.measure(
        recordings, tracks, tiles, map_file, output,
        filters=chosen, clocks=known, processes=processes or workers_here(), reporter=reporter,
        **options,
    )  # fmt: skip
    if map_file is None or (output / dataset.STATED_LANES).exists():
        return measured
    return measured.state_lanes(streets=tile_file)


def write_sights_of(
    tracks: Sequence[PoseTrack], tile_file: Path, output: Path, *, scans: Sequence[Path],
    scan_crs: str | None, reporter: Reporter,
) -> dict[str, Any]:  # fmt: skip
    """Write which tiles sensors see; return figures by sensor, those of its last pose."""
    tiles = hdmap.read_tiles(tile_file)
    for track in tracks:
        what = Text("the pose of {}", track.sensor)
        require_same(track.poses[0].crs, tiles.crs, what=what, other_what="the tiles")
    road = scan_room.SightTiles.of(tiles)
    source = scan_room.open_sight(road, scans=scans, scan_crs=scan_crs, reporter=reporter)
    different = [
        track for k, track in enumerate(tracks)
        if not any(track.poses == each.poses for each in tracks[:k])
    ]  # fmt: skip
    found = [
        scan_room.find_sight(track.poses[head], road, source)
        for track in different
        for head in np.unique(measures.sight_owners(track.poses)).tolist()
    ]
    scan_room.report_uncovered(found, reporter)
    found.sort(key=lambda sight: sight.pose.sensor)  # equal files for any order of the input
    scan_room.write_sights(found, tiles, output)
    return {each.pose.sensor: each.figures() for each in found}


def _clocks(
    path: Path, tracks: Sequence[PoseTrack], reporter: Reporter
) -> dict[str, calibration.SensorClock]:
    """Return the clocks of a file; warn of sensors without one."""
    clocks = calibration.read_clocks(path)
    for sensor in sorted({track.sensor for track in tracks} - clocks.keys()):
        reporter.warn("the clock of {} is not corrected: its offset is not known", sensor)
    return clocks
