"""Localization: errors from many starts without a heading, sensor by sensor.

The road comes from the site's own scan by the built-in mask. Each start lies within `--within`
metres of the truth, drawn with a fixed seed; no heading is given. A refusal is counted, never an
error; `wrong` counts answers over 1 m or 1 degree off. Exit code 1 where any answer is wrong.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from simulated import ROOT, sites, true_pose

import gis_radar as gr
from gis_radar.arrays import Floats


def main() -> None:
    """Localize from every start, print and keep the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sites", type=Path, nargs="*", default=sites())
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--within", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "bench-localization.json")
    arguments = parser.parse_args()
    heads = ("2D m", "max 2D m", "height m", "roll deg", "pitch deg", "yaw deg", "s")
    print(f"{'sensor':16s}" + "".join(f"{head:>11s}" for head in heads) + "   refused  wrong")
    report = {}
    rng = np.random.default_rng(arguments.seed)
    for site in arguments.sites:
        roads = gr.read_map(next(site.glob("*.osm")))
        mask = gr.mask_road(
            [next(site.glob("*.laz"))], gr.read_roads(next(site.glob("*.osm"))), engine="laspy"
        )
        for path in sorted(site.glob("R*.parquet")):
            starts = _starts(arguments.starts, arguments.within, rng)
            errors, refused = _errors(path, roads, mask.points, starts)
            wrong = int(((errors[:, 0] > 1.0) | (errors[:, 4] > 1.0)).sum())
            middle = np.median(errors, axis=0) if len(errors) else np.full(6, np.nan)
            figures = [middle[0], errors[:, 0].max(initial=0.0), *middle[1:]]
            name = f"{site.name} {path.stem}"
            print(
                f"{name:16s}" + "".join(f"{x:11.2f}" for x in figures) + f"{refused:10d}{wrong:7d}"
            )
            report[name] = {**dict(zip(heads, figures, strict=True)), "refused": refused}
            report[name]["wrong"] = wrong
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if any(figures["wrong"] for figures in report.values()):
        sys.exit("an answer is in the wrong place")


def _starts(count: int, within_m: float, rng: np.random.Generator) -> Floats:
    """Return offsets from the truth, (n, 2) metres, evenly over a disc."""
    turn = rng.uniform(0.0, 2.0 * np.pi, count)
    reach = within_m * np.sqrt(rng.random(count))
    return np.column_stack([reach * np.cos(turn), reach * np.sin(turn)])


def _errors(path: Path, roads: gr.LaneletMap, road: Floats, starts: Floats) -> tuple[Floats, int]:
    """Return per answer 2D, height, roll, pitch, yaw (m, deg) and seconds; and the refusals."""
    truth, rows, refused = true_pose(path.parent, path.stem), [], 0
    for east, north in starts:
        guess = (truth.easting + east, truth.northing + north)
        begin = time.perf_counter()
        try:
            found = gr.localize(path, roads, road, guess=guess).pose
        except gr.NoAnswerError:
            refused += 1
            continue
        angles = [
            abs((getattr(found, a) - getattr(truth, a) + 180.0) % 360.0 - 180.0)
            for a in ("roll", "pitch", "yaw")
        ]
        flat = float(np.hypot(found.easting - truth.easting, found.northing - truth.northing))
        spent = time.perf_counter() - begin
        rows.append([flat, abs(found.height - truth.height), *angles, spent])
    return np.array(rows, dtype=np.float64).reshape(-1, 6), refused


if __name__ == "__main__":
    main()
