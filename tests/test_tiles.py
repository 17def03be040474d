import shutil
import sqlite3
import subprocess
import sys
import warnings

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
import shapely
from maps import Listener
from sites import EAST, NORTH, UTM, crossing, lane_quads, tiles_of

import gis_radar as gr
from gis_radar.base import CrsError, InputError, OutputError, UsageError
from gis_radar.hdmap import (
    LANE_COLUMN,
    TILE_COLUMNS,
    LaneletMap,
    fingerprint,
    make_tiles,
    quads,
    read_tiles,
    write_tiles,
)
from gis_radar.hdmap.tiles import with_road_heights
from gis_radar.scans import read_road

NO_PROBLEMS = gpd.GeoDataFrame(
    {"lanelet_id": np.empty(0, np.int64), "action": [], "reason": []}, geometry=[], crs=UTM
)


def road_map(*bounds, subtypes=None, first_id=9_000_000_000_000_000_000):
    """A map of lanelets, each given by its left and right bound."""
    lefts, rights = ([shapely.LineString(pair[i]) for pair in bounds] for i in (0, 1))
    lanelets = gpd.GeoDataFrame(
        {
            "lanelet_id": first_id + np.arange(len(bounds)),
            "subtype": subtypes or ["road"] * len(bounds),
            "successors": [()] * len(bounds),
            "left": lefts,
            "right": rights,
        },
        geometry=[
            shapely.Polygon([*left.coords, *reversed(right.coords)])
            for left, right in zip(lefts, rights, strict=True)
        ],
        crs=UTM,
    )
    return LaneletMap(
        lanelets=lanelets,
        regulatory=gpd.GeoDataFrame(geometry=[], crs=UTM),
        problems=NO_PROBLEMS,
        crs=UTM,
        remarks=(),
    )


def straight(length_m, width_m=3.0, *z):
    left = [(EAST, NORTH + width_m, *z), (EAST + length_m, NORTH + width_m, *z)]
    right = [(EAST, NORTH, *z), (EAST + length_m, NORTH, *z)]
    return left, right


def arc(radius_m, degrees, width_m=3.5):
    angle = np.radians(np.linspace(0.0, degrees, 60))
    circle = np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    centre = np.array([EAST, NORTH])
    inner = centre + [0.0, width_m] + circle * [radius_m - width_m] * 2
    return inner, centre + circle * [radius_m] * 2


@pytest.mark.parametrize(
    ("length_m", "count"), [(10.0, 20), (0.3, 1), (0.74, 1), (0.76, 2), (10.2, 20), (10.3, 21)]
)
def test_a_straight_lane_is_cut_at_half_metres(length_m, count):
    tiles = make_tiles(road_map(straight(length_m)))
    assert len(tiles) == count
    np.testing.assert_allclose(tiles["length_m"], length_m / count)
    np.testing.assert_allclose(tiles["s_m"], np.arange(count) * length_m / count)
    np.testing.assert_allclose(tiles["width_m"], 3.0)
    np.testing.assert_allclose(tiles.area.sum(), 3.0 * length_m)
    assert tiles["lanelet_id"].iloc[0] == 9_000_000_000_000_000_000
    assert tuple(tiles.columns) == (*TILE_COLUMNS, LANE_COLUMN, "geometry")
    assert shapely.is_ccw(shapely.get_exterior_ring(tiles.geometry.array)).all()


def test_a_map_is_given_as_it_is_or_as_its_file():
    path = gr.sample_folder() / "junction.osm"
    of_file = make_tiles(str(path))
    pd.testing.assert_frame_equal(of_file, make_tiles(gr.read_map(path)))


