"""Scenes: small simulated sites with their truth, made where missing and kept.

A scene is a folder: map.osm, scan.laz, R1.parquet ... with R1.json ... (true poses),
vehicles.parquet (true traffic), standing.npz (walls and parked cars). Scenes that end in ``-held``
are held out: no setting is chosen on them. The towns of `simulated.py` are scenes, too.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT), str(ROOT / "bench"), str(ROOT / "bench" / "localization")]

from conditions import CONDITIONS, Conditions  # noqa: E402
from passages import lanes_of, true_passages  # noqa: E402
from places import (  # noqa: E402
    ORIGIN,
    UTM,
    Place,
    TrafficSettings,
    make_place,
    up_to_date,
    write_moving,
)
from simulated import true_pose  # noqa: E402
from standing import in_sight, write_standing  # noqa: E402
from town import MASTS, TERRAIN, masts_of, town_plan  # noqa: E402
from true_occupancy import Sensor, TrueOccupancy, true_occupancy  # noqa: E402
from true_traffic import TrueTraffic, read_traffic  # noqa: E402
from wide_map import widen  # noqa: E402

import gis_radar as gr  # noqa: E402
from gis_radar.base import Integers  # noqa: E402
from simulation.lanelet_writer import write_lanelets  # noqa: E402
from simulation.presets import TEXTBOOK  # noqa: E402
from simulation.radar import RadarModel  # noqa: E402
from simulation.roadside import Roadside, roadside_stand  # noqa: E402
from simulation.scan import fly, write_scan  # noqa: E402
from simulation.street_plans import PLANS, StreetPlan, axis  # noqa: E402

OUT = ROOT / "out" / "bench-vehicles"
SHARED = ("town01", "town02", "town04")
WIDE = ", wide map"  # after the name of a plan: the map's lanelets are wider than its lanes
TOWN_MASTS = {mast.sensor: k for k, mast in enumerate(MASTS)}


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Settings from which a scene is made.

    Parameters
    ----------
    plan : str
        ``town``, ``motorway``, or the name of a random plan; `WIDE` may follow.
    seed : int
        Seed of all random numbers.
    per_hour : float
        Vehicles an hour, sum of all entries.
    radars : tuple of str or int
        Names of masts of the town, or the number of masts placed at random.
    conditions : str
        A name of `CONDITIONS`.
    minutes, warm_up_s : float
        Length of the recordings; how long traffic builds up before.
    free : bool
        Whether the town's sensors have the poses of set DO; else of DY.
    stand_m, aim_deg : tuple of float, float
        Of masts placed at random: least and greatest distance from the plan's middle; standard
        deviation of the yaw from the direction to it.
    """

    plan: str
    seed: int
    per_hour: float
    radars: tuple[str, ...] | int
    conditions: str = "as recorded"
    minutes: float = 2.0
    warm_up_s: float = 120.0
    free: bool = True
    stand_m: tuple[float, float] = (12.0, 60.0)
    aim_deg: float = 20.0


