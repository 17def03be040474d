"""By how much poses may shift what is on tiles, and what that adds to the error of occupancy."""

import json

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from gis_radar.dataset import Shifts, lanes_beside, shifts_of
from gis_radar.dataset.traffic.shifts import MAP_M, POSE_M
from gis_radar.products.heatmap.occupancy import occupancy_of

UTM = "EPSG:25832"
ORIGIN = np.array([690_000.0, 5_336_000.0])
POSE = {
    "sensor": "R1", "crs": UTM, "easting": ORIGIN[0], "northing": ORIGIN[1], "height": 10.0,
    "yaw": 0.0, "pitch": 0.0, "roll": 0.0,
}  # fmt: skip


def tiles_ahead(count=6, *, at_m=100.0, width_m=3.0):
    """Give tiles of a lane to the east, of which the first is so far east of the sensor."""
    east = at_m + 0.5 * np.arange(count)
    boxes = [shapely.Polygon([(e, -1.5), (e + 0.5, -1.5), (e + 0.5, 1.5), (e, 1.5)]) for e in east]
    geometry = shapely.transform(np.array(boxes), lambda xy: xy + ORIGIN)
    index = np.arange(count)
    columns = {"tile_id": index, "lanelet_id": 7, "index": index, "s_m": index / 2}
    return gpd.GeoDataFrame(
        columns | {"length_m": 0.5, "width_m": width_m}, geometry=geometry, crs=UTM
    )


def seen_from(poses, tiles):
    """Give poses and sights of which each pose sees all tiles."""
    names = [f"{pose['sensor']}-{number}" for number, pose in enumerate(poses)]
    rows = [(name, p["sensor"], json.dumps(p)) for name, p in zip(names, poses, strict=True)]
    sights = [(name, tile) for name in names for tile in tiles["tile_id"]]
    poses = pd.DataFrame(rows, columns=["pose", "sensor", "document"])
    return poses, pd.DataFrame(sights, columns=["pose", "tile_id"])


def own_m(poses, **at):
    """Give the shifts along and across that poses alone leave open, of the first tile."""
    tiles = tiles_ahead(**at)
    along, across = shifts_of(*seen_from(poses, tiles), tiles)
    return float(np.sqrt(along[0] ** 2 - MAP_M**2)), float(across[0])


def test_a_pose_shifts_its_vehicles_and_turns_them_around_itself():
    sigma = {"easting": 0.5, "northing": 0.2, "yaw": 1.0}
    along, across = own_m([POSE | {"sigma": sigma}])
    assert along == pytest.approx(0.5)
    assert across == pytest.approx(np.hypot(0.2, np.radians(1.0) * 100.25), rel=1e-4)
    covariance = np.diag([0.25, 0.04, 1.0, 1.0, 1.0, np.radians(1.0) ** 2])
    assert own_m([POSE | {"covariance": covariance.tolist()}]) == pytest.approx((along, across))
    covariance[1, 5] = covariance[5, 1] = -0.2 * np.radians(1.0)  # the turn undoes the shift
    less = own_m([POSE | {"covariance": covariance.tolist()}])
    assert less[1] == pytest.approx(np.radians(1.0) * 100.25 - 0.2, rel=1e-3)


def test_what_is_not_stated_is_as_usual_and_a_scale_of_range_counts_by_range():
    assert own_m([POSE]) == pytest.approx((POSE_M, POSE_M))
    scaled = POSE | {"range_scale": {"factor": 1.0, "sigma": 0.004, "vehicles": 30}}
    assert own_m([scaled]) == pytest.approx((np.hypot(POSE_M, 0.401), POSE_M))
    for unknown in ("not fitted", {"factor": 1.0, "sigma": None}):
        assert own_m([POSE | {"range_scale": unknown}]) == pytest.approx((POSE_M, POSE_M))


def test_sensors_err_independently_and_the_poses_of_one_as_one():
    other = POSE | {"sensor": "R2"}
    assert own_m([POSE, other]) == pytest.approx((POSE_M / np.sqrt(2.0),) * 2)
    assert own_m([POSE, POSE]) == pytest.approx((POSE_M, POSE_M))
    assert own_m([]) == pytest.approx((POSE_M, POSE_M))


