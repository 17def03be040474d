"""The radar as recorded: each measured figure, measured again on simulated frames."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import shapely
from pyproj import CRS

from gis_radar.base import STEP_S
from gis_radar.poses import Pose, View
from simulation.movement import Traffic
from simulation.presets import RADARS
from simulation.radar import RadarModel, place_radar
from simulation.recording import frame_times, simulate_recording
from simulation.scene import Building, ParkedCar, Post, Rail, Scene, Tree
from simulation.terrain import Terrain

ORIGIN = np.array([600_000.0, 5_400_000.0])
LEVEL = Terrain(origin=(600_000.0, 5_400_000.0), height_m=100.0)
MODEL = RADARS["as recorded"]
MOVES_MPS = 0.15


def pose(*, over_m: float, yaw: float = 0.0, pitch: float = 0.0) -> Pose:
    return Pose(
        sensor="R", crs=CRS.from_epsg(25832), easting=ORIGIN[0], northing=ORIGIN[1],
        height=100.0 + over_m, yaw=yaw, pitch=pitch, roll=0.0, view=View(max_range_m=300.0),
    )  # fmt: skip


def driven(places: np.ndarray, speed: float, *, kind: str, size: tuple[float, ...]) -> Traffic:
    """Road users that go east, given by their (times, n, 2) places about the origin."""
    steps, count = places.shape[:2]
    return Traffic(
        start=0.0, centre=places + ORIGIN, heading=np.zeros((steps, count)),
        speed=np.full((steps, count), speed), yaw_rate=np.zeros((steps, count)),
        size=np.tile(size, (count, 1)), kind=(kind,) * count,
    )  # fmt: skip


def record(model: RadarModel, stand: Pose, scene: Scene, traffic: Traffic, seconds: float):
    """The recording, with the number of each row's frame, and how many frames it has."""
    radar = place_radar(stand, scene, rng=np.random.default_rng(1), model=model)
    rng = np.random.default_rng(2)
    times = frame_times(0.0, seconds, rng=rng, cycle_s=model.cycle_s, jitter_s=model.jitter_s)
    table = simulate_recording(radar, traffic, times, rng=rng)
    return table.assign(frame=np.unique(table["time"], return_inverse=True)[1]), len(times)


# cycle


@pytest.mark.parametrize(
    ("name", "cycle"),
    [("as recorded", (0.0413, 0.0515, 0.0572)), ("as recorded, side", (0.047, 0.051, 0.052))],
)
def test_frames_come_in_turn_from_any_phase(name, cycle):
    firsts = set()
    for seed in range(30):
        rng = np.random.default_rng(seed)
        times = frame_times(5.0, 9.0, rng=rng, cycle_s=RADARS[name].cycle_s, jitter_s=0.0)
        gaps = np.diff(times)
        assert sum(cycle) == pytest.approx(0.15)
        assert gaps[3:] == pytest.approx(gaps[:-3], abs=3e-6)
        assert sorted(gaps[:3]) == pytest.approx(cycle, abs=3e-6)
        assert 5.0 <= times[0] < 5.0 + max(cycle)
        firsts.add(int(np.argmin(np.abs(np.array(cycle) - gaps[0]))))
    assert firsts == {0, 1, 2}


# a still yard, seen by a radar as on a vehicle


def yard() -> Scene:
    """A yard of 20 m between two houses, with cars, posts, a fence and a tree."""

    def house(*corners: tuple[float, float]) -> Building:
        return Building(outline=np.array(corners) + ORIGIN, height_m=8.0)

    return Scene(
        terrain=LEVEL,
        road=shapely.box(*(ORIGIN + (-30, -12)), *(ORIGIN + (40, 12))),
        buildings=(
            house((18, -14), (24, -14), (24, 10), (18, 10)),
            house((-5, 14), (15, 14), (15, 20), (-5, 20)),
        ),
        cars=tuple(
            ParkedCar(place=(ORIGIN[0] + x, ORIGIN[1] - 10.0), heading_rad=np.pi / 2)
            for x in (6.0, 9.0, 12.0)
        ),
        posts=tuple(Post(place=tuple(ORIGIN + p), height_m=4.0) for p in ((8.0, 9.0), (14.0, 3.0))),
        trees=(Tree(place=tuple(ORIGIN + (12.0, 12.0)), crown_m=2.5, crown_height_m=6.0),),
        rails=(Rail(line=np.array([(2.0, -13.0), (16.0, -13.0)]) + ORIGIN),),
    )


@pytest.fixture(scope="module")
def still() -> tuple[pd.DataFrame, int]:
    nobody = driven(np.zeros((2, 0, 2)), 0.0, kind="car", size=(4.5, 1.8, 1.5))
    return record(MODEL, pose(over_m=1.5), yard(), nobody, 20.0)


def standing(table: pd.DataFrame) -> pd.DataFrame:
    return table[table["range_rate"].abs() < MOVES_MPS]


