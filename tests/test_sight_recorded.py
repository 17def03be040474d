"""Sight against recordings: what moves shows what the scan does not."""

import numpy as np
import pytest
from maps import Listener
from scans import write_points
from sites import EAST, NORTH, START, lane_quads, pose, recording, tiles_of
from test_sight import HOUSE, ROAD_M, ROOF_M, SENSOR, across, flat, left_m, sight_over

import gis_radar as gr
from gis_radar.base import QUIET
from gis_radar.hdmap import TileGrid
from gis_radar.measures import PoseNumbers, SightBook, pose_sights
from gis_radar.measures.hit_counter import HitCounter, rows_of_detections
from gis_radar.poses import as_track
from gis_radar.scans import (
    HIDDEN,
    MovingHits,
    SightTiles,
    find_contradictions,
    report_contradictions,
)


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
    points = np.column_stack([np.full(len(left), 100.0), left, rng.normal(-5.0, 0.01, len(left))])
    return recording(path, np.array(time), points, range_rate=np.where(np.array(left) > 0, 5, -5.0))


def counted(path, tiles):
    """Frames with movement on each tile, and all frames, of a recording from one pose."""
    counter, count, frames = HitCounter(tiles, TileGrid(tiles.quads)), np.zeros(240, np.int64), 0
    numbers = PoseNumbers.of(SENSOR, road_m=np.nan)
    for batch in gr.open_recording(path).read():
        rows = rows_of_detections(batch, batch.time)
        frames += sum(
            len(each.frames) for each in counter.add(rows, 0, len(batch), numbers, movement=count)
        )
    return {"count": count, "frames": frames + len(counter.end().frames)}


def compared(tmp_path, scanned, unseen):
    """Sight from a scan, and what a recording of the world as it is contradicts of it."""
    tiles = across()
    sight = sight_over(tmp_path, scanned, tiles)
    path = traffic(tmp_path / "R1.parquet", unseen=unseen)
    hits = MovingHits(sight=sight, **counted(path, tiles))
    (found,) = find_contradictions([hits], tiles)
    return tiles, sight, found


BEHIND_THE_HOUSE = (-25.0, 25.0)


def test_a_recording_that_agrees_contradicts_nothing(tmp_path):
    for points, unseen in ((flat(), ()), (flat((HOUSE, ROOF_M)), (BEHIND_THE_HOUSE,))):
        _, _, found = compared(tmp_path, points, unseen)
        assert not (found.no_movement | found.movement).any()


def test_a_wall_since_the_flight_hides_where_nothing_moves(tmp_path):
    tiles, _, found = compared(tmp_path, flat(), (BEHIND_THE_HOUSE,))
    certain = np.abs(np.abs(left_m(tiles)) - 25.0) > 3.0
    shadow = np.abs(left_m(tiles)) < 25.0
    np.testing.assert_array_equal(found.no_movement[certain], shadow[certain])
    assert not found.movement.any()


def test_a_house_pulled_down_shows_what_moves_behind_it(tmp_path):
    _, sight, found = compared(tmp_path, flat((HOUSE, ROOF_M)), ())
    assert not found.no_movement.any()
    np.testing.assert_array_equal(found.movement, sight.state == HIDDEN)


def test_ghosts_behind_a_facade_contradict_nothing(tmp_path):
    tiles, sight, _ = compared(tmp_path, flat((HOUSE, ROOF_M)), (BEHIND_THE_HOUSE,))
    shadow = sight.state == HIDDEN
    count = np.where(shadow, 10, 100)  # a tenth of what moves comes as ghosts
    (found,) = find_contradictions([MovingHits(sight=sight, count=count, frames=4000)], tiles)
    assert not (found.no_movement | found.movement).any()


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
    assert not (other.no_movement | other.movement).any()
    (alone,) = find_contradictions([blind], tiles)  # who says that anybody drives there?
    assert not (alone.no_movement | alone.movement).any()


@pytest.mark.parametrize("level_m", [0.0, 6.5])
def test_what_moves_on_a_bridge_does_not_count_below(tmp_path, level_m):
    points = np.array([[100.0, -20.0, level_m - 5.0], [100.0, 0, level_m - 5.0], [100.0, 20, -5]])
    path = recording(
        tmp_path / "R1.parquet", np.full(3, START), points, range_rate=np.array([5.0, 5.0, 0.2])
    )
    found = counted(path, across(ROAD_M))
    assert (found["count"].sum(), found["frames"]) == (0 if level_m else 2, 1)


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


def moved(**change):
    return pose(height=ROAD_M + 6.0, view=SENSOR.view, **change)


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


def test_hits_warn_of_a_house_that_the_scan_lacks(rebuilt, run, tmp_path):
    given = ("R1.parquet", "--pose", "R1.json", "--tiles", "tiles.gpkg")
    code, _, err = run("measure", *given, "--hits-only", "--scan", "scan.laz", "-o", "plain")
    assert code == 0
    assert "contradicts its sight: nothing moves on" in " ".join(err.split())


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
