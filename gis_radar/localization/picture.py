"""What a picture of a localization is drawn of: scanned road, lanes, traces."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from gis_radar.arrays import Floats
from gis_radar.lanelets import LaneletMap

MARGIN_M = 12.0
ROAD_POINTS = 60_000
ARROW_EVERY_M = 12.0
ROAD, LANE, AWAY, NEAR, PLAIN = ("#c9c5bd", "#6f7780", "#c2410c", "#1d4ed8", "#7c3aed")

Extent = tuple[Floats, Floats]  # south-west and north-east, metres


def trace_extent(traces: Floats, place: Floats) -> Extent:
    """Return what a picture shows: nearly all traces and the sensor, with a margin."""
    low = np.minimum(np.percentile(traces[:, :2], 0.5, axis=0), place) - MARGIN_M
    high = np.maximum(np.percentile(traces[:, :2], 99.5, axis=0), place) + MARGIN_M
    return low, high


def draw_road(ax: Axes, road: Floats, extent: Extent) -> None:
    """Draw the points of the scanned road within an extent."""
    low, high = extent
    inside = road[((road[:, :2] > low) & (road[:, :2] < high)).all(axis=1)]
    shown = inside[:: max(len(inside) // ROAD_POINTS, 1)]
    ax.scatter(shown[:, 0], shown[:, 1], s=0.6, color=ROAD, linewidths=0, label="scanned road")


def draw_lanes(ax: Axes, roads: LaneletMap, extent: Extent) -> None:
    """Draw the bounds of the lanes within an extent, with arrows where they are one-way."""
    low, high = extent
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


def draw_traces(ax: Axes, traces: Floats, rate: Floats) -> None:
    """Draw traces by whether they recede."""
    kinds = (
        (rate > 0.0, AWAY, "recedes"),
        (rate < 0.0, NEAR, "comes near"),
        (np.isnan(rate), PLAIN, "moves"),
    )
    for which, colour, label in kinds:
        if which.any():
            x, y = traces[which, :2].T
            ax.scatter(x, y, s=1.5, color=colour, linewidths=0, label=label)