RECIPES: Mapping[str, Recipe] = {
    "town": Recipe(plan="town", seed=11, per_hour=2600, radars=("R1", "R2", "R4")),
    "motorway": Recipe(
        plan="motorway", seed=12, per_hour=7000, radars=2, stand_m=(110.0, 170.0), aim_deg=5.0
    ),
    "gridlock": Recipe(
        plan="town", seed=13, per_hour=9000, radars=("R1", "R3"), warm_up_s=900.0, free=False
    ),
    "light": Recipe(plan="junction", seed=20, per_hour=400, radars=1, minutes=3.0),
    "harsh": Recipe(plan="junction", seed=30, per_hour=1500, radars=2, conditions="harsh"),
    "ideal": Recipe(
        plan="tee", seed=16, per_hour=900, radars=1, conditions="textbook", aim_deg=8.0
    ),
    "wide": Recipe(plan="junction, wide map", seed=50, per_hour=900, radars=2),
    "wide-light": Recipe(plan="roundabout, wide map", seed=51, per_hour=350, radars=1, minutes=3.0),
    "town-held": Recipe(plan="town", seed=111, per_hour=2200, radars=("R3", "R5", "R6")),
    "motorway-held": Recipe(
        plan="motorway", seed=112, per_hour=5200, radars=1, stand_m=(110.0, 170.0), aim_deg=5.0
    ),
    "gridlock-held": Recipe(plan="junction", seed=113, per_hour=4200, radars=2, warm_up_s=600.0),
    "light-held": Recipe(plan="bend", seed=122, per_hour=300, radars=1, minutes=3.0),
    "harsh-held": Recipe(
        plan="town", seed=115, per_hour=2600, radars=("R2", "R4", "R6"), conditions="harsh"
    ),
    "roundabout": Recipe(
        plan="roundabout", seed=116, per_hour=1100, radars=1, conditions="textbook"
    ),
    "ideal-held": Recipe(
        plan="roundabout", seed=216, per_hour=900, radars=1, conditions="textbook"
    ),
    "wide-held": Recipe(plan="junction, wide map", seed=150, per_hour=700, radars=2),
}
SCENE_KINDS: Mapping[str, Mapping[str, Any]] = {
    "town": {"plan": "town", "per_hour": 2500, "radars": ("R2", "R4", "R6")},
    "tee": {"plan": "tee", "per_hour": 1600, "radars": 1, "minutes": 3.0},
    "arterial": {"plan": "arterial", "per_hour": 2400, "radars": 2},
    "gridlock": {"plan": "junction", "per_hour": 4200, "radars": 2, "warm_up_s": 600.0},
    "roundabout": {"plan": "roundabout", "per_hour": 1100, "radars": 2},
    "junction": {"plan": "junction", "per_hour": 1500, "radars": 2},
    "bend": {"plan": "bend", "per_hour": 1500, "radars": 2},
}
"""Settings of further scenes by the kind in a name such as `tee-932`; the number is the seed."""
SCENE_CHANGES: Mapping[str, Mapping[str, Any]] = {
    "tee-932": {"minutes": 10.0},
    "arterial-933": {"minutes": 10.0},
    "gridlock-934": {"minutes": 10.0},
    "town-941": {"radars": ("R1", "R3", "R5"), "minutes": 2.5, "warm_up_s": 420.0},
    "town-951": {"minutes": 2.5, "warm_up_s": 420.0},
    "gridlock-956": {"minutes": 2.5},
    "town-981": {"warm_up_s": 420.0},
    "arterial-984": {"warm_up_s": 300.0},
    "roundabout-985": {"radars": 1},
    "town-991": {"radars": ("R2", "R4"), "minutes": 10.0, "warm_up_s": 420.0},
    "junction-993": {"per_hour": 2600, "minutes": 20.0, "warm_up_s": 300.0},
    **{f"bend-{seed}": {"per_hour": 900} for seed in (8301, 8303, 8305, 8401, 8403)},
}  # fmt: skip
"""What differs from these settings in the scenes that the documentation names."""


def recipe_of(name: str) -> Recipe | None:
    """Return the settings of a scene; None where no scene has the name."""
    kind, _, seed = name.partition("-")
    if name in RECIPES or kind not in SCENE_KINDS or not seed.isdecimal():
        return RECIPES.get(name)
    return Recipe(seed=int(seed), **{**SCENE_KINDS[kind], **SCENE_CHANGES.get(name, {})})


