"""Random places: streets, drivers, vehicles and a sensor, drawn from the place's number.

Streets and pose are the same under all conditions. No setting of the package was chosen on these
places: they show whether covariances cover the errors.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from conditions import CONDITIONS, TEXTBOOK
from places import (
    ORIGIN,
    OUT,
    UTM,
    WINDOW_S,
    TrafficSettings,
    disc_offsets,
    make_place,
    up_to_date,
    vary_kinds,
    write_moving,
)
from trials import NEAR_M, Trial, in_workers

import gis_radar as gr
from simulation.demand import KINDS
from simulation.driving import LaneKeeping
from simulation.roadside import Roadside, roadside_stand
from simulation.scene import Scene
from simulation.street_plans import PLANS
from simulation.terrain import Terrain

COUNT, QUICK_COUNT = 120, 10


def plan(count: int, conditions: str) -> list[Trial]:
    """Return a trial at each of the first `count` places, without a heading."""
    folders = in_workers(random_place, [(number, conditions) for number in range(count)])
    return [
        Trial(group="random", folder=folder, name="R1", method="lane", offset=_offset(number))
        for number, folder in enumerate(folders)
    ]


def _offset(number: int) -> tuple[float, float]:
    """Draw how far the guess of a place is off, metres east and north."""
    east, north = disc_offsets(np.random.default_rng([number, 5]), 1, NEAR_M)[0].tolist()
    return east, north


def random_place(drawn: tuple[int, str]) -> Path:
    """Return the folder of a place (number, conditions), which is made where needed."""
    number, conditions = drawn
    folder = OUT / "random" / conditions / f"{number:03d}"

    def make() -> None:
        _make(number, folder, conditions)

    return up_to_date(folder, make, "random_places", "places", "conditions")


def _make(number: int, folder: Path, conditions: str) -> None:
    """Write map, road, recording and true pose of a place."""
    rng, under = np.random.default_rng([20260601, number]), CONDITIONS[conditions]
    plan = PLANS[number % len(PLANS)](rng)
    steep = rng.random() < 0.3
    slope = rng.normal(0.0, 0.045 if steep else 0.01, 2)
    terrain = Terrain(
        origin=ORIGIN,
        height_m=round(float(rng.uniform(20.0, 700.0)), 2),
        slope=(float(slope[0]), float(slope[1])),
        wave_m=float(rng.uniform(0.0, 0.6)),
        wave_length_m=float(rng.uniform(180.0, 320.0)),
    )
    settings = TrafficSettings(
        per_hour=round(float(np.exp(rng.uniform(np.log(500.0), np.log(2400.0)))) * under.demand),
        kinds=vary_kinds(KINDS, rng),
        keeping=_keeping(rng),
        people=under.people,
    )
    if under.drivers != TEXTBOOK:
        more = vary_kinds(under.kinds[len(KINDS) :], np.random.default_rng([20260601, number, 1]))
        settings = replace(settings, keeping=under.keeping, kinds=(*settings.kinds, *more))
    roadside = Roadside(
        tree_gap_m=float(rng.uniform(9.0, 30.0)),
        house_gap_m=float(rng.uniform(26.0, 60.0)),
        house_setback_m=float(rng.uniform(8.0, 16.0)),
        car_share=float(rng.uniform(0.0, 0.4)),
    )
    place = make_place(
        plan, seed=number, terrain=terrain, settings=settings, duration_s=WINDOW_S,
        roadside=roadside,
    )  # fmt: skip
    pose = _sensor(place.scene, rng)
    write_moving(place.record(pose, seed=number, model=under.model), folder / "R1.parquet")
    pose.write(folder / "R1.json")
    place.write_ground(folder, seed=number)


def _keeping(rng: np.random.Generator) -> LaneKeeping:
    """Draw how drivers keep near the middle of their lanes."""
    return LaneKeeping(
        mean_m=float(rng.normal(0.0, 0.08)),
        street_m=float(rng.uniform(0.0, 0.15)),
        driver_m=float(rng.uniform(0.1, 0.25)),
        wander_m=float(rng.uniform(0.04, 0.12)),
    )


def _sensor(scene: Scene, rng: np.random.Generator) -> gr.Pose:
    """Draw the pose of a sensor beside a kerb; it looks to the plan's middle (sigma 20 deg)."""
    stand = roadside_stand(scene, ORIGIN, rng, within_m=(12.0, 60.0))
    towards = np.array(ORIGIN) - stand
    yaw = np.degrees(np.arctan2(towards[1], towards[0])) + rng.normal(0.0, 20.0)
    ground = float(scene.terrain.height(stand))
    return gr.Pose(
        sensor="R1",
        crs=UTM,
        easting=round(float(stand[0]), 3),
        northing=round(float(stand[1]), 3),
        height=round(ground + float(rng.uniform(4.0, 8.0)), 3),
        yaw=round(float((yaw + 180.0) % 360.0 - 180.0), 3),
        pitch=round(float(np.clip(rng.normal(3.5, 2.5), -2.0, 9.0)), 3),
        roll=round(float(np.clip(rng.normal(0.0, 1.5), -4.0, 4.0)), 3),
        view=gr.View(
            azimuth_deg=float(rng.choice([90.0, 110.0, 120.0])),
            elevation_deg=float(rng.choice([24.0, 30.0, 40.0])),
            max_range_m=float(rng.choice([150.0, 200.0, 300.0])),
        ),
    )
