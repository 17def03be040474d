"""What vehicles cover and hide, and which lanelets they pass, as finished states come."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import geopandas as gpd
import pandas as pd

from gis_radar.arrays import Floats, Integers
from gis_radar.vehicles.coverage_settings import DEFAULTS, CoverageSettings
from gis_radar.vehicles.tables import COVERED, PASSAGES, VISIBLE


@dataclass(frozen=True, kw_only=True)
class SensorView:
    """Where a sensor stood, and the tiles that it had in sight from there.

    Parameters
    ----------
    sensor, view : str
        Names, as in the table of frames.
    tile_id : (n,) int64 array
        The tiles in sight.
    position : (3,) array
        Easting, northing, height in the map, metres.
    """

    sensor: str
    view: str
    tile_id: Integers
    position: Floats


class CoverageEngine:
    """Runs of covered and visible tiles, and passages, from states that come in ascending time.

    Parameters
    ----------
    tiles : GeoDataFrame
        All tiles.
    views : sequence of SensorView
        Of all sensors.
    settings : CoverageSettings
        Of footprints and visibility.
    """

    def __init__(
        self,
        tiles: gpd.GeoDataFrame,
        views: Sequence[SensorView],
        settings: CoverageSettings = DEFAULTS,
    ) -> None:
        self._tiles, self._views, self._settings = tiles, views, settings

    def advance(
        self,
        states: pd.DataFrame,
        vehicles: pd.DataFrame,
        held: pd.DataFrame,
        span: tuple[int, int],
    ) -> pd.DataFrame:
        """Go on from the first step of a span to the step before its end; return the passages.

        Parameters
        ----------
        states : DataFrame
            Rows of `tracks` in the span.
        vehicles : DataFrame
            The vehicles that they are of.
        held : DataFrame
            `sensor, view, first_step, last_step`: runs of steps that frames cover.
        span : (int, int)
            First step, and the step after the last; of one block of runs.
        """
        del states, vehicles, held, span
        return PASSAGES.empty()

    def flush(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Return the runs of covered and of visible tiles since the last time, by tile and step."""
        return COVERED.empty(), VISIBLE.empty()
