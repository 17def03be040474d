"""What vehicles cover, hide and pass, against shapely and plain loops."""

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely
from driven import FIRST, drive, straight_tiles
from hypothesis import example, given, settings
from hypothesis import strategies as st
from shapely.affinity import rotate, translate
from sites import pose

from gis_radar.hdmap import quads
from gis_radar.measures import PoseSight
from gis_radar.tracking import PathBook, footprints, visibility
from gis_radar.tracking.footprints import MOST_PARTS, overlapped_m
from gis_radar.tracking.occupancy import OccupancyEngine
from gis_radar.tracking.passages import LaneletPlaces, PassageBook, levels_of

NO_FRAMES = pd.DataFrame({"sight": [], "first_step": [], "last_step": []})


@pytest.fixture(scope="module", autouse=True)
def _every_step_is_looked_at():
    with pytest.MonkeyPatch.context() as often:
        often.setattr(visibility, "CHECK_STEPS", 1)
        yield


def rows_of(tracks, *, length=4.5, width=1.8, p_heavy=0.0):
    """Give the rows of the vehicles of some states."""
    by = tracks.groupby("vehicle")["step"].agg(["min", "max"])
    return pd.DataFrame(
        {
            "vehicle": by.index, "first_step": by["min"], "last_step": by["max"],
            "length_m": length, "width_m": width, "p_heavy": p_heavy,
        }
    )  # fmt: skip


def crossing_tiles(angles, levels, widths):
    """Lay lanelets of 20 m through the origin, each at an angle and a height."""
    parts = []
    for number, (angle, level, width) in enumerate(zip(angles, levels, widths, strict=True)):
        part = straight_tiles(40, width=width, lanelet_id=number, height=level)
        part.geometry = part.geometry.translate(-10.0, 0.0).rotate(angle, origin=(0, 0))
        parts.append(part)
    tiles = pd.concat(parts, ignore_index=True)
    return gpd.GeoDataFrame(tiles.assign(tile_id=np.arange(len(tiles))), crs=parts[0].crs)


def cross_lines(tiles):
    corners = quads(tiles)
    ends = np.stack([corners[:, :2].mean(axis=1), corners[:, 2:].mean(axis=1)], axis=1)
    return shapely.linestrings(ends)


def rectangle(state, length, width):
    box = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    turned = rotate(box, state["heading"], origin=(0, 0))
    return translate(turned, state["easting"], state["northing"])


def occupied_pairs(tables):
    """Give the pairs of a tile and a step, with seen, of a table of runs; each once."""
    pairs = {}
    for row in tables.itertuples():
        for step in range(row.first_step, row.last_step + 1):
            assert (row.tile_id, step) not in pairs
            pairs[row.tile_id, step] = bool(row.seen)
    return pairs


def run_engine(tiles, tracks, rows, *, views=(), held=NO_FRAMES, span=None):
    engine = OccupancyEngine(tiles, {each.name: each for each in views})
    span = span or (int(tracks["step"].min()), int(tracks["step"].max()) + 1)
    passages = engine.advance(tracks, rows, held, span)
    return passages, *engine.flush()


angles = st.floats(-180, 180).map(lambda x: round(x, 2))