def test_a_yard_gives_45_to_52_returns_a_frame_that_stand(still):
    table, frames = still
    assert 42.0 < len(table) / frames < 54.0
    assert len(standing(table)) / len(table) == pytest.approx(0.99, abs=0.006)
    rate = standing(table)["range_rate"]
    assert 0.014 < rate.std() < 0.019
    assert rate.quantile([0.01, 0.99]).abs().to_numpy() == pytest.approx(0.05, abs=0.02)


def test_still_targets_come_again(still):
    table, frames = still
    here = standing(table)
    cell = np.floor(here[["x", "y"]].to_numpy() / 0.5)
    cells = here.assign(cell=np.unique(cell, axis=0, return_inverse=True)[1].ravel())
    hit = cells.groupby("cell")["frame"].nunique()
    assert 0.46 < (hit[cells["cell"]] >= frames / 2).mean() < 0.84


def test_false_returns_seem_to_move_far_off_and_fast():
    bare = Scene(terrain=LEVEL, road=shapely.box(0, 0, 1, 1))
    nobody = driven(np.zeros((2, 0, 2)), 0.0, kind="car", size=(4.5, 1.8, 1.5))
    table, frames = record(MODEL, pose(over_m=1.5), bare, nobody, 60.0)
    false = table[table["range_rate"].abs() > MOVES_MPS]
    assert 0.25 < len(false) / frames < 0.43
    away = np.linalg.norm(false[["x", "y", "z"]], axis=1)
    assert away.min() > 59.0
    assert away.max() < 301.0
    assert np.histogram(away, bins=[60, 120, 180, 240, 300])[0] / len(false) == pytest.approx(
        0.25, abs=0.08
    )
    fast = false["range_rate"].abs()
    assert 20.0 < fast.quantile(0.95) < 28.0
    assert np.abs(MODEL.wrong_rates(20_000, np.random.default_rng(0))).max() == pytest.approx(
        105.0, abs=5.0
    )


# one target over time


FIGURES = ("range_m", "azimuth", "elevation", "rcs")


# vehicles


@pytest.fixture(scope="module")
def passing() -> tuple[Traffic, pd.DataFrame, int]:
    """Cars at 12 m/s on a road past the radar, 45 m apart, for 30 s."""
    time = np.arange(0.0, 30.1, STEP_S)
    begin = np.arange(-300.0, 180.0, 45.0)
    east = begin + 12.0 * time[:, None]
    traffic = driven(
        np.stack([east, np.full_like(east, 9.0)], axis=-1), 12.0, kind="car", size=(4.5, 1.8, 1.5)
    )
    road = Scene(terrain=LEVEL, road=shapely.box(*(ORIGIN + (-300, 4)), *(ORIGIN + (300, 14))))
    return traffic, *record(MODEL, pose(over_m=6.0, yaw=20.0, pitch=3.0), road, traffic, 30.0)


def returns(passing, near_m: float, far_m: float) -> np.ndarray:
    """How many returns each frame has of each car between two ranges."""
    traffic, table, _ = passing
    stand = pose(over_m=6.0, yaw=20.0, pitch=3.0)
    counts = []
    for time, rows in table.groupby("time"):
        place = stand.to_map(rows[["x", "y", "z"]].to_numpy(np.float64))[:, :2]
        cars = traffic.at(float(time)).centre
        moves = rows["range_rate"].abs().to_numpy() > MOVES_MPS
        off = np.abs(place[:, None] - cars)
        on = (off[..., 0] < 3.2) & (off[..., 1] < 2.5) & moves[:, None]
        local = cars - ORIGIN
        reach = np.hypot(*local.T)
        seen = (reach >= near_m) & (reach < far_m) & (local[:, 0] > 0.0)
        counts.append(on.sum(axis=0)[seen])
    return np.concatenate(counts)


def test_a_car_gives_one_or_two_returns_a_frame_and_often_none(passing):
    near, far = returns(passing, 25.0, 75.0), returns(passing, 75.0, 150.0)
    assert 1.0 < near.mean() < 2.0
    assert 0.24 < np.mean(near == 0) < 0.44
    assert 0.2 < far.mean() < 0.6


def test_a_harsh_radar_sees_less_and_errs_more(passing):
    harsh = RADARS["harsh"]
    traffic = passing[0]
    road = Scene(terrain=LEVEL, road=shapely.box(*(ORIGIN + (-300, 4)), *(ORIGIN + (300, 14))))
    stand = pose(over_m=6.0, yaw=20.0, pitch=3.0)
    table, frames = record(harsh, stand, road, traffic, 12.0)
    few = returns((traffic, table, frames), 25.0, 75.0)
    assert few.mean() < 0.8 * returns(passing, 25.0, 75.0).mean()
    # no car moves so fast
    false, fewer = (
        (t["range_rate"].abs() > 15.0).sum() / n for t, n in ((table, frames), passing[1:])
    )
    assert false > 3.0 * fewer > 0.0
