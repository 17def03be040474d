"""A simulated town with six radars, after the paper's Table I.

A main road with two lanes each way crosses a junction with lights and ends in a roundabout; side
streets bend on a slope. In the set DY all sensors have the same pitch and no roll, and only yaw
differs; in DO pitch, roll and yaw differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np
import shapely
from conditions import CONDITIONS, TEXTBOOK
from places import ORIGIN, OUT, UTM, WINDOW_S, make_place, up_to_date, write_moving
from scipy.interpolate import CubicSpline

import gis_radar as gr
from gis_radar.base import Floats
from simulation.scene import Scene
from simulation.street_plans import StreetPlan
from simulation.terrain import Terrain

SETS = ("DY", "DO")
MAST_M, PITCH_DEG = 6.0, 3.0
VIEW = gr.View(azimuth_deg=120.0, elevation_deg=30.0, max_range_m=200.0)
TERRAIN = Terrain(
    origin=ORIGIN, height_m=374.0, slope=(0.011, 0.017), wave_m=0.5, wave_length_m=310.0
)
PER_HOUR = 2600.0  # vehicles
SEED = 4
RING = np.array([190.0, 30.0])  # middle of the roundabout on the plan, metres


@dataclass(frozen=True, kw_only=True)
class Mast:
    """A mast of the town with its radar.

    Parameters
    ----------
    sensor : str
        Name of the radar.
    near, towards : tuple of float
        Places on the plan, metres: it stands on the verge nearest to the one, and looks at the
        other.
    turned_deg : float
        Yaw in set DO minus that in DY.
    pitch_deg, roll_deg : float
        Angles in set DO.
    """

    sensor: str
    near: tuple[float, float]
    towards: tuple[float, float]
    turned_deg: float
    pitch_deg: float
    roll_deg: float


MASTS = (
    Mast(sensor="R1", near=(-16, -17), towards=(20, 30), turned_deg=24.0, pitch_deg=5.1,
         roll_deg=-1.6),
    Mast(sensor="R2", near=(-200, -26), towards=(-150, 20), turned_deg=-17.0, pitch_deg=1.2,
         roll_deg=2.4),
    Mast(sensor="R3", near=(26, 176), towards=(-40, 150), turned_deg=31.0, pitch_deg=6.4,
         roll_deg=3.1),
    Mast(sensor="R4", near=(215, 62), towards=(170, 20), turned_deg=-26.0, pitch_deg=4.0,
         roll_deg=-3.4),
    Mast(sensor="R5", near=(-36, -166), towards=(10, -140), turned_deg=14.0, pitch_deg=2.2,
         roll_deg=0.9),
    Mast(sensor="R6", near=(-150, 172), towards=(-178, 120), turned_deg=-35.0, pitch_deg=7.0,
         roll_deg=-2.2),
)  # fmt: skip


class Wide(TypedDict):
    """Options of `StreetPlan.street` for the main road."""

    lanes: tuple[int, int]
    median_m: float
    rank: int


def town_plan() -> StreetPlan:
    """Return the streets of the town."""
    plan = StreetPlan(name="town", lane_width_m=3.25)
    places = {"W": (-185.0, -18.0), "C": (0.0, 0.0), "NW": (-165.0, 150.0), "N": (12.0, 160.0),
              "NE": (205.0, 165.0), "S": (-18.0, -150.0)}  # fmt: skip
    for name, place in places.items():
        plan.node(name, np.array(place), "traffic_light" if name == "C" else "priority")
    _add_ring(plan)
    ring = {name: _on_ring(k) for k, name in enumerate(_RING)}
    at = {**{k: np.array(v) for k, v in places.items()}, **ring}
    wide: Wide = {"lanes": (2, 2), "median_m": 1.5, "rank": 5}
    plan.street(("W", "C"), _through(at["W"], (-90.0, -22.0), at["C"]), **wide)
    plan.street(("C", "RW"), _through(at["C"], (95.0, 24.0), at["RW"]), **wide)
    plan.street(("W", "NW"), _through(at["W"], (-205.0, 70.0), at["NW"]))
    plan.street(("NW", "N"), _through(at["NW"], (-80.0, 128.0), at["N"]))
    plan.street(("C", "N"), _through(at["C"], (-4.0, 80.0), at["N"]), rank=3)
    plan.street(("N", "NE"), _through(at["N"], (110.0, 190.0), at["NE"]))
    plan.street(("NE", "RN"), _through(at["NE"], (186.0, 105.0), at["RN"]))
    plan.street(("S", "C"), _through(at["S"], (14.0, -78.0), at["C"]), rank=3)
    plan.street(("S", "RS"), _through(at["S"], (80.0, -125.0), (150.0, -70.0), at["RS"]))
    plan.arm("west", "W", _through(at["W"], (-270.0, -20.0), (-350.0, -50.0)), **wide)
    plan.arm("east", "RE", _through(at["RE"], (280.0, 36.0), (360.0, 62.0)), (2, 2), rank=5)
    plan.arm("northwest", "NW", _through(at["NW"], (-230.0, 185.0), (-310.0, 180.0)))
    plan.arm("north", "N", _through(at["N"], (35.0, 230.0), (20.0, 310.0)), rank=3)
    plan.arm("northeast", "NE", _through(at["NE"], (270.0, 180.0), (340.0, 215.0)))
    plan.arm("south", "S", _through(at["S"], (-50.0, -220.0), (-45.0, -300.0)), rank=3)
    return plan


_RING = ("RE", "RN", "RW", "RS")
_RING_M = 19.0


def _on_ring(k: int) -> Floats:
    turn = np.radians(8.0 + 90.0 * k)
    return np.asarray(RING + _RING_M * np.array([np.cos(turn), np.sin(turn)]))


def _add_ring(plan: StreetPlan) -> None:
    for k, name in enumerate(_RING):
        plan.node(name, _on_ring(k), radius_m=5.0)
        turn = np.radians(np.linspace(8.0 + 90.0 * k, 98.0 + 90.0 * k, 24))
        arc = RING + _RING_M * np.column_stack([np.cos(turn), np.sin(turn)])
        plan.one_way(f"ring{k}", (name, _RING[(k + 1) % 4]), arc, 1, rank=9)


def _through(*points: Floats | tuple[float, float]) -> Floats:
    """Return a smooth line through points, a vertex every 3 m or so."""
    knots = np.array(points, dtype=np.float64)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(knots, axis=0).T))])
    at = np.linspace(0.0, s[-1], max(3, round(s[-1] / 3.0)))
    return np.asarray(CubicSpline(s, knots, bc_type="natural")(at))


def masts_of(scene: Scene, *, free: bool) -> list[gr.Pose]:
    """Return the six true poses in a scene of the town: of set DO if `free`, else of DY."""
    houses = [shapely.Polygon(b.outline).buffer(1.0) for b in scene.buildings]
    verge = scene.road.buffer(4.5).difference(shapely.union_all([*houses, scene.road.buffer(2.0)]))
    return [_pose(scene, mast, verge, free=free) for mast in MASTS]


def _pose(scene: Scene, mast: Mast, verge: shapely.Geometry, *, free: bool) -> gr.Pose:
    wanted = shapely.Point(np.array(mast.near) + ORIGIN)
    stand = shapely.get_coordinates(shapely.shortest_line(verge, wanted))[0]
    ahead = np.array(mast.towards) + ORIGIN - stand
    yaw = float(np.degrees(np.arctan2(ahead[1], ahead[0]))) + (mast.turned_deg if free else 0.0)
    return gr.Pose(
        sensor=mast.sensor,
        crs=UTM,
        easting=round(float(stand[0]), 3),
        northing=round(float(stand[1]), 3),
        height=round(float(scene.terrain.height(stand)) + MAST_M, 3),
        yaw=round((yaw + 180.0) % 360.0 - 180.0, 2),
        pitch=mast.pitch_deg if free else PITCH_DEG,
        roll=mast.roll_deg if free else 0.0,
        view=VIEW,
    )


def town_folder(conditions: str = TEXTBOOK) -> Path:
    """Return a folder with map, road, recordings and poses of both sets, made where needed.

    The sets record different 100 s of the same traffic; `conditions` is a name of `CONDITIONS`.
    """
    folder, under = OUT / "town" / conditions, CONDITIONS[conditions]

    def make() -> None:
        place = make_place(
            town_plan(), seed=SEED, terrain=TERRAIN, settings=under.traffic(PER_HOUR),
            duration_s=len(SETS) * WINDOW_S,
        )  # fmt: skip
        for k, set_name in enumerate(SETS):
            for number, pose in enumerate(masts_of(place.scene, free=set_name == "DO")):
                seed = 100 * SEED + 10 * k + number
                heard = place.record(pose, seed=seed, model=under.model, begin_s=k * WINDOW_S)
                write_moving(heard, folder / f"{set_name}_{pose.sensor}.parquet")
                pose.write(folder / f"{set_name}_{pose.sensor}.json")
        place.write_ground(folder, seed=SEED)

    return up_to_date(folder, make, "town", "places", "conditions")