@pytest.mark.parametrize("radius_m", [5.0, 12.0, 200.0])
@pytest.mark.parametrize("degrees", [45, 90, 270])
def test_a_curve_keeps_its_area_and_shares_its_edges(radius_m, degrees):
    roads = road_map(arc(radius_m, degrees))
    tiles = make_tiles(roads)
    corners = quads(tiles)
    np.testing.assert_array_equal(corners[:-1, 1], corners[1:, 0])
    np.testing.assert_array_equal(corners[:-1, 2], corners[1:, 3])
    assert tiles.is_valid.all()
    outline = roads.lanelets.geometry.iloc[0]
    off = shapely.symmetric_difference(shapely.union_all(tiles.geometry.array), outline).area
    assert off / outline.area < 0.005


def test_ids_follow_lanelet_and_index_whatever_the_order_of_the_map():
    roads = road_map(straight(2.0), arc(12.0, 90), straight(5.0))
    shuffled = LaneletMap(**{**vars(roads), "lanelets": roads.lanelets.iloc[[2, 0, 1]]})
    one, other = make_tiles(roads), make_tiles(shuffled)
    assert fingerprint(one) == fingerprint(other)
    assert one["tile_id"].tolist() == list(range(len(one)))
    assert one.sort_values(["lanelet_id", "index"]).index.tolist() == one.index.tolist()


def test_paths_for_people_are_left_out_unless_asked_for():
    roads = road_map(
        straight(2.0), straight(3.0), straight(4.0), subtypes=["road", "walkway", "bicycle_lane"]
    )
    assert set(make_tiles(roads)["subtype"]) == {"road"}
    assert set(make_tiles(roads, subtypes=["walkway", "road"])["subtype"]) == {"walkway", "road"}
    with pytest.raises(InputError, match="subtype crosswalk") as caught:
        make_tiles(roads, subtypes=["crosswalk"])
    assert "bicycle_lane, road, walkway" in caught.value.hint


@pytest.mark.parametrize("length_m", [0.0, -1.0, np.nan, np.inf])
def test_a_tile_needs_a_length(length_m):
    with pytest.raises(UsageError, match="tile length"):
        make_tiles(road_map(straight(2.0)), length_m=length_m)


def test_heights_come_from_the_map():
    tiles = make_tiles(road_map(straight(2.0, 3.0, 372.5)))
    np.testing.assert_allclose(tiles["height_m"], 372.5)
    assert make_tiles(road_map(straight(2.0)))["height_m"].isna().all()


def test_tiles_survive_their_file(tmp_path):
    tiles = make_tiles(road_map(straight(7.0), arc(12.0, 90)))
    path = tmp_path / "tiles.gpkg"
    write_tiles(tiles, path, problems=NO_PROBLEMS)
    again = read_tiles(path)
    assert fingerprint(again) == fingerprint(tiles)
    np.testing.assert_array_equal(quads(again), quads(tiles))
    assert again["height_m"].isna().all()
    assert again["lanelet_id"].tolist() == tiles["lanelet_id"].tolist()
    assert sorted(name for name, _ in pyogrio.list_layers(path)) == ["problems", "tiles"]
    with sqlite3.connect(path) as file:
        assert file.execute("select min(height_m is null) from tiles").fetchone() == (1,)
    assert [entry.name for entry in tmp_path.iterdir()] == ["tiles.gpkg"]


def test_tiles_go_to_a_geopackage(tmp_path):
    with pytest.raises(UsageError, match=r"end the name|GeoPackage"):
        write_tiles(crossing(), tmp_path / "tiles.shp", problems=NO_PROBLEMS)
    with pytest.raises(OutputError, match="cannot be written"):
        write_tiles(crossing(), tmp_path / "gone" / "tiles.gpkg", problems=NO_PROBLEMS)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: t.drop(columns="lanelet_id"), "lacks lanelet_id"),
        (lambda t: t.iloc[:0], "is empty"),
        (lambda t: t.assign(geometry=t.centroid), "has not four vertices"),
        (lambda t: t.assign(geometry=t.buffer(1.0)), "has not four vertices"),
        (lambda t: t.assign(tile_id=7), "tile 7 is there twice"),
    ],
)
def test_other_layers_are_no_tiles(tmp_path, change, reason):
    pyogrio.write_dataframe(change(crossing()), tmp_path / "tiles.gpkg", layer="tiles")
    with pytest.raises(InputError, match=reason):
        read_tiles(tmp_path / "tiles.gpkg")


