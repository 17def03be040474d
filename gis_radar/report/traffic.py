"""The heat map that a report tells of, read from its GeoPackage, interval by interval."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import geopandas as gpd
import numpy as np
import pyogrio
from pyproj import CRS

from gis_radar.arrays import Floats
from gis_radar.crs import metric_crs
from gis_radar.errors import InputError
from gis_radar.heatmap.layers import LONG, WIDE

PACKAGE = "heatmap.gpkg"
COLUMNS = (
    "tile_id", "lanelet_id", "index", "s_m", "length_m", "subtype",
    "occupied_s", "observed_s", "occupancy",
)  # fmt: skip
# From one begin to the next by their index: a look at all rows would take seconds.
_TIMES = f"""
    WITH RECURSIVE times(moment) AS (
        SELECT min("begin") FROM "{LONG}"
        UNION ALL
        SELECT (SELECT min("begin") FROM "{LONG}" WHERE "begin" > moment)
        FROM times WHERE moment IS NOT NULL
    )
    SELECT moment, (SELECT "end" FROM "{LONG}" WHERE "begin" = moment LIMIT 1)
    FROM times WHERE moment IS NOT NULL
"""  # noqa: S608 - our own name
_HINT = "make it again with: gis-radar heatmap"

Span = tuple[datetime, datetime]


class Seconds(NamedTuple):
    """How long tiles were occupied and observed, in the order of the tiles.

    Parameters
    ----------
    occupied, observed : (n,) float64 arrays
        Seconds; both 0 where not observed.
    """

    occupied: Floats
    observed: Floats

    @property
    def occupancy(self) -> Floats:
        """The share, NaN where not observed."""
        known = self.observed > 0
        share = np.full(len(known), np.nan)
        share[known] = self.occupied[known] / self.observed[known]
        return share


@dataclass(frozen=True, kw_only=True, eq=False)
class Traffic:
    """A heat map as its files hold it.

    Parameters
    ----------
    folder : Path
        Of the heat map.
    tiles : GeoDataFrame
        All tiles by ascending `tile_id`, with `COLUMNS` over the whole time.
    crs : CRS
        Theirs.
    fingerprint : str
        Of the tiles; empty where the file does not say.
    whole : (datetime, datetime)
        Begin and end of all data, UTC.
    intervals : sequence of (datetime, datetime)
        Of the heat map, ascending; one where none were asked for.
    """

    folder: Path
    tiles: gpd.GeoDataFrame
    crs: CRS
    fingerprint: str
    whole: Span
    intervals: Sequence[Span]

    @property
    def overall(self) -> Seconds:
        """The seconds of the whole time."""
        observed = self.tiles["observed_s"].fillna(0.0).to_numpy(np.float64)
        return Seconds(self.tiles["occupied_s"].fillna(0.0).to_numpy(np.float64), observed)

    def by_interval(self) -> Iterator[Seconds]:
        """Read the seconds of each interval, one after the other."""
        ids = self.tiles["tile_id"].to_numpy(np.int64)
        occupied, observed = np.zeros(len(ids)), np.zeros(len(ids))
        filled = 0
        with pyogrio.open_arrow(
            self.folder / PACKAGE, layer=LONG, use_pyarrow=True, read_geometry=False,
            columns=["tile_id", "occupied_s", "observed_s"],
        ) as (_, reader):  # fmt: skip
            for batch in reader:
                rows = [
                    np.nan_to_num(batch.column(name).to_numpy(zero_copy_only=False))
                    for name in ("tile_id", "occupied_s", "observed_s")
                ]
                start = 0
                while start < len(rows[0]):
                    stop = min(start + len(ids) - filled, len(rows[0]))
                    place = slice(filled, filled + stop - start)
                    self._require(np.array_equal(rows[0][start:stop], ids[place]))
                    occupied[place], observed[place] = (each[start:stop] for each in rows[1:])
                    filled, start = filled + stop - start, stop
                    if filled == len(ids):
                        yield Seconds(occupied.copy(), observed.copy())
                        filled = 0
        self._require(filled == 0)

    def _require(self, fits: bool) -> None:  # noqa: FBT001 - a test, not an option
        if not fits:
            raise InputError(
                f"{self.folder / PACKAGE}: layer {LONG} does not hold each tile once an interval",
                hint=_HINT,
            )


def read_traffic(folder: Path) -> Traffic:
    """Read a heat map; its intervals are read later, one by one.

    Raises
    ------
    InputError
        If the folder holds no heat map, or a damaged one.
    """
    package = folder / PACKAGE
    try:
        tiles = pyogrio.read_dataframe(package, layer=WIDE, columns=list(COLUMNS), use_arrow=True)
        notes = pyogrio.read_info(package, layer=WIDE)["layer_metadata"] or {}
        with closing(sqlite3.connect(f"{package.resolve().as_uri()}?mode=ro", uri=True)) as base:
            times = base.execute(_TIMES).fetchall()
    except (
        pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, sqlite3.Error, OSError,
    ) as error:  # fmt: skip
        reason = str(error).splitlines()[0]
        raise InputError(f"{package}: not a heat map: {reason}", hint=_HINT) from error
    missing = [name for name in COLUMNS if name not in tiles]
    if missing or tiles.empty or not times:
        lacks = f"the column {missing[0]}" if missing else "any row"
        raise InputError(f"{package}: not a heat map: it lacks {lacks}", hint=_HINT)
    crs = metric_crs(tiles.crs, what=str(package))
    intervals = [(datetime.fromisoformat(a), datetime.fromisoformat(b)) for a, b in times]
    return Traffic(
        folder=folder,
        tiles=tiles.sort_values("tile_id", ignore_index=True),
        crs=crs,
        fingerprint=str(notes.get("fingerprint", "")),
        whole=_whole(notes) or (intervals[0][0], intervals[-1][1]),
        intervals=intervals,
    )


def _whole(notes: Mapping[str, str]) -> Span | None:
    """Return the time from the first to the last frame, as the layer says it."""
    try:
        return datetime.fromisoformat(notes["begin"]), datetime.fromisoformat(notes["end"])
    except (KeyError, ValueError):
        return None
