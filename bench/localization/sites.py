"""Other sites: the sample junction, and those that lie beside the project; no heading given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from places import OUT
from simulated import sites, true_pose
from table import HEADS, figures, row
from trials import Result, Trial, spread

import gis_radar as gr
from gis_radar.poses.files import write_pose

STARTS, QUICK_STARTS = 10, 2


def plan(*, quick: bool) -> list[Trial]:
    """Return trials at each sensor of each site; the road comes from the site's own scan."""
    trials = []
    for site in sites():
        folder = site_folder(site)
        names = sorted(path.stem for path in folder.glob("R*.parquet"))
        trials += spread(
            folder, names, f"site {site.name}", method="lane", seed=17, heading_deg=None,
            count=QUICK_STARTS if quick else STARTS,
        )  # fmt: skip
    return trials


def site_folder(site: Path) -> Path:
    """Return a folder with a site's map, road, recordings and true poses as trials want them."""
    folder = OUT / "sites" / site.name
    folder.mkdir(parents=True, exist_ok=True)
    osm, scan = next(site.glob("*.osm")), next(site.glob("*.laz"))
    _link(osm, folder / "map.osm")
    if not (folder / "road.npy").exists():
        mask = gr.mask_road([scan], gr.read_roads(osm), engine="laspy")
        np.save(folder / "road.npy", mask.points)
    for recording in site.glob("R*.parquet"):
        _link(recording, folder / recording.name)
        write_pose(true_pose(site, recording.stem), folder / f"{recording.stem}.json")
    return folder


def _link(source: Path, target: Path) -> None:
    target.unlink(missing_ok=True)
    target.symlink_to(source.resolve())


def report(results: Sequence[Result]) -> dict[str, Any]:
    """Return figures by site."""
    groups = sorted({r.trial.group for r in results})
    return {
        group.removeprefix("site "): figures([r for r in results if r.trial.group == group])
        for group in groups
    }


def markdown(made: dict[str, Any]) -> str:
    """Return a row a site."""
    lines = [f"| site | starts | method | {' | '.join(HEADS)} |", "|---" * (3 + len(HEADS)) + "|"]
    return "\n".join([*lines, *(row(name, "any", "lane", f) for name, f in made.items())])
