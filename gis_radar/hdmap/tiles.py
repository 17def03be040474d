"""Tiles: slices of lanelets, half a metre along the lane and as wide as it."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import scipy
import shapely
from shapely.geometry.base import BaseGeometry

from gis_radar.base import (
    QUIET,
    Floats,
    InputError,
    LayerNotes,
    Reporter,
    Text,
    UsageError,
    add_layer,
    as_points,
    atomic_write,
    copy_saved_styles,
    metric_crs,
    name_of,
    opened_package,
    style_layers,
)
from gis_radar.hdmap.bounds import CannotMendError, slices, sound_rungs
from gis_radar.hdmap.lanelet_map import LaneletMap
from gis_radar.hdmap.lanes import LANES_LAYER, STOP_LINES_LAYER, lane_numbers, lane_style
from gis_radar.hdmap.mending import outline
from gis_radar.hdmap.reader import problem_table, read_map
from gis_radar.hdmap.tagging import ON_FOOT_OR_BICYCLE
from gis_radar.hdmap.tile_lookup import TileGrid

LENGTH_M = 0.5  # by the contract and the paper
_LEAST_LENGTH_M = 0.01  # a lane of 100 m has 10,000 of them
MOST_TILES = 2_500_000  # each takes 1.4 kB of memory when it is made and written: 3.5 GB
TILES_LAYER = "tiles"
_PROBLEMS = "problems"
_COUNT, _CONTENT = "gis_radar_tiles", "gis_radar_content"
_MAKE_ONE = Text("make one with: gis-radar tiles")
TILE_COLUMNS = (
    "tile_id", "lanelet_id", "index", "s_m", "length_m", "width_m", "height_m", "subtype",
)  # fmt: skip
SAME_LEVEL_M = 2.0  # heights that differ by more are of another level (the contract)
_IDS = ("tile_id", "lanelet_id", "index")
LANE_COLUMN = "lane"  # number of the lane; tiles without it are read, too


def make_tiles(
    roads: LaneletMap | str | Path,
    *,
    length_m: float = LENGTH_M,
    subtypes: Collection[str] | None = None,
    road: Floats | None = None,
    reporter: Reporter = QUIET,
) -> gpd.GeoDataFrame:
    """Split the lanelets of a map into tiles.

    Both bounds are interpolated to the same number of points; every four points that enclose a
    smallest quadrilateral make a tile (the paper, "Using the HD Map as Scaffold").

    Parameters
    ----------
    roads : LaneletMap, str or Path
        The map, or its file, which :func:`gis_radar.read_map` reads.
    length_m : float
        Length of a tile along the lane, metres; a lanelet gets
        `max(1, round(mean length of its bounds / length_m))` tiles, or more where these would
        cross themselves.
    subtypes : collection of str, optional
        Subtypes to tile; without it all but those for pedestrians and bicycles.
    road : (n, 3) array, optional
        Points of the road's surface in the map's CRS, as :func:`gis_radar.read_road` gives them:
        tiles take their height from those of their level, where there are some near.
    reporter : Reporter
        Receives progress, the lanelets that are not tiled, and the area that long tiles cut off.

    Returns
    -------
    GeoDataFrame
        A row a tile in the order of (lanelet_id, index), with the columns `TILE_COLUMNS`, `lane`
        (the number of its lane, as :meth:`gis_radar.LaneletMap.lanes` has it) and the CRS.
        `height_m` is NaN where neither map nor road has heights.

    Raises
    ------
    InputError
        If no lanelet is of these subtypes, one cannot be cut, there are too many tiles, or map and
        road do not overlap.
    UsageError
        If `length_m` is not positive.

    Examples
    --------
    >>> import gis_radar as gr
    >>> tiles = gr.make_tiles(gr.read_map(gr.sample_folder() / "junction.osm"))
    >>> len(tiles), tiles.geometry.geom_type.unique().tolist()
    (5387, ['Polygon'])
    """
    if not _LEAST_LENGTH_M <= length_m < np.inf:
        raise UsageError("tile length is {} m, expected {} m or more", length_m, _LEAST_LENGTH_M)
    if isinstance(roads, str | Path):
        roads = read_map(roads, reporter=reporter)
    lanelets = _chosen(roads.lanelets, subtypes)
    _log_not_tiled(roads.lanelets, lanelets, reporter)
    tiles = _table(lanelets, _rungs(lanelets, length_m, reporter), roads.crs)
    numbers = tiles["lanelet_id"].map(lane_numbers(roads.lanelets)).astype(np.int64)
    tiles.insert(len(TILE_COLUMNS), LANE_COLUMN, numbers)
    return tiles if road is None else with_road_heights(tiles, as_points(road), reporter=reporter)


TILE_FIELDS = {
    "tile_id": ("Tile", "from 0, in the order of lanelet and index"),
    "lanelet_id": ("Lanelet", "of the map"),
    "index": ("Place in the lanelet", "0 at the lanelet's start"),
    "s_m": ("Along the lanelet (m)", "from the lanelet's start to the tile's, along the middle"),
    "length_m": ("Length (m)", "along the middle"),
    "width_m": ("Width (m)", "mean of both ends, across"),
    "height_m": ("Height (m)", "of the road; null where unknown"),
    "subtype": ("Kind", "subtype of the lanelet"),
    LANE_COLUMN: ("Lane", "number of the lane: its smallest lanelet id"),
}
"""Titles and meaning of the columns of tiles."""
_NOTES = {
    TILES_LAYER: LayerNotes("Tiles", "Slices of lanelets, the unit of all statistics", TILE_FIELDS),
    LANES_LAYER: LayerNotes("Lanes", "Chains of lanelets by number, as in report and tables", {}),
    STOP_LINES_LAYER: LayerNotes("Stop lines", "A row for each lane that a stop line ends", {}),
}


def own_columns(tiles: gpd.GeoDataFrame) -> list[str]:
    """Return the columns that :func:`make_tiles` made, without those that users have added."""
    return [*TILE_COLUMNS, *((LANE_COLUMN,) if LANE_COLUMN in tiles else ())]


def _chosen(lanelets: gpd.GeoDataFrame, subtypes: Collection[str] | None) -> gpd.GeoDataFrame:
    """Return the lanelets to tile, by id: of some subtypes, or all that vehicles may use."""
    if subtypes is None:
        chosen = lanelets[~lanelets["subtype"].isin(ON_FOOT_OR_BICYCLE)]
    else:
        chosen = lanelets[lanelets["subtype"].isin(list(subtypes))]
    if chosen.empty:
        wanted = (
            Text("a road")
            if subtypes is None
            else Text("of subtype {}", ", ".join(sorted(subtypes)))
        )
        present = ", ".join(sorted(lanelets["subtype"].unique()))
        raise InputError(
            "the map has no lanelet that is {}", wanted, hint=Text("it has: {}", present)
        )
    return chosen.sort_values("lanelet_id")


def _log_not_tiled(
    lanelets: gpd.GeoDataFrame, chosen: gpd.GeoDataFrame, reporter: Reporter
) -> None:
    """Log how many lanelets of each subtype get no tiles."""
    counts = Counter(lanelets["subtype"])
    counts.subtract(chosen["subtype"])
    others = [f"{count} {subtype}" for subtype, count in counts.most_common() if count]
    if others:
        reporter.log(Text("not tiled: {} (use {})", ", ".join(others), "--subtype"))


def _table(
    lanelets: gpd.GeoDataFrame, rungs_by_lanelet: list[Floats], crs: Any
) -> gpd.GeoDataFrame:
    """Return the tiles between the rungs of all lanelets, each (n + 1, left and right, xyz)."""
    counts = np.array([len(rungs) - 1 for rungs in rungs_by_lanelet])
    index = np.concatenate([np.arange(count) for count in counts])
    corners = np.concatenate([corners_between(rungs) for rungs in rungs_by_lanelet])
    middle = [rungs[..., :2].mean(axis=1) for rungs in rungs_by_lanelet]
    steps = [np.hypot(*np.diff(line, axis=0).T) for line in middle]
    begins = [np.cumsum(step) - step for step in steps]
    widths = np.hypot(*(corners[:, [0, 1], :2] - corners[:, [3, 2], :2]).transpose(2, 0, 1))
    return gpd.GeoDataFrame(
        {
            "tile_id": np.arange(len(index)),
            "lanelet_id": np.repeat(lanelets["lanelet_id"].to_numpy(np.int64), counts),
            "index": index,
            "s_m": np.concatenate(begins),
            "length_m": np.concatenate(steps),
            "width_m": widths.mean(axis=1),
            "height_m": corners[..., 2].mean(axis=1),
            "subtype": np.repeat(lanelets["subtype"].to_numpy(object), counts),
        },
        geometry=polygons(corners[..., :2]),
        crs=crs,
    )


def polygons(corners: Floats) -> np.ndarray[Any, np.dtype[Any]]:
    """Return polygons with these (n, 4, 2) vertices."""
    return np.asarray(shapely.polygons(np.concatenate([corners, corners[:, :1]], axis=1)))


def quads(tiles: gpd.GeoDataFrame) -> Floats:
    """Return the (n, 4, 2) vertices of tiles, in order around each."""
    rings = shapely.get_coordinates(tiles.geometry.array)
    return np.ascontiguousarray(rings.reshape(-1, 5, 2)[:, :4])


def fingerprint(tiles: gpd.GeoDataFrame) -> str:
    """Return the digest of coordinate system, ids and vertices that tables made of tiles carry."""
    return _digest(tiles, name_of(metric_crs(tiles.crs, what="tiles")))


def _digest(tiles: gpd.GeoDataFrame, first: str = "") -> str:
    digest = hashlib.blake2b(first.encode(), digest_size=16)
    for column in _IDS:
        digest.update(tiles[column].to_numpy(np.int64).tobytes())
    digest.update(quads(tiles).tobytes())
    return digest.hexdigest()


def write_tiles(
    tiles: gpd.GeoDataFrame,
    path: str | Path,
    *,
    problems: gpd.GeoDataFrame | None = None,
    lanes: gpd.GeoDataFrame | None = None,
    stop_lines: gpd.GeoDataFrame | None = None,
) -> None:
    """Write tiles, the list of problems, lanes and stop lines as layers of a GeoPackage.

    Parameters
    ----------
    tiles : GeoDataFrame
        As from :func:`make_tiles`.
    problems : GeoDataFrame, optional
        As :attr:`LaneletMap.problems`; none without it.
    lanes, stop_lines : GeoDataFrame, optional
        As from :meth:`gis_radar.LaneletMap.lanes` and :meth:`gis_radar.LaneletMap.stop_lines`.
    path : str or Path
        The GeoPackage; it appears whole or not at all.
    """
    path = Path(path)
    if path.suffix.lower() != ".gpkg":
        raise UsageError("{}: tiles are written as GeoPackage", path, hint="end the name in .gpkg")
    require_tiles(tiles, what="tiles")
    # Without the CRS: GeoPackage changes the text of one that has no EPSG code.
    metadata = {_COUNT: str(len(tiles)), _CONTENT: _digest(tiles)}
    if problems is None:
        problems = problem_table([], tiles.crs)
    layers = [(TILES_LAYER, tiles, "Polygon"), (_PROBLEMS, problems, "Unknown")]
    if lanes is not None:
        # GeoPackage has no lists
        texts = lanes["lanelets"].map(lambda refs: " ".join(map(str, refs)))
        layers.append((LANES_LAYER, lanes.assign(lanelets=texts), "LineString"))
    if stop_lines is not None:
        layers.append((STOP_LINES_LAYER, stop_lines, "LineString"))
    with atomic_write(path) as part:
        for layer, table, kind in layers:
            of_layer = metadata if layer == TILES_LAYER else None
            options = {"geometry_type": kind, "layer_metadata": of_layer}
            add_layer(table, part, layer, use_arrow=True, **options)
        styles = {name: lane_style(name) for name, _, _ in layers[2:]}
        style_layers(
            part, styles, name="lanes", about="lanes by number, and stop lines",
            notes={name: _NOTES[name] for name in (TILES_LAYER, *styles)},
        )  # fmt: skip
        if styles:
            copy_saved_styles(part, earlier=path)


def read_tiles(path: str | Path) -> gpd.GeoDataFrame:
    """Read tiles from a GeoPackage.

    Returns
    -------
    GeoDataFrame
        Ascending by `tile_id`, with the columns `TILE_COLUMNS`.

    Raises
    ------
    InputError
        If the file is no GeoPackage with a layer `tiles` of four-vertex polygons, or it is not as
        :func:`write_tiles` left it; CrsError if its coordinate system is missing or not metric.
    """
    tiles, metadata = _read_layer(path)
    require_tiles(tiles, what=Text("{}: layer {}", path, TILES_LAYER))
    tiles = tiles.set_crs(metric_crs(tiles.crs, what=str(path)), allow_override=True)
    try:
        tiles["height_m"] = tiles["height_m"].astype(np.float64)
    except (ValueError, TypeError) as error:
        raise InputError("{}: column height_m holds something else than metres", path) from error
    tiles = tiles.sort_values("tile_id", ignore_index=True)
    _refuse_changed_tiles(tiles, metadata, path)
    return tiles


def _read_layer(path: str | Path) -> tuple[gpd.GeoDataFrame, dict[str, str]]:
    """Return the layer of tiles, unchecked, and its metadata from :func:`write_tiles`."""
    with opened_package(path, what="a GeoPackage of tiles", hint=_MAKE_ONE) as place:
        tiles = pyogrio.read_dataframe(place, layer=TILES_LAYER, use_arrow=True)
        metadata = pyogrio.read_info(place, layer=TILES_LAYER)["layer_metadata"] or {}
    return tiles, metadata


def _refuse_changed_tiles(
    tiles: gpd.GeoDataFrame, metadata: dict[str, str], path: str | Path
) -> None:
    """Refuse tiles that differ from those written, by the digest in the layer's metadata.

    A layer of another program has none, and is not checked.
    """
    if _CONTENT not in metadata or metadata[_CONTENT] == _digest(tiles):
        return
    count = metadata.get(_COUNT, str(len(tiles)))
    wrong = (
        Text("{} of {} tiles", len(tiles), count)
        if count != str(len(tiles))
        else Text("other ids or corners")
    )
    raise InputError(
        "{}: layer {} was damaged or edited after gis_radar wrote it: it has {}",
        path,
        TILES_LAYER,
        wrong,
        hint="make it again with: gis-radar tiles; a changed table of your own: write_tiles",
    )


def require_tiles(tiles: gpd.GeoDataFrame, *, what: str) -> None:
    """Refuse a table that is none of tiles, as :func:`make_tiles` returns them.

    Raises
    ------
    InputError
        If it lacks columns, has no rows, or a tile has not four vertices or is there twice.
    """
    missing = [name for name in TILE_COLUMNS if name not in tiles.columns]
    if missing or not isinstance(tiles, gpd.GeoDataFrame):
        lacking = ", ".join(missing) or "geometry"
        raise InputError("{} lacks {}", what, lacking, hint=_MAKE_ONE)
    if tiles.empty:
        raise InputError("{} is empty", what)
    for column in _IDS:
        if not pd.api.types.is_integer_dtype(tiles[column]) or tiles[column].hasnans:
            raise InputError("{}: column {} holds something else than whole numbers", what, column)
    shapes = tiles.geometry.array
    odd = (shapely.get_type_id(shapes) != shapely.GeometryType.POLYGON) | (
        shapely.get_num_coordinates(shapes) != 5
    )
    if odd.any():
        raise InputError(
            "{}: tile {} has not four vertices", what, tiles["tile_id"].to_numpy()[odd][0]
        )
    if not np.isfinite(shapely.get_coordinates(shapes)).all():
        raise InputError("{}: a tile has corners that are no numbers", what)
    if tiles["tile_id"].duplicated().any():
        twice = tiles["tile_id"][tiles["tile_id"].duplicated()].iloc[0]
        raise InputError("{}: tile {} is there twice", what, twice)


_ON_TILES = 0.5  # share of a road's points to warn under: all of it with its map, of another's 0.42
_NEAR_M = 1.5  # half a lane: the nearest point is still of the same road


def with_road_heights(
    tiles: gpd.GeoDataFrame, road: Floats, *, reporter: Reporter = QUIET
) -> gpd.GeoDataFrame:
    """Return tiles whose `height_m` is that of the scanned road.

    A tile takes the median height of the points in it; without any, that of the nearest point
    within `_NEAR_M` of its centre; else it keeps its height. Points that differ from the map's
    height by more than `SAME_LEVEL_M` belong to another road, and do not count.

    Parameters
    ----------
    tiles : GeoDataFrame
        As from :func:`make_tiles`.
    road : (n, 3) array
        Points of the road's surface in the tiles' CRS, metres.
    reporter : Reporter
        Receives a warning where most of them lie beside the tiles.

    Raises
    ------
    InputError
        If no tile gets a height: scan and map do not overlap, or lie at other heights.
    """
    map_height_m = tiles["height_m"].to_numpy(np.float64)
    point, tile = TileGrid(quads(tiles)).assign(road[:, 0], road[:, 1])
    share = len(np.unique(point)) / max(len(road), 1)
    if 0.0 < share < _ON_TILES:
        reporter.warn("only {:.0%} of the road's points lie on tiles: of another place?", share)
    level = ~(np.abs(road[point, 2] - map_height_m[tile]) > SAME_LEVEL_M)
    inside = pd.Series(road[point[level], 2]).groupby(tile[level]).median()
    height_m = inside.reindex(np.arange(len(tiles))).to_numpy(copy=True)
    without = np.flatnonzero(np.isnan(height_m))
    centres = shapely.get_coordinates(tiles.geometry.centroid)[without]
    tree = scipy.spatial.cKDTree(road[:, :2])
    distance, nearest = tree.query(centres, distance_upper_bound=_NEAR_M)
    near = np.isfinite(distance)
    height = road[np.asarray(nearest)[near], 2]
    fits = ~(np.abs(height - map_height_m[without[near]]) > SAME_LEVEL_M)
    height_m[without[near][fits]] = height[fits]
    if np.isnan(height_m).all():
        if not len(point):
            raise InputError("the road's points and the map do not overlap")
        raise InputError(
            "heights of the road's points and of the map differ by {:.1f} m: another vertical "
            "datum, or feet?",
            float(np.median(np.abs(road[point, 2] - map_height_m[tile]))),
        )
    return tiles.assign(height_m=np.where(np.isnan(height_m), map_height_m, height_m))


_AREA_TOLERANCE = 0.005  # share of a lanelet's area from which on cut corners are reported
_STAGE = "splitting lanelets"


def _rungs(lanelets: gpd.GeoDataFrame, length_m: float, reporter: Reporter) -> list[Floats]:
    """Return the rungs that cut each lanelet into tiles: (n + 1, left and right, xyz), metres.

    A lanelet whose slices would cross themselves gets shorter ones.
    """
    rungs_by_lanelet = []
    finer = count = 0
    rows = zip(lanelets["lanelet_id"], lanelets["left"], lanelets["right"], strict=True)
    for done, (ref, left, right) in enumerate(rows):
        bounds = _coordinates(left), _coordinates(right)
        count += slices(*bounds, length_m)
        if count > MOST_TILES:
            raise InputError(
                "the map has over {:,} tiles of {:g} m",
                MOST_TILES,
                length_m,
                hint="make them longer",
            )
        try:
            rungs_by_lanelet.append(np.stack(sound_rungs(*bounds, length_m), axis=1))
        except CannotMendError as error:
            raise InputError("lanelet {}: {}", ref, error) from error
        finer += len(rungs_by_lanelet[-1]) - 1 != slices(*bounds, length_m)
        if done % 100 == 0:
            reporter.progress(_STAGE, done, len(lanelets))
    reporter.progress(_STAGE, len(lanelets), len(lanelets))
    if finer:
        asked = Text("{} cut into more tiles than {:g} m asks for", _lanelet_count(finer), length_m)
        reporter.warn("{}: longer ones would cross themselves", asked)
    _warn_of_cut_corners(lanelets, rungs_by_lanelet, reporter)
    return rungs_by_lanelet


def corners_between(rungs: Floats) -> Floats:
    """Return the slices between rungs, (n, 4, 3): counter-clockwise from the right of the start."""
    return np.stack([rungs[:-1, 1], rungs[1:, 1], rungs[1:, 0], rungs[:-1, 0]], axis=1)


def _coordinates(line: shapely.LineString) -> Floats:
    return shapely.get_coordinates(line, include_z=True)


def _warn_of_cut_corners(
    lanelets: gpd.GeoDataFrame, rungs_by_lanelet: list[Floats], reporter: Reporter
) -> None:
    """Warn where tiles differ from their lanelet's area by more than `_AREA_TOLERANCE`."""
    shapes = lanelets.geometry.array
    tiled = np.array([_tiled_area(rungs) for rungs in rungs_by_lanelet])
    off = shapely.area(shapely.symmetric_difference(shapes, tiled)) / shapely.area(shapes)
    bad = int(np.count_nonzero(off > _AREA_TOLERANCE))
    if not bad:
        return
    worst = Text(
        "lanelet {} by {:.1f} %", lanelets["lanelet_id"].iloc[off.argmax()], 100.0 * off.max()
    )
    reporter.warn(
        "tiles cut corners: {} of {} are off by more than {:g} % of their area, {}; a "
        "shorter {} follows curves better",
        bad,
        _lanelet_count(len(rungs_by_lanelet)),
        100.0 * _AREA_TOLERANCE,
        worst,
        "--length",
    )


def _tiled_area(rungs: Floats) -> BaseGeometry:
    shape = outline(rungs[:, 0], rungs[:, 1])
    if shape.is_valid:
        return shape
    rings = corners_between(rungs)[:, [0, 1, 2, 3, 0], :2]
    return shapely.union_all(shapely.polygons(rings))


def _lanelet_count(count: int) -> str:
    return Text("{} lanelets", count) if count > 1 else Text("{} lanelet", count)
