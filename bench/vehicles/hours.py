"""Vehicles and passages over the edge of an hour, beside the same minutes without one.

The scene's clocks are shifted so that an edge lies at several moments; what is found is shifted
back and scored, and passages are compared one by one. Exit code 1 where scale, recall or precision
of passages differ by over 0.01.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from found import found_in
from passages import WITHIN_STEPS, score_passages
from scenes import OUT, SceneFiles, scene
from score import score_occupancy
from tracks import by_step, compared, matched, similarity

import gis_radar as gr
from gis_radar.base import STEPS_PER_HOUR, STEPS_PER_SECOND, Integers

sys.path.append(str(Path(__file__).parents[1]))  # what all benches share
from figures import table

EDGES_S = (150.0, 301.3, 450.0)
MOST = 0.01
AT_EDGE_STEPS = 100  # 5 s: a passage that is lost or doubled there is the fault of the edge
OVERLAP = 0.3  # of two estimated vehicles along the lane: one is too many
FIGURES = (
    "mae_percent", "scale", "passages_recall", "passages_precision", "passages_given", "vehicles",
    "doubles", "found", "differ", "differ_at_edge",
)  # fmt: skip


def main() -> None:
    """Measure, score, print and keep."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scene", default="hours")
    parser.add_argument("--json", type=Path, default=OUT / "hours.json")
    arguments = parser.parse_args()
    site = scene(arguments.scene)
    rows = measure(site)
    heads = ["edge", *FIGURES]
    shown = [[name, *(f"{row[key]:.4g}" for key in FIGURES)] for name, row in rows.items()]
    print(table(heads, shown))
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    if trouble := worse(rows):
        sys.exit("\n".join(trouble))


def measure(site: SceneFiles) -> dict[str, dict[str, float]]:
    """Return the figures without an edge, and with it at each moment."""
    first = site.truth().first_step
    hour = (first // STEPS_PER_HOUR + 1) * STEPS_PER_HOUR
    moments = {"none": -STEPS_PER_HOUR / 2.0} | {
        f"{edge_s:.0f} s": edge_s * STEPS_PER_SECOND for edge_s in EDGES_S
    }
    rows, alone = {}, None
    for name, before in moments.items():
        row, passages = _figures(site, hour - first - round(before))
        alone = passages if alone is None else alone
        apart = _differing(alone, passages)
        near = np.abs(apart - first - round(before)) <= AT_EDGE_STEPS
        rows[name] = row | {"differ": len(apart), "differ_at_edge": int(near.sum())}
        print(f"edge, {name}: {rows[name]}", flush=True)
    return rows


def worse(rows: dict[str, dict[str, float]]) -> list[str]:
    """Return a line for each place of the edge at which it costs too much."""
    whole = rows["none"]
    return [
        f"edge at {name}: {key} {row[key]:.3f}, was {whole[key]:.3f}"
        for name, row in rows.items()
        for key in ("scale", "passages_recall", "passages_precision")
        if abs(row[key] - whole[key]) > MOST
    ]


def _differing(one: pd.DataFrame, other: pd.DataFrame) -> Integers:
    """Return the steps of passages that only one of two runs has, each passage used once."""
    left = {lane: sorted(rows["step"]) for lane, rows in other.groupby("lanelet_id")}
    apart = []
    for lane, step in one.sort_values("step")[["lanelet_id", "step"]].to_numpy().tolist():
        steps = left.get(lane, [])
        near = [each for each in steps if abs(each - step) <= WITHIN_STEPS]
        if near:
            steps.remove(min(near, key=lambda each: abs(each - step)))
        else:
            apart.append(step)
    return np.array([*apart, *(step for steps in left.values() for step in steps)], np.int64)


def _figures(site: SceneFiles, shift: int) -> tuple[dict[str, float], pd.DataFrame]:
    """Measure a scene that is so many steps later; return scores and passages shifted back."""
    with tempfile.TemporaryDirectory() as name:
        found = found_in(follow(site, shift, Path(name)))
    occupancy = score_occupancy(site.truth(), found.occupancy)
    given = found.passages.assign(step=found.passages["step"] - shift)
    passed = score_passages(site.passages(), given)
    states = found.states.assign(step=found.states["step"] - shift)
    vehicles = states["vehicle"].nunique()
    scored = compared(site.tiles(), site.truth(), site.traffic(), states)
    true, _ = matched(scored)
    scores = {
        "mae_percent": occupancy.mae_percent,
        "scale": occupancy.scale,
        **passed,
        "passages_given": len(given),
        "vehicles": vehicles,
        "doubles": float(np.mean([_doubles(other) for _, other in by_step(scored)])),
        "found": float((true.loc[true["due"], "match"] >= 0).mean()),
    }
    return scores, given


def _doubles(given: pd.DataFrame) -> int:
    """Return how many pairs of estimated vehicles of a step stand on each other."""
    alike = similarity(given, given)
    return int((np.triu(alike, 1) > OVERLAP).sum())


def follow(site: SceneFiles, shift: int, place: Path) -> gr.Dataset:
    """Measure a scene that is so many steps later."""
    recordings = []
    for path in site.recordings:
        later = pd.read_parquet(path)
        later["time"] += shift / STEPS_PER_SECOND
        recordings.append(place / path.name)
        later.to_parquet(recordings[-1])
    return gr.measure(
        recordings, site.poses, site.tiles(), site.map, place / "site", scans=[site.scan]
    )


if __name__ == "__main__":
    main()
