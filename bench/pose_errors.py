"""Standard errors of occupancy where poses are wrong by what their sigmas say.

The first minute of a sensor of a simulated town is measured with poses that are drawn around the
true one. Shown is the share of the tiles with occupancy that are within two standard errors of the
truth, where the pose states its sigmas and where it states none, and the root mean squares of
errors and of standard errors.

Example: ``python bench/pose_errors.py --site town04 --sensor R1 --draws 10``
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from figures import ROOT, table
from simulated import sites, true_pose

import gis_radar as gr

sys.path[:0] = [str(ROOT / "bench" / each) for each in ("vehicles", "localization")]

SIGMAS = {"0.15 m, 0.1 deg": (0.15, 0.1), "0.5 m, 0.3 deg": (0.5, 0.3), "1 m, 0.5 deg": (1.0, 0.5)}
SECONDS, WITHIN_SIGMAS = 60.0, 2.0  # of the recording that is measured


def true_shares(site: str, sensor: str) -> pd.Series:
    """Return the true occupancy of the tiles that a sensor has in sight, by tile."""
    from scenes import scene  # noqa: PLC0415 - needs the simulator
    from true_occupancy import true_occupancy  # noqa: PLC0415

    made = scene(site)
    (mine,) = (each for each in made.sensors() if each.pose.sensor == sensor)
    mine = replace(mine, times=mine.times[mine.times < mine.times[0] + SECONDS])
    found = true_occupancy(made.tiles(), [mine], made.traffic()).table()
    return pd.Series(found.set_index("tile_id")["occupancy"].rename("true"))


def estimated(dataset: Path) -> pd.DataFrame:
    """Return occupancy and its standard error of the visible tiles, by tile."""
    wide = gr.make_heatmap(gr.open_dataset(dataset)).wide()
    return pd.DataFrame(wide[wide["visible_s"] > 0.0].set_index("tile_id"))


def remove_sigmas(dataset: Path) -> None:
    """Remove the sigmas from the poses of a dataset."""
    path = dataset / "poses.parquet"
    rows = pq.read_table(path)
    texts = [json.dumps(json.loads(t) | {"sigma": None}) for t in rows["document"].to_pylist()]
    place = rows.column_names.index("document")
    pq.write_table(rows.set_column(place, rows.field(place), [texts]), path)


def agreement(known: pd.DataFrame, true: pd.Series) -> list[float]:
    """Return the share within two standard errors, and both root mean squares."""
    both = known.join(true, how="inner").dropna(subset=["occupancy", "true"])
    both = both[(both["occupancy"] > 0.0) | (both["true"] > 0.0)]
    off, error = (both["occupancy"] - both["true"]).abs(), both["occupancy_se"]
    within = float((off <= WITHIN_SIGMAS * error).mean())
    return [within, float(np.sqrt((off**2).mean())), float(np.sqrt((error**2).mean()))]


def main() -> None:
    """Measure and compare; print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--site", default="town04")
    parser.add_argument("--sensor", default="R1")
    parser.add_argument("--draws", type=int, default=10)
    given = parser.parse_args()
    (folder,) = (each for each in sites(given.site) if each.name == given.site)
    true, pose = true_shares(given.site, given.sensor), true_pose(folder, given.sensor)
    rows = pd.read_parquet(folder / f"{given.sensor}.parquet")
    tiles, lines = gr.make_tiles(gr.read_map(folder / "map.osm")), []
    for number, (name, (metres, degrees)) in enumerate(SIGMAS.items(), 1):
        found: dict[str, list[list[float]]] = {"stated": [], "not stated": []}
        sigma = {"easting": metres, "northing": metres, "yaw": degrees}
        for draw in range(given.draws):
            steps = np.random.default_rng([35, draw, number]).normal(size=3).tolist()
            off = {n: getattr(pose, n) + sigma[n] * s for n, s in zip(sigma, steps, strict=True)}
            with tempfile.TemporaryDirectory() as place:
                path, made = Path(place) / "recording.parquet", Path(place) / "site"
                rows[rows["time"] < rows["time"].iloc[0] + SECONDS].to_parquet(path, index=False)
                drawn = replace(pose, evidence={"sigma": sigma}, **off)
                gr.measure([path], [drawn], tiles, folder / "map.osm", made, check=False)
                found["stated"].append(agreement(estimated(made), true))
                remove_sigmas(made)
                found["not stated"].append(agreement(estimated(made), true))
        for how, values in found.items():
            within, off_rms, error_rms = np.mean(values, axis=0)
            lines.append([name, how, f"{within:.1%}", f"{off_rms:.3f}", f"{error_rms:.3f}"])
    print(table(["sigma", "pose's sigmas", "within 2 se", "rms error", "rms se"], lines))


if __name__ == "__main__":
    main()
