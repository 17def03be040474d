"""Questions to a dataset over months: roll-ups, profiles of streets, the map of a month."""

from __future__ import annotations

import pandas as pd
import pyarrow as pa

from gis_radar.dataset.rollups import RollUps
from gis_radar.dataset.source import Source
from gis_radar.dataset.table_schema import TableSchema
from gis_radar.dataset.tables import LANE_MONTHS, TILE_MONTHS
from gis_radar.dataset.units import for_people


class Questions:
    """Methods of a dataset that answer questions over months."""

    def lane_months(self: Source, *, month: str | None = None) -> pd.DataFrame:
        """Read the sums of lane measures by month, weekday and hour, by the clocks of the site.

        Parameters
        ----------
        month : str, optional
            Such as `2026-10`; by default all.

        Returns
        -------
        DataFrame
            `month`, and the columns of the files.
        """
        return _read(self, LANE_MONTHS, month)

    def tile_months(self: Source, *, month: str | None = None) -> pd.DataFrame:
        """Read the sums of tile counts by month and hour of the day; as :meth:`lane_months`."""
        return _read(self, TILE_MONTHS, month)


def roll_ups(dataset: Source) -> RollUps:
    """Return the maker and reader of the roll-ups of a dataset."""
    manifest = dataset.manifest
    return RollUps(
        folder=dataset.folder, fingerprint=manifest.fingerprint, timezone=manifest.timezone
    )


def _read(dataset: Source, table: TableSchema, month: str | None) -> pd.DataFrame:
    rolled = roll_ups(dataset)
    span = None if month is None else dataset.span(*rolled.edges(month))
    known = dataset.records(span)
    months = rolled.months(known) if month is None else [month]
    parts = [rolled.read(table, each, known) for each in months]
    whole = pa.concat_tables([table.empty(), *parts])
    found = for_people(whole, dataset.manifest.origin)
    lengths = [len(each) for each in parts]
    found.insert(0, "month", pd.Series(months, dtype=object).repeat(lengths).to_list())
    return found