@pytest.mark.parametrize(("along_m", "change"), [(0.25, 0.25), (0.5, 0.5), (1.0, 0.5), (2.0, 0.5)])
def test_along_the_lane_occupancy_is_that_of_the_place_so_far_on(along_m, change):
    """Half of the lane is occupied half of the time; beyond the ends nothing is known."""
    tiles = tiles_ahead(10)
    sums = {
        "visible_steps": np.full((1, 10), 1000.0),
        "occupied_steps": 500.0 * (np.arange(10) > 4)[None],
        "occupied_variance": np.zeros((1, 10)), "inferred_steps": np.zeros((1, 10)),
    }  # fmt: skip
    shifts = Shifts(along=np.full(10, along_m), across=np.zeros(10))
    found = occupancy_of(sums, sums, tiles, np.arange(10), shifts).error_whole
    assert found[[4, 5]] == pytest.approx(change, rel=1e-5)
    assert (found > 0.1).sum() == 2 * max(1, round(along_m / 0.5))


def test_across_the_lane_some_poses_put_all_on_another_one():
    """Of two lanes in one direction, and one against them, one is occupied half of the time."""
    one, other, against = tiles_ahead(2), tiles_ahead(2), tiles_ahead(2)
    other.geometry = other.translate(0.0, 3.0)
    against.geometry = shapely.transform(
        against.geometry.to_numpy(), lambda xy: 2.0 * (ORIGIN + [100.5, -1.5]) - xy
    )
    tiles = pd.concat([one, other.assign(lanelet_id=8), against.assign(lanelet_id=9)])
    tiles = tiles.reset_index(drop=True).assign(tile_id=np.arange(6))
    assert lanes_beside(tiles).tolist() == [[2, 3, -1, -1, -1, -1], [-1, -1, 0, 1, -1, -1]]
    share = np.array([0.5, 0.5, 0.0, 0.0, 0.5, 0.5])
    sums = {
        "visible_steps": np.full((1, 6), 1000.0), "occupied_steps": 1000.0 * share[None],
        "occupied_variance": np.zeros((1, 6)), "inferred_steps": np.zeros((1, 6)),
    }  # fmt: skip
    shifts = Shifts(along=np.full(6, 0.3), across=np.tile([0.15, 1.5], 3))
    found = occupancy_of(sums, sums, tiles, np.arange(6), shifts).error_whole
    assert found[::2] == pytest.approx(0.002)  # two steps of a thousand
    chance = 0.3173  # beyond one sigma
    leave, come = 0.5 * np.sqrt(chance), 0.5 * np.sqrt(chance / 2.0)
    assert found[1::2] == pytest.approx([leave, come, leave], rel=1e-3)


def test_a_narrow_lane_beside_a_wide_one_is_found():
    wide, narrow = tiles_ahead(2), tiles_ahead(2)
    narrow.geometry = shapely.transform(
        wide.geometry.to_numpy(),
        lambda xy: xy * [1.0, 0.5] + [0.0, 0.5 * ORIGIN[1] + 2.25],
    )
    tiles = pd.concat([wide, narrow.assign(lanelet_id=8, width_m=wide["width_m"] / 2)])
    tiles = tiles.reset_index(drop=True).assign(tile_id=np.arange(4))
    assert lanes_beside(tiles).tolist() == [[2, 3, -1, -1], [-1, -1, 0, 1]]


def test_of_several_intervals_the_shift_is_not_averaged_out():
    """Sixteen intervals alike are as wrong by the pose as one of them and as all of the time."""
    tiles, alike = tiles_ahead(10), np.ones((16, 1))
    sums = {
        "visible_steps": 1000.0 * np.ones((16, 10)),
        "occupied_steps": 500.0 * (np.arange(10) > 4)[None] * alike,
        "occupied_variance": np.zeros((16, 10)), "inferred_steps": np.zeros((16, 10)),
    }  # fmt: skip
    shifts = Shifts(along=np.full(10, 1.0), across=np.zeros(10))
    found = occupancy_of(sums, sums, tiles, np.arange(10), shifts)
    each = [found.shares(np.arange(10), 10, part).occupancy_se for part in (3, slice(0, 16), None)]
    assert [float(errors[4]) for errors in each] == pytest.approx([0.5] * 3, rel=0.01)
