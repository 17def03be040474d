"""Sight against recordings: what moves shows what the scan does not; sight as a file."""

import geopandas as gpd
import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from geopandas.testing import assert_geodataframe_equal
from maps import Listener
from scans import write_points
from sites import EAST, NORTH, START, lane_quads, pose, recording, tiles_of
from test_sight import HOUSE, ROAD_M, ROOF_M, SENSOR, across, flat, left_m, sight_over

import gis_radar as gr
from gis_radar.base import QUIET, InputError, UsageError
from gis_radar.measures import SightBook, count_movement, pose_sights
from gis_radar.poses import View, as_track
from gis_radar.scans import (
    HIDDEN,
    IN_SIGHT,
    MovingHits,
    SightFile,
    SightTiles,
    find_contradictions,
    find_sight,
    open_sight,
    report_contradictions,
    write_sights,
)
from gis_radar.scans.sight.sight import HIDERS


def traffic(path, *, unseen=(), seconds=200, seed=3):
    """What the sensor records of cars that drive along the lane across, at 10 m/s; some hidden.

    `unseen` are the left and right bounds of what nothing is seen of, metres left of the axis.
    """
    rng = np.random.default_rng(seed)
    time, left = [], []
    for frame in range(20 * seconds):
        for car in range(2):
            at = (0.5 * frame + 60.0 * car) % 120.0 - 60.0
            if rng.random() < 0.4 and not any(low < at < high for low, high in unseen):
                time.append(START + 0.05 * frame)
                left.append(at)
    points = np.column_stack([np.full(len(left), 100.0), left, np.full(len(left), -5.0)])
    return recording(path, np.array(time), points, range_rate=np.where(np.array(left) > 0, 5, -5.0))


def compared(tmp_path, scanned, unseen):
    """Sight from a scan, and what a recording of the world as it is contradicts of it."""
    tiles = across()
    sight = sight_over(tmp_path, scanned, tiles)
    path = traffic(tmp_path / "R1.parquet", unseen=unseen)
    movement, frames = count_movement([path], as_track(SENSOR), tiles, [np.nan])
    hits = MovingHits(sight=sight, count=movement[0], frames=frames[0])
    (found,) = find_contradictions([hits], tiles)
    return tiles, sight, found


BEHIND_THE_HOUSE = (-25.0, 25.0)


def test_a_recording_that_agrees_contradicts_nothing(tmp_path):
    for points, unseen in ((flat(), ()), (flat((HOUSE, ROOF_M)), (BEHIND_THE_HOUSE,))):
        _, sight, found = compared(tmp_path, points, unseen)
        assert found.tiles == 0
        np.testing.assert_array_equal(found.corrected().state, sight.state)


def test_a_wall_since_the_flight_hides_where_nothing_moves(tmp_path):
    tiles, _, found = compared(tmp_path, flat(), (BEHIND_THE_HOUSE,))
    certain = np.abs(np.abs(left_m(tiles)) - 25.0) > 3.0
    shadow = np.abs(left_m(tiles)) < 25.0
    np.testing.assert_array_equal(found.no_movement[certain], shadow[certain])
    assert not found.movement.any()
    after = found.corrected()
    assert set(np.array(HIDERS)[after.hider[found.no_movement]]) == {"something not in the scan"}
    assert (after.state[found.no_movement] == HIDDEN).all()


def test_a_house_pulled_down_shows_what_moves_behind_it(tmp_path):
    _, sight, found = compared(tmp_path, flat((HOUSE, ROOF_M)), ())
    assert not found.no_movement.any()
    np.testing.assert_array_equal(found.movement, sight.state == HIDDEN)
    after = found.corrected()
    assert (after.state == IN_SIGHT).all()
    assert np.isnan(after.hidden_at_m).all()


def test_ghosts_behind_a_facade_contradict_nothing(tmp_path):
    tiles, sight, _ = compared(tmp_path, flat((HOUSE, ROOF_M)), (BEHIND_THE_HOUSE,))
    shadow = sight.state == HIDDEN
    count = np.where(shadow, 10, 100)  # a tenth of what moves comes as ghosts
    (found,) = find_contradictions([MovingHits(sight=sight, count=count, frames=4000)], tiles)
    assert found.tiles == 0


def test_where_nothing_is_expected_nothing_is_missed(tmp_path):
    tiles = across()
    sight = sight_over(tmp_path, flat(), tiles)
    hits = MovingHits(sight=sight, count=np.zeros(240, np.int64), frames=4000)
    (found,) = find_contradictions([hits], tiles)
    assert found.tiles == 0
    assert find_contradictions([], tiles) == []