@pytest.mark.parametrize(("crs", "reason"), [("EPSG:4326", "geographic"), (None, "no coordinate")])
def test_tiles_need_a_metric_crs(tmp_path, crs, reason):
    path = tmp_path / "tiles.gpkg"
    shapes = crossing().set_crs(crs, allow_override=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        pyogrio.write_dataframe(shapes, path, layer="tiles")
    with pytest.raises(CrsError, match=reason):
        read_tiles(path)


@pytest.mark.parametrize("content", [None, b"", b"SQLite format 3\x00 and then nothing"])
def test_a_file_that_is_no_geopackage(tmp_path, content):
    path = tmp_path / "tiles.gpkg"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"tiles\.gpkg"):
        read_tiles(path)


def test_a_geopackage_of_something_else(tmp_path):
    pyogrio.write_dataframe(crossing(), tmp_path / "x.gpkg", layer="roads")
    with pytest.raises(InputError, match="not a GeoPackage of tiles"):
        read_tiles(tmp_path / "x.gpkg")


def bridge(height_m):
    return tiles_of(
        [lane_quads(EAST + 10, NORTH, 0.0), lane_quads(EAST + 20, NORTH - 10, 90.0)],
        height_m=height_m,
    )


def scan(low_m, high_m):
    """A scanned road along the first lane, a bridge along the second."""
    x, y = np.meshgrid(np.arange(0.25, 40, 0.5), np.arange(-12.25, 12.5, 0.5))
    east, north = (EAST + x).ravel(), (NORTH + y).ravel()
    lower = np.abs(north - NORTH) < 1.6
    upper = np.abs(east - EAST - 20) < 1.6
    return np.concatenate(
        [
            np.column_stack([east, north, np.full(east.size, low_m)])[lower],
            np.column_stack([east, north, np.full(east.size, high_m)])[upper],
        ]
    )


def test_the_scan_gives_heights_and_the_map_chooses_the_level():
    heights = with_road_heights(bridge([370.5, 376.5]), scan(370.0, 376.0))["height_m"]
    np.testing.assert_allclose(heights, np.repeat([370.0, 376.0], 40))


def test_a_tile_off_the_scan_keeps_its_height():
    far = tiles_of([lane_quads(EAST + 10, NORTH, 0.0, count=100)], height_m=371.0)
    heights = with_road_heights(far, scan(370.0, 376.0))["height_m"].to_numpy()
    assert heights[0] == 370.0
    assert heights[-1] == 371.0


def test_a_scan_elsewhere_is_refused():
    with pytest.raises(InputError, match="do not overlap"):
        with_road_heights(bridge(np.nan), scan(370.0, 376.0) + np.array([5000, 0, 0]))


@pytest.mark.parametrize(("off_m", "told"), [(0.0, False), (25.0, True)])
def test_a_road_that_lies_beside_the_tiles_is_told(off_m, told):
    """As that of another map in the same coordinates does."""
    road = scan(370.0, 376.0) + np.array([off_m, 0, 0])
    heard = Listener()
    with_road_heights(bridge([370.5, 376.5]), road, reporter=heard)
    assert any("of the road's points lie on tiles" in text for _, text in heard.messages) is told


def test_a_road_at_other_heights_is_told_from_one_elsewhere():
    with pytest.raises(InputError, match=r"differ by 50\.0 m: another vertical"):
        with_road_heights(bridge(370.0), scan(420.0, 420.0))


def test_a_road_file_must_be_a_scan(tmp_path):
    (tmp_path / "road.laz").write_bytes(b"LASF but not really")
    with pytest.raises(InputError, match=r"road\.laz"):
        read_road(tmp_path / "road.laz", UTM)
    with pytest.raises(InputError, match="no such file"):
        read_road(tmp_path / "gone.laz", UTM)


