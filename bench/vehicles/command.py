"""Errors of vehicles and occupancy beside the true traffic of simulated scenes.

    python bench/vehicles                                        all methods, scenes not held out
    python bench/vehicles --scene town --methods hits,true       some methods on some scenes
    python bench/vehicles --scene town --set start.links.END_COST=0    with changed constants
    python bench/vehicles --scene tee-9881 --off as-is,no-cut     without parts of the tracker
    python bench/vehicles --scene town --score-only dataset/     scores of a dataset, or of a table
    python bench/vehicles --into docs/accuracy.md    writes that page's tables from kept figures

Methods: hits (hit share, as in the paper), soup (Stone Soup), true and found (the package with true
and with found poses), oracle (true footprints between detections on them). From Python, with
bench/vehicles in the path: `score.score_occupancy(scenes.scene("town").truth(), table)`. Figures
are kept in out/bench-vehicles/bench.json. Needs Eclipse SUMO to make scenes.
"""

from __future__ import annotations

import argparse
import ast
import json
import math
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import tables
from ablated import PARTS
from methods import (
    METHODS,
    NotThereError,
    figures_of_dataset,
    figures_of_table,
    with_constants,
    without,
)
from scenes import OUT, RECIPES, SHARED, is_there, scene

sys.path.append(str(Path(__file__).parents[1]))  # what all benches share
import figures
import pages

HELD_OUT = "-held"
KEPT = OUT / "bench.json"


def main() -> None:
    """Score the scenes as the options say; print tables, keep the figures of methods."""
    options = _options()
    if options.into:
        pages.put(options.into, {"vehicles": tables.accuracy_tables(kept())})
        return
    changes = dict(each.split("=", 1) for each in options.set)
    for name in filter(is_there, options.scene.split(",")):
        if options.score_only:
            rows = {options.score_only.name: score(name, options.score_only)}
        elif changes:
            values = {place: ast.literal_eval(value) for place, value in changes.items()}
            rows = {", ".join(options.set): with_constants(scene(name), values)}
        elif options.off:
            rows = {off: without(scene(name), off) for off in options.off.split(",")}
        else:
            rows = compare(name, options.methods.split(","))
        named = {f"{name}, {method}": row for method, row in rows.items()}
        print(tables.everything(named) + "\n", flush=True)


def _options() -> argparse.Namespace:
    names = [*RECIPES, *SHARED]
    usual = [name for name in names if not name.endswith(HELD_OUT)]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scene", default=",".join(usual), help=f"of {', '.join(names)}, or KIND-SEED"
    )
    parser.add_argument("--methods", default=",".join(METHODS), help=f"of {', '.join(METHODS)}")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="constants")
    parser.add_argument("--off", default="", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--score-only", type=Path, metavar="DIR", help="dataset, or table")
    parser.add_argument("--into", type=Path, metavar="MD", help="put the tables into this page")
    options = parser.parse_args()
    scenes = {*SHARED, *filter(is_there, options.scene.split(","))}
    parts = options.off.replace("+", ",")
    if options.set and options.off:
        parser.error("--set and --off: give one of them")
    for given, known in ((options.scene, scenes), (options.methods, METHODS), (parts, PARTS)):
        if unknown := [name for name in given.split(",") if given and name not in known]:
            parser.error(f"{unknown[0]} is not known")
    for name in options.scene.split(","):
        if not is_there(name):
            print(f"left out: {name}: not there")
    return options


def score(name: str, given: Path) -> dict[str, Any]:
    """Return the figures of a dataset (a folder) or of a table of occupancy (Parquet)."""
    if given.is_dir():
        return figures_of_dataset(scene(name), given)
    return figures_of_table(scene(name), pd.read_parquet(given))


def compare(name: str, methods: list[str]) -> dict[str, dict[str, Any]]:
    """Run methods on a scene; keep and return their figures."""
    rows = {}
    for method in methods:
        try:
            rows[method] = METHODS[method](scene(name))
        except NotThereError as error:
            print(f"{name}: {method}: left out: {error}", flush=True)
            continue
        keep(name, method, rows[method])
    return rows


def kept() -> dict[str, Any]:
    """Return the kept figures by scene and method."""
    return dict(json.loads(KEPT.read_text())) if KEPT.exists() else {}


def keep(name: str, method: str, row: dict[str, Any]) -> None:
    """Add the figures of a method on a scene to those kept."""
    report = kept()
    report.setdefault(name, {})[method] = _finite(row)
    KEPT.parent.mkdir(parents=True, exist_ok=True)
    KEPT.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
    figures.keep("vehicles", tables.accepted({name: report[name]}))


def _finite(value: Any) -> Any:
    """Return a record with None in place of NaN and infinity."""
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
