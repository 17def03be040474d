"""Hit share against the true traffic: how well it ranks tiles, and how it scales.

For each simulated site the true share of time in which a vehicle's footprint covers a tile's
centre is counted from the vehicles' positions at every step. A radar hits a vehicle in few places a
frame, so hit share lies below the true share: `scale` is the sum of hit over the sum of true
hit share, `rho` Spearman's rank correlation; first over all observed tiles (also those hidden
behind houses and queues), then over those that were hit. `false hits` is the share of the tiles
without any vehicle whose hit share is over half a percent.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
from scipy.stats import spearmanr
from simulated import ROOT, sites, true_pose

import gis_radar as gr
from gis_radar.arrays import Floats, Integers

NAMES = {"t": "time", "L": "length", "W": "width"}
CLEARANCE_M = (-0.5, 4.5)
FALSE_HIT = 0.005
NO_VEHICLES = ("walker", "cyclist")


def main() -> None:
    """Compare each site, print the table, keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sites", type=Path, nargs="*", default=sites())
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-truth.json")
    arguments = parser.parse_args()
    heads = ("tiles", "rho", "scale", "tiles hit", "rho", "scale", "false hits")
    print(f"{'site':14s}{'filter':>10s}" + "".join(f"{head:>11s}" for head in heads))
    report = {}
    for site in arguments.sites:
        for name, filters in (("none", gr.Filters()), ("clearance", _clearance())):
            figures = _compare(site, filters)
            report[f"{site.name}, {name}"] = figures
            print(f"{site.name:14s}{name:>10s}" + "".join(f"{x:11.4g}" for x in figures.values()))
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")


def _clearance() -> gr.Filters:
    return gr.Filters(clearance=CLEARANCE_M)


def _compare(site: Path, filters: gr.Filters) -> dict[str, float]:
    tiles = gr.make_tiles(gr.read_map(next(site.glob("*.osm"))))
    recordings = sorted(site.glob("R*.parquet"))
    with tempfile.TemporaryDirectory() as folder:
        dataset = gr.measure(
            recordings, [true_pose(site, path.stem) for path in recordings], tiles, None,
            Path(folder) / "site", filters=filters, hits_only=True,
        )  # fmt: skip
        heat = gr.make_heatmap(dataset).wide()
    traffic = pd.read_parquet(site / "vehicles.parquet").rename(columns=NAMES)
    if "kind" in traffic:
        traffic = traffic[~traffic["kind"].isin(NO_VEHICLES)]
    true = _true_share(tiles, traffic)
    observed = heat["hit_share"].notna().to_numpy()
    hit, true = heat["hit_share"].to_numpy()[observed], true[observed]
    was_hit, empty = hit > 0.0, true == 0.0
    return {
        "tiles": int(observed.sum()),
        **_agreement(hit, true),
        "tiles_hit": int(was_hit.sum()),
        **{f"{k}_hit": v for k, v in _agreement(hit[was_hit], true[was_hit]).items()},
        "false_hits": float((hit[empty] > FALSE_HIT).mean()) if empty.any() else float("nan"),
    }


def _agreement(hit: Floats, true: Floats) -> dict[str, float]:
    return {"rho": float(spearmanr(hit, true).statistic), "scale": float(hit.sum() / true.sum())}


def _true_share(tiles: gpd.GeoDataFrame, vehicles: pd.DataFrame) -> Floats:
    """Return the share of time in which a vehicle covers each tile's centre."""
    centres = np.column_stack([tiles.geometry.centroid.x, tiles.geometry.centroid.y])
    height = tiles["height_m"].to_numpy()
    road = vehicles["height" if "height" in vehicles else "z"].to_numpy(float)
    level = road if "height" in vehicles else road + 372.0
    at = vehicles["time"].rank(method="dense").to_numpy(np.int64) - 1
    steps = np.unique(at).size
    occupied: Integers = np.zeros(len(tiles), np.int64)
    grid = gr.TileGrid(_footprints(vehicles))
    point, vehicle = grid.assign(centres[:, 0], centres[:, 1])
    same_level = ~(np.abs(height[point] - level[vehicle]) > 2.5)
    pairs = np.unique(np.stack([point[same_level], at[vehicle[same_level]]]), axis=1)
    np.add.at(occupied, pairs[0], 1)
    return occupied / steps


def _footprints(vehicles: pd.DataFrame) -> Floats:
    """Return the (n, 4, 2) outlines of all vehicles at all times."""
    heading = np.radians(vehicles["heading"].to_numpy())
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    middle = vehicles[["easting", "northing"]].to_numpy()
    half_length = ahead * vehicles["length"].to_numpy()[:, None] / 2
    half_width = left * vehicles["width"].to_numpy()[:, None] / 2
    corners = [
        -half_length - half_width, half_length - half_width,
        half_length + half_width, -half_length + half_width,
    ]  # fmt: skip
    return np.stack([middle + corner for corner in corners], axis=1)


if __name__ == "__main__":
    main()