@dataclass(frozen=True, kw_only=True)
class SceneFiles:
    """Files of a scene.

    Parameters
    ----------
    name : str
        Its name, as given on the command line.
    folder : Path
        Folder of its files.
    kept : Path
        Folder for what is made from them.
    """

    name: str
    folder: Path
    kept: Path

    @property
    def map(self) -> Path:
        """The map."""
        return next(self.folder.glob("*.osm"))

    @property
    def scan(self) -> Path:
        """The scan."""
        return next(self.folder.glob("*.laz"))

    @property
    def recordings(self) -> list[Path]:
        """The recordings."""
        return sorted(self.folder.glob("R*.parquet"))

    @property
    def poses(self) -> list[gr.Pose]:
        """The true poses, in the order of the recordings."""
        return [true_pose(self.folder, path.stem) for path in self.recordings]

    def traffic(self) -> TrueTraffic:
        """Return the true traffic."""
        return read_traffic(self.folder / "vehicles.parquet")

    def tiles(self) -> gpd.GeoDataFrame:
        """Return the tiles, kept in `tiles.gpkg`."""
        path = self.kept / "tiles.gpkg"
        if not path.exists():
            roads = gr.read_map(self.map)
            gr.write_tiles(gr.make_tiles(roads), path, problems=roads.problems)
        return gr.read_tiles(path)

    def truth(self) -> TrueOccupancy:
        """Return the true occupancy, which is kept."""
        path = self.kept / f"truth-{_digest('true_traffic', 'true_occupancy', 'standing')}.npz"
        if path.exists():
            return _read_truth(path)
        tiles = self.tiles()
        truth = true_occupancy(tiles, self.sensors(), self.traffic())
        _write_truth(truth, path)
        return truth

    def passages(self) -> pd.DataFrame:
        """Return the true passages, which are kept."""
        code = ("true_traffic", "true_occupancy", "standing", "passages")
        path = self.kept / f"passages-{_digest(*code)}.parquet"
        if not path.exists():
            lanes = lanes_of(self.tiles(), gr.read_map(self.map))
            true_passages(lanes, self.traffic(), self.truth()).to_parquet(path)
        return pd.read_parquet(path)

    def lanelets_in_sight(self) -> Integers:
        """Return the lanelets whose middles are truly in sight; only their passages count."""
        tiles, seen = self.tiles(), self.truth().tile_id
        half = (tiles.groupby("lanelet_id")["index"].transform("max") + 1) // 2
        middle = (tiles["index"] == half) & tiles["tile_id"].isin(seen)
        return np.asarray(tiles.loc[middle, "lanelet_id"], np.int64)

    def sensors(self) -> list[Sensor]:
        """Return the sensors with the tiles that they have truly in sight."""
        tiles = self.tiles()
        return [
            Sensor(
                pose=pose,
                in_sight=in_sight(tiles, pose, self.folder),
                times=np.unique(pd.read_parquet(file, columns=["time"])["time"]),
            )
            for pose, file in zip(self.poses, self.recordings, strict=True)
        ]


def _write_truth(truth: TrueOccupancy, path: Path) -> None:
    flags: dict[str, Any] = {n: np.packbits(getattr(truth, n), axis=1) for n in _FLAGS}
    count = truth.occupied.shape[1]
    np.savez_compressed(
        path, tile_id=truth.tile_id, first_step=truth.first_step, count=count, **flags
    )


_FLAGS = ("occupied", "visible", "blocked")


def _read_truth(path: Path) -> TrueOccupancy:
    with np.load(path) as kept:
        count = int(kept["count"])
        flags = {n: np.unpackbits(kept[n], axis=1, count=count).astype(np.bool_) for n in _FLAGS}
        return TrueOccupancy(tile_id=kept["tile_id"], first_step=int(kept["first_step"]), **flags)


def scene(name: str) -> SceneFiles:
    """Return a scene; it is made where it is missing or out of date.

    Raises
    ------
    KeyError
        If there is none of that name.
    """
    kept = OUT / "scenes" / name
    shared = ROOT.parent / "shared" / "data" / name
    if name in SHARED and shared.exists():
        kept.mkdir(parents=True, exist_ok=True)
        return SceneFiles(name=name, folder=shared, kept=kept)
    if (recipe := recipe_of(name)) is None:
        raise KeyError(name)

    def make() -> None:
        for old in ("truth-*.npz", "passages-*", "tiles.gpkg"):
            for path in kept.glob(old):
                path.unlink()
        _make(recipe, kept)

    up_to_date(kept, make, settings=str(recipe))
    return SceneFiles(name=name, folder=kept, kept=kept)


def is_there(name: str) -> bool:
    """Return whether a scene is there or can be made."""
    return recipe_of(name) is not None or (ROOT.parent / "shared" / "data" / name).exists()


def _digest(*names: str) -> str:
    """Return a digest of modules of this folder: what they make is made again when they change."""
    here = Path(__file__).parent
    code = b"".join((here / f"{name}.py").read_bytes() for name in names)
    return hashlib.sha256(code).hexdigest()[:8]