def test_another_sensor_shows_the_flow_behind_a_wall(tmp_path):
    """A lane that one sensor has wholly behind a new wall counts by what the other one sees."""
    right = lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=120)
    left = lane_quads(EAST + 100.0, NORTH, 90.0, count=120)
    tiles = SightTiles.of(tiles_of([right, left], height_m=ROAD_M))
    sight = sight_over(tmp_path, flat(), tiles)
    behind = left_m(tiles) > 0.0
    blind = MovingHits(sight=sight, count=np.where(behind, 0, 50), frames=4000)
    seeing = MovingHits(sight=sight, count=np.full(240, 50), frames=4000)
    found, other = find_contradictions([blind, seeing], tiles)
    certain = left_m(tiles) > 2.0
    assert found.no_movement[certain].all()
    assert not found.no_movement[~behind].any()
    assert other.tiles == 0
    (alone,) = find_contradictions([blind], tiles)  # who says that anybody drives there?
    assert alone.tiles == 0


@pytest.mark.parametrize("level_m", [0.0, 6.5])
def test_what_moves_on_a_bridge_does_not_count_below(tmp_path, level_m):
    points = np.array([[100.0, -20.0, level_m - 5.0], [100.0, 0, level_m - 5.0], [100.0, 20, -5]])
    path = recording(
        tmp_path / "R1.parquet", np.full(3, START), points, range_rate=np.array([5.0, 5.0, 0.2])
    )
    movement, frames = count_movement([path], as_track(SENSOR), across(ROAD_M), [np.nan])
    assert (movement[0].sum(), frames[0]) == (0 if level_m else 2, 1)


def test_contradictions_are_a_line_a_sensor(tmp_path):
    _, _, found = compared(tmp_path, flat(), (BEHIND_THE_HOUSE,))
    heard = Listener()
    report_contradictions([found, found], heard)
    ((rank, message),) = heard.messages
    assert rank == "warning"
    still = 2 * found.no_movement.sum()
    assert f"of R1 contradicts its sight: nothing moves on {still} tiles" in message
    assert "hidden" not in message
    _, _, found = compared(tmp_path, flat((HOUSE, ROOF_M)), ())
    report_contradictions([found], heard)
    assert f"something moves on {found.movement.sum()} hidden tiles" in heard.messages[1][1]


def test_a_file_of_sight_is_read_back_as_it_was(tmp_path):
    table = tiles_of([lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=240)], height_m=ROAD_M)
    tiles, sight, found = compared(tmp_path, flat((HOUSE, ROOF_M)), ((30.0, 60.0),))
    assert tiles.fingerprint == SightTiles.of(table).fingerprint
    path = tmp_path / "sight.gpkg"
    write_sights([found.corrected()], table, path, contradictions=[found])
    file = SightFile(path, tiles)
    after = file.find(SENSOR)
    for name in ("state", "hider", "hidden_at_m", "uncovered"):
        np.testing.assert_array_equal(getattr(after, name), getattr(found.corrected(), name))
    assert after.scan == sight.scan
    layer = gpd.read_file(path, layer="contradicted")
    listed = np.flatnonzero(found.no_movement | found.movement)
    assert layer["tile_id"].tolist() == tiles.tile_id[listed].tolist()
    assert set(layer["what"]) == {"nothing moves in sight", "moves where hidden"}
    # the same content in another file has the same digest
    write_sights([found.corrected()], table, tmp_path / "again.gpkg")
    assert SightFile(tmp_path / "again.gpkg", tiles).digest == file.digest
    write_sights([sight], table, tmp_path / "other.gpkg")
    assert SightFile(tmp_path / "other.gpkg", tiles).digest != file.digest


def moved(**change):
    return pose(height=ROAD_M + 6.0, view=SENSOR.view, **change)


@pytest.mark.parametrize(
    ("sensor", "said"),
    [
        (moved(sensor="R7"), "holds no sight of R7, only of R1"),
        (moved(easting=EAST + 1.2), "was made 1.2 m and 0.0 deg from its pose"),
        (moved(yaw=3.0), "was made 0.0 m and 3.0 deg from its pose"),
        (pose(height=ROAD_M + 6.0, view=View(max_range_m=90.0)), "was made for another view"),
    ],
)
def test_a_file_of_sight_serves_its_poses_only(tmp_path, sensor, said):
    table = tiles_of([lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=240)], height_m=ROAD_M)
    write_sights([find_sight(SENSOR, SightTiles.of(table))], table, tmp_path / "sight.gpkg")
    file = SightFile(tmp_path / "sight.gpkg", SightTiles.of(table))
    assert file.find(moved(easting=EAST + 0.3)).pose.easting == EAST + 0.3
    with pytest.raises(InputError, match=said):
        file.read([sensor])


