"""Real maps: every lanelet can be cut into slices, and is what Lanelet2 itself reads."""

import math
from functools import cache

import numpy as np
import pytest
import shapely
from maps import SHARED_MAPS, Listener, map_name, needs_shared_maps
from pyproj import Transformer

from gis_radar.hdmap import make_tiles, quads, read_map, read_osm, rungs, slices, sound

# reading a map takes longer than most of what is checked of it
map_at, osm_at = cache(read_map), cache(read_osm)


@needs_shared_maps
@pytest.mark.parametrize("path", SHARED_MAPS, ids=map_name)
def test_real_maps_are_cut_into_sound_slices(path):
    road = map_at(path)
    bounds = zip(road.lanelets["left"], road.lanelets["right"], strict=True)
    for (left, right), shape in zip(bounds, road.lanelets.geometry, strict=True):
        a, b = shapely.get_coordinates(left), shapely.get_coordinates(right)
        left_points, right_points = rungs(a, b, slices(a, b))
        assert sound(left_points, right_points).all()
        corners = [right_points[:-1], right_points[1:], left_points[1:], left_points[:-1]]
        union = shapely.union_all(shapely.polygons(np.stack(corners, axis=1)))
        assert union.symmetric_difference(shape).area < 0.005 * shape.area
    assert shapely.is_valid(road.lanelets.geometry.to_numpy()).all()
    assert set(road.problems["action"]) <= {"repaired", "doubtful"}  # none is left out


@pytest.fixture(scope="module")
def lanelet2():
    module = pytest.importorskip("lanelet2", reason="the lanelet2 wheel is for Linux only")
    pytest.importorskip("lanelet2.io", reason="the lanelet2 wheel is for Linux only")
    return module


@needs_shared_maps
@pytest.mark.parametrize("path", SHARED_MAPS, ids=map_name)
def test_real_maps_are_read_as_lanelet2_reads_them(lanelet2, path):
    theirs = {lanelet.id: lanelet for lanelet in loaded(lanelet2, path).laneletLayer}
    road = map_at(path)
    ours = road.lanelets.set_index("lanelet_id")
    assert set(theirs) == set(ours.index)
    drawn = Drawn(path, road.crs)
    repaired = set(road.problems["lanelet_id"])
    for ref in sorted(set(ours.index) - repaired):
        drawn.compare(theirs[ref].leftBound, ours["left"][ref])
        drawn.compare(theirs[ref].rightBound, ours["right"][ref])
    follows = lanelet2.geometry.follows
    for ref, lanelet in theirs.items():
        expected = {other for other, end in theirs.items() if follows(lanelet, end)}
        assert set(ours["successors"][ref]) == expected


@needs_shared_maps
@pytest.mark.parametrize("user", ["vehicle", "bicycle"])
@pytest.mark.parametrize("path", SHARED_MAPS, ids=map_name)
def test_traffic_rules_are_those_of_lanelet2(lanelet2, path, user):
    theirs = {lanelet.id: lanelet for lanelet in loaded(lanelet2, path).laneletLayer}
    rules = lanelet2.traffic_rules.create("de", user)
    ours = map_at(path).lanelets.set_index("lanelet_id")
    for ref, lanelet in theirs.items():
        assert (user in ours["participants"][ref]) == rules.canPass(lanelet)
        limit = ours["speed_limit_kmh"][ref]
        assert math.isnan(limit) or limit == pytest.approx(rules.speedLimit(lanelet).speedLimit)
        if rules.canPass(lanelet):
            assert bool(ours["one_way"][ref]) == rules.isOneWay(lanelet)


@cache
def loaded(lanelet2, path):
    longitude, latitude = np.nanmedian(osm_at(path).geographic, axis=0)
    origin = lanelet2.io.Origin(float(latitude), float(longitude))
    return lanelet2.io.load(str(path), lanelet2.projection.UtmProjector(origin))


class Drawn:
    """Positions of the nodes that Lanelet2 names: projected here, node by node, or local."""

    def __init__(self, path, crs):
        osm = osm_at(path)
        self.rows = osm.node_index
        self.local = bool(np.isfinite(osm.local).any())
        to_metres = Transformer.from_crs(4326, crs, always_xy=True)
        self.xy = (
            osm.local if self.local else np.array([to_metres.transform(*p) for p in osm.geographic])
        )

    def compare(self, bound, line):
        expected = self.xy[[self.rows[point.id] for point in bound]]
        moved = np.concatenate([[True], np.any(np.diff(expected, axis=0) != 0.0, axis=1)])
        expected, found = expected[moved], shapely.get_coordinates(line)
        if self.local:
            expected, found = expected - expected[0], found - found[0]
        np.testing.assert_allclose(found, expected, atol=1e-6)


@needs_shared_maps
@pytest.mark.parametrize("length_m", [0.5, 20.0])
@pytest.mark.parametrize("path", SHARED_MAPS, ids=map_name)
def test_tiles_of_any_length_are_sound(path, length_m):
    road, listener = map_at(path), Listener()
    subtypes = set(road.lanelets["subtype"])
    tiles = make_tiles(road, length_m=length_m, subtypes=subtypes, reporter=listener)
    assert shapely.is_valid(tiles.geometry.array).all()
    assert shapely.is_ccw(shapely.get_exterior_ring(tiles.geometry.array)).all()
    corners = quads(tiles)
    assert all(
        (corners[:, i] != corners[:, j]).any(axis=1).all() for i in range(4) for j in range(i)
    )
    means = (road.lanelets["left"].length + road.lanelets["right"].length) / 2.0
    asked = np.maximum(1, np.rint(means / length_m)).to_numpy()
    more = tiles.groupby("lanelet_id").size().to_numpy() - asked
    assert more.min() >= 0
    if length_m == 0.5:
        assert not more.any()
        assert listener.messages == []
    if more.any():
        lines = [message for level, message in listener.messages if "more tiles" in message]
        assert len(lines) == 1
        assert f"{np.count_nonzero(more)} lanelet" in lines[0]
    assert ("cut corners" in str(listener.messages)) == (length_m > 0.5)
