"""Vehicles and occupancy, measured against the true traffic of simulated scenes.

    python bench/vehicles --scene town --score-only dataset/    a dataset, or a table
    python bench/vehicles --make town,light                      only make scenes
    python bench/vehicles --scene town --methods hits,true       some methods on some scenes
    python bench/vehicles --ablation                             what each component is worth
    python bench/vehicles --bad-input                            how bad input is treated
    python bench/vehicles --tables                               tables of docs/accuracy.md
    python bench/vehicles                                        all methods, development scenes

From Python, with bench/vehicles in the path: `from scenes import scene`, `from score import
score_occupancy`; `score_occupancy(scene("town").truth(), table)`. A scene has `.map`, `.scan`,
`.recordings`, `.poses` (true ones), `.tiles()`, `.truth()`, `.traffic()`. Figures are collected in
out/bench-vehicles/bench.json, those of components in ablation.json. Needs Eclipse SUMO to make
scenes.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import pandas as pd
import tables
from bad_input import try_all
from components import ablate
from found import estimated_occupancy
from methods import METHODS, SHORT, NotThereError, figures_of_dataset, figures_of_table
from pictures import draw_occupancy
from scenes import OUT, RECIPES, SHARED, is_there, scene

import gis_radar as gr

sys.path.append(str(Path(__file__).parents[1]))  # what all benches share
import pages

HELD_OUT = "-held"
NOT_COMPARED = ("parked", "hours")  # of bad input, and of hours.py
ABLATED = ("town", "light", "harsh", "gridlock", "motorway", "wide", "wide-light")
KEPT, COMPONENTS = OUT / "bench.json", OUT / "ablation.json"


def main() -> None:
    """Make scenes, run what is asked for, print tables, keep figures."""
    options = _options()
    chosen = [name for name in _scenes(options).split(",") if is_there(name)]
    if options.tables:
        print_kept(options.into)
    elif options.make:
        for name in chosen:
            make(name)
    elif options.score_only:
        for name in chosen:
            print(tables.everything({name: score(name, options.score_only)}))
            if options.picture:
                draw(name, options.score_only, options.picture)
    elif options.ablation:
        run_ablation(chosen)
    elif options.bad_input:
        run_bad_input()
    else:
        compare(chosen, [SHORT[name] for name in options.methods.split(",")])


def _options() -> argparse.Namespace:
    names = [*RECIPES, *SHARED]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", help=f"of {', '.join(names)}")
    parser.add_argument("--make", metavar="SCENES", help="only make these")
    parser.add_argument("--score-only", type=Path, metavar="DIR", help="dataset, or table")
    parser.add_argument("--picture", type=Path, metavar="PNG", help="with --score-only: draw it")
    parser.add_argument("--methods", default=",".join(SHORT), help=f"of {', '.join(SHORT)}")
    parser.add_argument("--ablation", action="store_true", help="each component off in turn")
    parser.add_argument("--bad-input", action="store_true", help="scenes that go wrong")
    parser.add_argument("--tables", action="store_true", help="only print what is kept")
    parser.add_argument("--into", type=Path, metavar="MD", help="put them where it has marks")
    options = parser.parse_args()
    for given, known in ((_scenes(options), names), (options.methods, SHORT)):
        if unknown := [name for name in given.split(",") if name not in known]:
            parser.error(f"{unknown[0]} is none of {', '.join(known)}")
    if options.score_only and not options.score_only.exists():
        parser.error(f"{options.score_only} is not there")
    for name in _scenes(options).split(","):
        if not is_there(name):
            print(f"left out: {name}: not there")
    return options


def _scenes(options: argparse.Namespace) -> str:
    """Return the scenes that are asked for: those of development where none is named."""
    names = [*RECIPES, *SHARED]
    development = [n for n in names if not n.endswith(HELD_OUT) and n not in NOT_COMPARED]
    usual = ABLATED if options.ablation else development
    return str(options.make or options.scene or ",".join(usual))


def make(name: str) -> None:
    """Make a scene and its truth, and say how long that took."""
    begin = time.perf_counter()
    made = scene(name)
    middle = time.perf_counter()
    true = made.truth().table()
    share = true["occupancy"].mean()
    end = time.perf_counter()
    about = f"{len(made.recordings)} radars, {len(true)} tiles in sight, mean {share:.1%}"
    print(f"{name}: {about}; {middle - begin:.0f} s, truth {end - middle:.0f} s", flush=True)


def score(name: str, given: Path) -> dict[str, Any]:
    """Return the figures of a dataset, or of a table of occupancy, on a scene."""
    if given.is_dir():
        return figures_of_dataset(scene(name), given)
    return figures_of_table(scene(name), pd.read_parquet(given))


def compare(names: list[str], methods: list[str]) -> None:
    """Run methods on scenes, one after the other."""
    for name in names:
        rows = {}
        for method in methods:
            try:
                rows[method] = METHODS[method](scene(name))
            except NotThereError as error:
                print(f"{name}: {method}: left out: {error}", flush=True)
                continue
            keep("scenes", name, method, rows[method])
        named = {f"{name}, {method}": row for method, row in rows.items()}
        print(tables.everything(named) + "\n", flush=True)


def run_ablation(names: list[str]) -> None:
    """Run the tracker with each component off, print and keep what that costs."""
    for name in names:
        for without, figures in ablate(scene(name)):
            keep("ablation", name, without, figures, COMPONENTS)
            print(f"{name}, without {without}: done", flush=True)
    print(tables.ablation(kept(COMPONENTS)))


def run_bad_input() -> None:
    """Try each bad input, print and keep how it went."""
    for name, row in try_all():
        keep("bad input", name, None, row)
        verdict = "as it should be" if row["good"] else "NOT as it should be"
        print(f"{name}: {verdict}", flush=True)
    print(tables.bad_input(kept()))


def kept(path: Path | None = None) -> dict[str, Any]:
    """Return all figures so far."""
    path = path or KEPT
    return dict(json.loads(path.read_text())) if path.exists() else {}


def keep(
    part: str, name: str, row: str | None, figures: dict[str, Any], path: Path | None = None
) -> None:
    """Add figures to those kept."""
    path = path or KEPT
    report = kept(path)
    place = report.setdefault(part, {})
    if row is None:
        place[name] = figures
    else:
        place.setdefault(name, {})[row] = figures
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(_finite(report), indent=1, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    """Return a record with None for what is no number."""
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_kept(into: Path | None = None) -> None:
    """Print the tables of what is kept; put them into a page, between its marks."""
    report = kept() | kept(COMPONENTS)
    parts = {"vehicles": tables.readme(report)}
    if "ablation" in report:
        parts["components"] = tables.ablation(report)
    if into is not None:
        pages.put(into, {name: parts[name] for name in pages.marked(into, parts)})
    bad = [tables.bad_input(report)] if "bad input" in report else []
    print("\n\n".join([*parts.values(), *bad]))


def draw(name: str, given: Path, path: Path) -> None:
    """Draw an estimate beside the truth."""
    site = scene(name)
    whole = given.is_dir()
    table = estimated_occupancy(gr.open_dataset(given)) if whole else pd.read_parquet(given)
    draw_occupancy(site, site.truth(), table, path, title=given.name)
    print(path)
