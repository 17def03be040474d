"""A localization as a picture: traces over lanes and scanned road, the sensor and its error."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gis_radar.arrays import Floats
from gis_radar.files import whole_file
from gis_radar.lanelets import LaneletMap
from gis_radar.localization.result import Localization
from gis_radar.second_look import SecondLook
from gis_radar.second_look.picture import draw_surroundings

DPI = 216
SIZE_IN = (6.6, 6.6)
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
        found.plot(roads, road_points, ax=figure.add_subplot(1, panels, 1))
        if look is not None:
            draw_surroundings(figure.add_subplot(1, panels, 2), look)
        with whole_file(Path(path)) as part:
            # axes true to scale outgrow a constrained layout: nothing is cut off
            figure.savefig(part, format="png", bbox_inches="tight")
