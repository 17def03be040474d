"""Stated standard errors beside true errors, as a picture and a table.

    python bench/vehicles/error_bars.py --scene town-991,tee-932 docs/error_bars.png

Occupancy of tiles in classes of distance from the nearest radar and of true occupancy, and volumes
of lanes by minute, of scenes with found poses. Each class is sorted by the stated error and divided
into six bins; a point is the root mean square of stated and of true errors in one, and lies on the
diagonal where standard errors are right. With `--into`, the table is put into a page.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import lane_volumes
import numpy as np
import pandas as pd
from found import estimated_occupancy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from own import measured
from scenes import SceneFiles, scene
from targets import beside_truth

import gis_radar as gr

sys.path.append(str(Path(__file__).parents[1]))  # what all benches share
import pages

# Classes by name, with the largest value in each.
RANGES_M = {"up to 40 m": 40.0, "40 to 80 m": 80.0, "80 to 140 m": 140.0, "farther": np.inf}
BUSY = {"up to 5 %": 5.0, "5 to 20 %": 20.0, "over 20 %": np.inf}
VOLUMES = {"none": 0.5, "1 to 5": 5.5, "over 5": np.inf}
PANELS = {
    "range": "occupancy of tiles by range, points",
    "traffic": "occupancy of tiles by true occupancy, points",
    "lanes": "volumes of lanes by minute by true volume, vehicles",
}
BINS, LEAST_ROWS = 6, 60  # of a class; smaller classes are not drawn
LEAST_DRAWN = 0.05  # smaller values are drawn here: the axes are logarithmic
COLORS = ("#1f4e79", "#3f8f8f", "#c98a1b", "#b5482a")  # differ in grey, too
MARKS = "os^D"  # markers of the classes
WIDTH_PX = 1600


def main() -> None:
    """Measure, draw, print the table, and put it into a page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", required=True)
    parser.add_argument("picture", type=Path, metavar="PNG")
    parser.add_argument("--into", type=Path, metavar="MD")
    options = parser.parse_args()
    rows = pd.concat([each for name in options.scene.split(",") for each in errors(scene(name))])
    figure = draw(rows)
    figure.savefig(options.picture, dpi=WIDTH_PX / figure.get_figwidth())
    text = table(rows)
    print(text)
    if options.into is not None:
        pages.put(options.into, {"error bars": text})


def errors(site: SceneFiles) -> Iterator[pd.DataFrame]:
    """Yield a table `panel kind stated error` a panel, of a scene measured with found poses."""
    with tempfile.TemporaryDirectory() as folder:
        dataset = measured(site, Path(folder) / "dataset", found=True)
        tiles, lanes = of_tiles(site, dataset), of_lanes(site, dataset)
    yield tiles.assign(panel="range", kind=classed(tiles["away"], RANGES_M))
    yield tiles.assign(panel="traffic", kind=classed(tiles["true"], BUSY))
    yield lanes.assign(panel="lanes", kind=classed(lanes["true"], VOLUMES))


def classed(values: pd.Series, uppers: dict[str, float]) -> pd.Series:
    """Return the name of the class of each value; `uppers` are their largest values."""
    return pd.cut(values, [-np.inf, *uppers.values()], labels=list(uppers)).astype(str)


def of_tiles(site: SceneFiles, dataset: gr.Dataset) -> pd.DataFrame:
    """Return `stated error true`, percentage points, and `away`, metres, of the visible tiles."""
    both = beside_truth(site, estimated_occupancy(dataset))
    return pd.DataFrame({
        "stated": 100.0 * both["occupancy_se"],
        "error": 100.0 * (both["occupancy_given"] - both["occupancy"]),
        "true": 100.0 * both["occupancy"], "away": both["away_m"],
    }).dropna()  # fmt: skip


def of_lanes(site: SceneFiles, dataset: gr.Dataset) -> pd.DataFrame:
    """Return `stated error true`, vehicles, of lanes near radars by minute, where visible."""
    network = lane_volumes.network_of(dataset)
    near = network.lane[lane_volumes.lanes_near_radars(site, network)]
    rows = lane_volumes.minutes(dataset, near, lane_volumes.true_crossings(site, network))
    rows = rows[rows["visible_share"] > lane_volumes.WHOLE_SHARE]
    return pd.DataFrame(
        {"stated": rows["volume_se"], "error": rows["volume"] - rows["true"], "true": rows["true"]}
    ).dropna()


def table(rows: pd.DataFrame) -> str:
    """Return the table of classes."""
    lines = ["| | values | stated | error | within two | too high, mean |"]
    lines.append("|---|---|---|---|---|---|")
    for (panel, kind), part in in_order(rows):
        within = part["error"].abs() <= 2.0 * part["stated"] + 1e-9
        lines.append(
            f"| {PANELS[panel]}: {kind} | {len(part):,} | {_rms(part['stated']):.1f} "
            f"| {_rms(part['error']):.1f} | {within.mean():.0%} | {part['error'].mean():+.2f} |"
        )
    return "\n".join(lines)


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def in_order(rows: pd.DataFrame) -> Iterator[tuple[tuple[str, str], pd.DataFrame]]:
    """Yield the rows of each class that has any, after the names of its panel and class."""
    for panel, kinds in zip(PANELS, (RANGES_M, BUSY, VOLUMES), strict=True):
        for kind in kinds:
            part = rows[(rows["panel"] == panel) & (rows["kind"] == kind)]
            if len(part):
                yield (panel, kind), part


def draw(rows: pd.DataFrame) -> Figure:
    """Draw the panels: stated errors on the x axis, true ones on the y axis."""
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    axes = dict(zip(PANELS, figure.subplots(1, len(PANELS)), strict=True))
    for (panel, kind), part in in_order(rows):
        _draw_class(axes[panel], kind, part)
    for panel, each in axes.items():
        low, high = np.array([each.get_xlim(), each.get_ylim()]).T
        ends = np.array([min(low), max(high)])
        each.plot(ends, ends, color="#666666", linewidth=1.0)
        each.plot(ends, 2.0 * ends, color="#bbbbbb", linewidth=1.0, linestyle="--")
        each.set(xscale="log", yscale="log", xlabel="stated standard error", xlim=ends, ylim=ends)
        each.set_title(PANELS[panel], fontsize="small")
        each.grid(color="#eeeeee")
        each.legend(frameon=False, fontsize="small", loc="upper left")
    axes["range"].set_ylabel("true error")
    return figure


def _draw_class(axes: Axes, kind: str, part: pd.DataFrame) -> None:
    """Draw the errors of a class by bins of the stated error."""
    if len(part) < LEAST_ROWS:
        return
    rank = np.argsort(np.argsort(part["stated"].to_numpy(), kind="stable"), kind="stable")
    points = part.groupby(rank * BINS // len(part))[["stated", "error"]].agg(_rms)
    points = points.clip(lower=LEAST_DRAWN)
    number = len(axes.lines)
    axes.plot(
        points["stated"], points["error"], color=COLORS[number],
        marker=MARKS[number], markersize=5, linewidth=1.5, label=kind,
    )  # fmt: skip


if __name__ == "__main__":
    main()
