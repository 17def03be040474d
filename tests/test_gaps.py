"""Stretches that nothing passes although vehicles pass on both sides: named, and only those."""

import numpy as np
import pytest
from datasets import measured
from maps import Listener
from sites import EAST, NORTH, lane_quads, tiles_of
from test_sight import ROAD_M, SENSOR
from test_sight_recorded import traffic

from gis_radar.scans import MovingHits, SightTiles, find_gaps, find_sight

FRAMES = 4000


def lane(*, left=60.0, heading=90.0, count=240):
    """A lane across, 100 m ahead, that begins so far to the right."""
    return lane_quads(EAST + 100.0, NORTH - left, heading, count=count)


@pytest.mark.parametrize(
    ("unseen", "tiles"), [((), 0), ([(-20.0, 0.0)], 30), ([(-3.0, -2.0)], 0), ([(20.0, 60.0)], 0)]
)
def test_what_a_house_hides_without_a_scan_is_named(tmp_path, unseen, tiles):
    """Not what is shorter than a car, and not where nobody is met behind it."""
    heard = Listener()
    path = traffic(tmp_path / "R1.parquet", unseen=unseen)
    road = tiles_of([lane()], height_m=ROAD_M)
    measured([path], [SENSOR], road, tmp_path / "o", reporter=heard)
    said = [line for line in map(str, heard.messages) if "never passed" in line]
    assert len(said) == (tiles > 0)
    if tiles:
        assert f"{tiles} tiles are never passed" in said[0]
        assert "most on lanelet 100" in said[0]


def moved(lanes, counts):
    """Return the gaps where so many frames had movement on the tiles of each lane."""
    tiles = SightTiles.of(tiles_of(lanes, height_m=ROAD_M))
    sight = find_sight(SENSOR, tiles)
    count = np.concatenate(counts).astype(np.int64)
    return find_gaps([MovingHits(sight=sight, count=count, frames=FRAMES)], tiles)


def counts(rate, *empty):
    found = np.full(240, rate)
    for begin, end in empty:
        found[begin:end] = 0
    return found


def test_gaps_need_traffic_on_both_sides_and_enough_of_it():
    assert [(g.lanelet_id, g.tiles) for g in moved([lane()], [counts(20, (100, 140))])] == [
        (100, 40)
    ]
    assert moved([lane()], [counts(20)]) == []
    assert moved([lane()], [counts(20, (100, 240))]) == []  # its end
    assert moved([lane()], [counts(20, (0, 140))]) == []  # its beginning
    assert moved([lane()], [counts(1, (100, 140))]) == []  # two vehicles
    slower = counts(20)
    slower[100:140] = 2  # queues on both sides, free between them
    assert moved([lane()], [slower]) == []


def test_traffic_of_crossing_lanes_tells_nothing_of_a_lane_that_nobody_takes():
    """A turn: its first and last tiles lie under the lanes that it leaves and joins."""
    one, other = (
        lane_quads(EAST + 80.0, NORTH - 50.0, 0.0, count=80),
        lane_quads(EAST + 80.0, NORTH + 50.0, 0.0, count=80),
    )
    own = np.zeros(240)
    own[14:27], own[214:227] = 20, 20  # hits of those that cross
    busy = np.full(80, 20)
    assert moved([lane(), one, other], [own, busy, busy]) == []
    assert len(moved([lane()], [own])) == 1