def test_files_that_hold_no_sight_of_these_tiles_are_refused(tmp_path):
    table = tiles_of([lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=240)], height_m=ROAD_M)
    tiles = SightTiles.of(table)
    with pytest.raises(InputError, match=r"gone.gpkg: no such file"):
        open_sight(tiles, sight=tmp_path / "gone.gpkg")
    (tmp_path / "text.gpkg").write_text("sight")
    with pytest.raises(InputError, match=r"text.gpkg: not a file of sight"):
        open_sight(tiles, sight=tmp_path / "text.gpkg")
    table.to_file(tmp_path / "tiles.gpkg", layer="tiles")
    with pytest.raises(InputError, match=r"tiles.gpkg: not a file of sight"):
        open_sight(tiles, sight=tmp_path / "tiles.gpkg")
    table.to_file(tmp_path / "odd.gpkg", layer="sight")
    with pytest.raises(InputError, match=r"layer sight lacks sensor, pose, state"):
        open_sight(tiles, sight=tmp_path / "odd.gpkg")
    write_sights([find_sight(SENSOR, tiles)], table, tmp_path / "sight.gpkg")
    other = SightTiles.of(tiles_of([lane_quads(EAST + 90.0, NORTH - 60.0, 90.0)], height_m=ROAD_M))
    with pytest.raises(InputError, match=r"sight.gpkg: was made for tiles"):
        open_sight(other, sight=tmp_path / "sight.gpkg")
    with pytest.raises(UsageError, match="both scans and a file of sight"):
        open_sight(tiles, sight=tmp_path / "sight.gpkg", scans=["scan.laz"])
    assert open_sight(tiles) is None


@pytest.fixture
def rebuilt(tmp_path, monkeypatch):
    """A folder, where we are, with a scan that lacks a house, and a recording that has it."""
    monkeypatch.chdir(tmp_path)
    table = tiles_of([lane_quads(EAST + 100.0, NORTH - 60.0, 90.0, count=240)], height_m=ROAD_M)
    problems = table.iloc[:0][["lanelet_id", "geometry"]].assign(action="", reason="")
    gr.write_tiles(table, tmp_path / "tiles.gpkg", problems=problems)
    write_points(tmp_path / "scan.laz", flat())
    SENSOR.write(tmp_path / "R1.json")
    traffic(tmp_path / "R1.parquet", unseen=(BEHIND_THE_HOUSE,), seconds=900)
    return table


def test_the_corrected_sight_serves_hits(rebuilt, run, tmp_path):
    """The whole way: a warning with a scan, a corrected sight, and none with that."""
    given = ("R1.parquet", "--pose", "R1.json", "--tiles", "tiles.gpkg")
    code, _, err = run("measure", *given, "--hits-only", "--scan", "scan.laz", "-o", "plain")
    assert code == 0
    assert "contradicts its sight: nothing moves on" in " ".join(err.split())
    words = ("--pose", "R1.json", "--tiles", "tiles.gpkg", "--scan", "scan.laz")
    code, _, err = run("sight", *words, "--recording", "R1.parquet", "-o", "sight.gpkg")
    assert (code, "contradicts its sight" in " ".join(err.split())) == (0, True)
    code, out, err = run(
        "measure", *given, "--hits-only", "--sight", "sight.gpkg", "-o", "occ", "--json"
    )
    assert code == 0
    assert "contradicts" not in out
    plain, found = gr.open_dataset("plain"), gr.open_dataset("occ")
    layer = gpd.read_file("sight.gpkg", layer="sight")
    in_sight = layer.loc[layer["state"] == "in sight", "tile_id"]
    assert sorted(found.sights()["tile_id"]) == sorted(in_sight)
    assert 80 <= len(plain.sights()) - len(found.sights()) <= 110  # 50 m of half metres
    road = SightTiles.of(rebuilt)
    digest = SightFile("sight.gpkg", road).digest
    assert found.manifest.settings["sight"] == {"file": "sight.gpkg", "digest": digest}


