"""Cutting the lanelets of a map into slices, and saying where a length does not suit them."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from gis_radar.arrays import Floats
from gis_radar.errors import InputError
from gis_radar.lanelets.bounds import CannotMendError, slices, sound_rungs
from gis_radar.lanelets.mending import outline
from gis_radar.progress import Reporter

AREA_TOLERANCE = 0.005  # of a lanelet, from which corners that tiles cut are reported
STAGE = "splitting lanelets"


def cut(lanelets: gpd.GeoDataFrame, length_m: float, reporter: Reporter) -> list[Floats]:
    """Return the rungs of each lanelet, between which its slices are.

    Parameters
    ----------
    lanelets : GeoDataFrame
        As in :class:`gis_radar.lanelets.LaneletMap`.
    length_m : float
        Length of a slice, metres. A lanelet whose slices would cross themselves gets shorter ones.
    reporter : Reporter
        Receives progress, how many lanelets got shorter slices, and how much area long slices
        of curves miss.

    Returns
    -------
    list of (n + 1, 2, 3) array
        The ends of the rungs, left and right.

    Raises
    ------
    InputError
        If no number of slices suits a lanelet.
    """
    pieces = []
    finer = 0
    rows = zip(lanelets["lanelet_id"], lanelets["left"], lanelets["right"], strict=True)
    for done, (ref, left, right) in enumerate(rows):
        bounds = _coordinates(left), _coordinates(right)
        try:
            pieces.append(np.stack(sound_rungs(*bounds, length_m), axis=1))
        except CannotMendError as error:
            raise InputError(f"lanelet {ref}: {error}") from error
        finer += len(pieces[-1]) - 1 != slices(*bounds, length_m)
        if done % 100 == 0:
            reporter.progress(STAGE, done, len(lanelets))
    reporter.progress(STAGE, len(lanelets), len(lanelets))
    if finer:
        asked = f"{_counted(finer)} cut into more tiles than {length_m:g} m asks for"
        reporter.log(f"{asked}: longer ones would cross themselves", "warning")
    _say_losses(lanelets, pieces, reporter)
    return pieces


def corners_between(piece: Floats) -> Floats:
    """Return the slices between rungs: (n, 4, 3), counter-clockwise from the right at the start."""
    return np.stack([piece[:-1, 1], piece[1:, 1], piece[1:, 0], piece[:-1, 0]], axis=1)


def _coordinates(line: shapely.LineString) -> Floats:
    return shapely.get_coordinates(line, include_z=True)


def _say_losses(lanelets: gpd.GeoDataFrame, pieces: list[Floats], reporter: Reporter) -> None:
    shapes = lanelets.geometry.array
    tiled = np.array([_covered(piece) for piece in pieces])
    off = shapely.area(shapely.symmetric_difference(shapes, tiled)) / shapely.area(shapes)
    bad = int(np.count_nonzero(off > AREA_TOLERANCE))
    if not bad:
        return
    worst = f"lanelet {lanelets['lanelet_id'].iloc[off.argmax()]} by {100.0 * off.max():.1f} %"
    reporter.log(
        f"tiles cut corners: {bad} of {_counted(len(pieces))} are off by more than "
        f"{100.0 * AREA_TOLERANCE:g} % of their area, {worst}; "
        "a shorter --length follows curves better",
        "warning",
    )


def _covered(piece: Floats) -> BaseGeometry:
    shape = outline(piece[:, 0], piece[:, 1])
    if shape.is_valid:
        return shape
    rings = corners_between(piece)[:, [0, 1, 2, 3, 0], :2]
    return shapely.union_all(shapely.polygons(rings))


def _counted(count: int) -> str:
    return f"{count} lanelet{'s'[: count > 1]}"