def test_what_is_not_tiled_is_said():
    kinds = ["road", "walkway", "crosswalk", "crosswalk"]
    roads, listener = road_map(*[straight(2.0)] * 4, subtypes=kinds), Listener()
    make_tiles(roads, reporter=listener)
    make_tiles(roads, subtypes=kinds, reporter=listener)
    assert listener.messages == [("info", "not tiled: 2 crosswalk, 1 walkway (use --subtype)")]


@pytest.mark.parametrize("degrees", [180, 270, 340])
def test_a_tile_never_crosses_itself_however_long(degrees):
    listener = Listener()
    tiles = make_tiles(
        road_map(straight(30.0), arc(8.0, degrees)), length_m=1000.0, reporter=listener
    )
    assert tiles.is_valid.all()
    assert shapely.is_ccw(shapely.get_exterior_ring(tiles.geometry.array)).all()
    assert tiles.groupby("lanelet_id").size().iloc[0] == 1
    (finer, _), (level, _) = ((message, kind) for kind, message in listener.messages)
    assert finer.startswith("1 lanelet cut into more tiles than 1000 m asks for")
    assert "cut corners" in level


def test_area_that_long_tiles_lose_is_said():
    roads, listener = road_map(straight(30.0), arc(12.0, 90)), Listener()
    tiles = make_tiles(roads, length_m=5.0, reporter=listener)
    ((level, message),) = listener.messages
    assert level == "warning"
    outline = roads.lanelets.geometry.iloc[1]
    curve = shapely.union_all(tiles.geometry.array[tiles["lanelet_id"] % 10 == 1])
    off = 100.0 * outline.symmetric_difference(curve).area / outline.area
    assert f" {off:.1f} %" in message
    assert "1 of 2 lanelets" in message
    assert "--length" in message
    listener.messages.clear()
    make_tiles(roads, length_m=0.5, reporter=listener)
    assert listener.messages == []


def test_a_lanelet_that_cannot_be_cut_is_refused():
    with pytest.raises(InputError, match="lanelet 9000000000000000000"):
        make_tiles(road_map(straight(20.0)[::-1]))


def stored(tmp_path, tiles=None):
    path = tmp_path / "tiles.gpkg"
    write_tiles(crossing() if tiles is None else tiles, path, problems=NO_PROBLEMS)
    return path


@pytest.mark.parametrize(
    "change",
    [
        "delete from tiles where tile_id > 50",
        "update tiles set tile_id = 9999 where tile_id = 3",
        "update tiles set lanelet_id = 9999 where tile_id = 3",
        "update tiles set geom = (select geom from tiles where tile_id = 4) where tile_id = 3",
    ],
)
def test_tiles_changed_since_they_were_written_are_refused(tmp_path, change):
    path = stored(tmp_path)
    run_sql(path, change)
    with pytest.raises(InputError, match=r"tiles\.gpkg: .*damaged or edited") as caught:
        read_tiles(path)
    assert "gis-radar tiles" in caught.value.hint


def test_heights_and_further_columns_may_be_edited(tmp_path):
    path = stored(tmp_path)
    run_sql(path, "update tiles set height_m = 7.0", "alter table tiles add column note text")
    assert (read_tiles(path)["height_m"] == 7.0).all()


def test_a_file_with_zeros_in_its_middle_is_refused(tmp_path):
    path = stored(tmp_path, make_tiles(road_map(straight(1500.0))))
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 20_000] = bytes(20_000)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"tiles\.gpkg: .*(damaged|holds)"):
        read_tiles(path)