def test_hits_says_nothing_of_sight_after_a_short_recording(rebuilt, run, tmp_path):
    traffic(tmp_path / "R1.parquet", unseen=(BEHIND_THE_HOUSE,), seconds=200)
    given = ("R1.parquet", "--pose", "R1.json", "--tiles", "tiles.gpkg")
    code, _, err = run("measure", *given, "--hits-only", "--scan", "scan.laz", "-o", "plain")
    assert (code, "contradicts" in err) == (0, False)


def test_recordings_from_one_pose_correct_sight_together(rebuilt, run, tmp_path):
    table = pq.read_table("R1.parquet")
    middle = pc.less(table["time"], START + 450.0)
    pq.write_table(table.filter(middle), "R1-a.parquet")
    pq.write_table(table.filter(pc.invert(middle)), "R1-b.parquet")
    given = ("--pose", "R1.json", "--tiles", "tiles.gpkg", "--scan", "scan.laz")
    run("sight", *given, "--recording", "R1.parquet", "-o", "whole.gpkg")
    both = ("--recording", "R1-a.parquet", "--pose", "R1.json", "--recording", "R1-b.parquet")
    code, _, _ = run("sight", *given, *both, "-o", "halves.gpkg")
    assert code == 0
    for layer in ("sight", "contradicted"):
        whole, halves = (gpd.read_file(f"{name}.gpkg", layer=layer) for name in ("whole", "halves"))
        assert len(whole) > 0
        assert_geodataframe_equal(whole, halves)


def test_a_short_recording_corrects_no_sight(rebuilt, run, tmp_path):
    traffic(tmp_path / "R1.parquet", unseen=(BEHIND_THE_HOUSE,), seconds=200)
    given = ("--pose", "R1.json", "--tiles", "tiles.gpkg", "--scan", "scan.laz")
    code, _, err = run("sight", *given, "--recording", "R1.parquet", "-o", "sight.gpkg")
    said = " ".join(err.split())
    assert (code, "are too few to correct its sight by, 6000 are needed" in said) == (0, True)
    assert "contradicts" not in said
    assert (gpd.read_file("sight.gpkg", layer="sight")["state"] == "in sight").all()


def test_the_pose_and_the_tiles_of_a_sight_are_in_one_system(rebuilt, run, tmp_path):
    moved(crs="EPSG:25833").write(tmp_path / "R1.json")
    words = ("--pose", "R1.json", "--tiles", "tiles.gpkg", "--scan", "scan.laz")
    code, _, err = run("sight", *words, "-o", "sight.gpkg")
    told = "the pose of R1 is in EPSG:25833, but the tiles in EPSG:25832"
    assert (code, told in " ".join(err.split())) == (3, True)
    assert not (tmp_path / "sight.gpkg").exists()


def test_sensors_that_see_the_same_tiles_keep_their_own_sight(tmp_path, monkeypatch):
    lanes = [lane_quads(EAST + 20.0, NORTH - 10.0, 90.0), lane_quads(EAST + 60.0, NORTH, 90.0)]
    road = SightTiles.of(tiles_of(lanes, height_m=[370.0, 374.0]))
    monkeypatch.setattr(pose_sights, "ROAD_TILES", 20)
    book = SightBook(road=road)
    near, far = pose(), pose(sensor="R2", easting=EAST + 80.0, yaw=180.0)
    time = START + np.arange(2.0)
    paths = [recording(tmp_path / f"{k}.parquet", time, np.ones((2, 3))) for k in range(2)]
    placed = book.place(paths, [as_track(near), as_track(far)], None, QUIET)
    (one,), (other,) = (each.sights for each in placed)
    np.testing.assert_array_equal(one.tile_id, other.tile_id)
    assert [book.sights[each.name].pose for each in (one, other)] == [near, far]
    assert [each.road_m for each in (one, other)] == [370.0, 374.0]


def test_recordings_of_sight_are_one_a_pose(rebuilt, run):
    words = ("--pose", "R1.json", "--tiles", "tiles.gpkg", "--scan", "scan.laz")
    both = ("--recording", "R1.parquet") * 2
    code, _, err = run("sight", *words, *both, "-o", "sight.gpkg")
    assert (code, "2 recordings, but 1 poses" in err) == (2, True)
    code, _, err = run("sight", *words[:4], "-o", "sight.gpkg")
    assert (code, "no scan is given" in err) == (2, True)
    code, _, err = run(
        "measure", "R1.parquet", *words, "--sight", "sight.gpkg", "--hits-only", "-o", "occ",
    )  # fmt: skip
    assert (code, "both scans and a file of sight are given" in err) == (2, True)
