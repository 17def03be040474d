"""Vehicles and coverage, measured against the true traffic of simulated scenes.

    python bench/vehicles --scene town --score-only coverage.parquet     a table or vehicles folder
    python bench/vehicles --make town,light                              only make scenes
    python bench/vehicles                                                the development scenes

From Python, with bench/vehicles in the path: `from scenes import scene`, `from score import
score_coverage`; `score_coverage(scene("town").truth(), table)`. A scene has `.map`, `.scan`,
`.recordings`, `.poses` (true ones), `.tiles()`, `.truth()`, `.traffic()`. Results in
out/bench-vehicles. Needs Eclipse SUMO to make scenes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import pandas as pd
from passages import score_passages
from peers import PEERS
from scenes import OUT, RECIPES, SHARED, scene
from score import CoverageScore, coverage_of_folder, score_coverage
from tracks import compared, estimated_states, score_tracks

HELD_OUT = "-held"
HEADS = {
    "tiles": "d", "true_mean": ".1%", "answered": ".0%", "rank": ".2f", "scale": ".2f",
    "mae_percent": ".1f", "r2": ".2f", "false_zeros": ".0%", "false_busy": ".0%", "beyond": ".0%",
    "within_2_se": ".0%",
}  # fmt: skip
VEHICLES = {
    "recall": ".0%", "precision": ".0%", "found": ".0%", "real": ".0%", "gospa_m": ".1f",
    "hota": ".2f", "det_a": ".2f", "ass_a": ".2f", "along_m": ".2f", "across_m": ".2f",
    "speed_mps": ".2f", "speed_90_mps": ".2f", "length_m": ".2f", "length_bias_m": "+.2f",
    "two_groups": ".0%", "count_bias": "+.1%", "count_error": ".1%", "passages_recall": ".0%",
    "passages_precision": ".0%",
}  # fmt: skip


def main() -> None:
    """Make scenes, run what is asked for, print a table."""
    names = [*RECIPES, *SHARED]
    development = [name for name in names if not name.endswith(HELD_OUT)]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default=",".join(development), help=f"of {', '.join(names)}")
    parser.add_argument("--make", metavar="SCENES", help="only make these")
    parser.add_argument("--score-only", type=Path, metavar="FILE", help="table, or vehicles folder")
    parser.add_argument("--peers", default=",".join(PEERS), help=f"of {', '.join(PEERS)}")
    options = parser.parse_args()
    if options.make:
        for name in options.make.split(","):
            make(name)
        return
    if options.score_only:
        if not options.score_only.exists():
            parser.error(f"{options.score_only} is not there")
        print_rows({options.scene: score(options.scene, options.score_only)})
        if options.score_only.is_dir():
            print_vehicles({options.scene: vehicles_score(options.scene, options.score_only)})
        return
    report = {}
    for name in options.scene.split(","):
        for peer in options.peers.split(","):
            made = PEERS[peer](scene(name))
            report[f"{name}, {peer}"] = score_coverage(scene(name).truth(), made)
            print_rows({f"{name}, {peer}": report[f"{name}, {peer}"]}, head=len(report) == 1)
    kept = {name: dataclasses.asdict(row) for name, row in report.items()}
    (OUT / "coverage.json").write_text(json.dumps(kept, indent=1) + "\n")


def make(name: str) -> None:
    """Make a scene and its truth, and say how long that took."""
    begin = time.perf_counter()
    made = scene(name)
    middle = time.perf_counter()
    true = made.truth().table()
    share = true["coverage"].mean()
    end = time.perf_counter()
    about = f"{len(made.recordings)} radars, {len(true)} tiles in sight, mean {share:.1%}"
    print(f"{name}: {about}; {middle - begin:.0f} s, truth {end - middle:.0f} s", flush=True)


def score(name: str, given: Path | pd.DataFrame) -> CoverageScore:
    """Return the score of a coverage table, its file, or a vehicles folder, on a scene."""
    site = scene(name)
    if isinstance(given, Path):
        folder = given.is_dir()
        given = coverage_of_folder(given, site.tiles()) if folder else pd.read_parquet(given)
    return score_coverage(site.truth(), given)


def vehicles_score(name: str, folder: Path) -> dict[str, Any]:
    """Return the figures of a vehicles folder: vehicles, and passages where they are there."""
    site = scene(name)
    given = estimated_states(folder)
    poses, traffic = site.poses, site.traffic()
    figures = score_tracks(
        compared(site.tiles(), site.truth(), poses, traffic, given), traffic.kinds
    )
    if (folder / "passages.parquet").exists():
        passed = pd.read_parquet(folder / "passages.parquet")
        passed = passed[passed["lanelet_id"].isin(site.lanelets_in_sight())]
        figures |= score_passages(site.passages(), passed)
    return figures


def print_vehicles(rows: dict[str, dict[str, Any]]) -> None:
    """Print figures of vehicles as a Markdown table, and what they come from."""
    print(f"\n| what | {' | '.join(VEHICLES)} |\n{'|---' * (1 + len(VEHICLES))}|")
    for name, row in rows.items():
        shown = [format(row.get(key, float("nan")), form) for key, form in VEHICLES.items()]
        print(f"| {name} | {' | '.join(shown)} |")
    heads = list(next(iter(rows.values()))["by"])
    print(f"\n| what | {' | '.join(heads)} |\n{'|---' * (1 + len(heads))}|")
    for name, row in rows.items():
        print(f"| {name} | {' | '.join(format(v, '.0%') for v in row['by'].values())} |")


def print_rows(rows: dict[str, CoverageScore], *, head: bool = True) -> None:
    """Print scores as rows of a Markdown table."""
    if head:
        print(f"| what | {' | '.join(HEADS)} |\n{'|---' * (1 + len(HEADS))}|")
    for name, row in rows.items():
        figures = [format(getattr(row, key), form) for key, form in HEADS.items()]
        print(f"| {name} | {' | '.join(figures)} |", flush=True)
