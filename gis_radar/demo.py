"""The whole way on the sample junction: scan to road, map to tiles, recordings to a heat map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gis_radar.aerial import mask_road, read_road
from gis_radar.aerial.roads import roads_of_map
from gis_radar.elevation import with_road_heights
from gis_radar.errors import InputError
from gis_radar.heatmap import make_heatmap
from gis_radar.lanelets import read_map
from gis_radar.occupancy import Filters, measure_occupancy
from gis_radar.pose_files import read_pose
from gis_radar.progress import QUIET, Reporter
from gis_radar.tiles import make_tiles, write_tiles

INTERVAL = "20s"
SENSORS = ("R1", "R2")
CLEARANCE_M = (-0.5, 4.5)  # what drives, without the tree crowns over the kerb


def sample_folder() -> Path:
    """Return the folder of the sample junction: inside an installed package, or beside it.

    Raises
    ------
    InputError
        If neither is there.
    """
    package = Path(__file__).parent
    for folder in (package / "sample_maps", package.parent / "sample_maps"):
        if (folder / "junction.osm").is_file():
            return folder
    raise InputError("the sample maps are missing", hint="install gis_radar again")


def run_demo(
    folder: str | Path, *, reporter: Reporter = QUIET
) -> tuple[list[Path], dict[str, Any]]:
    """Run the main job on the sample and write its results.

    Parameters
    ----------
    folder : str or Path
        Where `road.laz`, `tiles.gpkg`, `occupancy/` and `heatmap/` go; made if it is not there.
    reporter : Reporter
        Hears how far the work is.

    Returns
    -------
    outputs : list of Path
        What was written.
    figures : dict
        A few figures worth a look.
    """
    sample, folder = sample_folder(), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    roads = read_map(sample / "junction.osm", reporter=reporter)
    mask = mask_road([sample / "scan.laz"], roads_of_map(roads), reporter=reporter)
    written = mask.write(folder / "road.laz")
    tiles = make_tiles(roads, reporter=reporter)
    tiles = with_road_heights(tiles, read_road(folder / "road.laz", roads.crs))
    write_tiles(tiles, folder / "tiles.gpkg", problems=roads.problems)
    occupancy = measure_occupancy(
        [sample / f"{sensor}.parquet" for sensor in SENSORS],
        [read_pose(sample / f"{sensor}.json") for sensor in SENSORS],
        tiles,
        folder / "occupancy",
        filters=Filters(clearance=CLEARANCE_M),
        reporter=reporter,
    )
    heat = make_heatmap(occupancy, tiles, interval=INTERVAL, reporter=reporter)
    pictures = heat.write(folder / "heatmap", reporter=reporter)
    road = {name: mask.figures()[name] for name in ("engine", "points_on_road", "covered")}
    figures = {**road, "tiles": len(tiles), **occupancy.figures(), **heat.figures()}
    return [*written, folder / "tiles.gpkg", folder / "occupancy", *pictures], figures
