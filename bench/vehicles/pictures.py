"""Pictures: true occupancy, an estimate beside it, and what it is off by; frames of a queue."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scenes import SceneFiles
from score import with_occupancy
from true_occupancy import TrueOccupancy

import gis_radar as gr
from gis_radar.arrays import Floats

mpl.use("Agg")
OFF = 0.1  # occupancy at which the colours of errors end


def draw_occupancy(
    site: SceneFiles, truth: TrueOccupancy, table: pd.DataFrame, path: Path, *, title: str
) -> None:
    """Draw true and estimated occupancy of a scene, and the difference.

    Parameters
    ----------
    site : SceneFiles
        The scene.
    truth : TrueOccupancy
        Its truth.
    table : DataFrame
        The estimate, as `score_occupancy` takes it.
    path : Path
        The PNG.
    title : str
        What made the estimate.
    """
    tiles = site.tiles()
    quads = pd.Series(list(gr.quads(tiles)), index=tiles["tile_id"])
    true = truth.table().set_index("tile_id")["occupancy"].dropna()
    given = with_occupancy(table).set_index("tile_id")["occupancy"].dropna()
    shown = given[given.index.isin(true.index)]
    off = (given - true).dropna()
    most = max(float(np.quantile(true, 0.98)), 0.02)
    figure = Figure(figsize=(18, 6.5), layout="constrained")
    parts = (
        (true, f"{site.name}: true occupancy", "viridis", (0.0, most)),
        (shown, f"estimated: {title}", "viridis", (0.0, most)),
        (off, "estimated - true", "RdBu_r", (-OFF, OFF)),
    )
    everything = np.concatenate(list(quads.loc[true.index]))
    for ax, (values, name, colours, limits) in zip(figure.subplots(1, 3), parts, strict=True):
        _roads(ax, np.stack(list(quads)))
        drawn = PolyCollection(
            list(quads.loc[values.index]), array=values.to_numpy(), cmap=colours, clim=limits
        )
        ax.add_collection(drawn)
        _masts(ax, site)
        ax.set_title(name)
        _frame(ax, everything)
        figure.colorbar(drawn, ax=ax, shrink=0.7, format=lambda x, _: f"{x:.0%}")
    figure.savefig(path, dpi=90)


def _roads(ax: Axes, quads: Floats) -> None:
    ax.add_collection(PolyCollection(list(quads), facecolor="0.88", edgecolor="none"))


def _masts(ax: Axes, site: SceneFiles) -> None:
    for pose in site.poses:
        turn = np.radians(pose.yaw)
        ax.plot(pose.easting, pose.northing, "r^", markersize=8)
        ax.annotate(
            "", (pose.easting + 25 * np.cos(turn), pose.northing + 25 * np.sin(turn)),
            (pose.easting, pose.northing), arrowprops={"arrowstyle": "->", "color": "red"},
        )  # fmt: skip


def _frame(ax: Axes, points: Floats) -> None:
    low, high = points.min(axis=0) - 15.0, points.max(axis=0) + 15.0
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
