"""Errors of localization: of our method and of the paper's, beside the paper's figures.

    python bench/localization             all, half an hour on two free cores
    python bench/localization --quick     few starts, a few minutes
    python bench/localization --only table,sites
    python bench/localization --only random --conditions "radar as recorded, walkers"
    python bench/localization --into docs/accuracy.md   writes that page's table from kept figures

Parts: table (sets DY and DO of a town, as in Table I), sites (the sample, and towns where they are
there), random (places drawn at random: do covariances cover the errors?). Figures are kept in
out/bench-localization/groups.json; simulated places lie beside it and are made again when the
simulator changes. Needs Eclipse SUMO, and Open3D for the paper's method. Exit code 1 where one of
our answers is wrong and says that it is `observable`.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import random_places
import table
from conditions import CONDITIONS, TEXTBOOK
from places import OUT, link
from town import town_folder
from trials import METHODS, Trial, run_all, spread

sys.path.append(str(Path(__file__).resolve().parents[1]))  # what all benches share
import pages
from figures import keep
from simulated import sites, true_pose

import gis_radar as gr

PARTS = ("table", "sites", "random")
SITE_STARTS, QUICK_STARTS = 10, 2
KEPT = OUT / "groups.json"


def main() -> None:
    """Run the parts, print the table, keep the figures, and judge."""
    options = _options()
    if options.into:
        pages.put(options.into, {"accuracy": table.accuracy_table(_kept())})
        return
    trials = [each for part in options.only for each in _plan(part, options)]
    groups = table.by_group(run_all(trials))
    print(table.markdown(groups))
    kept = _kept()
    kept.setdefault(options.conditions, {}).update(groups)
    KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    keep("localization", table.accepted(groups, options.conditions))
    wrong = {name: f["wrong"] for name, f in groups.items() if name.endswith("lane") and f["wrong"]}
    if wrong:
        shares = ", ".join(f"{share:.0%} of {name}" for name, share in wrong.items())
        sys.exit(f"answers that are wrong and are not marked as such: {shares}")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a few starts")
    parser.add_argument("--only", default=",".join(PARTS), help=f"some of {','.join(PARTS)}")
    parser.add_argument("--starts", type=int, help="a sensor in the table, at most (50)")
    parser.add_argument("--conditions", choices=CONDITIONS, default=TEXTBOOK,
                        help="radar, drivers and people; not for sites")  # fmt: skip
    parser.add_argument("--methods", default=",".join(METHODS), help=f"of {','.join(METHODS)}")
    parser.add_argument("--into", type=Path, help="put kept figures into this page, run nothing")
    options = parser.parse_args()
    for name, known in (("only", PARTS), ("methods", METHODS)):
        given = getattr(options, name).split(",")
        if unknown := set(given) - set(known):
            parser.error(f"--{name}: {', '.join(sorted(unknown))} is none of {', '.join(known)}")
        setattr(options, name, given)
    return options


def _plan(part: str, options: argparse.Namespace) -> list[Trial]:
    """Return the trials of a part of the bench."""
    if part == "table":
        most = options.starts or (QUICK_STARTS if options.quick else table.NEAR_STARTS["lane"])
        return table.plan(town_folder(options.conditions), most=most, methods=options.methods)
    if part == "random":
        count = random_places.QUICK_COUNT if options.quick else random_places.COUNT
        return random_places.plan(count, options.conditions)
    return [trial for site in sites() for trial in _at_site(site, options)]


def _at_site(site: Path, options: argparse.Namespace) -> list[Trial]:
    """Return the trials at each sensor of a site; its road is masked from its scan."""
    folder = OUT / "sites" / site.name
    folder.mkdir(parents=True, exist_ok=True)
    osm, scan = next(site.glob("*.osm")), next(site.glob("*.laz"))
    link(osm, folder / "map.osm")
    if not (folder / "road.npy").exists():
        mask = gr.mask_road([scan], osm, engine="laspy")
        np.save(folder / "road.npy", mask.points)
    names = sorted(path.stem for path in site.glob("R*.parquet"))
    for name in names:
        link(site / f"{name}.parquet", folder / f"{name}.parquet")
        true_pose(site, name).write(folder / f"{name}.json")
    return spread(
        folder, names, f"site {site.name}", method="lane", seed=17,
        count=QUICK_STARTS if options.quick else SITE_STARTS,
    )  # fmt: skip


def _kept() -> dict[str, dict[str, table.Figures]]:
    """Return the kept figures by conditions and group of trials."""
    return dict(json.loads(KEPT.read_text())) if KEPT.exists() else {}


if __name__ == "__main__":
    main()