@settings(max_examples=25)
@given(
    lanes=st.lists(
        st.tuples(angles, st.sampled_from([0.0, 1.9, 6.0]), st.sampled_from([0.6, 3.0, 5.5])),
        min_size=1, max_size=3,
    ),
    cars=st.lists(
        st.tuples(
            st.floats(-9, 9), st.floats(-4, 4), angles, st.sampled_from([0.8, 1.8, 2.5]),
            st.integers(0, 2), st.booleans(),
        ),
        min_size=1, max_size=4,
    ),
)  # fmt: skip
def test_rectangles_cover_what_shapely_says(lanes, cars):
    tiles = crossing_tiles(*zip(*lanes, strict=True))
    states = []
    for number, (x, y, heading, _, lane, seen) in enumerate(cars):
        state = drive(number, FIRST, [0.0], lanelet_id=lane % len(lanes), seen=seen)
        states.append(state.assign(easting=x, northing=y, heading=heading, s_m=10.0))
    tracks = pd.concat(states, ignore_index=True)
    rows = rows_of(tracks, width=[car[3] for car in cars])
    occupied = occupied_pairs(run_engine(tiles, tracks, rows)[1])
    lines, height = cross_lines(tiles), tiles["height_m"].to_numpy()
    long = shapely.length(lines)
    sure, likely, seen = (np.zeros((len(cars), len(tiles)), np.bool_) for _ in range(3))
    for number, state in enumerate(tracks.to_dict("records")):
        width = rows["width_m"].iloc[number]
        least, most = (
            shapely.length(shapely.intersection(lines, rectangle(state, 4.5 + e, width + e)))
            for e in (-1e-6, 1e-6)
        )
        need = np.minimum(np.minimum(0.5, long / 2), width / 2)
        level = np.abs(height - lanes[state["lanelet_id"]][1]) <= 2.0
        sure[number], likely[number] = level & (least >= need), level & (most >= need - 1e-6)
        seen[number] = state["seen"]
    certain = (sure == likely).all(axis=0)
    got = {tile: flag for (tile, _), flag in occupied.items()}
    assert set(np.flatnonzero(certain & sure.any(axis=0))) <= set(got)
    assert set(got) <= set(np.flatnonzero(likely.any(axis=0)))
    for tile in np.flatnonzero(certain & sure.any(axis=0)):
        assert got[tile] == (sure & seen)[:, tile].any()


@settings(max_examples=60)
@given(
    turns=st.lists(st.floats(-12, 12), min_size=20, max_size=40),
    line=st.tuples(st.floats(-25, 25), st.floats(-12, 12), angles, st.floats(0.5, 8)),
    length=st.sampled_from([12.5, 18.0, 25.0]),
    driven=st.integers(0, 39),
)
@example(turns=[0.0, 4.0] + 18 * [0.0], line=(1.9375, 0.0, 0.0, 2.0), length=18.0, driven=20)
def test_a_strip_overlaps_as_the_buffer_of_its_path(turns, line, length, driven):
    """The path goes on by 1 m and a turn; the oracle buffers its last metres."""
    heading = np.radians(np.cumsum([0.0, *turns]))[: driven + 1]
    move = np.column_stack([np.cos(heading), np.sin(heading)])
    fronts = np.concatenate([[[0.0, 0.0]], np.cumsum(move[:-1], axis=0)])
    boxes = np.column_stack(
        [fronts - move * length / 2, move, np.full(len(move), length / 2), np.full(len(move), 1.25)]
    )
    long = np.ones(len(fronts), np.bool_)
    with pytest.MonkeyPatch.context() as finer:
        finer.setattr(footprints, "PATH_STEP_M", 0.5)
        path, points, begins = PathBook().extend(np.zeros(len(fronts), np.int64), boxes, long)
    ends = shapely.affinity.rotate(
        shapely.LineString([(line[0], line[1] - line[3] / 2), (line[0], line[1] + line[3] / 2)]),
        line[2],
    )
    got = overlapped_m(
        shapely.get_coordinates(ends).ravel(), boxes[-1], int(path[-1]), points, begins,
        np.empty((2 * MOST_PARTS, 2)),
    )  # fmt: skip
    taken = shapely.LineString(np.concatenate([[[-60.0, 0.0]], fronts]))
    last = np.subtract(taken.coords[-1], taken.coords[-2])
    beyond = shapely.LineString([*taken.coords, fronts[-1] + last / np.hypot(*last)])
    # A line within a centimetre of the edge may count or not; the rear end is cut at the heading
    # before or after a turn.
    rear = max(len(fronts) - 1 - length, 0.0)
    near = np.abs(np.arange(1, len(heading)) - rear) < 1.0
    turn = np.abs(np.diff(heading)[near]).max(initial=0.0)
    rear_m = 1.25 * np.tan(turn)
    least, most = (
        ends.intersection(
            shapely.ops.substring(
                beyond, taken.length - length - e - np.copysign(rear_m, e), taken.length + e
            ).buffer(1.25 + e, cap_style="flat", join_style="round", quad_segs=64)
        ).length
        for e in (-0.01, 0.01)
    )  # fmt: skip
    # its rear end is cut across the path's last steps of half a metre
    assert least - 0.1 < got < most + 0.1


