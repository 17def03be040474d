"""Compare a dataset with what the version before found: hits and observed steps row by row, tracks.

`python bench/dataset_same.py --before FOLDER`, where FOLDER is a checkout of the version before the
dataset. The sites are those of `../shared/data`, as far as they are there, and the sample. Tracks
are equal but in the first and last `margin` steps around the edges of hours.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import KDTree
from simulated import ROOT, true_pose

import gis_radar as gr

DATA = ROOT.parent / "shared" / "data"
STEPS_PER_HOUR = 72_000
AWAY_STEPS = 1200  # of an hour's edge: blocks lie elsewhere than before up to there
BEFORE = """
import sys, numpy as np, pandas as pd, gis_radar as gr
from pathlib import Path
folder, map_path, *names = map(Path, sys.argv[1:])
tiles = gr.read_tiles(folder / "tiles.gpkg")
poses = [gr.read_pose(folder / f"{each.stem}.json") for each in names]
found = gr.measure_occupancy(names, poses, tiles, folder / "hits")
step, tile = (np.concatenate(each) for each in zip(*found.held_hits()))
pd.DataFrame({"tile_id": tile, "step": step}).to_parquet(folder / "hits.parquet")
found.covered_frames().to_parquet(folder / "frames.parquet")
found.views[["view", "tile_id"]].drop_duplicates().to_parquet(folder / "views.parquet")
vehicles = gr.find_vehicles(names, poses, tiles, map_path, folder / "vehicles")
pd.concat(vehicles.tracks()).to_parquet(folder / "tracks.parquet")
"""


def site_files(folder: Path) -> tuple[Path, list[Path], dict[str, gr.Pose]]:
    """Return map, recordings and poses of a site."""
    recordings = sorted(folder.glob("R?.parquet"))
    poses = {each.stem: true_pose(folder, each.stem) for each in recordings}
    return next(folder.glob("*.osm")), recordings, poses


def compare(site: Path, before: Path) -> bool:
    """Measure a site by both versions and print what differs."""
    name = site.name
    map_path, recordings, poses = site_files(site)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        tiles = gr.make_tiles(gr.read_map(map_path, crs="EPSG:25832"))
        gr.write_tiles(tiles, folder / "tiles.gpkg")
        for sensor, pose in poses.items():
            gr.write_pose(pose, folder / f"{sensor}.json")
        tiles = gr.read_tiles(folder / "tiles.gpkg")
        command = [sys.executable, "-c", BEFORE, folder, map_path, *recordings]
        subprocess.run(
            list(map(str, command)), check=True, cwd=folder,
            env=os.environ | {"PYTHONPATH": str(before)},
        )  # fmt: skip
        ds = gr.measure(recordings, list(poses.values()), tiles, map_path, folder / "site")
        same = _same_hits(name, ds, folder) and _same_observed(name, ds, folder)
        return _same_tracks(name, ds, folder) and same


def _steps(times: pd.Series) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    micros = times.astype("datetime64[us, UTC]").astype(np.int64).to_numpy()
    return np.asarray(micros // 50_000)


def _same_hits(name: str, ds: gr.Dataset, folder: Path) -> bool:
    old = pd.read_parquet(folder / "hits.parquet").sort_values(["tile_id", "step"])
    new = ds.hits()
    now = np.column_stack([new["tile_id"], _steps(new["time"])])
    equal = np.array_equal(old.to_numpy(), now)
    print(f"{name}: hits before {len(old):,}, now {len(now):,}: {'equal' if equal else 'DIFFER'}")
    return equal


def _same_observed(name: str, ds: gr.Dataset, folder: Path) -> bool:
    """Compare the observed steps of each tile, to the last frame, where they ended before."""
    frames = pd.read_parquet(folder / "frames.parquet")
    views = pd.read_parquet(folder / "views.parquet")
    first, end = int(frames["first_step"].min()), int(frames["last_step"].max())
    count = int(ds.tiles()["tile_id"].max()) + 1
    old, new = (np.zeros((count, end - first + 1), np.bool_) for _ in range(2))
    for view, rows in frames.groupby("view"):
        steps = np.zeros(end - first + 1, np.bool_)
        for low, high in rows[["first_step", "last_step"]].to_numpy():
            steps[low - first : high - first + 1] = True
        old[views.loc[views["view"] == view, "tile_id"]] |= steps
    runs = ds.observed()
    begins, ends = _steps(runs["begin"]) - first, _steps(runs["end"]) - first
    for tile, low, high in zip(runs["tile_id"], begins, ends, strict=True):
        new[tile, low : min(high, end - first + 1)] = True
    equal = bool((old == new).all())
    print(f"{name}: observed steps {old.sum():,}, now {new.sum():,}: "
          f"{'equal' if equal else 'DIFFER'}")  # fmt: skip
    return equal


def _same_tracks(name: str, ds: gr.Dataset, folder: Path) -> bool:
    """Compare the states that both have, by place: numbers differ."""
    new = ds.tracks()
    new = new.assign(step=_steps(new["time"]))
    old, new = (
        _away_from_edges(each) for each in (pd.read_parquet(folder / "tracks.parquet"), new)
    )
    places = [each[["step", "easting", "northing"]].to_numpy() * (1e3, 1, 1) for each in (old, new)]
    apart, match = KDTree(places[1]).query(places[0])
    other = new.iloc[match]
    turn = (old["heading"].to_numpy() - other["heading"].to_numpy() + 180.0) % 360.0 - 180.0
    faster = old["speed"].to_numpy() - other["speed"].to_numpy()
    differs = (apart > 0.02) | (np.abs(turn) > 0.02) | (np.abs(faster) > 0.02)
    equal = len(old) == len(new) == len(np.unique(match)) and not differs.any()
    print(
        f"{name}: states before {len(old):,}, now {len(new):,}: "
        + ("equal" if equal else f"{int(differs.sum()):,} DIFFER")
    )
    return bool(equal)


def _away_from_edges(tracks: pd.DataFrame) -> pd.DataFrame:
    beside = tracks["step"] % STEPS_PER_HOUR
    away = (beside >= AWAY_STEPS) & (beside < STEPS_PER_HOUR - AWAY_STEPS)
    return tracks[away & (tracks["step"] % 4 == 0)]


def main() -> int:
    """Compare all sites."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, required=True, help="checkout of the version before")
    parser.add_argument("--only", nargs="*", help="names of sites")
    options = parser.parse_args()
    towns = [DATA / name for name in ("town01", "town02", "town04")]
    results = [
        compare(site, options.before.resolve())
        for site in (gr.sample_folder(), *towns)
        if site.is_dir() and (not options.only or site.name in options.only)
    ]
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main())
