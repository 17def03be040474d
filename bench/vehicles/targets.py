"""Errors of vehicles, lanes and tiles within 100 m of a radar, by measures of traffic engineering.

    python bench/vehicles/targets.py --scene town-991,gridlock-934 [--poses found]

For each scene: volumes, speeds, turns and queues of lanes (`lane_volumes.py`), occupancy of
lanelets and tiles, recall and precision of vehicles, also of standing ones. With `--poses found`,
poses are those that `gis-radar localize` finds; else the true ones.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import lane_volumes
import numpy as np
import pandas as pd
from found import found_in
from own import measured
from scenes import SceneFiles, scene
from tracks import Scored, compared, score_tracks

from gis_radar.base import Floats

STANDS_MPS = 0.5  # slower vehicles stand
LEAST_S = 30.0  # for which a tile is visible, truly and by the estimate


def figures_of(site: SceneFiles, *, found: bool) -> dict[str, str]:
    """Measure a scene with found or with true poses; return its figures as texts."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = measured(site, Path(folder) / "dataset", found=found)
        given = found_in(dataset)
        figures = lane_volumes.score(site, dataset)
    scored = compared(site.tiles(), site.truth(), site.traffic(), given.states)
    return figures | occupancy(site, given.occupancy) | vehicles(near_only(site, scored))


def from_radar(site: SceneFiles, easting: pd.Series, northing: pd.Series) -> Floats:
    """Return how far places are from the nearest radar, metres."""
    apart = [
        np.hypot(easting - pose.easting, northing - pose.northing) for pose in site.poses
    ]  # fmt: skip
    return np.asarray(np.min(apart, axis=0))


def near_only(site: SceneFiles, scored: Scored) -> Scored:
    """Return the states with only those due that are near a radar."""
    true, given = (
        side.assign(
            due=side["due"]
            & (from_radar(site, side["easting"], side["northing"]) < lane_volumes.WITHIN_M)
        )
        for side in (scored.true, scored.given)
    )
    return replace(scored, true=true, given=given)


def occupancy(site: SceneFiles, given: pd.DataFrame) -> dict[str, str]:
    """Return the errors of occupancy of near tiles and lanelets."""
    both = beside_truth(site, given)
    both = both[both["away_m"] < lane_volumes.WITHIN_M]
    error = both["occupancy_given"] - both["occupancy"]
    lane = site.tiles().set_index("tile_id")["lanelet_id"].loc[both["tile_id"]].to_numpy()
    by_lane = both.groupby(lane)[["occupancy", "occupancy_given"]].sum()
    off = (by_lane["occupancy_given"] - by_lane["occupancy"]).abs().sum()
    within = error.abs() <= 2.0 * both["occupancy_se"]
    points, mean = 100.0 * error.abs().mean(), 100.0 * both["occupancy"].mean()
    return {
        "tile_points": f"{points:.2f} of {mean:.1f}",
        "lane_occupancy_off": f"{off / both['occupancy'].sum():.1%} "
        f"(bias {error.sum() / both['occupancy'].sum():+.1%})",
        "tiles_within_2_se": f"{within.mean():.0%}",
    }


def beside_truth(site: SceneFiles, given: pd.DataFrame) -> pd.DataFrame:
    """Return the truth of tiles visible in both, with `..._given` and `away_m` (to radars)."""
    both = site.truth().table().merge(given, on="tile_id", suffixes=("", "_given"))
    both = both[(both["visible_s"] > LEAST_S) & (both["visible_s_given"] > LEAST_S)]
    middle = site.tiles().set_index("tile_id").centroid.loc[both["tile_id"]]
    both = both.assign(away_m=from_radar(site, middle.x, middle.y))
    return both.dropna(subset="occupancy_given")


def vehicles(scored: Scored) -> dict[str, str]:
    """Return recall and precision of all and of standing vehicles, and how often heavy is right."""
    every = score_tracks(scored)
    still = score_tracks(
        replace(scored, true=_standing(scored.true), given=_standing(scored.given))
    )
    return {
        "recall": f"{every['recall']:.3f}", "precision": f"{every['precision']:.3f}",
        "standing": f"{still['recall']:.3f} found, {1.0 - still['precision']:.3f} false",
        "heavy_right": f"{every['two_groups']:.1%}",
    }  # fmt: skip


def _standing(side: pd.DataFrame) -> pd.DataFrame:
    """Return states of which only standing ones are due; others may still be matched."""
    return side.assign(due=side["due"] & (side["speed"] < STANDS_MPS))


def main() -> None:
    """Print the figures of each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", required=True)
    parser.add_argument("--poses", choices=("true", "found"), default="true")
    options = parser.parse_args()
    for name in options.scene.split(","):
        figures = figures_of(scene(name), found=options.poses == "found")
        print(name, *(f"{key} {value}" for key, value in figures.items()), sep="\n  ", flush=True)


if __name__ == "__main__":
    main()