def test_the_strip_of_a_truck_bends_and_goes_on_from_piece_to_piece(monkeypatch):
    """On a curve of 15 m radius the rear of 18 m lies 9 m beside the straight rectangle."""
    angle = np.radians(np.arange(0, 120, 1.5))
    front = 15 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    heading = np.degrees(angle)
    middle = front - 9.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    tracks = drive(0, FIRST, np.zeros(len(angle)), length=18.0)
    tracks = tracks.assign(easting=middle[:, 0], northing=middle[:, 1], heading=heading)
    tiles = crossing_tiles([0.0, 90.0], [np.nan] * 2, [3.0] * 2)
    tiles.geometry = tiles.geometry.translate(14.0, 8.0)
    rows = rows_of(tracks, length=18.0, width=2.5)
    coarse = occupied_pairs(run_engine(tiles, tracks, rows)[1])
    monkeypatch.setattr(footprints, "PATH_STEP_M", 0.1)
    whole = occupied_pairs(run_engine(tiles, tracks, rows)[1])
    assert len(whole.keys() ^ coarse.keys()) < 0.03 * len(whole)
    engine = OccupancyEngine(tiles, ())
    for low, high in ((0, 33), (33, 34), (34, len(tracks))):
        part = tracks.iloc[low:high].reset_index(drop=True)
        engine.advance(part, rows, NO_FRAMES, (FIRST + low, FIRST + high))
    assert occupied_pairs(engine.flush()[0]) == whole
    line = shapely.LineString([(-40, 0), *front])
    lines, need = cross_lines(tiles), 0.5
    wrong = 0
    for k in range(len(front)):
        end = line.project(shapely.Point(front[k]))
        strip = shapely.ops.substring(line, end - 18, end).buffer(1.25, cap_style="flat")
        over = shapely.length(shapely.intersection(lines, strip))
        got = np.array([(tile, FIRST + k) in whole for tile in range(len(lines))])
        wrong += np.count_nonzero(got != (over >= need))
    assert len(whole) > 500
    assert wrong == 0


def test_a_passing_car_occupies_each_tile_for_length_by_speed():
    """At 5 m/s, 0.25 m a step, a car of 4.5 m is 18 steps on a cross-line."""
    tiles = straight_tiles(60)
    fronts = np.arange(-1.0, 40.0, 0.25) + 1e-3
    tracks = drive(0, FIRST, fronts)
    _, runs, _ = run_engine(tiles, tracks, rows_of(tracks))
    steps = (runs["last_step"] - runs["first_step"] + 1).to_numpy()
    assert runs["tile_id"].tolist() == list(range(60))
    assert set(steps) == {18}
    first = FIRST + np.searchsorted(fronts, tiles["s_m"] + 0.25)
    np.testing.assert_array_equal(runs["first_step"], first)


def tower_views(tiles, places):
    ids = tiles["tile_id"].to_numpy(np.int64)
    return [
        PoseSight(
            name=f"R{n}", tile_id=ids[seen], road_m=float("nan"),
            pose=pose(easting=place[0], northing=place[1], height=place[2]),
        )
        for n, (place, seen) in enumerate(places)
    ]  # fmt: skip


def held_by(views, first, last):
    return pd.DataFrame(
        [{"sight": each.name, "first_step": first, "last_step": last} for each in views]
    )


def hidden_by(state, rows, tiles, view):
    """Tell for all tiles whether the line of sight crosses a vehicle that is not on the tile."""
    row = rows[rows["vehicle"] == state["vehicle"]].iloc[0]
    box = rectangle(state, row["length_m"], row["width_m"])
    centre = shapely.centroid(tiles.geometry.array)
    over = shapely.length(shapely.intersection(cross_lines(tiles), box))
    on_it = shapely.contains(box, centre) | (over >= min(0.5, row["width_m"] / 2))
    ends = shapely.get_coordinates(centre)
    eye = view.pose.position
    inside = shapely.intersection(
        shapely.linestrings(np.stack([np.broadcast_to(eye[:2], ends.shape), ends], axis=1)), box
    )
    tall = 3.5 if row["p_heavy"] >= 0.5 else 1.5
    hidden = np.zeros(len(tiles), np.bool_)
    for tile in np.flatnonzero(~on_it & (shapely.length(inside) > 0)):
        apart = shapely.get_coordinates(inside[tile]) - eye[:2]
        share = np.hypot(*apart.T) / np.hypot(*(ends[tile] - eye[:2]))
        height = eye[2] + share * (0.6 - eye[2])
        hidden[tile] = height.min() < tall and height.max() > 0.0
    return hidden


