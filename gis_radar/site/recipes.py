"""Recipes that commands share with the stages of a site, from files to files.

Further options go to the function of the library that has them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import geopandas as gpd

from gis_radar.clocks import SensorClock, measure_clocks, read_clocks
from gis_radar.crs import name_of
from gis_radar.lanelets import read_map
from gis_radar.occupancy import Filters, Occupancy, measure_occupancy
from gis_radar.poses.files import PoseTrack
from gis_radar.progress import Reporter
from gis_radar.scans.mask import mask_road, require_road_name
from gis_radar.scans.roads import read_roads
from gis_radar.scans.scan import read_road
from gis_radar.tiles.lookup import with_road_heights
from gis_radar.tiles.tiles import fingerprint, make_tiles, read_tiles, write_tiles
from gis_radar.vehicles import Vehicles, find_vehicles

AUTO = "auto"  # clocks: as the recordings themselves show


def split_map(
    map_file: Path, output: Path, *, road: Path | None = None, reporter: Reporter,
    crs: str | None = None, origin: tuple[float, float] | None = None, **options: Any,
) -> dict[str, Any]:  # fmt: skip
    """Split the lanes into tiles, at the heights of the scanned road where there is one.

    The figures are returned; options are those of :func:`gis_radar.make_tiles`.
    """
    roads = read_map(map_file, crs=crs, origin=origin, reporter=reporter)
    table = make_tiles(roads, reporter=reporter, **options)
    if road is not None:
        table = with_road_heights(table, read_road(road, roads.crs))
    write_tiles(table, output, problems=roads.problems)
    actions = roads.problems["action"].value_counts()
    return {
        "crs": name_of(roads.crs),
        "lanelets": len(roads.lanelets),
        "lanelets_tiled": int(table["lanelet_id"].nunique()),
        "repaired": int(actions.get("repaired", 0)),
        "left_out": int(actions.get("left out", 0)),
        "problems": len(roads.problems),
        "tiles": len(table),
        "with_height": int(table["height_m"].notna().sum()),
        "fingerprint": fingerprint(table),
    }


def mask_scans(
    scans: Sequence[Path], map_file: Path, output: Path, *, reporter: Reporter,
    engine: str, scan_crs: str | None, **options: Any,
) -> tuple[list[Path], dict[str, Any]]:  # fmt: skip
    """Mask the road out of the scans.

    What was written and the figures are returned; options are those of
    :func:`gis_radar.read_roads`.
    """
    require_road_name(output)
    roads = read_roads(map_file, reporter=reporter, **options)
    road = mask_road(scans, roads, engine=engine, scan_crs=scan_crs, reporter=reporter)
    return road.write(output), road.figures()


def join_recordings(
    recordings: Sequence[Path], tracks: Sequence[PoseTrack], tile_file: Path, output: Path, *,
    filters: Mapping[str, Any], clocks: str | Path | None, reporter: Reporter, **options: Any,
) -> Occupancy:  # fmt: skip
    """Join recordings to the tiles; clocks are those of a file, or `auto`.

    Options are those of :func:`gis_radar.measure_occupancy`.
    """
    kept, tiles = Filters(**filters), read_tiles(tile_file)
    known = {} if clocks is None else _clocks(clocks, recordings, tracks, tiles, reporter)
    return measure_occupancy(
        recordings, tracks, tiles, output,
        filters=kept, clocks=known, reporter=reporter, **options,
    )  # fmt: skip


def follow_vehicles(
    recordings: Sequence[Path], tracks: Sequence[PoseTrack], tile_file: Path, map_path: Path,
    output: Path, *, clocks: str | Path | None, reporter: Reporter, **options: Any,
) -> Vehicles:  # fmt: skip
    """Follow the vehicles in recordings; clocks are those of a file, or `auto`.

    Options are those of :func:`gis_radar.find_vehicles`.
    """
    tiles = read_tiles(tile_file)
    known = {} if clocks is None else _clocks(clocks, recordings, tracks, tiles, reporter)
    return find_vehicles(
        recordings, tracks, tiles, map_path, output, clocks=known, reporter=reporter, **options
    )


def _clocks(
    source: str | Path, recordings: Sequence[Path], tracks: Sequence[PoseTrack],
    tiles: gpd.GeoDataFrame, reporter: Reporter,
) -> dict[str, SensorClock]:  # fmt: skip
    """Return the clocks of a file, or compare them; warn of those that are not corrected."""
    if source == AUTO:
        found = measure_clocks(recordings, tracks, tiles, reporter=reporter)
        for sensor, text in found.lines().items():
            reference = sensor == "reference"
            what = "clocks are corrected to that of" if reference else f"clock of {sensor}:"
            reporter.log(f"{what} {text}")
        clocks = dict(found.clocks)
    else:
        clocks = read_clocks(source)
    for sensor in sorted({track.sensor for track in tracks} - clocks.keys()):
        reporter.log(f"the clock of {sensor} is not corrected: its offset is not known", "warning")
    return clocks
