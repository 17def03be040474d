"""What it costs that a site's vehicles are followed hour by hour, and joined.

A recording is moved in time so that the full hour falls in the midst of it, at several places:
followed hour by hour and joined as a site's run does it, beside the same recording followed in
one go, in which a block of five minutes ends there, and beside one in which none does.

    python bench/vehicles/hours.py [--scene hours]

Figures are kept in out/bench-vehicles/hours.json. Exit code 1 where the hours cost more than a
hundredth of the coverage, or a passage in a hundred.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from passages import score_passages
from scenes import OUT, SceneFiles, scene
from score import coverage_of_folder, score_coverage
from tables import table
from tracks import by_step, compared, estimated_states, matched, similarity

import gis_radar as gr
from gis_radar.site.hours import HOUR_STEPS
from gis_radar.steps import STEPS_PER_SECOND
from gis_radar.vehicles.hours import join_hours
from gis_radar.vehicles.settings import DEFAULTS

EDGES_S = (70.0, 110.0, 150.0, 190.0)
MOST = 0.01
OVERLAP = 0.3  # of two estimated vehicles along the lane: one is too many
FIGURES = {
    "mae_percent": "error", "scale": "scale", "passages_recall": "recall",
    "passages_precision": "precision", "passages_given": "passages", "vehicles": "vehicles",
    "doubles": "doubles", "found": "found",
}  # fmt: skip


def main() -> None:
    """Follow, join, score, print and keep."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scene", default="hours")
    parser.add_argument("--json", type=Path, default=OUT / "hours.json")
    arguments = parser.parse_args()
    site = scene(arguments.scene)
    rows = measure(site)
    heads = ["edge", *FIGURES.values()]
    shown = [[name, *(f"{row[key]:.4g}" for key in FIGURES)] for name, row in rows.items()]
    print(table(heads, shown))
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    if trouble := worse(rows):
        sys.exit("\n".join(trouble))


def measure(site: SceneFiles) -> dict[str, dict[str, float]]:
    """Return the figures without an edge, and for each edge those of one go and of the hours."""
    first = site.truth().first_step
    block = DEFAULTS.blocks.steps
    rows = {"none": _figures(site, (first // block + 1) * block - first, hours=False)}
    hour = (first // HOUR_STEPS + 1) * HOUR_STEPS
    for edge_s in EDGES_S:
        shift = hour - first - round(edge_s * STEPS_PER_SECOND)
        for name, more, hours in (("in one go", block, False), ("hours joined", 0, True)):
            found = _figures(site, shift + more, hours=hours)
            rows[f"{edge_s:.0f} s, {name}"] = found
            print(f"{edge_s:.0f} s, {name}: {found}", flush=True)
    return rows


def worse(rows: dict[str, dict[str, float]]) -> list[str]:
    """Return a line for each place of the edge at which the hours cost too much."""
    lines: list[str] = []
    for edge_s in EDGES_S:
        one, joined = (rows[f"{edge_s:.0f} s, {name}"] for name in ("in one go", "hours joined"))
        lines += [
            f"edge at {edge_s:.0f} s: {key} {joined[key]:.3f}, was {one[key]:.3f}"
            for key in ("scale", "passages_recall", "passages_precision")
            if abs(joined[key] - one[key]) > MOST
        ]
    return lines


def _figures(site: SceneFiles, shift: int, *, hours: bool) -> dict[str, float]:
    """Follow the vehicles of a scene that is so many steps later, and score them."""
    with tempfile.TemporaryDirectory() as name:
        folder = follow(site, shift, Path(name), hours=hours)
        coverage = score_coverage(site.truth(), coverage_of_folder(folder))
        given = pd.read_parquet(folder / "passages.parquet")
        passed = score_passages(site.passages(), given.assign(step=given["step"] - shift))
        states = estimated_states(folder)
        states = states.assign(step=states["step"] - shift)
        vehicles = len(pd.read_parquet(folder / "vehicles.parquet", columns=["vehicle"]))
    scored = compared(site.tiles(), site.truth(), site.poses, site.traffic(), states)
    true, _, _ = matched(scored)
    return {
        "mae_percent": coverage.mae_percent,
        "scale": coverage.scale,
        **passed,
        "passages_given": len(given),
        "vehicles": vehicles,
        "doubles": float(np.mean([_doubles(other) for _, other in by_step(scored)])),
        "found": float((true.loc[true["due"], "match"] >= 0).mean()),
    }


def _doubles(given: pd.DataFrame) -> int:
    """Return how many pairs of estimated vehicles of a step stand on each other."""
    alike = similarity(given, given)
    return int((np.triu(alike, 1) > OVERLAP).sum())


def follow(site: SceneFiles, shift: int, place: Path, *, hours: bool) -> Path:
    """Write the vehicles of a scene that is so many steps later; return their folder."""
    recordings = []
    for path in site.recordings:
        later = pd.read_parquet(path)
        later["time"] += shift / STEPS_PER_SECOND
        recordings.append(place / path.name)
        later.to_parquet(recordings[-1])
    begin = site.truth().first_step + shift
    spans: list[Any] = [None]
    if hours:
        last = begin + site.truth().covered.shape[1]
        numbers = range(begin // HOUR_STEPS, last // HOUR_STEPS + 1)
        spans = [(n * HOUR_STEPS, (n + 1) * HOUR_STEPS - 1) for n in numbers]
    parts = [place / f"part{number}" for number in range(len(spans))]
    for part, span in zip(parts, spans, strict=True):
        gr.find_vehicles(
            recordings, site.poses, site.tiles(), site.map, part, scans=[site.scan], span=span
        )
    if not hours:
        return parts[0]
    join_hours(parts, place / "joined", tiles=site.tiles())
    return place / "joined"


if __name__ == "__main__":
    main()