@settings(max_examples=25)
@given(
    eyes=st.lists(
        st.tuples(st.floats(-40, 40), st.floats(-30, 30), st.floats(1.0, 9.0)),
        min_size=1, max_size=2,
    ),
    cars=st.lists(
        st.tuples(st.floats(-9, 9), st.floats(-5, 5), angles, st.booleans()),
        min_size=1, max_size=3,
    ),
)  # fmt: skip
def test_lines_of_sight_are_hidden_as_by_samples(eyes, cars):
    tiles = crossing_tiles([0.0, 80.0], [0.0, 0.0], [3.0, 3.0])
    views = tower_views(tiles, [(eye, slice(n * 10, None)) for n, eye in enumerate(eyes)])
    states = [
        drive(number, FIRST, [0.0, 0.0], speed=0.0).assign(easting=x, northing=y, heading=heading)
        for number, (x, y, heading, _) in enumerate(cars)
    ]
    tracks = pd.concat(states).sort_values(["step", "vehicle"], ignore_index=True)
    rows = rows_of(tracks, p_heavy=[float(car[3]) for car in cars])
    held = held_by(views, FIRST, FIRST + 1)
    with pytest.MonkeyPatch.context() as at_once:
        at_once.setattr(visibility, "HIDDEN_S", 0.0)
        _, _, visible = run_engine(tiles, tracks, rows, views=views, held=held)
    cars = tracks[tracks["step"] == FIRST].to_dict("records")
    clear = np.zeros(len(tiles), np.bool_)
    for view in views:
        hidden = np.any([hidden_by(car, rows, tiles, view) for car in cars], axis=0)
        clear |= ~hidden & np.isin(np.arange(len(tiles)), view.tile_id)
    expected = set(np.flatnonzero(clear))
    assert len(expected ^ set(visible["tile_id"])) <= 2  # lines that graze a box
    assert (visible["last_step"] - visible["first_step"] == 1).all()


def test_a_hidden_tile_stays_visible_for_ten_seconds():
    """A truck stands between sensor and tiles for 20 s; a step without frames ends the count."""
    tiles = straight_tiles(60)
    views = tower_views(tiles, [((-20.0, 0.0, 3.0), slice(None))])
    tracks = drive(0, FIRST, np.full(400, 12.0), speed=0.0, length=10.0)
    rows = rows_of(tracks, length=10.0, width=2.5, p_heavy=1.0)
    span = (FIRST, FIRST + 500)
    held = pd.concat(
        [held_by(views, FIRST, FIRST + 99), held_by(views, FIRST + 101, FIRST + 499)],
        ignore_index=True,
    )
    _, _, visible = run_engine(tiles, tracks, rows, views=views, held=held, span=span)
    runs = visible.groupby("tile_id")[["first_step", "last_step"]].apply(
        lambda each: [(a - FIRST, b - FIRST) for a, b in each.to_numpy()]
    )
    assert runs[2] == [(0, 99), (101, 499)]  # before the truck
    assert runs[15] == [(0, 99), (101, 499)]  # under it
    assert runs[40] == [(0, 99), (101, 300), (400, 499)]  # behind it, until it is gone
    seen = visible.groupby("tile_id")["seen"].agg(list)
    assert (seen[15], seen[40]) == ([True, True], [False, False, True])