def _make(recipe: Recipe, folder: Path) -> None:
    """Write the files of a scene."""
    rng = np.random.default_rng([20261122, recipe.seed])
    under = CONDITIONS[recipe.conditions]
    place = make_place(
        _plan(recipe.plan, rng),
        seed=recipe.seed,
        terrain=TERRAIN,
        settings=TrafficSettings(
            per_hour=recipe.per_hour,
            kinds=under.kinds,
            keeping=under.keeping,
            people=replace(under.people, walkers=0, cyclists=0)
            if recipe.plan == "motorway" else under.people,
        ),
        duration_s=recipe.minutes * 60.0,
        warm_up_s=recipe.warm_up_s,
        roadside=_roadside(recipe.plan),
    )  # fmt: skip
    for number, pose in enumerate(_masts(recipe, place, rng)):
        heard = place.record(
            pose, seed=10 * recipe.seed + number, model=_radar(recipe, under),
            duration_s=recipe.minutes * 60.0,
        )  # fmt: skip
        write_moving(heard, folder / f"{pose.sensor}.parquet")
        pose.write(folder / f"{pose.sensor}.json")
    write_lanelets(place.network, folder / "map.osm", terrain=place.scene.terrain, crs=UTM)
    if recipe.plan.endswith(WIDE):
        widen(folder / "map.osm")
    scan = fly(place.scene, rng=np.random.default_rng([recipe.seed, 3]))
    write_scan(scan, folder / "scan.laz", crs=UTM, flown=date(2026, 3, 14))
    write_standing(place.scene, folder / "standing.npz")
    place.write_truth(folder)


def _roadside(plan: str) -> Roadside | None:
    """Return what stands along a motorway; None: the usual."""
    if plan == "motorway":
        return Roadside(house_setback_m=40.0, car_share=0.0)
    return None


def _radar(recipe: Recipe, under: Conditions) -> RadarModel:
    """Return the radar's model; the textbook's with its full number of fixed detections."""
    return TEXTBOOK if recipe.conditions == "textbook" else under.model


def _plan(name: str, rng: np.random.Generator) -> StreetPlan:
    if name == "town":
        return town_plan()
    if name == "motorway":
        return _motorway(rng)
    drawn: dict[str, Callable[[np.random.Generator], StreetPlan]] = {p.__name__: p for p in PLANS}
    return drawn[name.removesuffix(WIDE)](rng)


def _motorway(rng: np.random.Generator) -> StreetPlan:
    """Return three lanes each way in a long bend."""
    plan = StreetPlan(name="motorway", lane_width_m=3.6, speed_mps=33.0)
    plan.node("C", np.zeros(2))
    heading, radius = rng.uniform(0.0, 360.0), rng.uniform(900.0, 2500.0)
    for k, way in enumerate((heading, heading + 180.0)):
        line = axis(np.zeros(2), way, (60.0, 0.0), (300.0, (1.0, -1.0)[k] / radius))
        plan.arm(f"M{k}", "C", line, (3, 3), median_m=4.0, rank=5)
    return plan


def _masts(recipe: Recipe, place: Place, rng: np.random.Generator) -> list[gr.Pose]:
    """Return the true poses of the sensors."""
    if not isinstance(recipe.radars, int):
        all_of_them = masts_of(place.scene, free=recipe.free)
        return [all_of_them[TOWN_MASTS[name]] for name in recipe.radars]
    found: list[gr.Pose] = []
    for number in range(1, recipe.radars + 1):
        stand = roadside_stand(place.scene, ORIGIN, rng, within_m=recipe.stand_m)
        towards = np.array(ORIGIN) - stand
        yaw = np.degrees(np.arctan2(towards[1], towards[0])) + rng.normal(0.0, recipe.aim_deg)
        ground = float(place.scene.terrain.height(stand))
        fields: dict[str, Any] = {
            "easting": float(stand[0]), "northing": float(stand[1]),
            "height": ground + float(rng.uniform(5.0, 8.0)),
            "yaw": float((yaw + 180.0) % 360.0 - 180.0), "pitch": float(rng.uniform(1.0, 5.0)),
            "roll": float(rng.normal(0.0, 1.5)),
        }  # fmt: skip
        fields = {name: round(value, 3) for name, value in fields.items()}
        view = gr.View(max_range_m=200.0)
        found.append(gr.Pose(sensor=f"R{number}", crs=UTM, view=view, **fields))
    return found
