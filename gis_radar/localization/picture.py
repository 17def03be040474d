"""A localization as a picture: traces over lanes and scanned road, the sensor and its error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PatchCollection, PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, PathPatch
from matplotlib.path import Path as Outline

from gis_radar.arrays import Floats
from gis_radar.lanelets import LaneletMap
from gis_radar.localization.answer import Localization
from gis_radar.outputs import whole_file
from gis_radar.surroundings import SecondLook, draw_surroundings

DPI = 160
SIZE_IN = (9.0, 9.0)
MARGIN_M = 12.0
ROAD_POINTS = 60_000
ARROW_EVERY_M = 12.0
ROAD, LANE, AWAY, NEAR, PLAIN, SENSOR = (
    "#c9c5bd", "#6f7780", "#c2410c", "#1d4ed8", "#7c3aed", "#111827",
)  # fmt: skip
SETTINGS: dict[Any, Any] = {"font.family": ["DejaVu Sans"], "text.usetex": False, "font.size": 8}


def draw_localization(
    found: Localization,
    roads: LaneletMap,
    road_points: Floats,
    path: str | Path,
    *,
    look: SecondLook | None = None,
) -> None:
    """Draw the traces at the found pose over lanes and scanned road (PNG).

    Parameters
    ----------
    found : Localization
        The answer.
    roads : LaneletMap
        The lanes, in the answer's CRS.
    road_points : (n, 3) array
        The scanned road.
    path : str or Path
        The picture; appears whole or not at all.
    look : SecondLook, optional
        Drawn beside it: what stands, over canopy, roofs and walls.
    """
    with mpl.rc_context(SETTINGS):
        width, height = SIZE_IN
        panels = 1 if look is None else 2
        figure = Figure(figsize=(panels * width, height), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        ax = figure.add_subplot(1, panels, 1)
        if look is not None:
            draw_surroundings(figure.add_subplot(1, panels, 2), look)
        traces = found.pose.to_map(found.traces)
        place = found.pose.position[:2]
        low = np.minimum(np.percentile(traces[:, :2], 0.5, axis=0), place) - MARGIN_M
        high = np.maximum(np.percentile(traces[:, :2], 99.5, axis=0), place) + MARGIN_M
        _draw_road(ax, road_points, low, high)
        _draw_lanes(ax, roads, low, high)
        _draw_traces(ax, traces, found.range_rate)
        _draw_sensor(ax, found, float((high - low).max()))
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        ax.ticklabel_format(useOffset=False, style="plain")
        ax.set(xlabel="easting, m", ylabel="northing, m", title=_title(found))
        legend = ax.legend(loc="best", framealpha=0.9)
        for handle in legend.legend_handles:
            if isinstance(handle, PathCollection):
                handle.set_sizes([18.0])
        with whole_file(Path(path)) as part:
            figure.savefig(part, format="png")


def _title(found: Localization) -> str:
    sigma = found.pose.evidence.get("sigma")
    said = [f"{found.pose.sensor}: {found.fitness:.0%} of the traces fit"]
    if sigma:
        across = float(np.hypot(sigma["easting"], sigma["northing"]))
        said.append(f"position \u00b1 {across:.2f} m, yaw \u00b1 {sigma['yaw']:.2f} deg")
    if not found.observable:
        said.append("the scene does not fix all of the pose")
    return "; ".join(said)


def _draw_road(ax: Axes, road: Floats, low: Floats, high: Floats) -> None:
    inside = road[((road[:, :2] > low) & (road[:, :2] < high)).all(axis=1)]
    shown = inside[:: max(len(inside) // ROAD_POINTS, 1)]
    ax.scatter(shown[:, 0], shown[:, 1], s=0.6, color=ROAD, linewidths=0, label="scanned road")


def _draw_lanes(ax: Axes, roads: LaneletMap, low: Floats, high: Floats) -> None:
    near = roads.lanelets.cx[low[0] : high[0], low[1] : high[1]]
    bounds = [np.asarray(line.coords)[:, :2] for side in ("left", "right") for line in near[side]]
    ax.add_collection(LineCollection(bounds, colors=LANE, linewidths=0.5))
    centres = near.loc[near["one_way"].to_numpy(bool), "centre"]
    for line in centres:
        for at in np.arange(ARROW_EVERY_M / 2, line.length, ARROW_EVERY_M):
            here, ahead = line.interpolate(at), line.interpolate(min(at + 2.0, line.length))
            ax.annotate(
                "",
                (ahead.x, ahead.y),
                (here.x, here.y),
                arrowprops={"arrowstyle": "->", "color": LANE, "linewidth": 0.5},
                annotation_clip=True,
            )


def _draw_traces(ax: Axes, traces: Floats, rate: Floats) -> None:
    kinds = (
        (rate > 0.0, AWAY, "recedes"),
        (rate < 0.0, NEAR, "comes near"),
        (np.isnan(rate), PLAIN, "moves"),
    )
    for which, colour, label in kinds:
        if which.any():
            x, y = traces[which, :2].T
            ax.scatter(x, y, s=1.5, color=colour, linewidths=0, label=label)


def _draw_sensor(ax: Axes, found: Localization, span_m: float) -> None:
    """Draw the sensor, where it looks, and twice its standard deviation."""
    east, north = found.pose.position[:2]
    ahead = found.pose.R_map_sensor[:2, 0] * span_m / 12.0
    arrow = Outline([(east, north), (east + ahead[0], north + ahead[1])])
    ax.add_patch(PathPatch(arrow, color=SENSOR, linewidth=1.5, fill=False))
    ax.scatter([east], [north], s=30, color=SENSOR, marker="^", label="sensor", zorder=5)
    covariance = found.pose.evidence.get("covariance")
    if covariance is not None:
        values, vectors = np.linalg.eigh(np.asarray(covariance)[:2, :2])
        turn = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        minor, major = 4.0 * np.sqrt(values)
        ellipse = Ellipse((east, north), major, minor, angle=turn)
        ax.add_collection(
            PatchCollection([ellipse], facecolor="none", edgecolor=SENSOR, linewidths=1.0)
        )