@pytest.mark.parametrize("column", ["tile_id", "lanelet_id", "index"])
@pytest.mark.parametrize("value", [None, 1.5, "x"])
def test_ids_that_are_no_whole_numbers_are_refused(tmp_path, column, value):
    tiles = crossing()
    tiles[column] = tiles[column].astype(object if value == "x" else float)
    tiles.loc[3, column] = value
    tiles[column] = tiles[column].astype(str) if value == "x" else tiles[column]
    pyogrio.write_dataframe(tiles, tmp_path / "tiles.gpkg", layer="tiles")
    with pytest.raises(InputError, match=f"column {column} holds"):
        read_tiles(tmp_path / "tiles.gpkg")


def test_a_layer_of_another_program_is_read_as_it_is(tmp_path):
    pyogrio.write_dataframe(crossing().iloc[5:], tmp_path / "tiles.gpkg", layer="tiles")
    assert len(read_tiles(tmp_path / "tiles.gpkg")) == len(crossing()) - 5


@pytest.mark.parametrize("crs", ["ESRI:102067", "+proj=tmerc +lon_0=11.1 +ellps=GRS80 +units=m"])
def test_tiles_in_a_system_without_epsg_number_survive_their_file(tmp_path, crs):
    path = stored(tmp_path, crossing().set_crs(crs, allow_override=True))
    assert len(read_tiles(path)) == len(crossing())


def run_sql(path, *commands):
    """Edit a GeoPackage behind our back; its triggers need functions that SQLite lacks."""
    with sqlite3.connect(path) as file:
        for (name,) in file.execute("select name from sqlite_master where type = 'trigger'"):
            file.execute(f'drop trigger "{name}"')
        for command in commands:
            file.execute(command)
    file.close()


def test_tiles_are_written_without_a_list_of_problems(tmp_path):
    """A table of one's own has none; the layer is there all the same, with its columns."""
    tiles = crossing()
    write_tiles(tiles, tmp_path / "own.gpkg")
    assert len(read_tiles(tmp_path / "own.gpkg")) == len(tiles)
    problems = pyogrio.read_dataframe(tmp_path / "own.gpkg", layer="problems")
    assert len(problems) == 0
    assert {"lanelet_id", "action", "reason"} <= set(problems.columns)
    assert problems[["action", "reason"]].dtypes.eq(object).all()  # text, as where there are some


def test_tiles_that_another_program_has_locked_are_named_and_stay(tmp_path):
    """As while somebody edits them in QGIS."""
    path = tmp_path / "tiles.gpkg"
    write_tiles(crossing(), path, problems=NO_PROBLEMS)
    before = path.read_bytes()
    program = (
        "import sqlite3, sys\n"
        "editor = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "editor.execute('BEGIN EXCLUSIVE')\nprint('locked', flush=True)\nsys.stdin.read()"
    )  # locks of files hold between processes
    words = [sys.executable, "-c", program, path]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as editor:
        assert editor.stdout.readline() == b"locked\n"
        pyogrio.set_gdal_config_options({"SQLITE_BUSY_TIMEOUT": "50"})  # ms; by default 5 s
        with pytest.raises(InputError, match=r"tiles\.gpkg: another program has it") as caught:
            read_tiles(path)
        editor.stdin.close()
    pyogrio.set_gdal_config_options({"SQLITE_BUSY_TIMEOUT": None})
    assert "\n" not in str(caught.value)
    assert path.read_bytes() == before
    assert len(read_tiles(path)) > 0


def test_a_line_break_in_a_name_is_named(tmp_path):
    """GDAL drops it, and would write or read another file."""
    for place in (tmp_path / "a\nb.gpkg", tmp_path / "c\nd" / "tiles.gpkg"):
        place.parent.mkdir(exist_ok=True)
        with pytest.raises((OSError, OutputError), match="holds a line break"):
            write_tiles(crossing(), place)
        write_tiles(crossing(), tmp_path / "tiles.gpkg")
        shutil.copy(tmp_path / "tiles.gpkg", place)
        with pytest.raises(InputError, match="holds a line break"):
            read_tiles(place)
