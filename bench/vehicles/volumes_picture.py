"""Picture of the demo's volumes of lanelets beside the true ones.

    gis-radar demo -o demo
    python bench/vehicles/volumes_picture.py demo docs/volumes.png --into README.md

Counted are passages of lanelets whose middles are truly in sight and near a radar. With `--into`,
the figures are put below the picture in a page, between its marks.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
from found import found_in
from lane_volumes import WITHIN_M
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scenes import SceneFiles

import gis_radar as gr

sys.path.append(str(Path(__file__).parents[1]))  # what all benches share
import pages

WIDTH_PX = 1600
TRUE, FOUND = "#b5482a", "#1f4e79"  # differ in grey and for the colour-blind


def main() -> None:
    """Draw, print, and put the figures into a page."""
    options = pages.picture_options(__doc__)
    with tempfile.TemporaryDirectory() as kept:
        site = SceneFiles(name="sample", folder=gr.sample_folder(), kept=Path(kept))
        counts = volumes(site, found_in(gr.open_dataset(options.demo / "dataset")).passages)
    figure = draw(counts)
    figure.savefig(options.picture, dpi=WIDTH_PX / figure.get_figwidth())
    text = caption(counts)
    print(text)
    if options.into is not None:
        pages.put(options.into, {"demo volumes": text})


def volumes(site: SceneFiles, given: pd.DataFrame) -> pd.DataFrame:
    """Return `true` and `found` passages of each lanelet in sight and near, the busiest first."""
    tiles = site.tiles().set_index("lanelet_id")
    middles = tiles.geometry[tiles.index.isin(site.lanelets_in_sight())].groupby(level=0).agg(
        lambda each: shapely.MultiPolygon([*each]).centroid
    )  # fmt: skip
    eyes = shapely.MultiPoint([pose.position[:2] for pose in site.poses])
    near = middles.index[[eyes.distance(each) < WITHIN_M for each in middles]]
    counts = pd.DataFrame(
        {"true": site.passages()["lanelet_id"].value_counts(),
         "found": given["lanelet_id"].value_counts()}
    )  # fmt: skip
    counts = counts.reindex(near).fillna(0).astype(np.int64)
    return counts[counts.sum(axis=1) > 0].sort_values(["true", "found"], ascending=False)


def caption(counts: pd.DataFrame) -> str:
    """Return the figures of the picture as a caption."""
    off, true = (counts["found"] - counts["true"]), int(counts["true"].sum())
    return (
        f"*Volumes of the sample's {len(counts)} lanelets in sight within {WITHIN_M:.0f} m of a "
        f"radar, in 100 s:\n{int(counts['found'].sum())} passages found where {true} are true, "
        f"{100 * float(off.abs().sum()) / true:.1f} % off lanelet by lanelet. A ring is the "
        "truth,\na point what the demo found.*"
    )


def draw(counts: pd.DataFrame) -> Figure:
    """Draw both counts of each lanelet."""
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(counts))
    axes.vlines(place, counts["true"], counts["found"], color=FOUND, linewidth=2.0)
    axes.scatter(
        place, counts["true"], s=110, facecolor="none", edgecolor=TRUE, linewidth=2.0, label="true"
    )
    axes.scatter(place, counts["found"], s=28, color=FOUND, label="found by gis_radar")
    axes.set(
        xlabel="lanelet, the busiest first", ylabel="passages in 100 s", xlim=(-1, len(counts)),
        ylim=(0, None),
    )  # fmt: skip
    axes.set_xticks(place, [str(each) for each in counts.index], rotation=90, fontsize="x-small")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(axis="y", color="#dddddd")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper right")
    return figure


if __name__ == "__main__":
    main()
