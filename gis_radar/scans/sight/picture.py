"""Draw what a sensor sees: the tiles in sight, hidden, and outside its view."""

from __future__ import annotations

from typing import Any

import numpy as np

from gis_radar.base import Floats, tr
from gis_radar.poses import draw_sensor
from gis_radar.scans.sight.sight import HIDDEN, IN_SIGHT, OUT_OF_VIEW, Sight
from gis_radar.scans.sight.tiles import SightTiles

# From the palette of Okabe and Ito; the style of the layer `sight` has the same.
SIGHT_COLOURS = {OUT_OF_VIEW: "#d8dade", HIDDEN: "#753d28", IN_SIGHT: "#56b4e9"}
SIGHT_NAMES = {IN_SIGHT: "in sight", HIDDEN: "hidden", OUT_OF_VIEW: "outside the view"}
_MARGIN_M = 15.0


def draw_sight(ax: Any, sight: Sight, tiles: SightTiles) -> None:
    """Draw what a sensor sees around it.

    Parameters
    ----------
    ax : matplotlib Axes
        In metres of the map.
    sight : Sight
        From :func:`find_sight`.
    tiles : SightTiles
        The tiles that it is of.
    """
    from matplotlib.collections import PolyCollection  # noqa: PLC0415 - slow, only for drawing

    low, high = _extent(sight, tiles)
    near = (tiles.quads.max(axis=1) > low).all(axis=1) & (tiles.quads.min(axis=1) < high).all(
        axis=1
    )
    for state, colour in SIGHT_COLOURS.items():
        rows = near & (sight.state == state)
        if rows.any():
            ax.add_collection(
                PolyCollection(
                    list(tiles.quads[rows]), facecolors=colour, edgecolors=colour, linewidths=0.2,
                    label=tr(SIGHT_NAMES[state]), zorder=state,
                )
            )  # fmt: skip
    ahead = sight.pose.R_map_sensor[:2, 0] * float((high - low).max()) / 12.0
    draw_sensor(ax, sight.pose.position[:2], ahead, None, sight.pose.sensor)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")


def _extent(sight: Sight, tiles: SightTiles) -> tuple[Floats, Floats]:
    """Return both corners (m) around the sensor and the tiles in its view, else all tiles."""
    in_view = sight.state != OUT_OF_VIEW
    shown = tiles.quads[in_view if in_view.any() else slice(None)].reshape(-1, 2)
    places = np.vstack([shown, sight.pose.position[:2]])
    return places.min(axis=0) - _MARGIN_M, places.max(axis=0) + _MARGIN_M