@pytest.mark.parametrize(
    ("stays", "runs"),
    [
        (19, [(0, 99, True)]),
        (
            21,
            [(0, 29, True), (30, 50, False), (51, 99, True)],
        ),
    ],
)
def test_runs_are_told_apart_where_a_tile_is_hidden_for_a_second(stays, runs):
    """A truck stands before the tiles for some steps."""
    tiles = straight_tiles(60)
    views = tower_views(tiles, [((-20.0, 0.0, 3.0), slice(None))])
    first = (FIRST // 4 + 1) * 4
    tracks = drive(0, first + 30, np.full(stays, 12.0), speed=0.0, length=10.0)
    rows = rows_of(tracks, length=10.0, width=2.5, p_heavy=1.0)
    held = held_by(views, first, first + 99)
    _, _, visible = run_engine(
        tiles, tracks, rows, views=views, held=held, span=(first, first + 100)
    )
    mine = visible[visible["tile_id"] == 40]
    found = zip(mine["first_step"] - first, mine["last_step"] - first, mine["seen"], strict=True)
    assert list(found) == runs


def test_a_second_sensor_sees_behind_the_truck():
    tiles = straight_tiles(60)
    places = [((-20.0, 0.0, 3.0), slice(None)), ((40.0, 0.0, 3.0), slice(0, 50))]
    views = tower_views(tiles, places)
    tracks = drive(0, FIRST, np.full(400, 12.0), speed=0.0, length=10.0)
    rows = rows_of(tracks, length=10.0, width=2.5, p_heavy=1.0)
    held = held_by(views, FIRST, FIRST + 399)
    _, _, visible = run_engine(tiles, tracks, rows, views=views, held=held)
    last = visible.set_index("tile_id")["last_step"] - FIRST
    assert last[40] == 399  # in sight of the other one
    assert last[55] == 199  # of the first alone


def test_passages_are_counted_once_and_where_visible():
    """Two lanelets of 10 m; a car that creeps back and forth over a middle passes once."""
    one, other = straight_tiles(20), straight_tiles(20, lanelet_id=8)
    other.geometry = other.geometry.translate(10.0)
    tiles = pd.concat([one, other], ignore_index=True).assign(tile_id=np.arange(40))
    fronts = np.array([4.0, 4.9, 5.1, 4.95, 5.2, 7.0, 9.9, 10.2, 12.0, 14.9, 15.6, 19.0])
    tracks = drive(4, FIRST, fronts, speed=np.arange(12.0))
    on = np.where(fronts < 10, 7, 8)
    tracks = tracks.assign(
        lanelet_id=pd.array(on, "Int64"), s_m=np.where(fronts < 10, fronts, fronts - 10)
    )
    rows = rows_of(tracks, p_heavy=0.9)
    views = tower_views(tiles, [((-20.0, 0.0, 6.0), slice(None))])
    engine, passed = OccupancyEngine(tiles, {each.name: each for each in views}), []
    held = held_by(views, FIRST, FIRST + 11)
    for low, high in ((0, 2), (2, 10), (10, 12)):
        part = tracks.iloc[low:high].reset_index(drop=True)
        passed.append(engine.advance(part, rows, held, (FIRST + low, FIRST + high)))
    found = pd.concat(passed)
    assert found[["vehicle", "lanelet_id", "step", "speed"]].to_numpy().tolist() == [
        [4, 7, FIRST + 1, 1.0],
        [4, 8, FIRST + 9, 9.0],
    ]


def passages_of(states, tiles):
    rows = rows_of(states)
    return PassageBook(places=LaneletPlaces.of(tiles)).find(states, rows)["lanelet_id"].tolist()


def test_a_lane_change_passes_the_middle_of_one_lanelet():
    """From lanelet 7 to 9 beside it, before, at and after the middle of both."""
    one, beside = straight_tiles(20), straight_tiles(20, lanelet_id=9)
    tiles = pd.concat([one, beside], ignore_index=True).assign(tile_id=np.arange(40))
    for fronts, expected in (
        ([3.0, 3.4, 4.0, 6.0], [9]),
        ([3.0, 4.8, 5.3, 6.0], [9]),
        ([4.8, 5.1, 5.4, 6.0], [7]),
    ):
        states = drive(0, FIRST, fronts)
        assert (
            passages_of(states.assign(lanelet_id=pd.array([7, 7, 9, 9], "Int64")), tiles)
            == expected
        )


def test_levels_are_those_of_the_lanelet_and_kept_off_the_lanes():
    low, high = straight_tiles(20, height=1.0), straight_tiles(20, lanelet_id=9, height=7.0)
    tiles = pd.concat([low, high], ignore_index=True).assign(tile_id=np.arange(40))
    states = pd.concat([drive(0, FIRST, [1.0, 2.0, 3.0]), drive(1, FIRST, [1.0, 2.0])])
    states = states.reset_index(drop=True)
    states["lanelet_id"] = pd.array([None, 9, None, None, None], "Int64")
    height = tiles["height_m"].to_numpy()
    level = levels_of(states, LaneletPlaces.of(tiles), height)
    np.testing.assert_array_equal(level, [7.0, 7.0, 7.0, np.nan, np.nan])
