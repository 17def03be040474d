"""Interface of a dataset for the modules that compute from its tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import geopandas as gpd
import pandas as pd
import pyarrow as pa

from gis_radar.base import InputError
from gis_radar.dataset.files.manifest import Manifest
from gis_radar.dataset.files.records import HourRecord, Span
from gis_radar.dataset.files.schema import TableSchema

Moment: TypeAlias = str | datetime | int | None
"""A time as ISO 8601 text or with its zone; without one by the clocks of the site; or a step."""


class Source(Protocol):
    """A dataset, as the modules that compute from its tables use it."""

    @property
    def folder(self) -> Path:
        """The dataset's folder."""

    @property
    def cache(self) -> dict[Any, Any]:
        """Results that several questions need, by key."""

    @property
    def crs(self) -> str:
        """Coordinate system of the map frame."""

    @property
    def timezone(self) -> str:
        """Time zone of the site."""

    @property
    def has_vehicles(self) -> bool:
        """Whether vehicles were looked for."""

    def span(self, begin: Moment = None, end: Moment = None) -> Span | None:
        """Return the first and the last step between two times."""

    @property
    def manifest(self) -> Manifest:
        """The manifest, with time zone and coordinate system."""

    def records(self, span: Span | None = None) -> dict[int, HourRecord]:
        """Return the records of its complete hours."""

    def single_table(self, table: TableSchema) -> pa.Table:
        """Read a table that is one file."""

    def layer(self, name: str) -> gpd.GeoDataFrame:
        """Read a layer of its tiles."""

    def poses(self) -> gpd.GeoDataFrame:
        """Read the poses of the sensors."""

    def sights(self) -> pd.DataFrame:
        """Read the tiles in sight of each pose."""

    def batches(
        self, table: TableSchema, span: Span | None = None, columns: Sequence[str] | None = None
    ) -> Iterator[pa.Table]:
        """Read the rows of a table, an hour (or date) at a time."""

    def continued(self) -> pd.DataFrame:
        """Read the pairs of numbers of one vehicle on either side of an hour's begin."""


class NoVehiclesError(InputError):
    """A dataset in which vehicles were not looked for."""


def require_vehicles(dataset: Source) -> None:
    """Refuse a dataset in which vehicles were not looked for."""
    if not dataset.has_vehicles:
        raise NoVehiclesError(
            "{}: holds no vehicles", dataset.folder, hint="measure it again, with vehicles"
        )
