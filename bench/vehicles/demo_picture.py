"""Picture of the demo's true and estimated occupancy and their difference, with the errors.

    gis-radar demo -o demo
    python bench/vehicles/demo_picture.py demo docs/occupancy.png --into docs/limits.md

With `--into`, the errors are put below the picture in a page, between its marks.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from found import estimated_occupancy
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scenes import SceneFiles
from score import OccupancyScore, score_occupancy, with_occupancy

import gis_radar as gr
from gis_radar.base import Floats
from gis_radar.hdmap import quads
from gis_radar.products import BREAKS, NEVER_HIT, NOT_OBSERVED
from gis_radar.products.heatmap.style import RAMP, legend

sys.path.append(str(Path(__file__).parents[1]))  # what all benches share
import pages

# Light is less, dark is more: so that its two ends differ in grey, too.
LESS_TO_MORE = LinearSegmentedColormap.from_list("off", ["#bfe0ff", "#a4a8ac", "#7a0c1f"])
OFF_POINTS = 25.0  # percentage points at which the colours of errors end
AROUND = (690_335.0, 690_505.0, 5_336_110.0, 5_336_262.0)  # west, east, south, north of the maps
WIDTH_PX = 1600


def main() -> None:
    """Draw, print, and put the figures into a page."""
    options = pages.picture_options(__doc__)
    with tempfile.TemporaryDirectory() as kept:
        site = SceneFiles(name="sample", folder=gr.sample_folder(), kept=Path(kept))
        truth = site.truth()
        tiles = site.tiles()
        table = estimated_occupancy(gr.open_dataset(options.demo / "dataset"))
        text = caption(score_occupancy(truth, table))
        corners = pd.Series(list(quads(tiles)), index=tiles["tile_id"])
    true = truth.table().set_index("tile_id")["occupancy"].dropna()
    given = with_occupancy(table).set_index("tile_id")["occupancy"].dropna()
    figure = draw(corners, true, given[given.index.isin(true.index)])
    figure.savefig(options.picture, dpi=WIDTH_PX / figure.get_figwidth())
    print(text)
    if options.into is not None:
        pages.put(options.into, {"demo occupancy": text})


def caption(score: OccupancyScore) -> str:
    """Return the errors of the occupancy as a caption."""
    return (
        f"*Over {score.tiles:,} tiles in sight and 100 s: rank correlation {score.rank:.2f}, "
        f"sum of the estimates\nover the sum of the truth {score.scale:.2f}, mean error "
        f"{score.mae_percent:.1f} percentage points where the true mean is\n"
        f"{100 * score.true_mean:.1f} %; {100 * score.within_2_se:.0f} % of the tiles are within "
        "two of their standard errors.*"
    )


def draw(corners: pd.Series, true: pd.Series, given: pd.Series) -> Figure:
    """Return the three maps, of tiles by their number."""
    figure = Figure(figsize=(16, 5.0), layout="constrained")
    axes = figure.subplots(1, 3)
    shares = (ListedColormap([NEVER_HIT, *RAMP]), BoundaryNorm([-1.0, *BREAKS[:-1], 1.001], 9))
    for ax, values, title in zip(
        axes, (true, given), ("true occupancy", "estimated by the demo"), strict=False
    ):
        # A value on a break belongs to the class below it; 0 is a class of its own.
        below = pd.Series(np.nextafter(values, -1.0), index=values.index)
        _add(ax, corners, below, cmap=shares[0], norm=shares[1])
        ax.set_title(title)
    classes = legend("hit_share")[:-2]
    handles = [Patch(facecolor=colour, label=label) for colour, label in classes]
    handles.append(Patch(facecolor=NEVER_HIT, label="0 %, no vehicle"))
    handles.append(Patch(facecolor=NOT_OBSERVED, label="not in sight"))
    axes[0].legend(handles=handles, loc="lower right", fontsize="small", frameon=False)
    off = 100.0 * (given - true).dropna()
    drawn = _add(axes[2], corners, off, cmap=LESS_TO_MORE, clim=(-OFF_POINTS, OFF_POINTS))
    axes[2].set_title("estimated less true, percentage points")
    figure.colorbar(drawn, ax=axes[2], shrink=0.7, extend="both", format="%+d")
    return figure


def _add(ax: Axes, corners: pd.Series, values: pd.Series, **colours: Any) -> PolyCollection:
    """Draw tiles by value over the road."""
    order = values.abs().sort_values().index  # the largest on top where tiles overlap
    ground: list[Floats] = list(corners)
    ax.add_collection(PolyCollection(ground, facecolor=NOT_OBSERVED, edgecolor="none"))
    drawn = PolyCollection(list(corners.loc[order]), array=values.loc[order].to_numpy(), **colours)
    drawn.set(edgecolor="face", linewidth=0.2)
    ax.add_collection(drawn)
    west, east, south, north = AROUND
    ax.set(xlim=(west, east), ylim=(south, north), aspect="equal", xticks=[], yticks=[])
    return drawn


if __name__ == "__main__":
    main()
