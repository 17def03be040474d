"""The straight road: a sensor that looks along it cannot know where along it stands.

Right is an answer that is marked as such (`observable` false, a large sigma along the road, a small
one across) or none at all. A confident answer is the one failure.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from conditions import CONDITIONS, TEXTBOOK
from places import (
    ORIGIN,
    OUT,
    UTM,
    WINDOW_S,
    Manners,
    disc,
    errors,
    make_place,
    read_ground,
    write_moving,
)
from street_plans import StreetPlan, axis

import gis_radar as gr
from gis_radar.arrays import Floats
from gis_radar.poses.files import write_pose
from simulation.terrain import Terrain

HEADING_DEG = 27.0
HALF_M = 420.0  # beyond the view: an end of the road would fix the place along it
ASIDE_M, MAST_M = 8.0, 6.0
LARGE_M, FAR_SIGMAS = 1.0, 5.0
STARTS = 6


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One try at the straight road.

    Parameters
    ----------
    said : str
        `refused` and why, or what the answer states of itself.
    confident : bool
        Whether it claims to know the place along the road, or to know it across and is far off.
    along_m, across_m : float
        Error along the road and across it; NaN where refused.
    sigma_along_m, sigma_across_m : float
        What the answer states of them.
    """

    said: str
    confident: bool
    along_m: float = float("nan")
    across_m: float = float("nan")
    sigma_along_m: float = float("nan")
    sigma_across_m: float = float("nan")


def measure(*, quick: bool) -> list[Attempt]:
    """Try to localize from several starts, without a heading and with one."""
    folder = straight_folder()
    true, ground = gr.read_pose(folder / "R1.json"), read_ground(folder)
    count = 2 if quick else STARTS
    attempts = []
    for k, offset in enumerate(disc(np.random.default_rng(3), count, 10.0)):
        place = true.position[:2] + offset
        try:
            found = gr.localize(
                folder / "R1.parquet",
                ground.roads,
                ground.road,
                guess=(place[0], place[1]),
                heading=true.yaw + 10.0 if k % 2 else None,
            )
        except gr.NoAnswerError as refusal:
            attempts.append(Attempt(said=f"refused: {refusal}", confident=False))
            continue
        attempts.append(_judged(found, true))
    return attempts


def _judged(found: gr.Localization, true: gr.Pose) -> Attempt:
    angle = np.radians(HEADING_DEG)
    turn: Floats = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    along_m, across_m = turn @ errors(found.pose, true)[:2]
    covariance = np.array(found.pose.evidence["covariance"])[:2, :2]
    sigma = np.sqrt(np.diag(turn @ covariance @ turn.T))
    far = abs(across_m) > FAR_SIGMAS * sigma[1]
    return Attempt(
        said=f"observable {str(found.observable).lower()}",
        confident=bool(found.observable or sigma[0] < LARGE_M or far),
        along_m=float(along_m),
        across_m=float(across_m),
        sigma_along_m=float(sigma[0]),
        sigma_across_m=float(sigma[1]),
    )


def straight_folder() -> Path:
    """Return the folder of the straight road; made where missing."""
    folder = OUT / "straight"
    if (folder / "road.npy").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    plan = StreetPlan(name="straight")
    plan.node("B", np.zeros(2))
    for name, turned in (("A", 180.0), ("C", 0.0)):
        plan.arm(name, "B", axis(np.zeros(2), HEADING_DEG + turned, (HALF_M, 0.0)))
    place = make_place(
        plan,
        seed=8,
        terrain=Terrain(origin=ORIGIN, height_m=370.0),
        manners=Manners(per_hour=1400.0),
        duration_s=WINDOW_S,
    )
    angle = np.radians(HEADING_DEG)
    stand = np.array(ORIGIN) + ASIDE_M * np.array([np.sin(angle), -np.cos(angle)])
    pose = gr.Pose(
        sensor="R1", crs=UTM, easting=float(stand[0]), northing=float(stand[1]),
        height=370.0 + MAST_M, yaw=HEADING_DEG + 5.0, pitch=3.0, roll=0.0,
        view=gr.View(max_range_m=200.0),
    )  # fmt: skip
    model = CONDITIONS[TEXTBOOK].model
    write_moving(place.record(pose, seed=8, model=model), folder / "R1.parquet")
    write_pose(pose, folder / "R1.json")
    place.write_ground(folder, seed=8)
    return folder


def markdown(attempts: list[Attempt]) -> str:
    """Return the attempts as a table."""
    lines = [
        "| start | answer | along: error, sigma | across: error, sigma |",
        "|---|---|---|---|",
    ]
    for k, a in enumerate(attempts, start=1):
        along, across = (
            "" if np.isnan(error) else f"{error:+.2f}, {sigma:.2f} m"
            for error, sigma in ((a.along_m, a.sigma_along_m), (a.across_m, a.sigma_across_m))
        )
        verdict = " **confident**" if a.confident else ""
        lines.append(f"| {k} | {a.said}{verdict} | {along} | {across} |")
    return "\n".join(lines)
