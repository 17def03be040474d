"""Combinations for the calibration: places, drivers, vehicles and sensors drawn at random.

Each has its own street plan, terrain, houses, drivers, vehicles, mast, view and radar, drawn from
its number, and nothing in common with any other.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from conditions import (
    CONDITIONS,
    FALSE_DOPPLER_SHARE,
    STATIC_PER_FRAME,
    TEXTBOOK,
    folder_name,
)
from places import (
    ORIGIN,
    OUT,
    ROOT,
    UTM,
    WINDOW_S,
    Manners,
    make_place,
    mixed,
    roadside_stand,
    write_moving,
)
from street_plans import PLANS

import gis_radar as gr
from gis_radar.poses.files import write_pose
from simulation.demand import KINDS
from simulation.driving import LaneKeeping
from simulation.radar import RadarModel
from simulation.roadside import Roadside
from simulation.scene import Scene
from simulation.terrain import Terrain


def combination(number: int, conditions: str = TEXTBOOK) -> Path:
    """Return the folder of a combination; it is made where it is missing or out of date.

    Under a name of `CONDITIONS` other than ``textbook`` the place, the demand and the sensor's pose
    are the same; radar, drivers and people are those of the name.
    """
    folder = OUT / folder_name("calibration", conditions) / f"{number:03d}"
    stamp = folder / "made.txt"
    if stamp.exists() and stamp.read_text() == _recipe():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    stamp.unlink(missing_ok=True)
    _make(number, folder, conditions)
    stamp.write_text(_recipe())
    return folder


def _recipe() -> str:
    """Return a checksum of all that decides how a combination comes out."""
    here = Path(__file__).parent
    parts = [
        here / f"{name}.py" for name in ("combinations", "places", "conditions", "street_plans")
    ]
    parts += sorted((ROOT / "simulation").glob("*.py"))
    return hashlib.sha256(b"".join(p.read_bytes() for p in parts)).hexdigest()


def _make(number: int, folder: Path, conditions: str) -> None:
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
    manners = Manners(
        per_hour=round(float(np.exp(rng.uniform(np.log(500.0), np.log(2400.0))))),
        kinds=mixed(KINDS, rng),
        keeping=_keeping(rng),
        people=under.people,
    )
    if under.drivers != TEXTBOOK:
        more = mixed(under.kinds[len(KINDS) :], np.random.default_rng([20260601, number, 1]))
        manners = replace(manners, keeping=under.keeping, kinds=(*manners.kinds, *more))
    roadside = Roadside(
        tree_gap_m=float(rng.uniform(9.0, 30.0)),
        house_gap_m=float(rng.uniform(26.0, 60.0)),
        house_setback_m=float(rng.uniform(8.0, 16.0)),
        car_share=float(rng.uniform(0.0, 0.4)),
    )
    place = make_place(
        plan, seed=number, terrain=terrain, manners=manners, duration_s=WINDOW_S, roadside=roadside
    )
    pose, model = _sensor(place.scene, rng), _radar(rng)
    if under.radar != TEXTBOOK:
        model = under.model
    recording = place.record(pose, seed=number, model=model)
    write_moving(recording, folder / "R1.parquet")
    write_pose(pose, folder / "R1.json")
    place.write_ground(folder, seed=number)
    place.write_truth(folder)
    about = {
        "plan": plan.name, "lane_width_m": plan.lane_width_m, "speed_mps": plan.speed_mps,
        "slope": round(float(np.hypot(*slope)), 3), "per_hour": manners.per_hour,
        "keeping": asdict(manners.keeping), "model": asdict(model),
        "mast_m": round(pose.height - float(terrain.height(pose.position[:2])), 2),
    }  # fmt: skip
    (folder / "about.json").write_text(json.dumps(about, indent=1))


def _keeping(rng: np.random.Generator) -> LaneKeeping:
    """Return drivers who keep near the middle of their lanes, here more and there less."""
    return LaneKeeping(
        mean_m=float(rng.normal(0.0, 0.08)),
        street_m=float(rng.uniform(0.0, 0.15)),
        driver_m=float(rng.uniform(0.1, 0.25)),
        wander_m=float(rng.uniform(0.04, 0.12)),
    )


def _sensor(scene: Scene, rng: np.random.Generator) -> gr.Pose:
    """Return a sensor beside a kerb that looks at the middle of the plan, or past it."""
    stand = roadside_stand(scene, rng, within_m=(12.0, 60.0))
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


def _radar(rng: np.random.Generator) -> RadarModel:
    """Return a radar as good or bad as those on the market."""
    return RadarModel(
        reach_m=float(rng.uniform(70.0, 115.0)),
        density=float(rng.uniform(1.2, 2.4)),
        static_per_frame=STATIC_PER_FRAME,
        false_doppler_share=FALSE_DOPPLER_SHARE,
        ghost_share=float(rng.uniform(0.01, 0.07)),
        false_alarms=float(rng.uniform(0.5, 5.0)),
        leak=float(rng.uniform(0.02, 0.08)),
        range_m=float(rng.uniform(0.06, 0.25)),
        azimuth_deg=float(rng.uniform(0.08, 0.35)),
        elevation_deg=float(rng.uniform(0.25, 0.9)),
        range_rate_mps=float(rng.uniform(0.03, 0.1)),
    )
